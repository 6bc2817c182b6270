"""The pipeline from Python: what it returns, what it keeps of earlier runs, and what it never overwrites."""

from __future__ import annotations

import csv
import hashlib
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.known import known
from tests.listener import Listener
from tests.outputs import names_in
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.pipeline.export_result import export_result
from rangesfm.pipeline.run import refine_model, run_survey, scale_model
from rangesfm.progress import Progress
from rangesfm.result.places import path_in, recorded_path
from rangesfm.result.result_folder import ResultFolder, is_refined_model
from rangesfm.result.result_tables import ScaleCandidates, ScaleConsensus
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.settings import KEYS, Survey
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey


@pytest.fixture
def survey(walked_survey: WalkedSurvey, tmp_path: Path) -> Survey:
    return survey_of(walked_survey, tmp_path)


@pytest.fixture
def site_survey(survey: Survey, walked_survey: WalkedSurvey) -> Survey:
    return in_site_frame(survey, walked_survey)


def survey_of(walked_survey: WalkedSurvey, where: Path) -> Survey:
    """The walked survey with a known time offset and anchors in the frame of its first camera.

    It is scaled in half the time that the site frame takes, in which the map has to find its place.
    """
    anchors = walked_survey.folder / "anchors_first_camera.csv"
    in_camera = {"anchors.path": anchors, "anchors.frame": "first_camera"}
    return walked_survey.survey(where / "out").changed(in_camera)


def in_site_frame(survey: Survey, walked_survey: WalkedSurvey) -> Survey:
    return survey.changed({"anchors.path": walked_survey.folder / "anchors.csv", "anchors.frame": "site"})


@dataclass(frozen=True)
class Done:
    """The result of a stage on the survey, and its messages. Tests must not write to it."""

    survey: Survey
    result: ResultFolder
    listener: Listener


