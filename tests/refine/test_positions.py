"""Known positions that hold a map in the refinement: which take part, and the residuals that they become."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known
from tests.refine.test_bundle_adjustment import a_bundle

from rangesfm.distances.tape import Marker
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import AssociationOptions
from rangesfm.positions.antenna_track import AntennaTrack
from rangesfm.positions.surveyed_positions import SurveyedPositions
from rangesfm.ranging.errors.robust_loss import RobustLoss
from rangesfm.refine.bundle_adjustment import BundleAdjustment
from rangesfm.refine.positions import HeldAntenna, HeldPositions, add_positions
from rangesfm.refine.vision_information import model_poses

Array = npt.NDArray[np.float64]
ARM_M = np.array([0.1, -0.3, 0.2])
PLACED = Similarity(2.5, Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(), np.array([4.0, -7.0, 2.0]))


def path(*, is_timed: bool = True) -> Trajectory:
    """Return four keyframes of an unscaled model."""
    rng = np.random.default_rng(1)
    return Trajectory(
        np.array([11, 12, 13, 14]),
        ("a", "b", "c", "d"),
        np.array([0.0, 1.0, 3.0, 3.5]) if is_timed else None,
        rng.normal(size=(4, 3)),
        Rotation.random(4, random_state=2).as_matrix(),
    )


def a_track(offset_s: float | None = 0.5, offset_stddev_s: float = 0.01) -> AntennaTrack:
    log: Any = None
    return AntennaTrack(log, ARM_M, offset_s, AssociationOptions(), offset_stddev_s)


def estimate(*, is_used: list[bool]) -> Any:
    """Return the scale by two marks and three positions of an antenna, of which some take part."""
    rng = np.random.default_rng(3)
    covariances = np.array([np.diag([1.0, 1.0, 4.0])] * 5)
    covariances[3] = np.nan
    found = SimpleNamespace(
        names=("P", "Q", "t1", "t2", "t3"),
        is_mark=np.array([True, True, False, False, False]),
        on_path=np.array([[-1, -1], [-1, -1], [0, 1], [1, 2], [3, 3]]),
        fraction=np.array([0.0, 0.0, 0.25, 0.5, 0.0]),
        from_line=rng.normal(0, 0.1, (5, 3)),
        arms_m=rng.normal(0, 0.3, (5, 3)),
        position_m=rng.normal(0, 9, (5, 3)),
        covariance_m2=covariances,
    )
    stddev_m = np.array([0.01, 0.02, 0.03, 0.04, 0.05])
    return SimpleNamespace(
        known=found, site_from_model=PLACED, is_used=np.array(is_used), stddev_m=stddev_m, inflation=2.0
    )


def test_an_antenna_is_held_where_the_scale_stage_put_it() -> None:
    found, trajectory = estimate(is_used=[True, False, True, True, True]), path()
    held = known(HeldAntenna.of(found, a_track(), trajectory))
    in_model = trajectory.centers
    on_line = np.array([0.75 * in_model[0] + 0.25 * in_model[1], 0.5 * in_model[1] + 0.5 * in_model[2], in_model[3]])
    expected = PLACED.apply(on_line + found.known.from_line[2:]) + found.known.arms_m[2:] @ PLACED.rotation.T
    metric = trajectory.transformed(PLACED.scale, PLACED.rotation, PLACED.translation)
    tags_m = metric.centers + metric.world_from_cam @ ARM_M
    share = held.fraction[:, None]
    at = (1 - share) * tags_m[held.before] + share * tags_m[held.after] + held.offset_in_world_m
    np.testing.assert_allclose(at, expected, atol=1e-12)
    np.testing.assert_allclose(held.position_m, found.known.position_m[2:])
    np.testing.assert_allclose(held.interval_s, [1.0, 2.0, 0.0])
    np.testing.assert_array_equal(held.frame_ids, [11, 12, 13, 14])
    assert held.share == pytest.approx(0.25)
    assert held.time_shift_stddev_s == 0.01
    np.testing.assert_array_equal(held.time_shift_s, [0.0])
    given_m, arm_m = held.antenna_in_cam_m
    np.testing.assert_array_equal(given_m, ARM_M)
    np.testing.assert_array_equal(arm_m, ARM_M)
    assert not np.shares_memory(given_m, arm_m)
    assert not np.shares_memory(given_m, ARM_M)


def test_covariances_of_positions_keep_their_shape_and_get_the_learnt_size() -> None:
    held = known(HeldAntenna.of(estimate(is_used=[True] * 5), a_track(), path()))
    found = [np.linalg.inv(whitening.T @ whitening) for whitening in held.whitening]
    # The mean of the variances 1, 1 and 4 is 2; without a covariance all axes are alike.
    np.testing.assert_allclose(found[0], 0.03**2 * np.diag([0.5, 0.5, 2.0]), atol=1e-12)
    np.testing.assert_allclose(found[1], 0.04**2 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found[2], 0.05**2 * np.diag([0.5, 0.5, 2.0]), atol=1e-12)
    positions = HeldPositions({}, {}, {"P": 0.01}, held)
    assert positions.stddevs_m == pytest.approx([0.01, 0.03, 0.04, 0.05])
    assert HeldPositions({}, {}, {"P": 0.01, "Q": 0.02}).stddevs_m == [0.01, 0.02]


def test_an_antenna_on_a_path_without_times_has_intervals_of_zero() -> None:
    held = known(HeldAntenna.of(estimate(is_used=[True] * 5), a_track(), path(is_timed=False)))
    np.testing.assert_array_equal(held.interval_s, [0.0, 0.0, 0.0])


def test_only_positions_that_took_part_in_the_scale_are_held() -> None:
    points: Any = SimpleNamespace(markers={name: Marker((), np.zeros((0, 2)), ()) for name in "PQR"})
    surveyed = SurveyedPositions(points, a_track())
    found = estimate(is_used=[False, True, False, True, False])
    held = HeldPositions.of(found, surveyed, path())
    assert held.markers == {"Q": surveyed.markers["Q"]}
    assert held.position_m.keys() == {"Q"}
    np.testing.assert_array_equal(held.position_m["Q"], found.known.position_m[1])
    assert held.stddev_m == {"Q": 0.02}
    np.testing.assert_array_equal(known(held.antenna).position_m, found.known.position_m[[3]])
    marks_alone = HeldPositions.of(estimate(is_used=[True, True, False, False, False]), surveyed, path())
    assert marks_alone.antenna is None
    assert list(marks_alone.position_m) == ["P", "Q"]
    assert HeldPositions.of(found, SurveyedPositions(points), path()).antenna is None
    assert HeldPositions.of(None, surveyed, path()) == HeldPositions()


def test_refined_positions_have_the_lever_arm_and_the_time_offset_of_the_solver() -> None:
    held = known(HeldAntenna.of(estimate(is_used=[True] * 5), a_track(), path()))
    held.antenna_in_cam_m[1][:] = [1.0, 2.0, 3.0]
    held.time_shift_s[:] = 0.125
    positions, surveyed = HeldPositions(antenna=held), SurveyedPositions(antenna=a_track(0.5))
    track = known(positions.refined(surveyed).antenna)
    np.testing.assert_array_equal(track.antenna_in_cam_m, [1.0, 2.0, 3.0])
    assert track.offset_s == pytest.approx(0.625)
    by_photo = positions.refined(SurveyedPositions(antenna=a_track(None))).antenna
    assert known(by_photo).offset_s is None
    assert HeldPositions().refined(surveyed) is surveyed
    nothing = SurveyedPositions()
    assert positions.refined(nothing) is nothing


def residuals_added(bundle: BundleAdjustment) -> Array:
    """Return the residuals after those of the photos, but for the ties, which are always zero."""
    residuals = np.asarray(bundle.adjuster.problem.evaluate_residuals())[bundle.num_reprojections :]
    return np.asarray(residuals[residuals != 0])


def test_the_errors_of_a_control_point_are_those_of_its_survey_and_of_its_marks() -> None:
    bundle = a_bundle()
    point_id = min(bundle.metric.points3D)
    off_m, of_marks_m2 = np.array([0.03, -0.01, 0.02]), np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 9.0]])
    position_m = bundle.metric.point3D(point_id).xyz + off_m
    positions = HeldPositions({}, {"P": position_m}, {"P": 0.02})
    added = add_positions(
        bundle, positions, {"P": point_id}, {"P": 1e-4 * of_marks_m2}, lever_arm_stddev_m=0.1, loss_scale=1.0
    )
    assert added == []
    expected = off_m @ np.linalg.solve(0.02**2 * np.eye(3) + 1e-4 * of_marks_m2, off_m)
    found = residuals_added(bundle)
    assert found @ found == pytest.approx(bundle.pixel_stddev**2 * expected)


def an_antenna(bundle: BundleAdjustment, time_shift_stddev_s: float) -> HeldAntenna:
    """Return an antenna's positions: two between keyframes, one at a keyframe, off by some centimetres."""
    rng = np.random.default_rng(5)
    return HeldAntenna(
        frame_ids=np.array(sorted(bundle.metric.reg_frame_ids())),
        before=np.array([3, 1, 1]),
        after=np.array([3, 2, 2]),
        fraction=np.array([0.0, 0.25, 0.5]),
        offset_in_world_m=np.array([[0.0] * 3, [0.1, 0.2, 0.3], [0.2, 0.1, 0.1]]),
        interval_s=np.array([0.0, 2.0, 2.0]),
        position_m=rng.normal(size=(3, 3)),
        whitening=np.asarray(np.linalg.inv(0.1 * np.eye(3) + 0.02 * rng.normal(size=(3, 3, 3)))),
        share=0.25,
        antenna_in_cam_m=(ARM_M, ARM_M.copy()),
        time_shift_s=np.zeros(1),
        time_shift_stddev_s=time_shift_stddev_s,
    )


