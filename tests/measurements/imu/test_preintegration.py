"""Preintegration and the errors of a motion, against finite differences and GTSAM's sums in much finer steps."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.measurements.imu.motion import MotionErrors, Mounting
from rangesfm.measurements.imu.preintegration import NUM_OF_SENSOR, Preintegrated, preintegrate
from rangesfm.solver import inertial_cost
from rangesfm.util.geometry.poses import Poses

Array = npt.NDArray[np.float64]

GRAVITY_M_S2 = 9.8
DENSITIES = np.array([2e-3, 2e-2])
OF_SENSOR = (
    *([0.02, -0.01, 0.03], [0.2, -0.1, 0.3], [0.01, -0.02, 0.01], [0.03, 0.02, -0.03]),
    *([0.01, -0.02, 0.01], [0.02, -0.01, 0.01], [0.004]),
)
SENSOR = np.concatenate(OF_SENSOR)
PHOTO_S = np.array([0.3, 0.55, 1.2, 2.0])


def signal(num: int = 250, seconds: float = 2.5) -> tuple[Array, Array, Array]:
    """Return a log of a hand that turns and shakes a sensor."""
    rng = np.random.default_rng(2)
    time_s = (np.arange(num) + rng.uniform(0, 0.8, num)) * seconds / num
    phase, pace = rng.uniform(0, 6, (2, 6))
    waves = np.sin(np.outer(time_s, 1 + pace) + phase)
    return time_s, 0.8 * waves[:, :3], 2.0 * waves[:, 3:] + [0.5, 9.0, 3.0]


def numbers(found: Preintegrated, about: Array) -> Array:
    """Return the nine numbers of each interval, the turn as a small one in its own frame."""
    turn = Rotation.from_matrix(np.swapaxes(about, 1, 2) @ found.turn).as_rotvec()
    return np.column_stack([turn, found.speed, found.shift])


def test_derivatives_by_the_sensors_numbers_are_those_of_the_sums() -> None:
    log = signal(500)
    found = preintegrate(*log, PHOTO_S, SENSOR)
    for k in range(NUM_OF_SENSOR):
        step = np.eye(NUM_OF_SENSOR)[k] * 1e-4
        ends = [preintegrate(*log, PHOTO_S, SENSOR + sign * step) for sign in (1, -1)]
        slope = np.subtract(*(numbers(end, found.turn) for end in ends)) / 2e-4
        # Straight lines between samples bend where an end of an interval passes one.
        np.testing.assert_allclose(found.by_sensor[:, :, k], slope, atol=1e-6 if k < NUM_OF_SENSOR - 1 else 5e-3)


def gtsams_sums(gtsam: Any) -> Iterator[Any]:
    """Yield GTSAM's sums of the intervals between the photos, with more steps than the log."""
    time_s, gyro, accel = signal()
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(np.eye(3) * DENSITIES[0] ** 2)
    params.setAccelerometerCovariance(np.eye(3) * DENSITIES[1] ** 2)
    params.setIntegrationCovariance(np.eye(3) * 1e-20)
    for start, end in pairwise(PHOTO_S.tolist()):
        sums = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias())
        ends = np.array([start, *time_s[(time_s > start) & (time_s < end)], end])
        fine = np.interp(np.arange(40 * (len(ends) - 1) + 1) / 40, np.arange(len(ends)), ends)
        middle = (fine[1:] + fine[:-1]) / 2
        for at, step in zip(middle, np.diff(fine), strict=True):
            rate, force = ([np.interp(at, time_s, axis) for axis in values.T] for values in (gyro, accel))
            sums.integrateMeasurement(np.array(force), np.array(rate), step)
        yield sums


def test_sums_derivatives_and_covariance_are_gtsams() -> None:
    gtsam = pytest.importorskip("gtsam", reason="it has no wheel for this Python")
    found = preintegrate(*signal(), PHOTO_S)
    order = [*range(3), *range(6, 9), *range(3, 6)]  # GTSAM has the position before the velocity
    for k, sums in enumerate(gtsams_sums(gtsam)):
        np.testing.assert_allclose(found.turn[k], sums.deltaRij().matrix(), atol=2e-5)
        np.testing.assert_allclose(found.speed[k], sums.deltaVij(), atol=2e-3)
        np.testing.assert_allclose(found.shift[k], sums.deltaPij(), atol=1e-3)
        expected = sums.preintMeasCov()[np.ix_(order, order)]
        np.testing.assert_allclose(found.covariance(DENSITIES)[k], expected, atol=2e-2 * np.abs(expected).max())
        biases = SENSOR[:6] * 1e-2
        states = [
            sums.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias(share * biases[3:], share * biases[:3]))
            for share in (1.0, 0.0)
        ]
        turned = Rotation.from_matrix(states[1].attitude().matrix().T @ states[0].attitude().matrix()).as_rotvec()
        moved = [states[0].velocity() - states[1].velocity(), states[0].position() - states[1].position()]
        np.testing.assert_allclose(found.by_sensor[k, :, :6] @ biases, np.concatenate([turned, *moved]), atol=1e-5)