@pytest.fixture(scope="module")
def scaled(walked_survey: WalkedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Done:
    survey, listener = survey_of(walked_survey, tmp_path_factory.mktemp("scaled")), Listener()
    return Done(survey, scale_model(survey, progress=listener), listener)


@pytest.fixture(scope="module")
def refined(walked_survey: WalkedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The survey in the site frame, compared with the truth."""
    survey, listener = (
        in_site_frame(survey_of(walked_survey, tmp_path_factory.mktemp("refined")), walked_survey),
        Listener(),
    )
    survey = survey.changed({"report.reference": walked_survey.folder / "reference.csv"})
    return Done(survey, refine_model(survey, progress=listener), listener)


def files_of(folder: Path) -> set[str]:
    return set(names_in(folder))


def test_result_and_summary_are_returned_as_written(refined: Done) -> None:
    done = refined.result
    assert refined.listener.stages == ["scale", "refinement", "judgement", "advice", "results", "report"]
    assert done.output_path == refined.survey.output.path
    written = ResultSummary.read(done.output_path / "result.json")
    assert written == done.summary
    assert done.lines[0] == f"accuracy: {done.summary.scale.in_words} (95 % interval)"
    assert done.lines[1].startswith(f"scale: {done.summary.scale.value:.6g} m per SfM unit")
    assert str(done) == repr(done) == "\n".join(done.lines)
    assert "comparison" in written.to_json()


def test_a_run_in_the_same_folder_leaves_nothing_of_the_one_before(survey: Survey, refined: Done) -> None:
    shutil.copytree(refined.survey.output.path, survey.output.path)
    assert {"sparse_metric", "reference.csv", "report.html"} <= files_of(survey.output.path)
    assert is_refined_model(survey.output.path / "sparse_metric" / "0")
    assert not is_refined_model(survey.output.path / "sparse_scaled" / "0")
    assert not is_refined_model(known(survey.images.model))
    written = (survey.output.path / "result.json").read_text()
    (survey.output.path / "result.json").write_text("{}")
    assert not is_refined_model(survey.output.path / "sparse_metric" / "0"), "of another program"
    (survey.output.path / "result.json").write_text(written)
    second = survey.changed({"export.formats": (), "report.enabled": False})
    scaled = scale_model(second, progress=Progress()).summary
    assert "comparison" not in scaled.to_json()
    left = files_of(survey.output.path) - {"trajectory.tum", "points.ply"}  # exported by request, not part of a result
    scale_tables = {"scale_candidates.csv", "scale_consensus.csv"}
    assert left == {"sparse_scaled", "result.json", "ranges.csv", "images.csv", *scale_tables}


def test_tables_beside_the_result_tell_how_the_scale_came_about(scaled: Done) -> None:
    scale = scaled.result.summary.scale
    folder, paper = scaled.survey.output.path, known(scale.two_candidate)
    candidates, consensus = known(ScaleCandidates.read(folder)), known(ScaleConsensus.read(folder))
    for values, branch in zip((candidates.alpha0, candidates.alpha1), (paper.alpha0, paper.alpha1)):
        assert values.mean() == pytest.approx(branch.mean, rel=1e-4)
        assert values.std(ddof=1) == pytest.approx(branch.std, rel=1e-4)
    assert consensus.scale[np.argmax(consensus.num_agreeing)] == pytest.approx(scale.value, rel=0.02)
    assert consensus.num_agreeing.max() > 0.95 * len(candidates.alpha0)
    parts = np.array(list(scale.relative_stddev.components.values()))
    assert known(scale.stddev_empirical) == pytest.approx(scale.value * np.linalg.norm(parts), rel=1e-4)


def test_the_result_names_its_inputs_by_their_hashes(scaled: Done) -> None:
    survey = scaled.survey
    inputs = scaled.result.summary.inputs
    by_path = {path_in(survey.output.path, entry.path): entry.to_json() for entry in inputs}
    assert survey.ranges.path is not None
    data = survey.ranges.path.read_bytes()
    expected = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data), "hashed": "content"}
    recorded = recorded_path(survey.ranges.path, survey.output.path)
    assert by_path[survey.ranges.path] == {"path": recorded, **expected}
    assert {path.name for path in by_path} >= {"cameras.bin", "images.bin", "points3D.bin", "uwb.csv"}


def test_ranges_held_out_check_the_result(survey: Survey) -> None:
    result = refine_model(survey.changed({"ranges.check_share": 0.25}), progress=Progress()).summary
    with (survey.output.path / "ranges.csv").open(newline="") as file:
        statuses = Counter(row["status"] for row in csv.DictReader(file))
    num_on_path = sum(statuses[name] for name in ("used", "down-weighted", "outlier", "check"))
    assert result.check_ranges.num == statuses["check"]
    assert statuses["check"] == pytest.approx(0.25 * num_on_path, rel=0.05)
    assert result.check_ranges.rms_m == pytest.approx(0.05, rel=0.3)
    assert result.ranges.num_used == statuses["used"] + statuses["down-weighted"]


def test_an_anchor_and_a_stretch_of_time_can_be_held_out(survey: Survey) -> None:
    log = read_ranges(survey.ranges.path or "")
    anchor_id, times = log.anchor_ids[0], tuple(np.quantile(log.timestamp_s, [0.4, 0.5]).tolist())
    checked = survey.changed({"ranges.check_anchors": (anchor_id,), "ranges.check_times_s": times})
    result = refine_model(checked, progress=Progress()).summary
    with (survey.output.path / "ranges.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["predicted_refined_m"]]
    held_out = {True: Counter[bool](), False: Counter[bool]()}
    for row in rows:
        wanted = row["anchor_id"] == anchor_id or times[0] <= float(row["timestamp_s"]) <= times[1]
        held_out[wanted][row["status"] == "check"] += 1
    assert held_out[True] == {True: result.check_ranges.num}
    assert not held_out[False][True]
    assert result.ranges.per_anchor[anchor_id].num_used == 0
    assert result.check_ranges.per_anchor[anchor_id].rms_m == pytest.approx(0.05, rel=0.4)


@pytest.mark.parametrize(
    ("checks", "frame", "said"),
    [
        ({"check_anchors": ("nobody",)}, "site", "the position of anchor 'nobody' is not known, .*"),
        ({"check_anchors": ("A1",)}, "unknown", "the position of anchor 'A1' is not known, .* none"),
        ({"check_times_s": (-20.0, -10.0)}, "site", "no range from -20 to -10 s, expected within .*"),
        (
            {"check_times_s": (1778768400.5, 1778768401.0)},
            "site",
            "no range from 1778768400.5 to 1778768401 s",
        ),
    ],
)
def test_what_cannot_be_held_out_is_refused(checks: dict[str, object], frame: str, said: str, survey: Survey) -> None:
    wrong = survey.changed({"anchors.frame": frame, **{f"ranges.{key}": value for key, value in checks.items()}})
    with pytest.raises(InputError, match=said):
        scale_model(wrong, progress=Progress())


LEVER_ARMS_M = {"left": (0.15, -0.1, 0.05), "right": (-0.15, 0.05, -0.1)}
ANCHORS_M = {"A1": (-6.0, -5.0, 0.5), "A2": (6.0, -5.0, 2.5), "A3": (6.0, 5.0, 0.7), "A4": (-6.0, 5.0, 4.2)}


class TestSeveralTags:
    """Two tags on the camera, without noise; there are also ranges between the anchors and between the tags."""

    @pytest.fixture(scope="class")
    @classmethod
    def made(cls) -> SyntheticModel:
        path, times = loop_path(42.0, start_s=0.0, seed=3), np.arange(1.0, 41.0)
        return synthetic_model(*along(path, times), num_observations=60, seed=1)

    @pytest.fixture(scope="class")
    @classmethod
    def survey(cls, made: SyntheticModel, tmp_path_factory: pytest.TempPathFactory) -> Survey:
        tmp_path = tmp_path_factory.mktemp("tags")
        (tmp_path / "sparse").mkdir()
        made.reconstruction.write(tmp_path / "sparse")
        rows = [
            "image_name,anchor_id,range_m,tag_id",
            "none.jpg,A1,12.0,A2",
            f"{next(iter(made.timestamps_s))},left,0.8,right",
        ]
        for tag_id, lever_arm in LEVER_ARMS_M.items():
            tags = made.centers_m + made.world_from_cam @ np.array(lever_arm)
            for anchor_id, position in ANCHORS_M.items():
                distances = np.linalg.norm(tags - position, axis=1).tolist()
                rows += [f"{name},{anchor_id},{d!r},{tag_id}" for name, d in zip(made.timestamps_s, distances)]
        (tmp_path / "uwb.csv").write_text("\n".join(rows))
        anchors = [f"{name},{x},{y},{z}" for name, (x, y, z) in ANCHORS_M.items()]
        (tmp_path / "anchors.csv").write_text("\n".join(["anchor_id,x_m,y_m,z_m", *anchors]))
        return Survey().changed(
            {
                "images.model": tmp_path / "sparse",
                "ranges.path": tmp_path / "uwb.csv",
                "anchors.path": tmp_path / "anchors.csv",
                "tag.lever_arms_m": LEVER_ARMS_M,
                "export.formats": (),
                "output.path": tmp_path / "out",
            }
        )

    def centers(self, survey: Survey, model: str) -> npt.NDArray[np.float64]:
        return trajectory_from_reconstruction(read_model(survey.output.path / model / "0")).centers

    @pytest.fixture(scope="class")
    @classmethod
    def exact(cls, survey: Survey) -> ResultFolder:
        """The refined map with the lever arm of each tag."""
        return refine_model(survey, progress=Progress())

    def test_map_is_exact_where_each_has_its_lever_arm(
        self, survey: Survey, exact: ResultFolder, made: SyntheticModel
    ) -> None:
        result = exact.summary
        assert result.scale.value == pytest.approx(made.metric_from_sfm.scale, rel=1e-6)
        np.testing.assert_allclose(self.centers(survey, "sparse_scaled"), made.centers_m, atol=1e-6)
        np.testing.assert_allclose(self.centers(survey, "sparse_metric"), made.centers_m, atol=1e-6)
        assert result.ranges.num_used == result.ranges.num == 8 * len(made.centers_m)
        assert known(result.ranges.rms_m) < 1e-6

    def test_map_is_wrong_with_the_lever_arms_of_each_other(self, survey: Survey, made: SyntheticModel) -> None:
        left, right = LEVER_ARMS_M.values()
        output = survey.output.path.with_name("swapped")
        swapped = survey.changed({"tag.lever_arms_m": {"left": right, "right": left}, "output.path": output})
        result = scale_model(swapped, progress=Progress()).summary
        assert np.abs(self.centers(swapped, "sparse_scaled") - made.centers_m).max() > 0.01
        assert known(result.ranges.rms_m) > 0.05

    def test_ranges_between_two_of_a_kind_are_in_the_results_with_their_status(
        self, survey: Survey, exact: ResultFolder
    ) -> None:
        result = exact.summary
        assert (result.ranges.num_anchor_anchor, result.ranges.num_tag_tag) == (1, 1)
        with (survey.output.path / "ranges.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["status"] in ("anchor-anchor", "tag-tag")]
        assert [(row["tag_id"], row["anchor_id"], row["range_m"], row["residual_m"]) for row in rows] == [
            ("right", "left", "0.8", ""),
            ("A2", "A1", "12.0", ""),
        ]


def test_what_the_refinement_found_beside_the_map_is_in_the_result(survey: Survey, refined: Done) -> None:
    stddevs = {"lever_arm_stddev_m": 0.05, "time_offset_stddev_s": 0.05, "short_range_stddev_m": 0.1}
    freed = survey.changed({f"refine.{key}": stddev for key, stddev in stddevs.items()})
    result = refine_model(freed, progress=Progress()).summary
    found = known(result.refine)
    (tag_id,) = found.tag_in_cam_m
    assert 0 < np.linalg.norm(np.subtract(found.tag_in_cam_m[tag_id], survey.tag.tag_in_cam_m)) < 0.15
    assert 0 < abs(known(found.time_offset_change_s)) < 0.15
    assert 0 < abs(known(found.short_range_error_m)) < 0.3
    held = known(refined.result.summary.refine)
    assert list(held.tag_in_cam_m.values()) == [survey.tag.tag_in_cam_m]
    assert (held.time_offset_change_s, held.short_range_error_m) == (None, None)


def test_covariances_of_the_centres_are_in_the_result_unless_unwanted(site_survey: Survey) -> None:
    survey = site_survey.changed({"export.formats": ("tum_covariance",)})
    result = refine_model(survey, progress=Progress()).summary
    path = survey.output.path / "pose_covariance.csv"
    beside_poses = (survey.output.path / "trajectory_covariance.csv").read_text()
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    model = pycolmap.Reconstruction(survey.output.path / "sparse_metric" / "0")
    assert {row["image_name"] for row in rows} == {image.name for image in model.images.values()}
    for row in rows:
        xx, xy, xz, yy, yz, zz = (float(row[f"cov_{axes}_m2"]) for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
        stddevs = np.sqrt(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        assert 1e-5 < stddevs.min() < stddevs.max() < 1.0
    assert beside_poses == path.read_text()
    exported, _ = export_result(survey.output.path, ["tum_covariance"], survey.output.path / "again")
    assert exported.read_text() == beside_poses
    assert 0 < known(known(result.refine).relative_scale_stddev) < 0.1
    without = refine_model(survey.changed({"refine.covariance": False}), progress=Progress()).summary
    assert "without covariances of the poses there is no tum_covariance" in without.warnings
    assert known(without.refine).relative_scale_stddev is None
    assert not path.exists()


def test_a_site_in_national_coordinates_loses_nothing(site_survey: Survey, refined: Done, tmp_path: Path) -> None:
    far = np.array([2_600_000.0, 1_200_000.0, 400.0])
    header, *rows = (site_survey.anchors.path or Path()).read_text().splitlines()
    lines = []
    for row in rows:
        name, *numbers = row.split(",")
        lines.append(",".join([name, *(repr(float(n) + float(o)) for n, o in zip(numbers, far, strict=True))]))
    (tmp_path / "far.csv").write_text("\n".join([header, *lines]) + "\n")
    near = refined.result.summary
    moved = site_survey.changed({"anchors.path": tmp_path / "far.csv", "output.path": tmp_path / "far"})
    away = refine_model(moved, progress=Progress()).summary
    assert away.metric_from_sfm.scale == pytest.approx(near.metric_from_sfm.scale, rel=1e-9)
    assert known(away.refine).scale_value == pytest.approx(known(near.refine).scale_value, rel=1e-7)
    for anchor_id, anchor in near.anchors.items():
        moved_m, own_m = known(away.anchors[anchor_id].position_m), known(anchor.position_m)
        np.testing.assert_allclose(np.subtract(moved_m, far), own_m, atol=1e-6)
    paths = (refined.survey.output.path, tmp_path / "far")
    models = [pycolmap.Reconstruction(path / "sparse_metric" / "0") for path in paths]
    for image_id, image in models[0].images.items():
        apart = models[1].image(image_id).projection_center() - far - image.projection_center()
        assert np.linalg.norm(apart) < 1e-6


def test_two_surveyed_anchors_stay_as_far_apart_as_they_were_surveyed(survey: Survey, tmp_path: Path) -> None:
    """They do not fix the frame but a length, which the ranges contradict by 2 %; the refinement keeps the length."""
    header, *rows = (survey.anchors.path or Path()).read_text().splitlines()
    names = [row.split(",")[0] for row in rows]
    places = 1.02 * np.array([row.split(",")[1:] for row in rows[:2]], dtype=np.float64)
    known = [",".join([name, *map(repr, place.tolist())]) for name, place in zip(names[:2], places, strict=True)]
    (tmp_path / "two.csv").write_text("\n".join([header, *known, *(f"{name},,," for name in names[2:])]) + "\n")
    two = survey.changed({"anchors.path": tmp_path / "two.csv", "anchors.frame": "site"})
    result = refine_model(two, progress=Progress()).summary
    assert result.frame == "first_camera"
    first, second = (np.array(result.anchors[name].position_m) for name in names[:2])
    assert np.linalg.norm(first - second) == pytest.approx(np.linalg.norm(places[0] - places[1]), abs=0.01)


def test_how_columns_were_read_is_a_note_and_no_warning(survey: Survey, tmp_path: Path) -> None:
    log = (survey.ranges.path or Path()).read_text()
    (tmp_path / "log.csv").write_text(log.replace("timestamp_s,anchor_id,range_m", "Zeit [s];Anker;Abstand [m]", 1))
    lines = (tmp_path / "log.csv").read_text().splitlines()
    (tmp_path / "log.csv").write_text("\n".join([lines[0], *(line.replace(",", ";") for line in lines[1:])]))
    listener = Listener()
    result = scale_model(survey.changed({"ranges.path": tmp_path / "log.csv"}), progress=listener).summary
    assert any(text.startswith("columns taken") for text in result.notes)
    assert not any("columns" in text for text in result.warnings)
    assert set(result.notes) <= set(listener.messages)


def test_doubts_are_warnings_in_the_result_and_for_the_user(survey: Survey) -> None:
    listener = Listener()
    paper = survey.changed({"scale.method": "two-candidate-unchecked"})
    result = scale_model(paper, progress=listener).summary
    assert result.scale.method == "two-candidate"
    assert result.scale.verdict == "doubtful"
    assert list(result.warnings) == listener.messages != []


@pytest.mark.parametrize("key", [item.dotted for item in KEYS if item.role == "file"])
def test_no_file_that_a_survey_reads_is_overwritten(key: str, survey: Survey) -> None:
    path = survey.output.path / "ranges.csv"
    path.parent.mkdir()
    path.write_text("an input\n")
    taped = {"scale.distances": survey.ranges.path} if key == "scale.markers" else {}
    with pytest.raises(InputError, match="the results would overwrite this input") as caught:
        scale_model(survey.changed({**taped, key: path}), progress=Progress())
    assert caught.value.path == path
    assert path.read_text() == "an input\n"


def test_a_wrong_coordinate_is_said_and_mended_only_when_asked_for(
    survey: Survey, walked_survey: WalkedSurvey, tmp_path: Path
) -> None:
    text = (walked_survey.folder / "anchors_first_camera.csv").read_text(encoding="utf-8")
    head, first, *rest = text.splitlines()
    cells = first.split(",")
    cells[2] = str(float(cells[2]) + 3.0)
    (tmp_path / "anchors.csv").write_text("\n".join([head, ",".join(cells), *rest]) + "\n", encoding="utf-8")
    wrong = survey.changed({"anchors.path": tmp_path / "anchors.csv"})
    told = scale_model(wrong, progress=Progress()).summary
    assert told.scale.verdict == "doubtful"
    assert f"anchor {cells[0]}" in told.scale.reasons[0]
    assert told.tests[0].rejected
    assert told.tests[0].subject.startswith(cells[0])
    mended = scale_model(wrong.changed({"scale.adopt": True}), progress=Progress()).summary
    assert mended.scale.verdict == "doubtful"
    assert mended.scale.reasons[0].startswith("adopted: ")
    assert told.scale.value != pytest.approx(mended.scale.value, rel=1e-6)
    low, high = known(mended.scale.interval_95)
    assert low < walked_survey.site_from_sfm.scale < high


def test_a_run_of_a_model_scales_it_alone_where_no_refinement_is_wanted(survey: Survey) -> None:
    result = run_survey(survey.changed({"refine.enabled": False, "report.enabled": False}))
    assert result.summary.refine is None
    assert not (survey.output.path / "sparse_metric").exists()
