"""Normal equations without the points, against dense algebra and small motions of the whole world."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from rangesfm.ceres import add_residual_block, distance_cost, normal_equations, tangent_jacobian
from rangesfm.ceres.normal_equations import BlockColumns, NormalEquations, address, rotation_of
from rangesfm.geometry.trajectory import pose_of

Array = npt.NDArray[np.float64]

SIZES = {"pose": 6, "sensor": 6, "anchor": 3, "point": 3}


def pose_at(seed: int) -> Array:
    """Return a random pose as [qx qy qz qw tx ty tz]."""
    return np.concatenate([Rotation.random(rng=seed).as_quat(), np.random.default_rng(seed).normal(size=3)])


def columns_of(blocks: Sequence[tuple[str, Array]], sizes: Sequence[int] | None = None) -> BlockColumns:
    """Return the columns of some blocks by their kinds, of which all poses are variable."""
    poses = [block for kind, block in blocks if kind == "pose"]
    counts = [SIZES.get(kind, len(block)) for kind, block in blocks] if sizes is None else sizes
    return BlockColumns._of_sizes(
        np.arange(len(poses)), poses, [b for _, b in blocks], [kind for kind, _ in blocks], np.array(counts)
    )


class Problem:
    """Some blocks with their numbers of columns, as a problem tells them; 0 columns: constant."""

    def __init__(self, blocks: Sequence[tuple[Array, int]]) -> None:
        self.sizes = {address(block): size for block, size in blocks}

    def has_parameter_block(self, block: Array) -> bool:
        return address(block) in self.sizes

    def num_parameter_blocks(self) -> int:
        return len(self.sizes)

    def is_parameter_block_constant(self, block: Array) -> bool:
        return self.sizes[address(block)] == 0

    def parameter_block_tangent_size(self, block: Array) -> int:
        return self.sizes[address(block)]


def model_of(frames: dict[int, Array], sensors: Sequence[Array | None], camera: Array, points: Sequence[Array]) -> Any:
    """Return what ``BlockColumns.of`` asks of a reconstruction."""
    poses = [None if sensor is None else SimpleNamespace(params=sensor) for sensor in sensors]
    return SimpleNamespace(
        reg_frame_ids=lambda: list(frames),
        frame=lambda frame: SimpleNamespace(rig_from_world=SimpleNamespace(params=frames[frame])),
        rigs={1: SimpleNamespace(non_ref_sensors=dict(enumerate(poses)))},
        cameras={1: SimpleNamespace(params=camera)},
        points3D={k: SimpleNamespace(xyz=point) for k, point in enumerate(points)},
    )


def test_blocks_that_nobody_named_are_counted_in_the_refusal() -> None:
    frames, camera, unknown = {1: pose_at(0)}, np.ones(4), np.zeros(1)
    problem = Problem([(frames[1], 6), (camera, 4), (unknown, 1)])
    with pytest.raises(ValueError, match=r"^the problem has 3 blocks, expected 2: those of the recon"):
        BlockColumns.of(problem, model_of(frames, [], camera, []), [], [])


def moved_by(turn: Array, shift: Array, log_scale: float, point: Array) -> Array:
    """Return a point of the world after a similarity of the whole world."""
    moved: Array = np.exp(log_scale) * Rotation.from_rotvec(turn).apply(point) + shift
    return moved


def steps_of_all(blocks: Sequence[tuple[str, Array]], motion: Array) -> Array:
    """Return the steps of all blocks, one after another, by a similarity of the world: turn, shift, log of scale."""
    turn, shift, log_scale = motion[:3], motion[3:6], float(motion[6])
    steps = []
    for kind, block in blocks:
        if kind == "pose":
            old = Rotation.from_quat(block[:4])
            new = old * Rotation.from_rotvec(turn).inv()
            center = moved_by(turn, shift, log_scale, -old.inv().apply(block[4:]))
            # Ceres turns on the left, and by twice its step.
            steps += [0.5 * (new * old.inv()).as_rotvec(), -new.apply(center) - block[4:]]
        elif kind == "sensor":
            steps += [np.zeros(3), (np.exp(log_scale) - 1.0) * block[4:]]
        elif kind in ("anchor", "point"):
            steps += [moved_by(turn, shift, log_scale, block) - block]
        else:
            steps += [np.zeros(len(block))]
    return np.concatenate(steps)


def test_motions_of_the_world_are_what_a_small_similarity_does_to_each_block() -> None:
    rng = np.random.default_rng(0)
    blocks = [
        ("pose", pose_at(0)),
        ("pose", pose_at(1)),
        ("sensor", pose_at(2)),
        ("anchor", rng.normal(size=3)),
        ("other", rng.normal(size=3)),
        ("other", rng.normal(size=6)),
        ("point", rng.normal(size=3)),
        ("point", rng.normal(size=3)),
    ]
    found = normal_equations._world_motions(columns_of(blocks))
    step = 1e-6
    differences = [
        (steps_of_all(blocks, step * unit) - steps_of_all(blocks, -step * unit)) / (2.0 * step) for unit in np.eye(7)
    ]
    np.testing.assert_allclose(found, np.transpose(differences), atol=1e-8)


def test_the_rotation_of_a_pose_is_that_of_its_quaternion() -> None:
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5), 7.0, 8.0, 9.0])
    np.testing.assert_allclose(rotation_of(quarter), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def adjusted_rig() -> tuple[pycolmap.Reconstruction, pycolmap.CeresBundleAdjuster]:
    """Return three frames of a rig of two cameras, with points that are off, and a bundle adjuster of all."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=12, track_length=4
    )
    reconstruction = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for point in reconstruction.points3D.values():
        point.xyz[:] += rng.normal(0.0, 0.05, 3)
    adjustment = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=True, refine_extra_params=False
    )
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    return reconstruction, pycolmap.create_default_ceres_bundle_adjuster(adjustment, config, reconstruction)


