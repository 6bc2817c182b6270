"""Normal equations without the points, against dense algebra and small motions of the whole world."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.sparse import csc_array, csr_array
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


def test_blocks_are_in_the_order_of_poses_rigs_cameras_anchors_others_and_points() -> None:
    frames = {9: pose_at(0), 4: pose_at(1), 6: pose_at(2)}
    sensor, camera, anchor, bias = pose_at(3), np.ones(4), np.zeros(3), np.zeros(1)
    padded, point, unseen = np.zeros(2), np.zeros(3), np.zeros(3)
    sizes = [6, 0, 6, 6, 2, 3, 1, 6, 3]  # of these, the pose of frame 4 is constant, and the block of two is padded
    blocks = [frames[9], frames[4], frames[6], sensor, camera, anchor, bias, padded, point]
    columns = BlockColumns.of(
        Problem(list(zip(blocks, sizes, strict=True))),
        model_of(frames, [None, sensor], camera, [unseen, point]),
        [anchor],
        [bias, padded],
    )
    assert columns.frames.tolist() == [4, 6, 9]
    assert [address(pose) for pose in columns.poses] == [address(frames[frame]) for frame in (4, 6, 9)]
    assert columns.kinds == ["pose", "pose", "sensor", "other", "anchor", "other", "other", "point"]
    expected = [frames[6], frames[9], sensor, camera, anchor, bias, padded, point]
    assert [address(block) for block in columns.variable] == [address(block) for block in expected]
    assert columns.starts.tolist() == [0, 6, 12, 18, 20, 23, 24, 26, 29]
    assert columns.index_of == {address(block): k for k, block in enumerate(expected)}


def test_blocks_that_nobody_named_are_counted_in_the_refusal() -> None:
    frames, camera, unknown = {1: pose_at(0)}, np.ones(4), np.zeros(1)
    problem = Problem([(frames[1], 6), (camera, 4), (unknown, 1)])
    with pytest.raises(ValueError, match=r"^the problem has 3 blocks, expected 2: those of the recon"):
        BlockColumns.of(problem, model_of(frames, [], camera, []), [], [])


def test_columns_and_blocks_find_each_other() -> None:
    blocks = [
        ("pose", pose_at(0)),
        ("other", np.zeros(2)),
        ("anchor", np.zeros(3)),
        ("anchor", np.ones(3)),
        ("other", np.zeros(1)),
        ("point", np.zeros(3)),
        ("point", np.ones(3)),
    ]
    columns = columns_of(blocks)
    assert columns.starts.tolist() == [0, 6, 8, 11, 14, 15, 18, 21]
    assert [columns.index_at(column) for column in (0, 5, 6, 7, 8, 13, 14, 20)] == [0, 0, 1, 1, 2, 3, 4, 6]
    assert [columns.name(column) for column in (0, 7, 8, 11, 14, 18)] == [
        *("pose number 0", "other number 0", "anchor number 0", "anchor number 1"),
        *("other number 1", "point number 1"),
    ]
    assert columns.span(2) == slice(8, 11)
    assert columns.points.tolist() == [5, 6]
    assert columns.of_blocks(np.array([1, 4, 5])).tolist() == [6, 7, 14, 15, 16, 17]
    some = columns.subset(np.array([1, 3, 4]))
    assert some.kinds == ["other", "anchor", "other"]
    assert some.starts.tolist() == [0, 2, 5, 6]
    assert some.index_of == {address(blocks[k][1]): at for at, k in enumerate((1, 3, 4))}
    assert [address(pose) for pose in some.poses] == [address(blocks[0][1])]
    assert some.points.tolist() == []


def test_a_block_that_is_not_estimated_has_no_variance() -> None:
    pose, anchor = pose_at(0), np.zeros(3)
    columns, of_blocks = columns_of([("pose", pose), ("anchor", anchor)]), [np.eye(6), 2.0 * np.eye(3)]
    np.testing.assert_array_equal(columns.covariance(pose, of_blocks), np.eye(6))
    np.testing.assert_array_equal(columns.covariance(anchor, of_blocks), 2.0 * np.eye(3))
    np.testing.assert_array_equal(columns.covariance(pose_at(1), of_blocks), np.zeros((6, 6)))
    np.testing.assert_array_equal(columns.covariance(np.zeros(3), of_blocks), np.zeros((3, 3)))
    np.testing.assert_array_equal(columns.covariance(np.zeros(1), of_blocks), np.zeros((1, 1)))


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


def test_a_sensor_that_may_only_turn_does_not_move_with_the_scale() -> None:
    found = normal_equations._world_motions(columns_of([("sensor", pose_at(0)), ("anchor", np.ones(3))], [3, 3]))
    assert found.shape == (6, 7)
    assert not found[:3].any()
    assert found[3:].any()


def test_the_whitener_squared_is_the_inverse_of_each_points_own_equations() -> None:
    rng = np.random.default_rng(0)
    jacobian = np.zeros((14, 9))
    for point, rows in enumerate((slice(0, 4), slice(4, 8), slice(8, 14))):
        jacobian[rows, 3 * point : 3 * point + 3] = rng.normal(size=(rows.stop - rows.start, 3))
    whitener = normal_equations._whitener(csc_array(jacobian)).toarray()
    assert whitener.shape == (9, 9)
    np.testing.assert_allclose(whitener @ whitener.T, np.linalg.inv(jacobian.T @ jacobian), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("weakest", "counts_as"), [(0.0, 9e-12), (0.8e-11, 9e-12), (1e-11, 1e-11), (1e-6, 1e-6)])
def test_a_direction_of_a_point_counts_with_at_least_a_trillionth_of_its_best_one(
    weakest: float, counts_as: float
) -> None:
    squares = np.array([weakest, 4.0, 9.0])
    whitener = normal_equations._whitener(csc_array(np.diag(np.sqrt(squares)))).toarray()
    expected = np.diag(1.0 / np.array([counts_as, 4.0, 9.0]))
    np.testing.assert_allclose(whitener @ whitener.T, expected, rtol=1e-6, atol=1e-9)


def test_a_point_that_no_residual_depends_on_has_a_finite_whitener() -> None:
    jacobian = np.zeros((3, 6))
    jacobian[:, 3:] = np.diag([1.0, 2.0, 4.0])
    whitener = normal_equations._whitener(csc_array(jacobian)).toarray()
    assert np.isfinite(whitener).all()
    np.testing.assert_allclose(np.abs(whitener[3:, 3:]).sum(axis=1), [1.0, 0.5, 0.25])
    np.testing.assert_allclose(np.square(whitener[:3, :3]).sum(axis=0), 1e300, rtol=1e-9)


@pytest.mark.parametrize("num_kept", [5, 6, 7, 13])
def test_what_the_points_explain_is_the_part_of_their_elimination(num_kept: int) -> None:
    rng = np.random.default_rng(num_kept)
    points = np.zeros((8, 6))
    points[:4, :3], points[4:, 3:] = rng.normal(size=(2, 4, 3))
    kept = rng.normal(size=(8, num_kept))
    whitener = normal_equations._whitener(csc_array(points))
    found = normal_equations._explained_by(csc_array(points), csr_array(kept), whitener)
    expected = kept.T @ points @ np.linalg.solve(points.T @ points, points.T @ kept)
    assert found.shape == (num_kept, num_kept)
    np.testing.assert_allclose(csr_array(found).toarray(), expected, atol=1e-12)


def test_points_on_which_residuals_depend_have_an_entry_that_is_not_zero() -> None:
    data, rows, columns = [0.0, 2.0, -1.0, 1e-9], [0, 0, 1, 1], [1, 5, 6, 12]
    entries = csr_array((data, (rows, columns)), shape=(2, 15))
    assert entries.nnz == 4
    assert normal_equations._has_entries(entries).tolist() == [False, True, True, False, True]


def test_free_motions_are_those_that_change_no_residual() -> None:
    rng = np.random.default_rng(0)
    motions = rng.normal(size=(10, 7))
    hidden = motions @ rng.normal(size=(7, 2))  # no residual depends on these two motions
    jacobian = rng.normal(size=(30, 10)) @ (np.eye(10) - hidden @ np.linalg.pinv(hidden))
    found = normal_equations._free_motions(motions, np.stack([jacobian @ motions, np.abs(jacobian) @ np.abs(motions)]))
    assert found.shape == (10, 2)
    assert np.linalg.matrix_rank(found) == 2
    np.testing.assert_allclose(hidden @ np.linalg.lstsq(hidden, found, rcond=None)[0], found, atol=1e-12)


def test_a_motion_is_free_below_a_ten_millionth_of_what_its_parts_change() -> None:
    parts = np.array([3.0, 1.0, 2.0, 1.0, 1.0, 1.0, 5.0])
    share = np.array([1.0, 1.0, 1.0, 1e-5, 1.1e-7, 0.9e-7, 0.0])
    found = normal_equations._free_motions(np.eye(7), np.stack([np.diag(share * parts), np.diag(parts)]))
    # The last two are free, of which one unit changes the sum of the parts by 1 and 5.
    expected = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.2**2])
    np.testing.assert_allclose(found @ found.T, expected, atol=1e-8)


def test_a_motion_that_moves_nothing_is_not_free() -> None:
    parts = 1e-6 * np.array([10.0, 1.1e-6, 0.9e-6, 0.0, 1.0, 1.0, 1.0])
    found = normal_equations._free_motions(np.eye(7), np.stack([np.zeros((7, 7)), np.diag(parts)]))
    assert found.shape == (7, 5)
    assert np.flatnonzero(np.abs(found).max(axis=1)).tolist() == [0, 1, 4, 5, 6]


def test_the_size_is_the_median_distance_to_the_points_or_else_to_the_frames() -> None:
    turned = Rotation.from_euler("z", 90, degrees=True)
    centers = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [5.0, 3.0, 0.0], [-1.0, 1.0, 0.0]])  # the middle is (2, 1, 0)
    blocks = [("pose", np.concatenate([turned.as_quat(), -turned.apply(center)])) for center in centers]
    distances = np.sqrt([2.0, 2.0, 13.0, 9.0])
    assert normal_equations._size_m(columns_of(blocks)) == pytest.approx(np.median(distances))
    points = [("point", np.array([2.0, 1.0, z])) for z in (1.0, -7.0, 20.0)]
    assert normal_equations._size_m(columns_of([*blocks, ("anchor", np.full(3, 99.0)), *points])) == pytest.approx(7.0)


def test_a_map_in_one_place_has_the_size_of_one_metre() -> None:
    assert normal_equations._size_m(columns_of([("pose", np.array([0.0, 0, 0, 1, 2, 3, 4]))])) == 1.0


def test_the_rotation_of_a_pose_is_that_of_its_quaternion() -> None:
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5), 7.0, 8.0, 9.0])
    np.testing.assert_allclose(rotation_of(quarter), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def equations_of(columns: BlockColumns, of_photos: Array) -> NormalEquations:
    size = len(of_photos)
    return NormalEquations(
        reconstruction=cast("Any", None),
        columns=columns,
        of_photos=csr_array(of_photos),
        gradient=np.arange(float(size)),
        others=csr_array((0, size)),
        num_reprojections=0,
        free=np.zeros((size, 0)),
        free_of_photos=np.zeros((size, 0)),
        size_m=1.0,
    )


def test_loose_poses_are_held_by_a_trillionth_of_what_their_photos_say() -> None:
    columns = columns_of([("pose", pose_at(0)), ("sensor", pose_at(1)), ("anchor", np.zeros(3)), ("pose", pose_at(2))])
    given = np.diag(np.arange(1.0, 22.0)) + 0.1
    equations = equations_of(columns, given)
    held = equations.with_loose_poses_held()
    added = csr_array(held.of_photos).toarray() - given
    # The values are about 10, so that rounding leaves some 1e-15 of a change of some 1e-11.
    expected = np.diag(1e-12 * given.diagonal() * np.repeat([1, 0, 0, 1], [6, 6, 3, 6]))
    np.testing.assert_allclose(added, expected, atol=6e-15)
    np.testing.assert_array_equal(held.gradient, equations.gradient)
    np.testing.assert_array_equal(csr_array(equations.of_photos).toarray(), given)


def test_blocks_that_photos_depend_on_have_a_column_that_is_not_zero() -> None:
    blocks = [("anchor", np.zeros(3)), ("pose", pose_at(0)), ("other", np.zeros(2)), ("other", np.zeros(1))]
    diagonal = np.zeros(12)
    diagonal[[3, 4, 10]] = 1.0, 2.0, 1e-9  # two columns of the pose, and the last one of the next block
    assert equations_of(columns_of(blocks), np.diag(diagonal)).seen_blocks.tolist() == [1, 2]


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
