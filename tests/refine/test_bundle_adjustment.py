"""The bundle adjustment of photos that the ranges are added to."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.known import known
from tests.simulated.model import synthetic_model
from tests.simulated.path import orbit_path

from rangesfm import ceres
from rangesfm.errors import SolverError
from rangesfm.geometry.trajectory import pose_of
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.refine import bundle_adjustment as of_photos
from rangesfm.refine.bundle_adjustment import (
    BundleAdjustment,
    SolverRun,
    bundle_adjustment,
    pixel_stddev_of,
    solve_bundle_adjustment,
    solve_until_still,
)

Array = npt.NDArray[np.float64]


def orbit() -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(_orbit())


@cache
def _orbit() -> pycolmap.Reconstruction:
    times, path = np.arange(6.0), orbit_path(8.0)
    poses = (times, path.centers(times), path.world_from_cam(times))
    return synthetic_model(*poses, num_observations=20, pixel_stddev=1.0).reconstruction


@pytest.mark.parametrize(("num_left", "expected"), [(1, False), (20, True)])
def test_a_map_is_at_rest_only_after_the_iterations_that_it_needs(num_left: int, expected: bool) -> None:
    model = orbit()
    rng = np.random.default_rng(0)
    for point in model.points3D.values():
        point.xyz += 0.3 * rng.standard_normal(3)
    one_step = RefineOptions(max_num_iterations=1)
    bundle = bundle_adjustment(model, CameraOptions(), one_step, fixed_frame_id=None, num_threads=1)
    run = solve_bundle_adjustment(bundle, tolerance_m=1e-4)
    assert not run.is_still
    assert solve_until_still(bundle, run, tolerance_m=1e-4, num_left=num_left)[1] == expected


def test_points_that_are_left_out_take_no_part_and_stay_in_the_model() -> None:
    model = orbit()
    before = {point_id: (point.xyz.copy(), point.track.length()) for point_id, point in model.points3D.items()}
    num_seen = {image_id: image.num_points3D for image_id, image in model.images.items()}
    left_out = sorted(before)[2:5]
    bundle = bundle_adjustment(
        model, CameraOptions(), RefineOptions(), fixed_frame_id=None, num_threads=1, left_out_ids=left_out
    )
    problem = bundle.adjuster.problem
    takes_part = {point_id for point_id, point in model.points3D.items() if problem.has_parameter_block(point.xyz)}
    assert takes_part == before.keys() - set(left_out)
    assert problem.num_residuals() == 2 * sum(num for point_id, (_, num) in before.items() if point_id in takes_part)
    assert {image_id: image.num_points3D for image_id, image in model.images.items()} == num_seen
    for point_id, (xyz, length) in before.items():
        point = model.point3D(point_id)
        np.testing.assert_array_equal(point.xyz, xyz)
        assert point.track.length() == length
        for element in point.track.elements:
            assert model.image(element.image_id).point2D(element.point2D_idx).point3D_id == point_id


def a_bundle(model: pycolmap.Reconstruction | None = None, **options: Any) -> BundleAdjustment:
    given = {"camera": CameraOptions(), "options": RefineOptions(), "fixed_frame_id": None, "num_threads": 1}
    return bundle_adjustment(orbit() if model is None else model, **{**given, **options})


def test_a_model_without_points_that_take_part_is_refused() -> None:
    model = orbit()
    with pytest.raises(SolverError, match="no point of the model takes part in the bundle adjustment"):
        a_bundle(model, left_out_ids=list(model.points3D))


def test_reprojection_errors_are_those_of_the_projected_points() -> None:
    model = orbit()
    bundle = a_bundle(model)
    squared = []
    for image in model.images.values():
        for feature in image.points2D:
            if feature.has_point3D():
                off_px = known(image.project_point(model.point3D(feature.point3D_id).xyz)) - feature.xy
                squared.append(off_px @ off_px)
    assert bundle.num_reprojections == 2 * len(squared)
    assert bundle.reprojection_rms_px == pytest.approx(np.sqrt(np.mean(squared)))
    # Residuals of others do not count.
    anchor_m = np.zeros(3)
    with_anchor(bundle, anchor_m)
    bundle.add_prior(anchor_m, np.full(3, 1e6), 1e-3)
    assert bundle.reprojection_rms_px == pytest.approx(np.sqrt(np.mean(squared)))


def stub_of_adjuster(residuals: list[float], num_parameters: int) -> Any:
    problem = SimpleNamespace(evaluate_residuals=lambda: residuals, num_parameters=lambda: num_parameters)
    return SimpleNamespace(problem=problem)


@pytest.mark.parametrize(
    ("num_parameters", "expected"),
    [
        (0, 0.3 * 1.4826022),
        (9, 0.3 * 1.4826022 * np.sqrt(12 / 3)),
        (11, 0.3 * 1.4826022 * np.sqrt(12)),
        (12, 0.3 * 1.4826022 * np.sqrt(12)),
        (50, 0.3 * 1.4826022 * np.sqrt(12)),
    ],
)
def test_parameters_that_absorb_residuals_make_the_noise_of_pixels_larger(num_parameters: int, expected: float) -> None:
    """The robust standard deviation is 1.4826 times the median of the residuals' sizes, without the last of others."""
    residuals = [*([0.1, -0.2, 0.3, -0.3, 0.4, -5.0] * 2), 90.0, 90.0]
    found = pixel_stddev_of(stub_of_adjuster(residuals, num_parameters), 12)
    assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("residual_px", "expected"), [(0.0, 0.05), (0.03, 0.05), (0.04, 0.04 * 1.4826022)])
