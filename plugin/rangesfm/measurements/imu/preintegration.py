"""Preintegration of an inertial sensor between photos (section 2 of ``model.md``).

Angular rate and specific force are summed up once, in the sensor's own frame at the first of two photos, so that the
sums depend on no pose. Equations: Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
2017, with scale factors of the axes and the clock besides the biases.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.util.geometry.rotations import cross_matrices, exponentials, left_jacobians

GYRO, ACCEL = 0, 1
"""The two sensors, in arrays that have one entry for each."""
TURN, SPEED, SHIFT = slice(0, 3), slice(3, 6), slice(6, 9)
"""The nine numbers of an interval."""
GYRO_BIAS, ACCEL_BIAS, GYRO_SCALE, ACCEL_SCALE = (slice(3 * k, 3 * k + 3) for k in range(4))
ACCEL_CROSS, CLOCK = slice(12, 18), slice(18, 19)
"""The nineteen numbers of the sensor."""
BIASES, SCALES = slice(0, 6), slice(6, 12)
"""Those of both sensors together."""
NUM_OF_SENSOR = 19
# Axes of the accelerometer, and those of which they read a share (``ACCEL_CROSS``).
_AXES, _OF_AXES = np.array([0, 0, 1, 1, 2, 2]), np.array([1, 2, 0, 2, 0, 1])
# Beyond this standard deviation of a turn, radians, the first-order corrections of what was summed up after it are off
# by more than half a percent (the next term is half its square).
_MAX_TURN_STDDEV_RAD = 0.1


@dataclass(frozen=True)
class Preintegrated:
    """Motion of the sensor in k intervals between photos, in its own frame at the start of each.

    The sensor's numbers b are: biases of the gyroscope (3, rad/s) and of the accelerometer (3, m/s^2), shares by which
    their axes read too much (3 and 3), shares by which those of the accelerometer read of others (6: x of y, x of z, y
    of x, y of z, z of x, z of y), as they are not at right angles or not along those of the gyroscope, and how much
    later than assumed it measured, seconds. True are ``reading - shares @ reading - bias``.

    Attributes:
        before, after: (k,) indices of the photos. interval_s: (k,) between them.
        turn: (k, 3, 3) rotations from the sensor's frame at the end into that at the start.
        speed: (k, 3) m/s, change of the velocity without gravity. shift: (k, 3) m, the same of the position, beyond
            that of the velocity at the start.
        at: (k, 19) numbers of the sensor at which it was summed up.
        by_sensor: (k, 9, 19) derivatives of turn (in its own frame, at its end), speed and shift by these.
        unit_covariance: (2, k, 9, 9) covariance for a noise density of 1 of the gyroscope (rad/s/sqrt(Hz)), and of the
            accelerometer (m/s^2/sqrt(Hz)).
        of_gaps: (k, 9, 9) covariance of what the log does not say in its gaps.
    """

    before: Indices
    after: Indices
    interval_s: Array
    turn: Array
    speed: Array
    shift: Array
    at: Array
    by_sensor: Array
    unit_covariance: Array
    of_gaps: Array

    def __len__(self) -> int:
        return len(self.before)

    def subset(self, rows: Indices) -> Preintegrated:
        """Return some of the intervals."""
        of_rows = {
            name: value[:, rows] if name == "unit_covariance" else value[rows] for name, value in vars(self).items()
        }
        return replace(self, **of_rows)

    def covariance(self, densities: Array) -> Array:
        """Return the (k, 9, 9) covariances for (2,) noise densities of gyroscope and accelerometer."""
        return np.asarray(np.einsum("s,skij->kij", np.square(densities), self.unit_covariance) + self.of_gaps)

    def corrected(self, sensor: Array) -> tuple[Array, Array, Array]:
        """Return turns, speeds and shifts for other (k, 19) numbers of the sensor, to first order in these."""
        change = np.einsum("kij,kj->ki", self.by_sensor, sensor - self.at)
        turn = self.turn @ exponentials(change[:, TURN])
        return turn, self.speed + change[:, SPEED], self.shift + change[:, SHIFT]


_WITHOUT_ERRORS, _WITHOUT_NOISE = np.zeros(NUM_OF_SENSOR), np.zeros(2)


def preintegrate(
    timestamp_s: Array,
    gyro_rad_s: Array,
    accel_m_s2: Array,
    photo_s: Array,
    sensor: Array = _WITHOUT_ERRORS,
    densities: Array = _WITHOUT_NOISE,
) -> Preintegrated:
    """Sum up a log between neighbouring photos, by the midpoint rule.

    Intervals that the log does not cover are left out, and so are those with gaps in which the turn is lost.

    Args:
        timestamp_s, gyro_rad_s, accel_m_s2: (m,), (m, 3), (m, 3) of the log, at least two samples.
        photo_s: (n,) times of the photos on the sensor's clock, in any order of equal or rising times.
        sensor: (19,) or (n - 1, 19) numbers of the sensor.
        densities: (2,) noise densities with which a turn must be known; without noise only gaps count.
    """
    samples, log = np.column_stack([gyro_rad_s, accel_m_s2]), np.asarray(timestamp_s, dtype=np.float64)
    num = max(len(photo_s) - 1, 0)
    sensors = np.broadcast_to(sensor, (num, NUM_OF_SENSOR))
    # Samples were taken later than their times say.
    late = sensors[:, CLOCK]
    starts, ends = photo_s[:-1] - late[:, 0], photo_s[1:] - late[:, 0]
    rows = np.flatnonzero((starts >= log[0]) & (ends <= log[-1]) & (ends > starts))
    times, readings = _between(log, samples, starts[rows], ends[rows])
    steps_s, unseen = np.diff(times, axis=1), _unseen_variance(log, samples)
    sums = _Sums(readings, steps_s, sensors[rows])
    gap_of = np.searchsorted(log, (times[:, 1:] + times[:, :-1]) / 2).clip(1, len(log) - 1) - 1
    for step in range(steps_s.shape[1]):
        sums.add(step, unseen[gap_of[:, step]])
    found = Preintegrated(
        rows, rows + 1, (ends - starts)[rows], sums.turn, sums.speed, sums.shift, np.array(sensors[rows]),
        sums.with_clock(), sums.covariance[:2], sums.covariance[2],
    )  # fmt: skip
    variances = found.covariance(densities)[:, TURN, TURN]
    is_known = np.linalg.eigvalsh(variances)[:, -1] <= _MAX_TURN_STDDEV_RAD**2
    return found.subset(np.flatnonzero(is_known))


def _between(log: Array, samples: Array, starts: Array, ends: Array) -> tuple[Array, Array]:
    """Return (k, m) times and (k, m, 6) readings of each interval: interpolated at its ends, and the samples between.

    Shorter intervals are filled up with their ends.
    """
    first, last = np.searchsorted(log, starts, side="right"), np.searchsorted(log, ends, side="left")
    most = int(np.max(last - first, initial=0))
    rows = np.minimum(first[:, None] + np.arange(most), last[:, None])
    is_inside = rows < last[:, None]
    times = np.where(is_inside, log[np.minimum(rows, len(log) - 1)], ends[:, None])
    times = np.column_stack([starts, times, ends])
    readings = np.stack([np.interp(times, log, axis) for axis in samples.T], axis=2)
    return times, readings


def _unseen_variance(log: Array, samples: Array) -> Array:
    """Return (m - 1, 2) mean squared errors of each sensor between neighbouring samples, where they are far apart.

    They are those that straight lines of the same length leave elsewhere in the log.
    """
    steps = np.diff(log)
    usual = float(np.median(steps))
    found = np.zeros((len(steps), 2))
    for num in np.unique(np.rint(steps / usual).astype(np.int64)):
        if num < 2:
            continue
        width = min(int(num), len(log) - 1)
        middle = np.arange(0, len(log) - width) + width // 2
        share = (
            (log[middle] - log[middle - width // 2]) / (log[middle - width // 2 + width] - log[middle - width // 2])
        )[:, None]
        line = (1 - share) * samples[middle - width // 2] + share * samples[middle - width // 2 + width]
        off = np.square(samples[middle] - line).reshape(-1, 2, 3)
        found[np.rint(steps / usual) == num] = off.mean(axis=(0, 2))
    return found


class _Sums:
    """Running sums of k intervals."""

    def __init__(self, readings: Array, steps_s: Array, sensors: Array) -> None:
        num = len(readings)
        gains = 1 - np.concatenate([sensors[:, GYRO_SCALE], sensors[:, ACCEL_SCALE]], axis=1)
        biases = np.concatenate([sensors[:, GYRO_BIAS], sensors[:, ACCEL_BIAS]], axis=1)
        self._readings, self._steps_s = readings, steps_s
        self._true = gains[:, None] * readings - biases[:, None]
        for share, axis, other in zip(sensors[:, ACCEL_CROSS].T, _AXES, _OF_AXES, strict=True):
            self._true[:, :, 3 + axis] -= share[:, None] * readings[:, :, 3 + other]
        self.turn = np.tile(np.eye(3), (num, 1, 1))
        self.speed, self.shift = np.zeros((2, num, 3))
        self.by_sensor = np.zeros((num, 9, NUM_OF_SENSOR))
        self.covariance = np.zeros((3, num, 9, 9))

    def add(self, step: int, unseen: Array) -> None:
        """Add one step of all intervals.

        Args:
            unseen: (k, 2) mean squared error of each sensor between the samples.
        """
        dt = self._steps_s[:, step, None]
        rate, force = np.split(self._true[:, step : step + 2].mean(axis=1), 2, axis=1)
        rate_read, force_read = np.split(self._readings[:, step : step + 2].mean(axis=1), 2, axis=1)
        half = exponentials(rate * dt / 2)
        middle, around = self.turn @ half, half @ half
        pushed = np.einsum("kij,kj->ki", middle, force) * dt
        num = len(dt)
        # Forster et al., eq. 59 to 63, with the attitude in the middle of the step.
        by_state = np.tile(np.eye(9), (num, 1, 1))
        by_state[:, TURN, TURN] = np.swapaxes(around, 1, 2)
        by_state[:, SPEED, TURN] = -middle @ cross_matrices(force * dt) @ np.swapaxes(half, 1, 2)
        by_state[:, SHIFT, TURN] = by_state[:, SPEED, TURN] * dt[:, :, None] / 2
        by_state[:, SHIFT, SPEED] = np.eye(3) * dt[:, :, None]
        by_rate, by_force = np.zeros((2, num, 9, 3))
        by_rate[:, TURN] = left_jacobians(-rate * dt) * dt[:, :, None]
        half_jacobian = left_jacobians(-rate * dt / 2) * dt[:, :, None] / 2
        by_rate[:, SPEED] = -middle @ cross_matrices(force * dt) @ half_jacobian
        by_rate[:, SHIFT] = by_rate[:, SPEED] * dt[:, :, None] / 2
        by_force[:, SPEED] = middle * dt[:, :, None]
        by_force[:, SHIFT] = by_force[:, SPEED] * dt[:, :, None] / 2
        self.by_sensor = by_state @ self.by_sensor
        self.by_sensor[:, :, GYRO_BIAS] -= by_rate
        self.by_sensor[:, :, ACCEL_BIAS] -= by_force
        self.by_sensor[:, :, GYRO_SCALE] -= by_rate * rate_read[:, None]
        self.by_sensor[:, :, ACCEL_SCALE] -= by_force * force_read[:, None]
        self.by_sensor[:, :, ACCEL_CROSS] -= by_force[:, :, _AXES] * force_read[:, None, _OF_AXES]
        self.covariance = by_state @ self.covariance @ np.swapaxes(by_state, 1, 2)
        per_s = np.divide(1.0, dt, out=np.zeros_like(dt), where=dt > 0)[:, :, None]
        of_rate, of_force = (by @ np.swapaxes(by, 1, 2) for by in (by_rate, by_force))
        self.covariance[GYRO] += of_rate * per_s
        self.covariance[ACCEL] += of_force * per_s
        self.covariance[2] += of_rate * unseen[:, 0, None, None] + of_force * unseen[:, 1, None, None]
        self.shift = self.shift + self.speed * dt + pushed * dt / 2
        self.speed = self.speed + pushed
        self.turn = self.turn @ around

    def with_clock(self) -> Array:
        """Return the derivatives with those by the clock: both ends of the interval move to earlier samples."""
        (rate_0, force_0), (rate_1, force_1) = (np.split(self._true[:, end], 2, axis=1) for end in (0, -1))
        span_s = self._steps_s.sum(axis=1)[:, None]
        later = np.zeros((len(span_s), 9))
        later[:, TURN] = rate_1 - np.einsum("kji,kj->ki", self.turn, rate_0)
        later[:, SPEED] = np.einsum("kij,kj->ki", self.turn, force_1) - force_0 - np.cross(rate_0, self.speed)
        later[:, SHIFT] = self.speed - force_0 * span_s - np.cross(rate_0, self.shift)
        found = self.by_sensor.copy()
        found[:, :, CLOCK] = -later[:, :, None]
        return found