def errors_of(bundle: BundleAdjustment, antenna: HeldAntenna, arm_m: Array, shift_s: float) -> Array:
    """Return the whitened errors (3, 3), predicted minus measured, in the order of keyframes."""
    poses = model_poses(bundle.metric, antenna.frame_ids)
    tags_m = poses.centers + poses.world_from_rig @ arm_m
    shares = antenna.fraction + np.array([0.0, shift_s / 2, shift_s / 2])
    at = (1 - shares)[:, None] * tags_m[antenna.before] + shares[:, None] * tags_m[antenna.after]
    off_m = at + antenna.offset_in_world_m - antenna.position_m
    return np.asarray(np.einsum("nij,nj->ni", antenna.whitening, off_m)[[1, 2, 0]])


@pytest.mark.parametrize("arm_stddev_m", [0.0, 0.1])
@pytest.mark.parametrize("shift_stddev_s", [0.0, 0.05])
def test_positions_of_an_antenna_are_residuals_in_pixels(arm_stddev_m: float, shift_stddev_s: float) -> None:
    bundle = a_bundle()
    antenna = an_antenna(bundle, shift_stddev_s)
    (_, arm_m), shift_s = antenna.antenna_in_cam_m, antenna.time_shift_s
    positions = HeldPositions(antenna=antenna)
    added = add_positions(bundle, positions, {}, {}, lever_arm_stddev_m=arm_stddev_m, loss_scale=np.inf)
    wanted = [block for block, stddev in ((arm_m, arm_stddev_m), (shift_s, shift_stddev_s)) if stddev > 0]
    assert [id(block) for block in added] == [id(block) for block in wanted]
    arm_m += [0.02, -0.01, 0.03]
    shift_s += 0.1
    arm_used, shift_used = arm_m if arm_stddev_m else ARM_M, 0.1 if shift_stddev_s else 0.0
    expected = [*(0.5 * errors_of(bundle, antenna, arm_used, shift_used)).ravel()]
    expected += [*(np.array([0.02, -0.01, 0.03]) / arm_stddev_m if arm_stddev_m else [])]
    expected += [0.1 / shift_stddev_s] if shift_stddev_s else []
    np.testing.assert_allclose(residuals_added(bundle), bundle.pixel_stddev * np.array(expected), rtol=1e-9)