def test_no_feature_is_located_more_precisely_than_to_a_twentieth_of_a_pixel(
    residual_px: float, expected: float
) -> None:
    assert pixel_stddev_of(stub_of_adjuster([residual_px] * 8, 0), 8) == pytest.approx(expected, rel=1e-4)


def of_num_photos(num: int) -> BundleAdjustment:
    metric: Any = SimpleNamespace(num_reg_images=lambda: num)
    return BundleAdjustment(metric, stub_of_adjuster([], 0), 0, 1.0, iter(()))


@pytest.mark.parametrize(("num", "is_affordable"), [(1500, True), (1501, False), (1501, True)])
def test_a_covariance_of_more_than_1500_photos_needs_photos_that_overlap_little(
    num: int, is_affordable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(of_photos, "overlaps_in", lambda metric: metric.num_reg_images())

    def is_affordable_for(*given: Any) -> bool:
        asked.append(given)
        return is_affordable

    monkeypatch.setattr(of_photos, "inverse_is_affordable", is_affordable_for)
    assert of_num_photos(num).has_covariance == is_affordable
    assert asked == ([] if num == 1500 else [(1501, 1500)])


def test_parameters_of_a_camera_are_refined_by_kind() -> None:
    cameras = {
        1: pycolmap.Camera(model="OPENCV", width=640, height=480, params=[500.0, 500.0, 320.0, 240.0, 0, 0, 0, 0]),
        2: pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[500.0, 320.0, 240.0, 0.0]),
    }

    def refined(*kinds: str) -> dict[int, list[int]]:
        names = ("focal_length", "principal_point", "extra_params")
        options = SimpleNamespace(**{f"refine_{name}": name in kinds for name in names})
        adjuster: Any = SimpleNamespace(options=options)
        metric: Any = SimpleNamespace(cameras=cameras)
        return BundleAdjustment(metric, adjuster, 0, 1.0, iter(())).refined_params

    assert refined() == {1: [], 2: []}
    assert refined("focal_length") == {1: [0, 1], 2: [0]}
    assert refined("principal_point") == {1: [2, 3], 2: [1, 2]}
    assert refined("extra_params") == {1: [4, 5, 6, 7], 2: [3]}
    assert refined("extra_params", "focal_length") == {1: [0, 1, 4, 5, 6, 7], 2: [0, 3]}


