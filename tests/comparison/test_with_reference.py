"""Comparison with a reference: the paper's table for known errors, and the differences between two models."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.export.models import synthesized
from tests.result_document import result_document

from rangesfm.comparison.before_after import compare_folder, compare_models
from rangesfm.comparison.same_photos import reprojection_rms_px
from rangesfm.comparison.with_reference import (
    compare,
    papers_table,
    reference_in_frame,
    with_true_scale,
)
from rangesfm.errors import InputError
from rangesfm.result.comparison_row import format_table
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.reference import Reference, write_reference
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]


def make_path(centers: Array, rotations: Array | None = None) -> Trajectory:
    num = len(centers)
    return Trajectory(
        frame_ids=np.arange(num),
        image_names=tuple(f"{i:03d}.jpg" for i in range(num)),
        timestamps_s=np.arange(num, dtype=np.float64),
        centers=centers,
        world_from_cam=np.tile(np.eye(3), (num, 1, 1)) if rotations is None else rotations,
    )


def walk(num: int = 30, seed: int = 0) -> tuple[Array, Array]:
    """Centres and rotations of a camera on a random walk."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(size=(num, 3)), axis=0), Rotation.random(num, random_state=seed).as_matrix()


def reference_of(path: Trajectory, *, has_rotations: bool = True) -> Reference:
    return Reference(
        path.centers,
        ByPhoto(path.image_names),
        world_from_cam=path.world_from_cam if has_rotations else None,
    )


def in_first_camera(path: Trajectory) -> Trajectory:
    """Return the path in the frame of its first camera."""
    rotation = path.world_from_cam[0].T
    return path.transformed(Similarity(1.0, rotation, -rotation @ path.centers[0]))


@pytest.mark.parametrize("percent", [-20.0, 3.0, 250.0])
def test_a_map_that_is_too_large_has_a_positive_scale_error(percent: float) -> None:
    truth = make_path(*walk())
    rotation = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
    path = truth.transformed(Similarity(1.0 + percent / 100.0, rotation, np.array([3.0, 2.0, 1.0])))
    (row,) = compare({"map": path}, reference_of(truth))
    assert row.scale_error_percent == pytest.approx(percent, abs=1e-9)
    assert row.rmse_sim3_m == pytest.approx(0.0, abs=1e-9)
    assert row.rmse_se3_m is not None
    assert row.rmse_se3_m > 0.1
    assert row.num_keyframes == 30


def test_without_alignment_a_shift_is_an_error_and_after_a_rigid_motion_it_is_not() -> None:
    truth = make_path(*walk())
    (row,) = compare(
        {"map": truth.transformed(Similarity(1.0, np.eye(3), np.array([0.3, 0.0, 0.4])))}, reference_of(truth)
    )
    assert row.rmse_m == pytest.approx(0.5)
    assert row.rmse_se3_m == pytest.approx(0.0, abs=1e-9)


def test_the_first_camera_frame_is_reached_through_the_references_orientation() -> None:
    truth = make_path(*walk())
    path = in_first_camera(truth)
    (row,) = compare({"map": path}, reference_of(truth), frame="first_camera")
    assert row.rmse_m == pytest.approx(0.0, abs=1e-9)
    (too_large,) = compare(
        {"map": path.transformed(Similarity(1.1, np.eye(3), np.zeros(3)))}, reference_of(truth), frame="first_camera"
    )
    assert too_large.rmse_m == pytest.approx(0.1 * np.sqrt(np.mean(np.sum(path.centers**2, axis=1))))


def test_the_first_camera_frame_is_reached_from_the_first_keyframe_that_the_reference_knows() -> None:
    truth = make_path(*walk())
    late = Reference(truth.centers[4:], ByPhoto(truth.image_names[4:]), world_from_cam=truth.world_from_cam[4:])
    (row,) = compare({"map": in_first_camera(truth)}, late, frame="first_camera")
    assert row.num_keyframes == 26
    assert row.rmse_m == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("frame", "has_rotations"), [("first_camera", False), (None, True)])
def test_frames_that_cannot_be_tied_leave_the_unaligned_rmse_out(frame: str | None, has_rotations: bool) -> None:
    truth = make_path(*walk())
    (row,) = compare({"map": truth}, reference_of(truth, has_rotations=has_rotations), frame=frame)
    assert row.rmse_m is None
    assert row.rmse_se3_m == pytest.approx(0.0, abs=1e-9)


