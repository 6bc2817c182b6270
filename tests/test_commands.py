"""Whole commands, run as users run them: what they leave, and that it is right."""

from __future__ import annotations

import copy
import csv
import json
import math
import os
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.conftest import SITE_M
from tests.outputs import paths_below
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.colmap.model_files import read_model
from rangesfm.demo.simulated_radio import Radio
from rangesfm.demo.survey import ANCHORS_M, CAMERA_MODEL, TAG_IN_CAM_M
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import read_ranges, write_ranges_csv
from rangesfm.result.places import path_in
from rangesfm.survey.settings import KEYS
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

if TYPE_CHECKING:
    from tests.conftest import Command, PhotoRun, WalkedSurvey

Array = npt.NDArray[np.float64]

NUMBER, TEXT, LIST, TABLE, BOOL = (float, int), str, list, dict, bool
OR_NULL = type(None)
RANGE_SUMMARY = {"num": int, "num_used": int, "num_rejected": int, "rms_m": NUMBER, "median_abs_m": NUMBER}
# Entries that result.json has at least; "*" stands for each key.
RESULT = {
    "scale": {
        "value": NUMBER,
        "stddev_formal": NUMBER,
        "stddev_empirical": NUMBER,
        "method": TEXT,
        "verdict": TEXT,
        "reasons": LIST,
        "per_anchor": {"*": NUMBER},
        "two_candidate": {
            "alpha0": {"mean": NUMBER, "std": NUMBER},
            "alpha1": {"mean": NUMBER, "std": NUMBER},
            "chosen": TEXT,
        },
    },
    "metric_from_sfm": {"scale": NUMBER, "rotation_xyzw": LIST, "translation_m": LIST},
    "frame": TEXT,
    "anchors": {
        "*": {
            "position_m": LIST,
            "stddev_m": NUMBER,
            "range_bias_m": NUMBER,
            "mirror_position_m": (list, OR_NULL),
        }
    },
    "time_offset": {"value_s": (float, OR_NULL), "stddev_s": (float, OR_NULL)},
    "ranges": {**RANGE_SUMMARY, "per_anchor": {"*": RANGE_SUMMARY}},
    "check_ranges": {"num": int, "rms_m": (float, OR_NULL)},
    "versions": {"rangesfm": TEXT, "pycolmap": TEXT, "pyceres": TEXT},
    "settings": TABLE,
    "seconds": {"*": NUMBER},
    "computed": TEXT,
    "warnings": LIST,
}
REFINE = {
    "iterations": int,
    "initial_cost": NUMBER,
    "final_cost": NUMBER,
    "reprojection_rms_px": NUMBER,
    "pixel_stddev": NUMBER,
    "seconds": NUMBER,
    "relative_scale_stddev": NUMBER,
    "tag_in_cam_m": {"*": LIST},
}
COMPARISON = {
    "name": TEXT,
    "rmse_m": (float, OR_NULL),
    "rmse_se3_m": NUMBER,
    "rmse_sim3_m": NUMBER,
    "scale_error_percent": NUMBER,
}
# Everything that a refined model with a reference leaves, each model as one entry.
REFINED_FILES = {
    "sparse_scaled/0",
    "sparse_metric/0",
    "pose_covariance.csv",
    "joint_covariance.npz",
    "result.json",
    "ranges.csv",
    "images.csv",
    "reference.csv",
    "report.html",
    "scale_candidates.csv",
    "scale_consensus.csv",
    "trajectory.tum",
    "points.ply",
}
MODEL_FILES = {"cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"}


@dataclass(frozen=True)
class Left:
    """An output folder and what the command printed."""

    folder: Path
    stdout: str
    stderr: str

    @cached_property
    def result(self) -> dict[str, Any]:
        loaded = json.loads((self.folder / "result.json").read_text(encoding="utf-8"))
        assert isinstance(loaded, dict)
        return loaded

    @property
    def without_seconds(self) -> dict[str, Any]:
        """Return a copy of result.json without durations and its own location, with absolute paths of its inputs."""
        result = copy.deepcopy(self.result)
        del result["seconds"], result["computed"], result["settings"]["output"]["path"]
        paths = [(result["settings"][key.table], key.name) for key in KEYS if key.role not in (None, "output")]
        for table, name in [*paths, *((entry, "path") for entry in result["inputs"])]:
            table[name] = table[name] and str(path_in(self.folder, table[name]))
        if result["refine"] is not None:
            del result["refine"]["seconds"]
        return result

    @property
    def files(self) -> set[str]:
        """List the files in the folder, with each model as one entry."""
        paths = {path.relative_to(self.folder).as_posix() for path in paths_below(self.folder) if path.is_file()}
        models = {path for path in paths if path.startswith("sparse") and os.path.basename(path) in MODEL_FILES}
        return (paths - models) | {os.path.dirname(path) for path in models}

    @property
    def timeless_contents(self) -> dict[str, bytes]:
        """Return the contents of all files except those that state durations."""
        paths = {path.relative_to(self.folder).as_posix(): path for path in paths_below(self.folder) if path.is_file()}
        return {name: path.read_bytes() for name, path in paths.items() if name not in ("result.json", "report.html")}

    @property
    def metric_from_sfm(self) -> Similarity:
        given = self.result["metric_from_sfm"]
        rotation = Rotation.from_quat(given["rotation_xyzw"]).as_matrix()
        return Similarity(given["scale"], rotation, np.array(given["translation_m"]))

    @property
    def relative_stddev(self) -> float:
        scale = self.result["scale"]
        return float(max(scale["stddev_formal"], scale["stddev_empirical"]) / scale["value"])

    def centers(self, model: str) -> Array:
        return centers_of(self.folder / model / "0")

    def rows(self, name: str) -> list[dict[str, str]]:
        with (self.folder / name).open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))