def with_anchor(bundle: BundleAdjustment, anchor_m: Array) -> None:
    """Add a distance of 1 m from a point to an anchor."""
    point = min(bundle.metric.points3D.items())[1].xyz
    cost = ceres.distance_cost(distance_m=1.0, stddev_m=1.0)
    ceres.add_residual_block(bundle.adjuster, cost, None, [point, anchor_m])


def test_a_prior_is_a_residual_in_pixels() -> None:
    bundle, anchor_m = a_bundle(), np.array([30.0, 40.0, 50.0])
    with_anchor(bundle, anchor_m)
    before = bundle.adjuster.problem.num_residuals()
    bundle.add_prior(anchor_m, anchor_m + np.array([0.1, -0.2, 0.4]), 0.2)
    residuals = np.asarray(bundle.adjuster.problem.evaluate_residuals())[before:]
    found, ties = residuals[:3], residuals[3:]
    np.testing.assert_allclose(found, bundle.pixel_stddev * np.array([-0.5, 1.0, -2.0]))
    assert len(ties) > 0
    np.testing.assert_array_equal(ties, 0.0)
    assert not bundle.adjuster.problem.is_parameter_block_constant(anchor_m)


def test_a_prior_without_a_mean_leaves_the_block_free() -> None:
    bundle, anchor_m = a_bundle(), np.array([30.0, 40.0, 50.0])
    with_anchor(bundle, anchor_m)
    before = bundle.adjuster.problem.num_residuals()
    bundle.add_prior(anchor_m, None, np.inf)
    added = np.asarray(bundle.adjuster.problem.evaluate_residuals())[before:]
    assert len(added) > 0
    np.testing.assert_array_equal(added, 0.0)
    assert bundle.adjuster.problem.has_manifold(anchor_m)
    assert not bundle.adjuster.problem.is_parameter_block_constant(anchor_m)


@pytest.mark.parametrize("mean", [None, np.zeros(3)])
def test_a_standard_deviation_of_zero_fixes_the_block(mean: Array | None) -> None:
    bundle, anchor_m = a_bundle(), np.array([30.0, 40.0, 50.0])
    with_anchor(bundle, anchor_m)
    before = bundle.adjuster.problem.num_residuals()
    bundle.add_prior(anchor_m, mean, 0.0)
    assert bundle.adjuster.problem.is_parameter_block_constant(anchor_m)
    assert bundle.adjuster.problem.num_residuals() == before


@pytest.mark.parametrize("stddev", [0.0, 0.1])
def test_a_block_that_no_residual_has_gets_no_prior(stddev: float) -> None:
    bundle, unknown_m = a_bundle(), np.zeros(3)
    before = bundle.adjuster.problem.num_residuals()
    bundle.add_prior(unknown_m, np.ones(3), stddev)
    bundle.add_prior(None, np.ones(3), stddev)
    assert bundle.adjuster.problem.num_residuals() == before
    assert not bundle.adjuster.problem.has_parameter_block(unknown_m)


def test_a_block_needs_no_tie_where_there_is_no_point_for_it() -> None:
    model = orbit()
    bundle, anchor_m = a_bundle(model, marker_ids=list(model.points3D)), np.array([30.0, 40.0, 50.0])
    with_anchor(bundle, anchor_m)
    before = bundle.adjuster.problem.num_residuals()
    bundle.add_prior(anchor_m, np.zeros(3), 0.1)
    assert bundle.adjuster.problem.num_residuals() == before + 3


def test_blocks_are_tied_to_points_in_turn_those_of_short_tracks_first(monkeypatch: pytest.MonkeyPatch) -> None:
    model = orbit()
    order = sorted(model.points3D, key=lambda point_id: (model.point3D(point_id).track.length(), point_id))
    marker, left_out = order[1], order[3]
    monkeypatch.setattr(of_photos, "_MAX_NUM_TIE_POINTS", 4)
    bundle = a_bundle(model, marker_ids=[marker], left_out_ids=[left_out])
    # A point that was taken out and put back is a new object, so addresses are compared.
    expected = [order[k] for k in (0, 2, 4, 5)]
    found = [next(bundle.tie_points).ctypes.data for _ in range(6)]
    assert found == [model.point3D(point_id).xyz.ctypes.data for point_id in [*expected, *expected[:2]]]


