"""Metres without a radio, from taped lengths or from printed tags in the photos; and both beside ranges."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from scipy.spatial.distance import pdist
from tests.known import assert_scale, known
from tests.outputs import paths_in
from tests.simulated.files import write_rows
from tests.simulated.model import SyntheticModel
from tests.simulated.tagged_room import DICTIONARY, NUM_TAGS, SIDE_M, tagged_room

from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape_file import read_markers
from rangesfm.pipeline.check import check_survey
from rangesfm.pipeline.run import refine_model, scale_model
from rangesfm.progress import Progress
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.settings import Survey

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey

QUIET = Progress()


@dataclass(frozen=True)
class Room:
    """Photos of a room with tags, their model, and the truth."""

    folder: Path
    made: SyntheticModel

    def survey(self, where: Path, **values: object) -> Survey:
        given = {key.replace("__", "."): value for key, value in values.items()}
        survey = Survey().changed({"images.model": self.folder / "sparse"})
        return survey.changed({"images.path": self.folder / "photos", "output.path": where / "out", **given})

    def taped(self, where: Path, pairs: Sequence[tuple[int, int]], *wrong_m: float) -> Path:
        """Write a file of lengths between cameras, accurate to 5 mm."""
        names, rng = list(self.made.timestamps_s), np.random.default_rng(1)
        lines = ["from,to,distance_m,stddev_m"]
        for k, (a, b) in enumerate(pairs):
            length_m = np.linalg.norm(self.made.centers_m[a] - self.made.centers_m[b]) + 0.005 * rng.standard_normal()
            lines.append(f"{names[a]},{names[b]},{length_m + (wrong_m[k] if k < len(wrong_m) else 0.0):.4f},0.005")
        path = where / "distances.csv"
        path.write_text("\n".join(lines) + "\n")
        return path


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    folder = tmp_path_factory.mktemp("room")
    return Room(folder, tagged_room(folder / "photos"))


NUM_MAPPED = 5
PAIRS = ((0, 7), (1, 6), (0, 5), (2, 7))


def test_three_taped_lengths_make_metres_and_no_word_is_said_of_ranges(room: Room, tmp_path: Path) -> None:
    survey = room.survey(tmp_path, scale__distances=room.taped(tmp_path, PAIRS[:3]))
    result = refine_model(survey, progress=QUIET)
    summary = result.summary
    assert_scale(summary, room.made.metric_from_sfm.scale, 0.005)
    assert (summary.scale.verdict, summary.frame, summary.scale.method) == ("good", "first_camera", "lengths")
    assert known(summary.refine).scale_value == pytest.approx(room.made.metric_from_sfm.scale, rel=0.005)
    assert [row.name for row in summary.tests] == ["length"] * 3
    assert not any(row.rejected for row in summary.tests)
    assert max(abs(known(row.residual_m)) for row in summary.distances) < 0.015
    assert not {"ranges.csv", "scale_candidates.csv", "scale_consensus.csv"} & {
        path.name for path in paths_in(survey.output.path)
    }
    page = (survey.output.path / "report.html").read_text()
    assert not [word for word in ("Ranges used", "Range RMS", "Clock offset") if f">{word}<" in page]
    assert not any(line.startswith("ranges:") for line in result.lines)
    assert ResultSummary.read(survey.output.path / "result.json") == summary


def test_a_mistyped_length_among_four_is_named_and_left_out(room: Room, tmp_path: Path) -> None:
    survey = room.survey(tmp_path, scale__distances=room.taped(tmp_path, PAIRS, 0.0, 1.0))
    summary = scale_model(survey, progress=QUIET).summary
    assert_scale(summary, room.made.metric_from_sfm.scale, 0.005)
    assert summary.scale.verdict == "doubtful"
    between = f"{summary.distances[1].from_} to {summary.distances[1].to}"
    assert (summary.tests[0].subject, summary.tests[0].rejected) == (between, True)
    assert known(summary.tests[0].size) == pytest.approx(1.0, abs=0.1)
    assert f"probably the length from {between}" in summary.scale.reasons[0]
    assert [row.kind for row in summary.distances] == ["control", "left out", "control", "control"]


@pytest.mark.parametrize("pairs", [((0, 7),), ((0, 7), (7, 0))], ids=["once", "twice"])
def test_of_one_length_the_verdict_says_that_nothing_checks_it(
    room: Room, tmp_path: Path, pairs: Sequence[tuple[int, int]]
) -> None:
    survey = room.survey(tmp_path, scale__distances=room.taped(tmp_path, pairs))
    summary = scale_model(survey, progress=QUIET).summary
    assert summary.scale.verdict == "doubtful"
    assert "one length that nothing checks" in summary.scale.reasons[0]
    assert (summary.tests[0].smallest_detectable is None) == (len(pairs) == 1)
    assert known(summary.reliability).scale_within is None


def test_a_map_that_needs_no_times_is_compared_with_a_truth_that_has_them(room: Room, tmp_path: Path) -> None:
    times, truth = tmp_path / "times.csv", tmp_path / "truth.csv"
    write_rows(times, "image_name,timestamp_s", room.made.timestamps_s.items())
    path = zip(room.made.timestamps_s.values(), *room.made.centers_m.T, strict=True)
    write_rows(truth, "timestamp_s,x_m,y_m,z_m", path)
    survey = room.survey(tmp_path, scale__distances=room.taped(tmp_path, PAIRS[:3]), images__times=times)
    result = scale_model(survey.changed({"report.reference": truth}), progress=QUIET)
    assert result.summary.comparison[0].num_keyframes == len(room.made.timestamps_s)


def test_photos_of_printed_tags_become_a_metric_map_by_init_and_run(room: Room, tmp_path: Path) -> None:
    names = sorted(room.made.timestamps_s)[:NUM_MAPPED]
    (tmp_path / "photos").mkdir()
    for name in names:
        shutil.copy(room.folder / "photos" / name, tmp_path / "photos")
    size = ("--marker_dictionary", DICTIONARY, "--marker_side_m", str(SIDE_M))
    assert main(["init", str(tmp_path), *size]) == 0
    assert main(["run", str(tmp_path / "survey.toml")]) == 0
    summary = ResultSummary.read(tmp_path / "out" / "result.json")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse_metric" / "0")
    found = {image.name: image.projection_center() for image in model.images.values()}
    assert sorted(found) == names
    too_long = np.sum(pdist([found[name] for name in names])) / np.sum(pdist(room.made.centers_m[:NUM_MAPPED]))
    low, high = known(summary.scale.interval_95)
    assert known(low) < summary.scale.value / too_long < known(high)
    assert high / low < 1.03
    assert len(summary.distances) == 4 * NUM_TAGS
    again = read_markers(tmp_path / "out" / "markers.csv")
    assert {name: len(marker.image_names) for name, marker in again.items()} == {
        f"tag{tag}.{corner}": NUM_MAPPED for tag in range(NUM_TAGS) for corner in range(4)
    }


def test_corners_of_tags_are_ends_of_taped_lengths(room: Room, tmp_path: Path) -> None:
    distances = tmp_path / "distances.csv"
    distances.write_text("from,to,distance_m\ntag0.0,tag2.0,1.7\ntag0.2,tag2.2,1.7\n")
    survey = room.survey(tmp_path, markers__dictionary=DICTIONARY, scale__distances=distances)
    assert_scale(scale_model(survey, progress=QUIET).summary, room.made.metric_from_sfm.scale, 0.01)


def test_where_no_tag_is_one_line_says_so(room: Room, tmp_path: Path) -> None:
    survey = room.survey(tmp_path, markers__dictionary="4X4_50", markers__side_m=SIDE_M)
    with pytest.raises(InputError, match="no tag of 4X4_50 in 8 photos: is it another dictionary"):
        scale_model(survey, progress=QUIET)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({}, "no ranges and no lengths: give a radio's log"),
        ({"markers__dictionary": DICTIONARY}, r"\[markers\] side_m is not given: give the tags' side"),
    ],
)
def test_where_nothing_says_how_long_a_metre_is_what_is_missing_is_said(
    room: Room, tmp_path: Path, values: dict[str, object], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        scale_model(room.survey(tmp_path, **values), progress=QUIET)


def test_an_end_that_no_photo_shows_is_named_with_its_line(room: Room, tmp_path: Path) -> None:
    distances = tmp_path / "distances.csv"
    distances.write_text("from,to,distance_m\ndoor,wall,2\n")
    with pytest.raises(InputError, match=r"distances.csv:2: an end is 'door', expected a photo that is in the model"):
        scale_model(room.survey(tmp_path, scale__distances=distances), progress=QUIET)


def test_check_tells_what_a_survey_without_a_radio_has(room: Room, tmp_path: Path) -> None:
    distances = room.taped(tmp_path, PAIRS)
    checked = check_survey(room.survey(tmp_path, scale__distances=distances, markers__dictionary=DICTIONARY))
    assert not checked.faults
    assert "taped distances: 4, which alone determine the scale (no ranges)" in checked.facts
    assert f"tags: those of {DICTIONARY} will be looked for in the photos" in checked.facts
    assert not [fact for fact in checked.understood() if "anchor" in fact]


@pytest.mark.parametrize("factor", [1.0, 1.3])
def test_ranges_and_lengths_check_each_other(walked_survey: WalkedSurvey, tmp_path: Path, factor: float) -> None:
    model = pycolmap.Reconstruction(walked_survey.folder / "sparse" / "0")
    images = sorted(model.images.values(), key=lambda image: image.name)
    first, middle = images[0], images[len(images) // 2]
    base = walked_survey.survey(tmp_path / "out").changed({"report.enabled": False})
    length = float(np.linalg.norm(first.projection_center() - middle.projection_center()))
    distances = tmp_path / "d.csv"
    length_m = factor * length * walked_survey.site_from_sfm.scale
    distances.write_text(f"from,to,distance_m\n{first.name},{middle.name},{length_m:.4f}\n")
    summary = scale_model(base.changed({"scale.distances": distances}), progress=QUIET).summary
    by_kind = summary.scale.by_kind
    assert by_kind["lengths"].value / by_kind["ranges"].value == pytest.approx(factor, rel=0.03)
    said = [reason for reason in summary.scale.reasons if "by the measured lengths the map is" in reason]
    assert bool(said) == (factor != 1.0)