def test_true_scale_keeps_the_middle_of_a_site_path_and_the_first_keyframe_of_a_first_camera_path() -> None:
    truth = make_path(*walk())
    wrong = truth.transformed(Similarity(0.8, np.eye(3), np.array([1.0, 0.0, 0.0])))
    in_site = with_true_scale(wrong, reference_of(truth), frame="site")
    np.testing.assert_allclose(in_site.centers.mean(axis=0), wrong.centers.mean(axis=0))
    in_camera = with_true_scale(wrong, reference_of(truth), frame="first_camera")
    np.testing.assert_allclose(in_camera.centers[0], wrong.centers[0])
    for path in (in_site, in_camera):
        np.testing.assert_allclose(np.diff(path.centers, axis=0), np.diff(truth.centers, axis=0), atol=1e-9)


def test_the_papers_table_separates_the_error_of_the_scale_from_that_of_the_shape() -> None:
    truth = make_path(*walk())
    drift = np.linspace(0, 1, 30)[:, None] ** 2 * [0.5, 0.2, 0.1]
    scaled = in_first_camera(make_path(1.05 * (truth.centers + drift), truth.world_from_cam))
    rows = papers_table(
        {"scaled": scaled, "refined": in_first_camera(truth)}, reference_of(truth), frame="first_camera"
    )
    true_scale, estimated, refined = rows
    assert [row.name for row in rows] == ["true scale", "scaled", "refined"]
    assert true_scale.scale_error_percent == pytest.approx(0.0, abs=1e-9)
    assert estimated.scale_error_percent == pytest.approx(5.0, abs=3.0)
    assert true_scale.rmse_sim3_m == pytest.approx(estimated.rmse_sim3_m)
    assert true_scale.rmse_m is not None
    assert estimated.rmse_m is not None
    assert 0.01 < true_scale.rmse_m < estimated.rmse_m
    assert refined.rmse_m == pytest.approx(0.0, abs=1e-9)
    assert len(papers_table({"scaled": scaled}, reference_of(truth))) == 2


def test_a_straight_path_still_tells_its_scale() -> None:
    truth = make_path(np.outer(np.arange(10.0), [1.0, 2.0, 2.0]))
    (row,) = compare({"map": truth.transformed(Similarity(1.02, np.eye(3), np.ones(3)))}, reference_of(truth))
    assert row.scale_error_percent == pytest.approx(2.0, abs=1e-6)
    assert row.rmse_sim3_m == pytest.approx(0.0, abs=1e-6)


def test_a_camera_that_stands_still_has_no_scale() -> None:
    truth = make_path(np.tile([5.0, 6.0, 7.0], (10, 1)))
    (row,) = compare({"map": truth}, reference_of(truth))
    assert row.scale_error_percent is None
    assert row.rmse_m == 0.0
    assert with_true_scale(truth, reference_of(truth)) is truth


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (
            Reference(np.zeros((1, 3)), ByPhoto(("other.jpg",))),
            "is of photo 'other.jpg', the first of the keyframes of photo '000.jpg'",
        ),
        (
            Reference(np.zeros((2, 3)), ByTime(np.array([90.0, 90.5]))),
            r"90\.000 to 90\.500 s, .* from 0\.000 to 29\.000 s",
        ),
    ],
)
def test_a_reference_of_something_else_is_refused(reference: Reference, message: str) -> None:
    with pytest.raises(InputError, match=message):
        compare({"map": make_path(*walk())}, reference)


def test_the_reference_in_the_maps_frame_lies_on_a_perfect_path() -> None:
    truth = make_path(*walk())
    path = in_first_camera(truth)
    carried = reference_in_frame(path, reference_of(truth), frame="first_camera")
    assert carried.moments == ByPhoto(path.image_names)
    np.testing.assert_allclose(carried.positions_m, path.centers, atol=1e-9)
    assert not len(reference_in_frame(path, reference_of(truth, has_rotations=False), frame="first_camera"))


def test_the_printed_table_has_a_dash_for_what_is_not_known() -> None:
    truth = make_path(*walk())
    header, line = format_table(compare({"a map": truth}, reference_of(truth), frame=None), "site").splitlines()
    assert header.split()[:4] == ["trajectory", "keyframes", "RMSE", "m"]
    assert line.startswith("a map")
    assert line.split()[2:5] == ["30", "-", "0.0000"]


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    return synthesized(8, 60, seed=1)


