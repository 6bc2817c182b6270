"""A map that has drifted is brought back by the log of an inertial sensor alone, as near to the truth as it says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.estimation.conftest import bent, poses_and_rays
from tests.simulated.inertial import CAM_FROM_IMU, Motion, by_hand, imu_log
from tests.simulated.model import SyntheticModel, synthetic_model

from rangesfm.colmap.transform import rescale
from rangesfm.estimation.drift import carry_model
from rangesfm.estimation.map_problem import map_problem
from rangesfm.estimation.refinement import MapAtRest, joint_errors, refine
from rangesfm.measurements.imu.inertial_fit import InertialProblem, InertialState
from rangesfm.measurements.imu.inertial_motions import GRAVITY, SCALE_ERRORS, motions_on_map
from rangesfm.measurements.imu.inertial_scale import scale_by_sensor
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.imu.motion import MotionErrors, Mounting
from rangesfm.measurements.imu.preintegration import NUM_OF_SENSOR, Preintegrated, preintegrate
from rangesfm.measurements.imu.sensor_prior import GRAVITY_M_S2, SensorPrior
from rangesfm.measurements.kind import Measurements
from rangesfm.measurements.points import NamedPoints
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.rotations import exponentials
from rangesfm.util.geometry.similarity import IDENTITY, align_points, rmse
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
MOUNTING = Mounting(CAM_FROM_IMU, np.zeros(3))
PRIOR = SensorPrior(clock_s=0.005, turn_rad=0.01, arm_m=0.02)
DOWN = np.array([0.0, 0.0, -1.0])


def mapped(motion: Motion, num: int, seed: int, pixel_stddev: float) -> SyntheticModel:
    times_s = np.linspace(2.0, 2.0 + 0.4 * (num - 1), num)
    turns = motion.world_from_imu(times_s).as_matrix() @ CAM_FROM_IMU.T
    return synthetic_model(
        times_s, motion.places_m(times_s), turns, num_observations=100, max_track_length=8, depth_range_m=(1.5, 8.0),
        pixel_stddev=pixel_stddev, metric_from_sfm=IDENTITY, seed=seed,
    )  # fmt: skip


def drift(made: SyntheticModel) -> tuple[Poses, Poses]:
    """Bend a map as drift does, in place, make it too large, and return its poses before and after."""
    true, rays = poses_and_rays(made)
    poses, scale = bent(true, 8.0, 1.15)
    drifted = Poses(poses.world_from_rig, poses.centers[0] + 1.05 * (poses.centers - poses.centers[0]))
    frame_ids = trajectory_from_reconstruction(made.reconstruction, made.timestamps_s).frame_ids
    carry_model(made.reconstruction, frame_ids, rays, true, drifted, 1.05 * scale)
    return true, drifted


def refined(
    metric: pycolmap.Reconstruction, path: Trajectory, measured: Callable[[NamedPoints], Measurements]
) -> MapAtRest:
    points = NamedPoints.in_model(metric, {}, first_ids=path.frame_ids)
    problem = map_problem(
        metric,
        (measured(points),),
        path,
        camera=CameraOptions(refine_intrinsics=False),
        options=RefineOptions(),
        first_pose_is_fixed=True,
        is_refined=False,
        num_threads=1,
    )
    return refine(problem)


def test_without_noise_a_map_is_what_it_was_before_it_drifted() -> None:
    motion, num = by_hand(0), 40
    made, log = mapped(motion, num, 0, 0.0), imu_log(motion)
    times_s = np.array(list(made.timestamps_s.values()))
    true, drifted = drift(made)
    velocities = (motion.places_m(times_s + 1e-4) - motion.places_m(times_s - 1e-4)) / 2e-4
    found = preintegrate(log.timestamp_s, log.gyro_rad_s, log.accel_m_s2, times_s)
    nothing = np.zeros((len(found), NUM_OF_SENSOR))
    off = MotionErrors.at(found, true, velocities, GRAVITY_M_S2 * DOWN, nothing, MOUNTING).residual
    exact = {
        "turn": found.turn @ exponentials(off[:, :3]), "speed": found.speed + off[:, 3:6],
        "shift": found.shift + off[:, 6:],
    }  # fmt: skip
    intervals = Preintegrated(**{**vars(found), **exact})
    path = trajectory_from_reconstruction(made.reconstruction, made.timestamps_s)
    gravity = GRAVITY_M_S2 * exponentials(np.array([[0.03, -0.02, 0.0]]))[0] @ DOWN
    state = InertialState.at_rest(gravity, MOUNTING, num)
    covariance = intervals.covariance(np.array([2e-4, 3e-3]))
    problem = InertialProblem(log, MOUNTING, PRIOR, WalkBending(path))

    def measured(points: NamedPoints) -> Measurements:
        return motions_on_map(problem, state, intervals, covariance, points.state.poses, RefineOptions())

    rest = refined(made.reconstruction, path, measured)
    assert rmse(drifted.centers - true.centers) > 0.1
    assert rest.run.converged
    np.testing.assert_allclose(rest.state.poses.centers, true.centers, atol=1e-6)
    np.testing.assert_allclose(rest.state.poses.world_from_rig, true.world_from_rig, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 2])
def test_drift_of_scale_and_tilt_is_gone_and_what_is_left_is_as_large_as_said(seed: int) -> None:
    motion = by_hand(seed)
    made, log = mapped(motion, 60, seed, 0.5), imu_log(motion, seed=seed)
    scale_errors = np.random.default_rng(seed).normal(0, 0.03, 3)
    log = ImuLog(log.timestamp_s, log.gyro_rad_s, (1 + scale_errors) * log.accel_m_s2)
    true, drifted = drift(made)
    path = trajectory_from_reconstruction(made.reconstruction, made.timestamps_s)
    sensor = scale_by_sensor(InertialProblem(log, MOUNTING, PRIOR, WalkBending(path)))
    placed = sensor.alone.estimate
    metric = rescale(made.reconstruction, placed)
    rest = refined(metric, path, lambda points: next(sensor.measurements(sensor.alone, points, RefineOptions())))
    poses, errors = rest.state.poses, joint_errors(rest, 1.0)
    in_first = (true.centers - true.centers[0]) @ true.world_from_rig[0]
    said_m = float(np.sqrt(np.trace(errors.centers_m2(path.frame_ids), axis1=1, axis2=2).mean()))
    assert rmse(poses.centers - in_first) < min(2 * said_m, 0.2 * rmse(placed.apply(drifted.centers) - in_first))
    off = np.log(align_points(in_first, poses.centers).scale)
    assert errors.scale_stddev < 0.005
    assert abs(off) < 3 * errors.scale_stddev
    in_last, truly = (of.world_from_rig[-1].T @ at for of, at in ((poses, rest.state.blocks[GRAVITY]), (true, DOWN)))
    assert np.degrees(np.arccos(in_last @ truly / np.linalg.norm(in_last))) < 0.1
    np.testing.assert_allclose(rest.state.blocks[SCALE_ERRORS][3:6], scale_errors, atol=0.01)