def test_a_position_far_off_counts_less() -> None:
    bundle = a_bundle()
    antenna = an_antenna(bundle, 0.0)
    add_positions(bundle, HeldPositions(antenna=antenna), {}, {}, lever_arm_stddev_m=0.0, loss_scale=4.0)
    squared = np.sum(errors_of(bundle, antenna, ARM_M, 0.0) ** 2, axis=1)
    expected = 0.25 * bundle.pixel_stddev**2 * RobustLoss(4.0, is_bounded=True).rho(squared)[0]
    found = residuals_added(bundle).reshape(3, 3)
    np.testing.assert_allclose(np.sum(found**2, axis=1), expected, rtol=1e-9)


def test_a_time_shift_of_positions_at_keyframes_alone_is_not_estimated() -> None:
    bundle = a_bundle()
    all_of_them = an_antenna(bundle, 0.05)
    names = ("before", "after", "fraction", "offset_in_world_m", "interval_s", "position_m", "whitening")
    columns: dict[str, Any] = {name: getattr(all_of_them, name)[[0]] for name in names}
    antenna = replace(all_of_them, **columns)
    added = add_positions(bundle, HeldPositions(antenna=antenna), {}, {}, lever_arm_stddev_m=0.1, loss_scale=np.inf)
    assert len(added) == 1
    assert added[0] is antenna.antenna_in_cam_m[1]
