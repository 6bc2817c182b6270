"""Models without a common photo are joined through anchors as the truth has them, or left out if they cannot be."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.known import known
from tests.simulated.model import random_similarity, synthetic_model
from tests.simulated.path import along, loop_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.cli import main
from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.transform import rescale, without_photos
from rangesfm.demo.simulated_radio import CameraPath, Radio
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.model_placement import Piece, place_pieces
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import local_site
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.pipeline.join_models import join_models
from rangesfm.pipeline.metric_result import ModelVerdict
from rangesfm.pipeline.run import run_survey, scale_model
from rangesfm.progress import Journal, Progress
from rangesfm.sfm.reconstruct import ReconstructionSummary
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.similarity import align_points
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
ANCHORS_M = {"A1": (-6.0, -5.0, 0.5), "A2": (6.0, -5.0, 2.5), "A3": (6.0, 5.0, 0.7), "A4": (-6.0, 5.0, 2.2)}
NUM_PHOTOS = 28
HALF = NUM_PHOTOS // 2


@dataclass(frozen=True)
class Halves:
    """One walk, mapped in two halves that have no photo or point in common.

    Attributes:
        parts: the paths of the halves, each in a world and a unit of its own.
        log: ranges of both halves.
        centers_m: (n, 3) true centres.
        first_camera: (3, 3) true world_from_cam of the first photo.
    """

    parts: tuple[PathOfModel, ...]
    log: RangeLog
    centers_m: Array
    first_camera: Array

    def with_ranges(self, wanted: npt.NDArray[np.bool_]) -> Halves:
        """Return the same halves with these ranges only."""
        log = self.log.subset(wanted)
        parts = (replace(p, observations=associate(log, p.trajectory, TAG_IN_CAM_M)) for p in self.parts)
        return replace(self, log=log, parts=tuple(parts))

    def join(
        self, frame: str, known: tuple[str, ...] = tuple(ANCHORS_M)
    ) -> tuple[PathOfModel, tuple[ModelVerdict, ...], list[str]]:
        """Join both, and return the model, the verdicts and the warnings."""
        positions = {name: np.array(ANCHORS_M[name]) for name in known}
        if frame == "first_camera":
            positions = {name: (at - self.centers_m[0]) @ self.first_camera for name, at in positions.items()}
        anchors = [Anchor(name, None if frame == "unknown" else positions.get(name)) for name in self.log.anchor_ids]
        arms, (site, _) = np.array([TAG_IN_CAM_M]), local_site((), "unknown", "")
        inputs = RangingInputs(self.log, arms, tuple(anchors), frame, site, Tape())
        survey = Survey().changed({"scale.max_relative_stddev": 0.2})
        journal = Journal(Progress())
        return *join_models(SurveyRun(survey, inputs, journal), self.parts), journal.warnings

    def off_m(self, centers: Array, *, with_scale: bool = True) -> float:
        """Return the largest distance of a photo from the truth after the best similarity (or rigid motion) of all."""
        aligned = align_points(centers, self.centers_m, with_scale=with_scale).apply(centers)
        return float(np.linalg.norm(aligned - self.centers_m, axis=1).max())

    def write(self, folder: Path) -> Survey:
        """Write the log and the times of the photos; return a survey that only lacks photos or a model."""
        write_ranges_csv(self.log, folder / "uwb.csv")
        rows = ["image_name,timestamp_s\n"]
        for path in (part.trajectory for part in self.parts):
            rows += [f"{name},{time!r}\n" for name, time in zip(path.image_names, path.times_s.tolist())]
        (folder / "images.csv").write_text("".join(rows))
        return Survey().changed(
            {
                "images.times": folder / "images.csv",
                "ranges.path": folder / "uwb.csv",
                "ranges.time_offset": 0.0,
                "anchors.frame": "unknown",
                "tag.tag_in_cam_m": TAG_IN_CAM_M,
                "scale.max_relative_stddev": 0.2,
                "refine.enabled": False,
                "export.formats": (),
                "report.enabled": False,
                "output.path": folder / "out",
            }
        )


def walked() -> CameraPath:
    """Return a loop with large changes of height."""
    level = loop_path(NUM_PHOTOS + 2.0, start_s=99.0, seed=3)
    knots = np.linspace(99.0, 101.0 + NUM_PHOTOS, NUM_PHOTOS + 3)
    centers = level.centers(knots) + np.outer(0.8 * np.sin(0.9 * knots), [0, 0, 1])
    return CameraPath.through(knots, centers, level.world_from_cam(knots))


def walk(anchors_m: Mapping[str, tuple[float, float, float]] = ANCHORS_M) -> Halves:
    """Simulate its photos, and ranges to four anchors at each."""
    path = walked()
    times = np.arange(100.0, 100.0 + NUM_PHOTOS)
    made = synthetic_model(*along(path, times), num_observations=30, max_track_length=8, seed=1)
    at = np.repeat(times, 2)
    log = simulate_ranges_at(at, path.centers(at), path.world_from_cam(at), anchors_m, TAG_IN_CAM_M, Radio(), 5)
    names, rng, parts = list(made.timestamps_s), np.random.default_rng(0), []
    for number, others in enumerate((names[HALF:], names[:HALF])):
        model = rescale(without_photos(made.reconstruction, others), random_similarity(rng))
        trajectory = trajectory_from_reconstruction(model, made.timestamps_s)
        parts.append(PathOfModel(f"sparse/{number}", model, trajectory, associate(log, trajectory, TAG_IN_CAM_M)))
    return Halves(tuple(parts), log, made.centers_m, made.world_from_cam[0])


@pytest.fixture(scope="module")
def exact() -> Halves:
    return walk()


def of_half(halves: Halves, number: int) -> npt.NDArray[np.bool_]:
    """(n,) whether each range was taken in this half."""
    in_second: npt.NDArray[np.bool_] = halves.log.timestamp_s >= 99.5 + HALF
    return in_second if number == 1 else ~in_second


def test_halves_of_a_walk_are_where_they_were_if_the_anchors_are_known(exact: Halves) -> None:
    """The anchors are given in the frame of the first photo; the second half treats it as a site frame."""
    path, verdicts, _ = exact.join("first_camera")
    assert exact.off_m(path.trajectory.centers) < 1e-6
    assert [verdict.joined_from_sfm is not None for verdict in verdicts] == [True, True]
    own = [verdict.estimate.value for verdict in verdicts if verdict.estimate is not None]
    assert own[1] != pytest.approx(own[0], rel=0.1)
    assert path.sfm.num_reg_images() == NUM_PHOTOS
    assert path.sfm.is_valid()
    observations = path.observations
    assert observations.has_place.all()
    predicted = observations.centers[observations.before == HALF + 3]
    assert predicted == pytest.approx(np.tile(path.trajectory.centers[HALF + 3], (len(predicted), 1)), abs=1e-9)


def test_anchors_that_noise_moves_are_not_called_elsewhere_and_all_ranges_count_in_the_end(
    exact: Halves, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise_m = 0.05 * np.random.default_rng(0).standard_normal(len(exact.log))
    noisy = replace(exact, log=replace(exact.log, range_m=exact.log.range_m + noise_m))
    rough = noisy.with_ranges(np.ones(len(noise_m), dtype=bool))
    _, verdicts, warnings = rough.join("unknown")
    assert warnings == []
    # Places are searched for with a part of the ranges.
    monkeypatch.setattr("rangesfm.estimation.scale.model_placement.ENOUGH_TO_SEARCH", 6)
    estimates = [known(verdict.estimate) for verdict in verdicts]
    pairs = zip(rough.parts, estimates, strict=True)
    pieces = [Piece(part.trajectory, each, False, each.metric_from_sfm) for part, each in pairs]
    again = place_pieces(dict(enumerate(pieces)))[0][1]
    assert again.scale == pytest.approx(known(verdicts[1].joined_from_sfm).scale, rel=1e-6)


def test_an_anchor_that_was_moved_between_the_halves_is_named_and_moves_neither(exact: Halves) -> None:
    of_both, there = exact.log, walk(ANCHORS_M | {"A2": (6.0, -3.0, 2.0)}).log
    log = replace(of_both, range_m=np.where(of_half(exact, 1), there.range_m, of_both.range_m))
    path, _, warnings = replace(exact, log=log).with_ranges(np.ones(len(log), dtype=bool)).join("unknown")
    (warning,) = warnings
    assert re.fullmatch(r"anchor A2 is (1\.\d|2\.1) m elsewhere by another model", warning)
    assert exact.off_m(path.trajectory.centers) < 1e-6


def test_a_half_that_shares_too_few_anchors_is_left_out_and_nothing_invented(exact: Halves) -> None:
    index = exact.log.anchor_ids.index("A1")
    halves = exact.with_ranges(of_half(exact, 0) | (exact.log.anchor_index == index))
    path, (first, second), _ = halves.join("site", ("A1",))
    assert (first.joined_from_sfm is not None, first.reason) == (True, "")
    assert second.joined_from_sfm is None
    assert "every turn about anchor A1 fits" in second.reason
    assert path.sfm is halves.parts[0].sfm


def test_a_half_without_ranges_is_left_out_and_one_that_others_join_must_have_some(exact: Halves) -> None:
    num = len(exact.log) // 2
    second = exact.with_ranges(of_half(exact, 0)).join("unknown")[1][1]
    assert second.estimate is None
    assert f"0 of {num} ranges lie on the path" in second.reason
    with pytest.raises(GeometryError, match=f"0 of {num} ranges lie on the path"):
        exact.with_ranges(of_half(exact, 1)).join("unknown")


def photographed(halves: Halves, folder: Path) -> Survey:
    """Write the halves with photos that nobody reads, and return their survey."""
    (folder / "photos").mkdir()
    for part in halves.parts:
        for name in part.trajectory.image_names:
            (folder / "photos" / name).touch()
    return halves.write(folder).changed({"images.path": folder / "photos"})


def test_a_run_joins_what_the_mapper_left_in_pieces(
    exact: Halves, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [name for part in exact.parts for name in part.trajectory.image_names]
    models = tuple(part.sfm for part in exact.parts)

    def reconstruct(*_: Any, **__: Any) -> ReconstructionSummary:
        return ReconstructionSummary(models, {}, {}, tmp_path / "mapper.log")

    monkeypatch.setattr("rangesfm.pipeline.map_photos.reconstruct_in", reconstruct)
    survey = photographed(exact, tmp_path)
    result = run_survey(survey, progress=Progress()).summary
    path = trajectory_from_reconstruction(read_model(tmp_path / "out" / "sparse_scaled" / "0"))
    assert path.image_names == tuple(names)
    assert exact.off_m(path.centers, with_scale=False) < 1e-6
    assert [(model.name, model.joined, model.num_images) for model in result.models] == [
        ("sparse/0", True, HALF),
        ("sparse/1", True, HALF),
    ]
    for part, model, first in zip(exact.parts, result.models, (0, HALF), strict=True):
        own, motion = model.scale, known(model.metric_from_sfm)
        low, high = known(own.interval_95)
        assert low < known(own.value) < high
        assert own.verdict in ("good", "doubtful")
        at = motion.similarity.apply(part.trajectory.centers[0])
        assert at == pytest.approx(path.centers[first], abs=1e-6)
    assert result.metric_from_sfm.scale == pytest.approx(known(result.models[0].metric_from_sfm).scale)


def test_a_run_joins_models_that_positions_have_placed(
    exact: Halves, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without any range, and with a clock that has to be found."""
    models, times = tuple(part.sfm for part in exact.parts), np.arange(100.4, 99.0 + NUM_PHOTOS, 0.5)
    monkeypatch.setattr(
        "rangesfm.pipeline.map_photos.reconstruct_in",
        lambda *_, **__: ReconstructionSummary(models, {}, {}, tmp_path / "mapper.log"),
    )
    at_m = walked().centers(times) + walked().world_from_cam(times) @ TAG_IN_CAM_M
    rows = (f"{t + 7.0},{x},{y},{z}" for t, (x, y, z) in zip(times.tolist(), at_m.tolist(), strict=True))
    (tmp_path / "positions.csv").write_text("\n".join(["timestamp_s,x_m,y_m,z_m", *rows]))
    survey = photographed(exact, tmp_path).changed(
        {
            "ranges.path": None,
            "ranges.time_offset": None,
            "tag.tag_in_cam_m": None,
            "positions.path": tmp_path / "positions.csv",
            "positions.antenna_in_cam_m": TAG_IN_CAM_M,
        }
    )
    result = run_survey(survey, progress=Progress()).summary
    assert [model.joined for model in result.models] == [True, True]
    path = trajectory_from_reconstruction(read_model(tmp_path / "out" / "sparse_scaled" / "0"))
    assert exact.off_m(path.centers, with_scale=False) < 0.05