def centers_of(model: Path) -> Array:
    """(n, 3) projection centres, in the order of the names."""
    images = sorted(pycolmap.Reconstruction(model).images.values(), key=lambda image: image.name)
    return np.array([image.projection_center() for image in images if image.has_pose])


def assert_has(found: Any, expected: Any, where: str = "") -> None:
    """Check that ``found`` has every key of ``expected`` with a value of its type, and that numbers are finite."""
    if not isinstance(expected, dict):
        is_right = isinstance(found, expected) and (not isinstance(found, bool) or expected is BOOL)
        assert is_right, f"{where} is {found!r}"
        assert not isinstance(found, float) or math.isfinite(found), f"{where} is {found!r}"
        return
    assert isinstance(found, dict), f"{where} is {found!r}"
    for key, inner in expected.items():
        for name in found if key == "*" else [key]:
            assert name in found, f"{where} has no {name}"
            assert_has(found[name], inner, f"{where}.{name}")
    assert found, f"{where} is empty"


def run_on(
    command: Command, survey: WalkedSurvey, folder: Path, stage: str, *flags: str, drop: tuple[str, ...] = ()
) -> Left:
    """Run a stage on the walked survey, with its results in ``folder``."""
    pairs = zip(survey.flags[::2], survey.flags[1::2], strict=True)
    given = [item for pair in pairs if pair[0] not in drop for item in pair]
    done = command(stage, *given, *flags, "--output_path", str(folder), cwd=survey.folder)
    return Left(folder, done.stdout, done.stderr)


@pytest.fixture(scope="module")
def walked_survey(dense_survey: WalkedSurvey) -> WalkedSurvey:
    return dense_survey


@pytest.fixture(scope="module")
def refined(walked_survey: WalkedSurvey, rangesfm_process: Command, tmp_path_factory: pytest.TempPathFactory) -> Left:
    """The walked survey refined in its site frame and compared with the truth. Tests must not write to it."""
    folder = tmp_path_factory.mktemp("refined") / "out"
    flags = ("--anchors", "anchors.csv", "--anchor_frame", "site", "--reference", "reference.csv")
    return run_on(rangesfm_process, walked_survey, folder, "refine", *flags)