def test_normal_equations_are_those_of_all_without_the_points_that_only_photos_see() -> None:
    reconstruction, adjuster = adjusted_rig()
    problem, num = adjuster.problem, adjuster.problem.num_residuals()
    anchor, points = np.array([1.0, 2.0, 3.0]), [point.xyz for point in reconstruction.points3D.values()]
    add_residual_block(adjuster, distance_cost(distance_m=2.0, stddev_m=0.1), None, [points[4], anchor])
    found = NormalEquations.of(problem, reconstruction, num, [anchor])
    (rig,) = reconstruction.rigs.values()
    (sensor,) = rig.non_ref_sensors.values()
    poses = [pose_of(reconstruction.frame(frame)).params for frame in sorted(reconstruction.reg_frame_ids())]
    assert sensor is not None
    cameras = [camera.params for camera in reconstruction.cameras.values()]
    kept = [*poses, sensor.params, *cameras, anchor, points[4]]
    assert [address(block) for block in found.columns.variable] == [address(block) for block in kept]
    assert found.columns.kinds == [*["pose"] * 3, "sensor", "other", "other", "anchor", "point"]
    all_rows = tangent_jacobian(problem, [*kept, *points[:4], *points[5:]]).toarray()
    size = int(found.columns.starts[-1])
    assert size == 18 + 6 + 2 + 3 + 3
    seen, residuals = all_rows[:num], np.asarray(problem.evaluate_residuals())
    of_kept, of_points = seen[:, :size], seen[:, size:]
    without_points = np.eye(num) - of_points @ np.linalg.pinv(of_points)
    largest = np.abs(of_kept.T @ of_kept).max()
    np.testing.assert_allclose(
        csr_array(found.of_photos).toarray(), of_kept.T @ without_points @ of_kept, atol=1e-11 * largest
    )
    expected = of_kept.T @ without_points @ residuals[:num]
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found.gradient, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(found.others.toarray(), all_rows[num:, :size], atol=1e-12)
    assert (found.num_reprojections, found.others.shape) == (num, (1, size))
    # The photos leave all 7 motions free, and the distance between a point and the anchor has the scale.
    assert (found.free.shape, found.free_of_photos.shape) == ((size, 6), (size, 7))
    for free, rows in ((found.free, all_rows), (found.free_of_photos, seen)):
        of_points = rows[:, size:]
        left = (np.eye(len(rows)) - of_points @ np.linalg.pinv(of_points)) @ rows[:, :size] @ free
        assert np.linalg.matrix_rank(free) == free.shape[1]
        assert np.abs(left).max() < 1e-7 * np.abs(rows[:, :size] @ np.abs(free)).max()
    centers = np.array([pose_of(reconstruction.frame(k)).inverse().translation for k in reconstruction.reg_frame_ids()])
    expected_size = np.median(np.linalg.norm(np.array(points) - centers.mean(axis=0), axis=1))
    assert found.size_m == pytest.approx(expected_size)


def test_points_that_are_held_leave_no_motion_free_and_nothing_to_eliminate() -> None:
    reconstruction, adjuster = adjusted_rig()
    problem, num = adjuster.problem, adjuster.problem.num_residuals()
    points = [point.xyz for point in reconstruction.points3D.values()]
    for point in points:
        problem.set_parameter_block_constant(point)
    found = NormalEquations.of(problem, reconstruction, num)
    jacobian = tangent_jacobian(problem, found.columns.variable).toarray()
    np.testing.assert_allclose(csr_array(found.of_photos).toarray(), jacobian.T @ jacobian, rtol=1e-9, atol=1e-6)
    assert found.free.shape[1] == found.free_of_photos.shape[1] == 0