def test_a_frame_is_held_where_it_is_if_it_fixes_the_frame() -> None:
    model = orbit()
    frame_ids = sorted(model.reg_frame_ids())
    before = {frame_id: pose_of(model.frame(frame_id)).params.copy() for frame_id in frame_ids}
    bundle = a_bundle(model, fixed_frame_id=frame_ids[2])
    assert solve_bundle_adjustment(bundle, tolerance_m=1e-6).converged
    held = [f for f in frame_ids if np.allclose(pose_of(model.frame(f)).params, before[f], rtol=0, atol=1e-9)]
    assert held == [frame_ids[2]]
    assert not bundle.adjuster.problem.has_parameter_block(pose_of(model.frame(frame_ids[2])).params)


def test_the_photos_alone_leave_all_seven_of_the_gauge_free() -> None:
    model = orbit()
    bundle = a_bundle(model)
    problem = bundle.adjuster.problem
    frames = [pose_of(model.frame(frame_id)).params for frame_id in model.reg_frame_ids()]
    assert all(problem.has_parameter_block(f) and not problem.is_parameter_block_constant(f) for f in frames)
    points = [point.xyz for point in model.points3D.values()]
    assert not any(problem.is_parameter_block_constant(point) for point in points)


@pytest.mark.parametrize(
    ("refines", "variable"),
    [((False, False), [False, False]), ((True, False), [True, False]), ((False, True), [False, True])],
)
def test_only_cameras_whose_table_says_so_are_refined(refines: tuple[bool, bool], variable: list[bool]) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=20)
    model = pycolmap.synthesize_dataset(options)
    second = CameraOptions(images="camera000002*", refine_intrinsics=refines[1])
    bundle = a_bundle(model, camera=CameraOptions(refine_intrinsics=refines[0], others=(second,)))
    problem, cameras = bundle.adjuster.problem, [model.camera(k).params for k in (1, 2)]
    found = [problem.has_parameter_block(c) and not problem.is_parameter_block_constant(c) for c in cameras]
    assert found == variable
    assert bundle.adjuster.options.refine_focal_length == any(refines)
    assert bundle.adjuster.options.refine_extra_params == any(refines)
    assert not bundle.adjuster.options.refine_principal_point


def test_the_dense_solver_serves_more_than_50_photos_where_it_is_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    times, path = np.linspace(0.0, 8.0, 51), orbit_path(8.0)
    poses = (times, path.centers(times), path.world_from_cam(times))
    model = synthetic_model(*poses, num_observations=3, max_track_length=2).reconstruction
    monkeypatch.setattr(of_photos, "overlaps_in", lambda metric: metric.num_reg_images())

    def limits(is_faster: bool, max_num_direct: int) -> tuple[int, int]:
        """Return the limits of the dense and the sparse solver."""
        monkeypatch.setattr(of_photos, "dense_is_faster", lambda overlaps: overlaps == 51 and is_faster)
        direct = {(51, 1000): max_num_direct}
        monkeypatch.setattr(of_photos, "max_num_images_direct", lambda *given: direct[given])
        found = a_bundle(model).adjuster.options.ceres
        return found.max_num_images_direct_dense_cpu_solver, found.max_num_images_direct_sparse_cpu_solver

    assert limits(True, 1000) == (51, 1000)
    assert limits(True, 52) == (51, 52)
    assert limits(True, 51) == (50, 51)  # the limits must differ
    assert limits(False, 2000) == (50, 2000)
    for frame_id in (51, 50):  # 50 photos, or fewer, are no question
        model.deregister_frame(frame_id)
        assert limits(True, 3000) == (50, 1000)