class TestRefineInASiteFrame:
    def test_leaves_every_file_and_nothing_half_written(self, refined: Left) -> None:
        assert refined.files == REFINED_FILES

    def test_result_has_every_key(self, refined: Left) -> None:
        assert_has(refined.result, {**RESULT, "refine": REFINE})
        assert refined.result["frame"] == "site"
        assert refined.result["scale"]["verdict"] == "good"
        assert refined.result["warnings"] == []
        assert set(refined.result["anchors"]) == {"A1", "A2", "A3", "A4"}
        assert refined.result["time_offset"]["value_s"] == 2.0
        assert [row["name"] for row in refined.result["comparison"]] == ["true scale", "scaled", "refined"]
        for row in refined.result["comparison"]:
            assert_has(row, COMPARISON)

    def test_result_says_what_checks_what_and_bounds_the_scale(self, refined: Left) -> None:
        reliability = refined.result["reliability"]
        half_width = 1.96 * refined.relative_stddev
        assert 3.7 / 1.96 * half_width < reliability["scale_within"] < 0.2
        assert reliability["unchecked"] == []
        said = f"the scale is off by {100 * reliability['scale_within']:.2g} % at most (risk of more: 0.0001)"
        assert f"reliability: if one mistake was made and not noticed, {said}" in refined.stdout
        places = {row["subject"]: row for row in refined.result["tests"] if row["name"] == "anchor place"}
        assert set(places) == {"A1", "A2", "A3", "A4"}
        for row in places.values():
            assert row["is_checked"]
            assert 0.01 < row["redundancy"] < 1.0

    def test_metric_from_sfm_carries_the_model_onto_the_scaled_one(
        self, refined: Left, walked_survey: WalkedSurvey
    ) -> None:
        sfm = centers_of(walked_survey.folder / "sparse" / "0")
        carried = refined.metric_from_sfm.apply(sfm)
        assert np.abs(carried - refined.centers("sparse_scaled")).max() < 1e-9

    def test_scale_is_right_within_its_stated_error(self, refined: Left, walked_survey: WalkedSurvey) -> None:
        error = refined.result["scale"]["value"] / walked_survey.site_from_sfm.scale - 1
        assert abs(error) < 3 * refined.relative_stddev < 0.05

    def test_map_is_in_the_site_frame_without_alignment(self, refined: Left, walked_survey: WalkedSurvey) -> None:
        worst_m = refined.result["place"]["worst_keyframe_stddev_m"]
        assert worst_m < 0.2
        for model in ("sparse_scaled", "sparse_metric"):
            errors = np.linalg.norm(refined.centers(model) - walked_survey.centers_m, axis=1)
            assert np.sqrt(np.mean(errors**2)) < worst_m

    def test_comparison_says_how_far_the_models_are_from_the_reference(
        self, refined: Left, walked_survey: WalkedSurvey
    ) -> None:
        by_name = {row["name"]: row for row in refined.result["comparison"]}
        for name, model in (("scaled", "sparse_scaled"), ("refined", "sparse_metric")):
            errors = np.linalg.norm(refined.centers(model) - walked_survey.centers_m, axis=1)
            assert by_name[name]["rmse_m"] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-6)
        assert by_name["true scale"]["scale_error_percent"] == pytest.approx(0, abs=1e-9)
        assert "RMSE m" in refined.stdout

    def test_every_range_is_listed_with_what_became_of_it(self, refined: Left, walked_survey: WalkedSurvey) -> None:
        log = read_ranges(walked_survey.folder / "uwb.csv")
        rows = refined.rows("ranges.csv")
        assert [float(row["range_m"]) for row in rows] == log.range_m.tolist()
        assert [row["anchor_id"] for row in rows] == [log.anchor_ids[k] for k in log.anchor_index]
        used = [row for row in rows if row["status"] in ("used", "down-weighted")]
        assert len(used) == refined.result["ranges"]["num_used"] > 0.9 * len(rows)
        for row in used:
            predicted, residual = float(row["predicted_refined_m"]), float(row["residual_m"])
            assert residual == pytest.approx(predicted - float(row["range_m"]), abs=1e-4)
        residuals = [float(row["residual_m"]) for row in used]
        assert refined.result["ranges"]["rms_m"] == pytest.approx(np.sqrt(np.mean(np.square(residuals))), rel=1e-3)
        outside = [row for row in rows if row["status"] == "outside-path"]
        assert outside
        assert all(row["keyframe_before"] == row["residual_m"] == "" for row in outside)

    def test_trajectory_and_points_are_those_of_the_metric_model(self, refined: Left) -> None:
        lines = (refined.folder / "trajectory.tum").read_text().splitlines()
        poses = np.array([line.split() for line in lines if not line.startswith("#")], dtype=np.float64)
        np.testing.assert_allclose(poses[:, 0], 100.0 + np.arange(40))
        np.testing.assert_allclose(poses[:, 1:4], refined.centers("sparse_metric"), atol=1e-6)
        num_points = pycolmap.Reconstruction(refined.folder / "sparse_metric" / "0").num_points3D()
        assert f"element vertex {num_points}\n".encode() in (refined.folder / "points.ply").read_bytes()

    def test_progress_goes_to_stderr_line_by_line_and_the_summary_to_stdout(self, refined: Left) -> None:
        stages = [line.removesuffix(" ...") for line in refined.stderr.splitlines() if line.endswith(" ...")]
        assert stages == ["scale", "refinement", "judgement", "advice", "results", "report"]
        assert "\r" not in refined.stderr
        assert "\033" not in refined.stderr
        assert f"\nscale: {refined.result['scale']['value']:.6g} m per SfM unit" in refined.stdout
        assert f"\nall results: {refined.folder / 'result.json'}\n" in refined.stdout
        assert refined.stdout.endswith(f"\nreport: {refined.folder / 'report.html'}\n")

    def test_survey_file_and_dashes_for_underscores_give_the_same_result(
        self, refined: Left, own_survey: WalkedSurvey, rangesfm_command: Command
    ) -> None:
        (own_survey.folder / "survey.toml").write_text(
            '[images]\ntimes = "images.csv"\n[ranges]\npath = "uwb.csv"\ntime_offset = 7\n'
            '[anchors]\npath = "anchors.csv"\n[report]\nreference = "reference.csv"\n'
        )
        flags = ["--input-path", "sparse/0", "--ranges-time-offset", "2", "--tag-in-cam", "0.03,-0.12,-0.05"]
        flags += ["--anchor-frame", "site", "--output-path", "new/out", "--quiet"]
        done = rangesfm_command("refine", "survey.toml", *flags, cwd=own_survey.folder)
        again = Left(own_survey.folder / "new" / "out", done.stdout, done.stderr)
        assert again.stderr == ""
        first, second = refined.without_seconds, again.without_seconds
        for name in ("settings", "inputs"):  # they hold absolute paths
            del first[name], second[name]
        assert second == first
        assert again.timeless_contents == refined.timeless_contents

    def test_order_of_rows_and_numbers_of_photos_and_points_change_nothing(
        self, refined: Left, own_survey: WalkedSurvey, rangesfm_command: Command
    ) -> None:
        rng = np.random.default_rng(0)
        for name in ("uwb.csv", "anchors.csv", "images.csv", "reference.csv"):
            head, *rows = (own_survey.folder / name).read_text().splitlines()
            (own_survey.folder / name).write_text("\n".join([head, *rng.permutation(rows)]) + "\n")
        renumber(own_survey.folder / "sparse" / "0", rng)
        flags = (*own_survey.flags, "--anchors", "anchors.csv", "--reference", "reference.csv", "--output_path", "out")
        done = rangesfm_command("refine", *flags, "--quiet", cwd=own_survey.folder)
        again = Left(own_survey.folder / "out", done.stdout, done.stderr)
        first, second = refined.without_seconds, again.without_seconds
        for result in (first, second):
            del result["settings"], result["inputs"], result["refine"]["message"]
        assert close(second, first)
        np.testing.assert_allclose(again.centers("sparse_metric"), refined.centers("sparse_metric"), rtol=0, atol=1e-9)