def test_a_perfect_model_reprojects_exactly_and_a_moved_observation_shows(model: pycolmap.Reconstruction) -> None:
    assert reprojection_rms_px(model) == pytest.approx(0.0, abs=1e-6)
    num = 0
    for image in model.images.values():
        for point in image.points2D:
            point.xy += [3.0, 4.0]
        num += image.num_points3D
    assert num > 100
    assert reprojection_rms_px(model) == pytest.approx(5.0)


def test_two_models_differ_by_what_was_done_to_one_of_them(model: pycolmap.Reconstruction) -> None:
    after = pycolmap.Reconstruction(model)
    after.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.zeros(3)))
    residuals = np.array([0.3, -0.4]), np.array([0.1, -0.1])
    comparison = compare_models(model, after, range_residuals_m=residuals)
    moved = np.linalg.norm(trajectory_from_reconstruction(model).centers, axis=1)
    assert len(comparison.displacements_m) == 8
    assert comparison.reprojection_rms_px == pytest.approx((0.0, 0.0), abs=1e-6)
    assert comparison.displacements_m.mean() == pytest.approx(moved.mean())
    assert comparison.displacements_m.max() == pytest.approx(moved.max())
    assert comparison.range_rms_m == pytest.approx((np.sqrt(0.125), 0.1))
    assert comparison.range_median_abs_m == pytest.approx((0.35, 0.1))
    assert len(comparison.distances) >= 3
    for _, _, (length_before, length_after) in comparison.distances:
        assert length_after == pytest.approx(2.0 * length_before)
    assert "8 keyframes moved" in str(comparison)


def write_folder(folder: Path, model: pycolmap.Reconstruction, *, is_refined: bool = True) -> Path:
    """Write a result whose refinement only shrank the map by a tenth."""
    scaled = pycolmap.Reconstruction(model)
    scaled.transform(pycolmap.Sim3d(1.1, pycolmap.Rotation3d(), np.zeros(3)))
    for name, part in (("sparse_scaled", scaled), ("sparse_metric", model)):
        if name == "sparse_scaled" or is_refined:
            (folder / name / "0").mkdir(parents=True)
            part.write_binary(folder / name / "0")
    (folder / "result.json").write_text(json.dumps(result_document()))
    (folder / "ranges.csv").write_text(
        f"{','.join(RangesAsUsed.columns())}\n"
        "0,,A,T,2,,,,,2.3,2.1,,,used\n1,,A,T,2,,,,,1.6,1.9,,,down-weighted\n"
        "2,,A,T,2,,,,,9,9,,,outlier\n3,,A,T,2,,,,,,,,,outside-path\n"
    )
    return folder


def test_a_result_folder_is_compared_with_a_reference_file(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    folder = write_folder(tmp_path / "out", model)
    reference_path = write_reference(reference_of(trajectory_from_reconstruction(model)), tmp_path / "reference.csv")
    papers, before_after = (block.splitlines() for block in compare_folder(folder, reference_path).split("\n\n"))
    assert "RMSE m  after SE(3)" in papers[0]  # in the site's frame
    assert [row.split("  ")[0] for row in papers[1:]] == ["true scale", "scaled", "refined"]
    assert [row.split()[-2] for row in papers[1:3]] == ["0.000", "+10.000"]
    assert float(papers[3].split()[2]) == 0.0
    assert before_after[1].startswith("reprojection RMS px")
    assert before_after[2].split() == ["range", "residual", "RMS", "m", f"{np.sqrt(0.125):.4f}", "0.1000"]


def test_a_scale_only_result_needs_a_reference(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    folder = write_folder(tmp_path / "out", model, is_refined=False)
    with pytest.raises(InputError, match="a reference is needed"):
        compare_folder(folder)
    reference_path = write_reference(reference_of(trajectory_from_reconstruction(model)), tmp_path / "reference.csv")
    assert len(compare_folder(folder, reference_path).splitlines()) == 3


RESULT = json.dumps(result_document())


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"result.json": RESULT}, "no scaled model"),
        ({"result.json": RESULT, "sparse_scaled/0/cameras.bin": ""}, r"there is no images\.bin"),
        (
            {"result.json": RESULT, "images.csv": "image_name,timestamp_s\na.jpg,x\n"},
            r"images\.csv:2: timestamp_s is 'x'",
        ),
    ],
)
def test_a_folder_that_is_not_a_result_is_refused(tmp_path: Path, files: dict[str, str], message: str) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        compare_folder(tmp_path)