def test_what_a_state_costs_is_what_it_costs_in_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam", reason="it has no wheel for this Python")
    found, rng = preintegrate(*signal(), PHOTO_S), np.random.default_rng(5)
    whitening = np.linalg.inv(np.linalg.cholesky(found.covariance(DENSITIES)))
    for k, sums in enumerate(gtsams_sums(gtsam)):
        cost = inertial_cost(
            interval_s=found.interval_s[k], turn=found.turn[k], speed=found.speed[k], shift=found.shift[k],
            at=found.at[k], by_sensor=found.by_sensor[k], whitening=whitening[k], rig_from_imu=np.eye(3),
        )  # fmt: skip
        factor = gtsam.ImuFactor(0, 1, 2, 3, 4, sums)
        for _ in range(20):
            pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 2, 3)), rng.normal(0, 3, 3))
            before = gtsam.NavState(pose, rng.normal(0, 1, 3))
            biases = rng.normal(0, 0.003, 6)
            bias = gtsam.imuBias.ConstantBias(biases[3:], biases[:3])
            after = sums.predict(before, bias).retract(rng.normal(0, 0.02, 9))
            ends = [(end.pose(), end.velocity()) for end in (before, after)]
            expected = factor.evaluateError(*ends[0], *ends[1], bias)
            expected = 0.5 * expected @ np.linalg.solve(sums.residualCovariance(), expected)
            blocks = [colmaps(end) for end, _ in ends] + [velocity for _, velocity in ends]
            gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
            residuals = cost.evaluate(*blocks, gravity, biases, *map(np.zeros, (6, 6, 1, 6)))[0]
            assert 0.5 * np.sum(np.square(residuals)) == pytest.approx(expected, rel=0.05)


def colmaps(pose: Any) -> Array:
    """Return the block rig_from_world of a pose of GTSAM."""
    rig_from_world = pose.inverse()
    quaternion = Rotation.from_matrix(rig_from_world.rotation().matrix()).as_quat()
    return np.concatenate([quaternion, rig_from_world.translation()])


def test_an_interval_counts_by_what_its_gap_hides_and_is_left_out_where_its_turn_is_lost() -> None:
    time_s, gyro, accel = signal(2500)
    whole = preintegrate(time_s, gyro, accel, PHOTO_S)
    short, long = ((time_s < 0.7) | (time_s > end) for end in (0.72, 1.15))
    gap = preintegrate(time_s[short], gyro[short], accel[short], PHOTO_S)
    np.testing.assert_allclose(gap.of_gaps[[0, 2]], whole.of_gaps[[0, 2]], atol=1e-9)
    off = numbers(gap, whole.turn)[1] - numbers(whole, whole.turn)[1]
    stddevs = np.sqrt(np.diag(gap.of_gaps[1]))
    assert np.all(np.abs(off) < 4 * stddevs)
    assert 0 < stddevs[4] < 0.02
    assert preintegrate(time_s[long], 9 * gyro[long], accel[long], PHOTO_S).before.tolist() == [0, 2]


def test_only_intervals_that_the_log_covers_are_there() -> None:
    found = preintegrate(*signal(), np.array([-1.0, 0.5, 1.0, 2.2, 3.0]))
    assert found.before.tolist() == [1, 2]
    assert found.after.tolist() == [2, 3]
    np.testing.assert_allclose(found.interval_s, [0.5, 1.2])


def test_derivatives_of_the_errors_of_a_motion_are_those_of_finite_differences() -> None:
    rng, num = np.random.default_rng(5), len(PHOTO_S)
    measured = preintegrate(*signal(500), PHOTO_S, SENSOR)
    turns, places, velocities = rng.normal(size=(3, num, 3))
    gravity, start = np.array([0.3, -0.2, -9.79]), np.zeros(9 * num + NUM_OF_SENSOR + 9)

    def errors(step: Array) -> MotionErrors:
        pose, rest = step[: 6 * num].reshape(num, 6), step[6 * num :]
        by_velocity, by_gravity, by_sensor, by_turn, by_arm = np.split(rest, np.cumsum([3 * num, 3, NUM_OF_SENSOR, 3]))
        rotations = (Rotation.from_rotvec(turns) * Rotation.from_rotvec(pose[:, :3])).as_matrix()
        mounting = Mounting(Rotation.from_rotvec([0.4, 1.0, -0.2]).as_matrix(), np.array([0.05, -0.1, 0.02]) + by_arm)
        return MotionErrors.at(
            measured,
            Poses(rotations, places + pose[:, 3:]),
            velocities + by_velocity.reshape(num, 3),
            gravity + by_gravity,
            np.tile(0.9 * SENSOR + by_sensor, (len(measured), 1)),
            mounting.turned(by_turn),
        )

    found, columns = errors(start), []
    for k in range(len(start)):
        step = np.eye(len(start))[k] * 1e-6
        columns.append((errors(step).residual - errors(-step).residual) / 2e-6)
    of_photos = np.zeros((len(measured), 9, num, 9))
    for side, photo in enumerate((measured.before, measured.after)):
        rows = np.arange(len(measured))
        of_photos[rows, :, photo, :6] = found.by_pose[:, :, side]
        of_photos[rows, :, photo, 6:] = found.by_velocity[:, :, side]
    of_all = [found.by_gravity, found.by_sensor, found.by_turn, found.by_arm]
    flat = [of_photos[..., :6].reshape(-1, 9, 6 * num), of_photos[..., 6:].reshape(-1, 9, 3 * num), *of_all]
    np.testing.assert_allclose(np.concatenate(flat, axis=2), np.stack(columns, axis=2), atol=1e-6)