@pytest.fixture(scope="module")
def finished(exact: Halves, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scale each half as a survey of its own, and return the folder."""
    folder = tmp_path_factory.mktemp("surveys")
    for part, day in zip(exact.parts, ("monday", "tuesday"), strict=True):
        (folder / day).mkdir()
        part.sfm.write(folder / day)
        survey = exact.write(folder).changed({"output.path": folder / day / "out"})
        survey = survey.changed({"images.model": folder / day})
        scale_model(survey, progress=Progress())
    return folder


def test_surveys_of_two_days_become_one_map(
    exact: Halves, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(finished)
    assert main(["join", "monday/out", "tuesday/out", "--output_path", str(tmp_path / "site")]) == 0
    assert "verdict:" in capsys.readouterr().out
    result = json.loads((tmp_path / "site" / "result.json").read_text())
    assert [(model["name"], model["joined"]) for model in result["models"]] == [("monday", True), ("tuesday", True)]
    path = trajectory_from_reconstruction(read_model(tmp_path / "site" / "sparse_metric" / "0"))
    assert exact.off_m(path.centers, with_scale=False) < 1e-4
    assert not any("hold the map together" in reason for reason in result["scale"]["reasons"])
    log = exact.log  # a range that both surveys have counts once
    assert result["ranges"]["num_used"] == len({*zip(known(log.timestamp_s), log.anchor_index, strict=True)})
    assert (tmp_path / "site" / "report.html").is_file()


def test_a_copy_of_a_survey_does_not_count_twice(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(finished / "monday" / "out", tmp_path / "copy")
    monkeypatch.chdir(finished)
    folders = ("monday/out", "tuesday/out", str(tmp_path / "copy"))
    assert main(["join", *folders, "--output_path", str(tmp_path / "site")]) == 2
    said = f"rangesfm: error: {tmp_path / 'copy'}: has the photos and ranges of monday/out: expected each survey once"
    assert capsys.readouterr().err.splitlines()[-1] == said
    assert not (tmp_path / "site").exists()


def test_a_survey_that_nothing_holds_is_refused_in_one_line_and_leaves_nothing(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(finished / "tuesday" / "out", tmp_path / "tuesday")
    header, *rows = (tmp_path / "tuesday" / "ranges.csv").read_text().splitlines(keepends=True)
    column = header.split(",").index("anchor_id")
    kept = (row for row in rows if row.split(",")[column] in ("A1", "A2"))
    (tmp_path / "tuesday" / "ranges.csv").write_text(header + "".join(kept))
    monkeypatch.chdir(finished)
    assert main(["join", "monday/out", str(tmp_path / "tuesday"), "--output_path", str(tmp_path / "site")]) == 3
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("rangesfm: error: nothing can be joined to out: tuesday: ")
    assert "every turn about the line through A1 and A2 fits" in line
    assert not (tmp_path / "site").exists()