def renumber(path: Path, rng: np.random.Generator) -> None:
    """Renumber the images and points of a model, in place."""
    model, renumbered = pycolmap.Reconstruction(path), pycolmap.Reconstruction()
    for camera in model.cameras.values():
        renumbered.add_camera_with_trivial_rig(camera)
    new_id = dict(zip(sorted(model.images), rng.permutation(sorted(model.images)).tolist()))
    for old, new in sorted(new_id.items(), key=lambda pair: pair[1]):
        image = model.images[old]
        points = [pycolmap.Point2D(point.xy) for point in image.points2D]
        copy_ = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=new, points2D=points)
        renumbered.add_image_with_trivial_frame(copy_, image.cam_from_world())
    for point_id in rng.permutation(sorted(model.points3D)).tolist():
        point, track = model.points3D[point_id], pycolmap.Track()
        for element in reversed(point.track.elements):
            track.add_element(new_id[element.image_id], element.point2D_idx)
        renumbered.add_point3D(point.xyz, track, point.color)
    renumbered.write(path)


def close(found: Any, expected: Any) -> bool:
    """Return whether two contents of result.json are the same up to rounding.

    The likelihood of the error components is flat at its maximum, so the maximum is only determined to the square root
    of the likelihood's rounding error.
    """
    if isinstance(expected, dict):
        return found.keys() == expected.keys() and all(close(found[key], expected[key]) for key in expected)
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(close, found, expected))
    if isinstance(expected, float):
        return bool(found == pytest.approx(expected, rel=1e-8, abs=1e-9))
    return bool(found == expected)