def a_run(*, is_still: bool = False, is_stuck: bool = False, num_iterations: int = 2) -> SolverRun:
    return SolverRun(num_iterations, 1.0, 1.0, 0.0, True, is_still, is_stuck, "")


class Solver:
    """A solver that moves the first keyframe by one length after another, and says what is given of each solution."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, moves_m: list[float], **said: Any) -> None:
        self.problem = a_bundle()
        self.num_settled = 0
        self._moves_m, self._said = iter(moves_m), said
        monkeypatch.setattr(of_photos, "solve_bundle_adjustment", self.solve)
        monkeypatch.setattr(of_photos, "_settle_radio", self.settle)

    def solve(self, problem: BundleAdjustment, tolerance_m: float) -> SolverRun:
        assert tolerance_m == 0.01
        frame_id = min(problem.metric.reg_frame_ids())
        pose_of(problem.metric.frame(frame_id)).params[4] += next(self._moves_m)
        return a_run(**self._said)

    def settle(self, problem: BundleAdjustment) -> None:
        assert problem is self.problem
        self.num_settled += 1

    def until_still(self, before: SolverRun, num_left: int) -> tuple[int, bool]:
        found, is_still = solve_until_still(self.problem, before, 0.01, num_left)
        assert self.num_settled == len(found)
        return len(found), is_still


def test_a_map_that_is_still_is_not_solved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Solver(monkeypatch, []).until_still(a_run(is_still=True), 100) == (0, True)


@pytest.mark.parametrize(("num_left", "num_solved"), [(0, 0), (1, 1), (2, 1), (3, 2), (4, 2), (5, 3)])
def test_solutions_end_when_no_iterations_are_left(
    num_left: int, num_solved: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = Solver(monkeypatch, [1.0] * 9, num_iterations=2)
    assert moving.until_still(a_run(), num_left) == (num_solved, False)


def test_a_solution_without_iterations_counts_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Solver(monkeypatch, [1.0] * 9, num_iterations=0).until_still(a_run(), 3) == (3, False)


def test_keyframes_are_at_rest_once_a_solution_moves_none_beyond_the_tolerance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Each solution counts from the one before, not from the start.
    assert Solver(monkeypatch, [1.0, 0.011, 0.009, 1.0]).until_still(a_run(), 100) == (3, True)


def test_keyframes_that_rest_although_steps_promise_more_are_at_no_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    stuck = Solver(monkeypatch, [1.0, 0.009, 1.0], is_stuck=True)
    assert stuck.until_still(a_run(), 100) == (2, False)


def test_a_solver_that_says_that_all_is_still_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Solver(monkeypatch, [1.0], is_still=True, is_stuck=True).until_still(a_run(), 100) == (1, True)


def test_the_radio_settles_while_the_map_is_held() -> None:
    bundle, truth_m = a_bundle(fixed_frame_id=None), np.array([3.0, 4.0, 5.0])
    model, problem, anchor_m = bundle.metric, bundle.adjuster.problem, truth_m + 0.5
    for point_id in sorted(model.points3D)[:8]:
        point = model.point3D(point_id).xyz
        cost = ceres.distance_cost(distance_m=np.linalg.norm(truth_m - point), stddev_m=1.0)
        ceres.add_residual_block(bundle.adjuster, cost, None, [point, anchor_m])
    held, moving = model.point3D(sorted(model.points3D)[3]).xyz, model.point3D(sorted(model.points3D)[4]).xyz
    problem.set_parameter_block_constant(held)
    before = [pose_of(model.frame(f)).params.copy() for f in model.reg_frame_ids()]
    points = {point_id: point.xyz.copy() for point_id, point in model.points3D.items()}
    of_photos._settle_radio(bundle)
    np.testing.assert_allclose(anchor_m, truth_m, atol=1e-6)
    np.testing.assert_array_equal([pose_of(model.frame(f)).params for f in model.reg_frame_ids()], before)
    for point_id, xyz in points.items():
        np.testing.assert_array_equal(model.point3D(point_id).xyz, xyz)
    assert problem.is_parameter_block_constant(held)
    assert not problem.is_parameter_block_constant(moving)
    assert not any(problem.is_parameter_block_constant(pose_of(model.frame(f)).params) for f in model.reg_frame_ids())


def test_the_run_of_a_solver_is_summarised() -> None:
    model = orbit()
    bundle = a_bundle(model)
    before = 0.5 * bundle.num_reprojections / 2 * bundle.reprojection_rms_px**2
    run = solve_bundle_adjustment(bundle, tolerance_m=0.0125)
    assert run.is_still
    assert run.converged
    assert not run.is_stuck
    assert run.message == "Converged: further steps would move the keyframes by less than 0.013 m."
    assert run.initial_cost == pytest.approx(before)
    assert run.final_cost == pytest.approx(0.5 * bundle.num_reprojections / 2 * bundle.reprojection_rms_px**2)
    assert run.final_cost < run.initial_cost
    assert 1 <= run.num_iterations < 20


def test_a_solver_that_stops_after_its_iterations_has_not_converged() -> None:
    model = orbit()
    for point in model.points3D.values():
        point.xyz += 0.3
    run = solve_bundle_adjustment(a_bundle(model, options=RefineOptions(max_num_iterations=2)), tolerance_m=1e-9)
    assert not run.converged
    assert not run.is_still
    assert "iterations" in run.message


@pytest.mark.parametrize(
    ("name", "converged"),
    [("CONVERGENCE", True), ("USER_SUCCESS", True), ("NO_CONVERGENCE", False), ("USER_FAILURE", False)],
)
def test_a_solver_converged_if_it_stopped_by_itself(
    name: str, converged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = SimpleNamespace(
        IsSolutionUsable=lambda: True, num_successful_steps=3, num_unsuccessful_steps=4, initial_cost=9.0,
        final_cost=5.0, termination_type=SimpleNamespace(name=name), message="the reason",
    )  # fmt: skip
    monkeypatch.setattr(ceres, "solve_adjuster", lambda *_: summary)
    monkeypatch.setattr(of_photos, "time", SimpleNamespace(monotonic=iter([100.0, 103.5]).__next__))
    run = solve_bundle_adjustment(a_bundle(), tolerance_m=0.1)
    assert (run.num_iterations, run.initial_cost, run.final_cost, run.seconds) == (7, 9.0, 5.0, 3.5)
    assert run.converged == converged
    by_monitor = "The last steps were kept small, so that the keyframes may have farther to go."
    assert run.message == (by_monitor if name == "USER_SUCCESS" else "the reason")


def test_a_solver_that_fails_is_an_error_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    summary = SimpleNamespace(IsSolutionUsable=lambda: False, message="residual is not finite")
    monkeypatch.setattr(ceres, "solve_adjuster", lambda *_: summary)
    with pytest.raises(SolverError, match="the bundle adjustment with ranges failed: residual is not finite"):
        solve_bundle_adjustment(a_bundle(), tolerance_m=0.1)


def test_a_solver_that_cannot_take_the_steps_it_needs_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def solve(_: Any, is_enough: Callable[[ceres.Step], bool]) -> Any:
        is_enough(ceres.Step(False, 1e10, cost=1e9, gain=-1e9, expected_gain=1e4))
        reason = SimpleNamespace(name="CONVERGENCE")
        return SimpleNamespace(
            IsSolutionUsable=lambda: True, num_successful_steps=1, num_unsuccessful_steps=0, initial_cost=9.0,
            final_cost=5.0, termination_type=reason, message="the reason",
        )  # fmt: skip

    monkeypatch.setattr(ceres, "solve_adjuster", solve)
    run = solve_bundle_adjustment(a_bundle(), tolerance_m=0.1)
    assert run.is_stuck
    assert not run.is_still
    assert run.message == "Some points or the lens allow only small steps, too small to reach the best map."