class TestModelWithoutSurveyedAnchors:
    @pytest.mark.parametrize(
        "flags",
        [("--anchors", "anchors_first_camera.csv", "--anchor_frame", "first_camera"), ()],
        ids=["first camera", "unknown"],
    )
    def test_is_metric_in_the_first_cameras_frame(
        self,
        flags: tuple[str, ...],
        walked_survey: WalkedSurvey,
        rangesfm_command: Command,
        tmp_path: Path,
    ) -> None:
        left = run_on(rangesfm_command, walked_survey, tmp_path / "out", "refine", *flags)
        assert_has(left.result, {**RESULT, "refine": REFINE})
        assert left.result["frame"] == "first_camera"
        error = left.result["scale"]["value"] / walked_survey.site_from_sfm.scale - 1
        assert abs(error) < 3 * left.relative_stddev < 0.05
        models = ["sparse_scaled", "sparse_metric"]
        assert {file for file in left.files if file.startswith("sparse")} == {f"{model}/0" for model in models}
        for model in models:
            first = pycolmap.Reconstruction(left.folder / model / "0").image(1).cam_from_world()
            np.testing.assert_allclose(first.matrix(), np.eye(3, 4), atol=1e-9)
            steps = np.linalg.norm(np.diff(left.centers(model), axis=0), axis=1)
            true_steps = np.linalg.norm(np.diff(walked_survey.centers_m, axis=0), axis=1)
            assert steps.sum() == pytest.approx(true_steps.sum(), rel=3 * left.relative_stddev)
        sfm = centers_of(walked_survey.folder / "sparse" / "0")
        assert np.abs(left.metric_from_sfm.apply(sfm) - left.centers("sparse_scaled")).max() < 1e-9

        with (walked_survey.folder / "anchors_first_camera.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                true = np.array([float(row[key]) for key in ("x_m", "y_m", "z_m")])
                found = left.result["anchors"][row["anchor_id"]]
                error_m = np.linalg.norm(np.array(found["position_m"]) - true)
                # The stddev of a refined anchor includes the common bias of all ranges (0.2 m), and errors of antennas
                # and radio.
                assert error_m <= 3 * np.sqrt(3) * found["stddev_m"] < 1.5

    def test_may_be_a_path_without_points(
        self, own_survey: WalkedSurvey, rangesfm_command: Command, refined: Left, tmp_path: Path
    ) -> None:
        path = own_survey.folder / "sparse" / "0"
        model = pycolmap.Reconstruction(path)
        for point_id in list(model.points3D):
            model.delete_point3D(point_id)
        model.write(path)
        left = run_on(rangesfm_command, own_survey, tmp_path / "out", "scale", "--anchors", "anchors.csv")
        # Without points, the path is bent by another model than with photos; noise alone moves the scale more than
        # that.
        scale = left.result["scale"]
        assert scale["value"] == pytest.approx(refined.result["scale"]["value"], abs=scale["stddev_formal"])
        assert left.result["refine"] is None
        assert left.files == {
            "sparse_scaled/0",
            "result.json",
            "ranges.csv",
            "images.csv",
            "report.html",
            "scale_candidates.csv",
            "scale_consensus.csv",
            "trajectory.tum",
        }


def test_scale_uses_the_anchors_and_the_tag_asked_for(
    own_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    log = own_survey.folder / "uwb.csv"
    header, *rows = log.read_text().splitlines()
    nonsense = [",".join([*row.split(",")[:2], "1.5"]) for row in rows]
    tagged = [f"{row},mine\n" for row in rows] + [f"{row},other\n" for row in nonsense]
    log.write_text(f"{header},tag_id\n" + "".join(tagged))
    flags = ("--use_anchors", "A2,A4", "--tag_id", "mine", "--anchors", "anchors.csv", "--anchor_frame", "unknown")
    left = run_on(rangesfm_command, own_survey, tmp_path / "out", "scale", *flags)
    assert set(left.result["anchors"]) == set(left.result["ranges"]["per_anchor"]) == {"A2", "A4"}
    assert left.result["ranges"]["num"] == len(rows) / 2
    assert {row["tag_id"] for row in left.rows("ranges.csv")} == {"mine"}
    error = left.result["scale"]["value"] / own_survey.site_from_sfm.scale - 1
    assert abs(error) < 3 * left.relative_stddev


def test_taped_distances_hold_the_scale_and_check_it(
    own_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    ends = [(0, 20, "control"), (5, 30, "check"), (10, 25, "check")]
    truth = [float(np.linalg.norm(own_survey.centers_m[i] - own_survey.centers_m[j])) for i, j, _ in ends]
    lengths = [truth[0], truth[1], truth[2] + 0.5]
    lines = [
        f"{own_survey.image_names[i]},{own_survey.image_names[j]},{length},0.005,{kind}\n"
        for (i, j, kind), length in zip(ends, lengths, strict=True)
    ]
    (own_survey.folder / "taped.csv").write_text("from,to,distance_m,stddev_m,kind\n" + "".join(lines))
    flags = ("--distances", "taped.csv", "--anchors", "anchors.csv", "--anchor_frame", "unknown")
    left = run_on(rangesfm_command, own_survey, tmp_path / "out", "refine", *flags)
    rows = left.result["distances"]
    assert [row["kind"] for row in rows] == ["control", "check", "check"]
    assert [row["measured_m"] for row in rows] == pytest.approx(lengths)
    assert rows[0]["residual_m"] == pytest.approx(0, abs=0.01)
    assert rows[1]["residual_m"] == pytest.approx(0, abs=0.03)
    assert rows[2]["residual_m"] == pytest.approx(-0.5, abs=0.03)
    (note,) = (text for text in left.result["warnings"] if text.startswith("check distance"))
    assert left.result["scale"]["verdict"] == "doubtful"
    assert note in left.result["scale"]["reasons"]
    error = left.result["scale"]["value"] / own_survey.site_from_sfm.scale - 1
    assert abs(error) < 0.003


def test_log_may_name_photos_instead_of_times(
    own_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    around_m = {"near": (2.0, 1.0, 3.0), "far": (-6.0, 5.0, 0.2), "third": (6.0, 4.0, 1.0)}
    anchors = {name: SITE_M + np.array(at) for name, at in around_m.items()}
    lines = ["image_name,anchor_id,range_m"]
    for name, center in zip(own_survey.image_names, own_survey.centers_m, strict=True):
        for anchor_id, position in anchors.items():
            range_m = np.linalg.norm(position - center) + 0.02 * rng.standard_normal()
            lines += [f"{name},{anchor_id},{range_m}"]
    (own_survey.folder / "uwb.csv").write_text("\n".join(lines) + "\n")
    drop = ("--images", "--tag_in_cam", "--ranges_time_offset")
    left = run_on(rangesfm_command, own_survey, tmp_path / "out", "refine", drop=drop)
    assert left.result["time_offset"]["value_s"] is None
    assert left.result["ranges"]["num_used"] > 100
    error = left.result["scale"]["value"] / own_survey.site_from_sfm.scale - 1
    assert abs(error) < 3 * left.relative_stddev < 0.05


def test_offset_of_the_clocks_is_found(walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path) -> None:
    flags = ("--anchors", "anchors.csv", "--ranges_time_offset", "auto")
    left = run_on(rangesfm_command, walked_survey, tmp_path / "out", "scale", *flags)
    offset = left.result["time_offset"]
    assert abs(offset["value_s"] - 2.0) < 3 * offset["stddev_s"] < 0.3
    assert abs(offset["drift_ppm"]) < 4 * offset["drift_stddev_ppm"]
    assert not offset["drift_is_followed"]
    header, *rows = (left.folder / "time_offset_curve.csv").read_text().splitlines()
    assert header == "time_offset_s,cost"
    offsets, costs = np.array([row.split(",") for row in rows], dtype=float).T
    assert np.all(np.diff(offsets) > 0)
    assert abs(offsets[np.argmin(costs)] - 2.0) < 0.3


class TestResultFolder:
    """Other commands on the folder that a run left."""

    @pytest.fixture
    def out(self, refined: Left, tmp_path: Path) -> Path:
        # The survey's folder keeps its name, because the report's title contains it.
        return shutil.copytree(refined.folder, tmp_path / refined.folder.parent.name / "out")

    def test_is_compared_with_and_without_a_reference(
        self, out: Path, refined: Left, walked_survey: WalkedSurvey, rangesfm_command: Command
    ) -> None:
        reference = walked_survey.folder / "reference.csv"
        text = rangesfm_command("compare", out, "--reference", reference, cwd=out.parent).stdout
        rmse_m = {row["name"]: row["rmse_m"] for row in refined.result["comparison"]}
        for name in ("true scale", "scaled", "refined"):
            (line,) = (line for line in text.splitlines() if line.startswith(f"{name} "))
            assert f" {rmse_m[name]:.4f} " in line
        text = rangesfm_command("compare", cwd=out.parent).stdout  # "out" is the default folder
        assert "RMSE m" not in text
        (line,) = (line for line in text.splitlines() if line.startswith("range residual RMS m"))
        assert float(line.split()[-1]) == pytest.approx(refined.result["ranges"]["rms_m"], abs=2e-3)

    def test_is_exported_to_other_formats(self, out: Path, rangesfm_command: Command) -> None:
        flags = ("--formats", "colmap_text,ply_cameras,ply_anchors,transform,model_aligner", "--output_path", "more")
        done = rangesfm_command("export", out, *flags, cwd=out.parent)
        written = [out.parent / line for line in done.stdout.splitlines()]
        assert len(written) == 6  # two of them are transforms
        assert all(path.exists() for path in written)
        assert pycolmap.Reconstruction(out.parent / "more" / "colmap_text").num_reg_images() == 40

    def test_is_exported_level_and_on_the_earth(self, out: Path, rangesfm_command: Command) -> None:
        place = ("--origin_anchor", "A1", "--origin_lat_lon_height", "47.4,8.5,430", "--heading_deg", "90")
        flags = ("--formats", "laz,geojson,nerfstudio", "--frame", "enu", *place, "--output_path", "exported")
        done = rangesfm_command("export", out, *flags, cwd=out)
        names = ("points.laz", "survey.geojson", "transforms.json")
        lost = "the photos are not there: give --images, or copy them to exported/images"
        lines = [*(f"exported/{name}" for name in names), "up is z of the site", lost]
        assert done.stdout.splitlines() == lines
        features = json.loads((out / "exported" / "survey.geojson").read_text())["features"]
        (anchor,) = (f for f in features if f["properties"]["name"] == "A1")
        assert anchor["geometry"]["coordinates"] == pytest.approx([8.5, 47.4, 430.0], abs=1e-6)

    def test_says_what_to_add_to_coordinates_of_trainers(self, out: Path, rangesfm_command: Command) -> None:
        done = rangesfm_command("export", out, "--formats", "nerfstudio,ply", "--output_path", "trained", cwd=out)
        offset_m = np.loadtxt(out / "trained" / "offset.txt")
        assert np.abs(offset_m - SITE_M).max() < 3
        assert f"add {', '.join(f'{x:.0f}' for x in offset_m)} m to their coordinates" in done.stdout
        assert "transforms.json, transforms_points.ply: the origin is moved" in done.stdout

    def test_carries_over_what_was_made_from_the_unscaled_model(
        self, out: Path, walked_survey: WalkedSurvey, rangesfm_command: Command
    ) -> None:
        shutil.copytree(walked_survey.folder / "sparse", out / "sparse")
        rangesfm_command("export", out, "--apply_to", "sparse/0", "--output_path", "applied", cwd=out)
        moved, refined = (pycolmap.Reconstruction(out / path) for path in ("applied/0", "sparse_metric/0"))
        apart = [
            np.linalg.norm(image.projection_center() - refined.image(image_id).projection_center())
            for image_id, image in moved.images.items()
        ]
        assert max(apart) < 0.1
        for again in ("applied/0", "sparse_metric/0"):
            done = rangesfm_command("export", out, "--apply_to", again, "--output_path", "twice", cwd=out, status=2)
            assert f"{again}: is in metres already" in done.stderr
        assert not (out / "twice").exists()

    def test_gets_its_report_anew(self, out: Path, rangesfm_command: Command) -> None:
        before = (out / "report.html").read_bytes()
        (out / "report.html").unlink()
        assert rangesfm_command("report", out, cwd=out.parent).stdout == f"{out / 'report.html'}\n"
        assert (out / "report.html").read_bytes() == before

    def test_ranges_as_used_are_a_log_again(self, out: Path, refined: Left, rangesfm_command: Command) -> None:
        done = rangesfm_command("ranges", out / "ranges.csv", "--output_path", "log.csv", cwd=out.parent)
        assert f"ranges  {refined.result['ranges']['num']}" in done.stdout
        assert len(read_ranges(out.parent / "log.csv")) == refined.result["ranges"]["num"]


def test_doctor_finds_nothing_wrong(rangesfm_process: Command, tmp_path: Path) -> None:
    lines = rangesfm_process("doctor", cwd=tmp_path).stdout.splitlines()
    assert all(line.startswith("ok ") for line in lines)
    assert any("shares its types" in line or "pybind11" in line for line in lines)


@pytest.fixture(scope="module")
def first_run(photo_run: PhotoRun) -> Left:
    return Left(photo_run.output_path, photo_run.stdout, photo_run.stderr)


class TestRunOnPhotos:
    def test_leaves_every_file(self, first_run: Left) -> None:
        assert first_run.files == REFINED_FILES | {"database.db", "reconstruct.json", "mapper.log", "sparse/0"}

    def test_tells_of_each_stage(self, first_run: Left) -> None:
        lines = first_run.stderr.splitlines()
        stages = [line.removesuffix(" ...") for line in lines if line.endswith(" ...")]
        of_map = ["features", "matching", "mapping"]
        assert stages == [*of_map, "scale", "refinement", "judgement", "advice", "results", "report"]
        told = dict(line.split(": ", 1) for line in lines if line.endswith(" s") and ": " in line)
        assert told.keys() >= {*stages}
        for stage in ("scale", "refinement", "judgement", "advice"):  # the same clock as in the result
            assert float(told[stage].removesuffix(" s")) == pytest.approx(first_run.result["seconds"][stage], abs=0.3)

    def test_result_has_every_key(self, first_run: Left) -> None:
        result = copy.deepcopy(first_run.result)
        assert_has(result, {**RESULT, "refine": REFINE})
        total_s = result["seconds"].pop("total")
        stages = {"keyframes", "features", "matching", "mapping", "scale", "refinement", "judgement", "advice"}
        assert result["seconds"].keys() == stages | {"results"}
        assert 0 < sum(result["seconds"].values()) <= total_s

    def test_map_is_true_to_scale_and_to_the_site_frame(self, photo_run: PhotoRun, first_run: Left) -> None:
        true = photo_run.survey.centers_m
        errors = np.linalg.norm(first_run.centers("sparse_metric") - true, axis=1)
        assert len(errors) == 14
        stated_m = np.linalg.norm(first_run.result["place"]["stddev_m"])
        assert np.sqrt(np.mean(errors**2)) < 1.5 * stated_m < 0.21
        (refined,) = (row for row in first_run.result["comparison"] if row["name"] == "refined")
        assert abs(refined["scale_error_percent"]) < 1.0
        sfm = first_run.centers("sparse")
        assert np.abs(first_run.metric_from_sfm.apply(sfm) - first_run.centers("sparse_scaled")).max() < 1e-9

    def test_again_and_quietly_takes_the_model_over_and_gives_the_same_result(
        self, photo_run: PhotoRun, first_run: Left, rangesfm_command: Command, tmp_path: Path
    ) -> None:
        out = shutil.copytree(photo_run.output_path, tmp_path / "out")
        flags = (*photo_run.flags, "--output_path", str(out), "--quiet")
        done = rangesfm_command("run", *flags, cwd=photo_run.survey.folder)
        again = Left(out, done.stdout, done.stderr)
        assert again.stderr == ""
        for stage in ("features", "matching", "mapping"):  # the report has the time of all stages
            assert again.result["seconds"][stage] == first_run.result["seconds"][stage]
        assert again.without_seconds == first_run.without_seconds
        assert again.files == first_run.files
        for model in ("sparse", "sparse_metric"):
            np.testing.assert_array_equal(again.centers(model), first_run.centers(model))

    def test_anew_elsewhere_gives_the_same_scale_for_the_same_seed(
        self, photo_run: PhotoRun, first_run: Left, rangesfm_command: Command, tmp_path: Path
    ) -> None:
        out = shutil.copytree(photo_run.output_path, tmp_path / "out")
        flags = (*photo_run.flags, "--restart", "--output_path", str(out))
        done = rangesfm_command("run", *flags, cwd=photo_run.survey.folder)
        again = Left(out, done.stdout, done.stderr)
        assert {"features", "matching", "mapping"} <= again.result["seconds"].keys()
        assert "taken over" not in again.stderr
        assert again.result["scale"]["value"] == pytest.approx(first_run.result["scale"]["value"], rel=1e-9)
        np.testing.assert_allclose(
            again.centers("sparse_metric"), first_run.centers("sparse_metric"), rtol=0, atol=1e-9
        )

    def test_refine_of_the_unscaled_model_gives_the_runs_answer_in_one_thread_too(
        self,
        photo_run: PhotoRun,
        first_run: Left,
        rangesfm_command: Command,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        given = [flag for flag in photo_run.flags if flag != "--reproducible"]  # of the mapping alone
        flags = ["--input_path", str(photo_run.output_path / "sparse" / "0"), "--output_path", str(tmp_path / "out")]
        done = rangesfm_command("refine", *given, *flags, cwd=photo_run.survey.folder)
        again = Left(tmp_path / "out", done.stdout, done.stderr)
        first, second = first_run.without_seconds, again.without_seconds
        for name in ("settings", "inputs"):
            del first[name], second[name]
        assert second == first
        np.testing.assert_allclose(
            again.centers("sparse_metric"), first_run.centers("sparse_metric"), rtol=0, atol=1e-9
        )

    def test_of_other_photos_leaves_the_result_as_it_was_where_it_fails(
        self, photo_run: PhotoRun, rangesfm_command: Command, tmp_path: Path
    ) -> None:
        out = shutil.copytree(photo_run.output_path, tmp_path / "out")
        before = {path: path.read_bytes() for path in paths_below(out) if path.is_file()}
        flags = (*photo_run.flags, "--output_path", str(out), "--every_nth", "5")
        done = rangesfm_command("run", *flags, cwd=photo_run.survey.folder, status=None)
        assert done.returncode in (3, 4)  # three photos a few metres apart
        assert {path: path.read_bytes() for path in paths_below(out) if path.is_file()} == before


def test_photos_and_a_log_that_names_them_need_no_times(
    photo_run: PhotoRun, rangesfm_command: Command, tmp_path: Path
) -> None:
    survey = photo_run.survey
    (tmp_path / "images").mkdir()
    for name in survey.image_names:
        with Image.open(survey.folder / "images" / name) as photo:
            photo.save(tmp_path / "images" / name, quality=95)  # without EXIF
    radio = Radio(range_stddev_m=0.02)
    measured = simulate_ranges_at(
        survey.timestamps_s, survey.centers_m, survey.world_from_cam, ANCHORS_M, TAG_IN_CAM_M, radio, seed=1
    )
    names = np.repeat(survey.image_names, len(ANCHORS_M)).tolist()
    log = RangeLog.from_arrays(measured.end_ids()[1], measured.range_m, image_name=names)
    write_ranges_csv(log, tmp_path / "uwb.csv")
    flags = ("--images", "images", "--ranges", "uwb.csv", "--anchors", survey.folder / "anchors.csv", "--seed", "0")
    camera = ("--camera_model", CAMERA_MODEL, "--camera_params", "280.8,180,120,-0.04")  # the small photos'
    tag = ("--tag_in_cam", ",".join(map(str, TAG_IN_CAM_M)), "--reproducible")
    rangesfm_command("run", *flags, *camera, *tag, "--output_path", "out", cwd=tmp_path)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["ranges"]["num"] == len(log)
    assert result["time_offset"]["value_s"] is None
    centers = trajectory_from_reconstruction(read_model(tmp_path / "out" / "sparse_metric" / "0"))
    true = dict(zip(survey.image_names, survey.centers_m))
    errors = [np.linalg.norm(center - true[name]) for name, center in zip(centers.image_names, centers.centers)]
    assert len(errors) > 10
    assert np.median(errors) < 0.1
