"""ImuLog: what an inertial sensor measured and how it turned, as checked arrays, and the noise of its two sensors."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.util.geometry.rotations import left_jacobians

# Times of arrival are those of an even clock and delays if in each stretch of so many samples ...
_NUM_IN_STRETCH = 1000
# ... the least late sample is late by less than this share of a step: after a lost one all are late by a whole step.
_LATE = 0.25
# Steps that differ more than this from their median, in steps, are not those of a sensor's own clock.
_UNEVEN = 0.25
STANDARD_GRAVITY_M_S2 = 9.80665
"""Acceleration that is called 1 g (ISO 80000-3)."""
# Full scales of accelerometers in g and of gyroscopes in deg/s, as data sheets of MEMS sensors give them; the factory's
# scale factors differ by some percent.
_FULL_SCALES_M_S2 = STANDARD_GRAVITY_M_S2 * np.array([2.0, 4.0, 8.0, 16.0])
_FULL_SCALES_RAD_S = np.radians([125.0, 250.0, 500.0, 1000.0, 2000.0])
_FULL_SCALE_ERROR = 0.03
# A motion comes to exactly the same extreme once. A sensor at the end of its scale holds it for three samples or more,
# and comes to it so many times; where the extreme is a usual full scale, once is enough.
_NUM_TIMES = 3


def times_of_sampling(arrived_s: Array) -> Array | None:
    """Return when the samples were taken if their times are those at which they arrived; None if they are not.

    A sensor samples evenly, and nothing arrives before it is taken: the least late samples are on the lower convex hull
    of the times over the samples' numbers. Source: Zhang, Liu and Xia, "Clock synchronization algorithms for network
    measurements", 2002.

    Args:
        arrived_s: (k,) times, rising.
    """
    steps_s = np.diff(arrived_s)
    step_s = float(np.median(steps_s))
    if np.quantile(np.abs(steps_s - step_s), 0.75) <= _UNEVEN * step_s:
        return None
    hull: list[int] = []
    for k, time_s in enumerate(arrived_s):
        while len(hull) > 1 and (arrived_s[hull[-1]] - arrived_s[hull[-2]]) * (k - hull[-2]) >= (
            time_s - arrived_s[hull[-2]]
        ) * (hull[-1] - hull[-2]):
            hull.pop()
        hull.append(k)
    # The first and the last sample are on the hull however late they are: there, the rest is extended.
    edge = min(_NUM_IN_STRETCH, len(arrived_s)) // 10
    inner = np.array([k for k in hull if edge <= k < len(arrived_s) - edge])
    if len(inner) < 2:
        return None
    rate_s = (arrived_s[inner[-1]] - arrived_s[inner[0]]) / (inner[-1] - inner[0])
    evenly_s = rate_s * np.arange(len(arrived_s))
    taken_s = evenly_s + np.interp(np.arange(len(arrived_s)), inner, arrived_s[inner] - evenly_s[inner])
    stretches = np.array_split(arrived_s - taken_s, max(len(arrived_s) // _NUM_IN_STRETCH, 1))
    return taken_s if max(late.min() for late in stretches) < _LATE * step_s else None


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an inertial sensor in continuous time, as kalibr states it (its wiki, "IMU Noise Model").

    Attributes:
        gyro_noise_density_rad_s_rthz: white noise of the angular rates, rad/s/sqrt(Hz).
        accel_noise_density_m_s2_rthz: white noise of the specific force, m/s^2/sqrt(Hz).
        gyro_bias_walk: random walk of the gyroscope's bias, rad/s^2/sqrt(Hz).
        accel_bias_walk: random walk of the accelerometer's bias, m/s^3/sqrt(Hz).
    """

    gyro_noise_density_rad_s_rthz: float
    accel_noise_density_m_s2_rthz: float
    gyro_bias_walk: float
    accel_bias_walk: float

    def __post_init__(self) -> None:
        if not all(np.isfinite(value) and value >= 0 for value in vars(self).values()):
            raise ValueError("noise is finite and not negative")


@dataclass(frozen=True)
class ImuLog:
    """k samples of an inertial sensor, in its own frame.

    Attributes:
        timestamp_s: (k,) seconds on the sensor's clock, rising.
        gyro_rad_s: (k, 3) angular rates of the sensor.
        accel_m_s2: (k, 3) specific force: acceleration minus gravity, which points upward in a sensor at rest.
        path: the file, for messages; empty if made in memory.
        noise: as a file states it; None if none does.
        notes: assumptions made in reading the file, as lines for the user.
        doubts: what is not as it should be, as lines for the user: gaps, few samples, values at the end of the scale.
        clipped: (k, 2) whether gyroscope and accelerometer were at the end of their scale in any axis; (0, 2) if they
            have none, as those of a plan.
    """

    timestamp_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    path: str = ""
    noise: ImuNoise | None = None
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    clipped: Mask = field(default_factory=lambda: np.zeros((0, 2), dtype=bool))

    def __post_init__(self) -> None:
        num = len(self.timestamp_s)
        if self.timestamp_s.shape != (num,) or not self.gyro_rad_s.shape == self.accel_m_s2.shape == (num, 3):
            raise ValueError("a log has k times, (k, 3) angular rates and (k, 3) accelerations")
        if not all(np.isfinite(values).all() for values in (self.timestamp_s, self.gyro_rad_s, self.accel_m_s2)):
            raise ValueError("times, angular rates and accelerations are finite")
        if np.any(np.diff(self.timestamp_s) <= 0):
            raise ValueError("times rise")

    def __len__(self) -> int:
        return len(self.timestamp_s)

    @property
    def name(self) -> str:
        """Name of the file, for messages."""
        return Path(self.path).name or "the inertial sensor"

    def is_clipped_between(self, from_s: Array, to_s: Array) -> Mask:
        """Return whether a sensor was at the end of its scale between two times (n,) each, or right before or after."""
        before = np.cumsum(np.append(0, self.clipped.any(axis=1)))
        first = np.searchsorted(self.timestamp_s, from_s, side="right") - 1
        last = np.searchsorted(self.timestamp_s, to_s, side="left")
        num = len(self.clipped)
        return np.asarray(before[np.clip(last + 1, 0, num)] > before[np.clip(first, 0, num)])

    @property
    def step_s(self) -> float:
        """Median time between samples."""
        return float(np.median(np.diff(self.timestamp_s)))

    @property
    def longest_gap_s(self) -> float:
        """Longest time between samples over which the motion can be interpolated; longer ones are gaps in the log.

        Hands and drones move with frequencies of some hertz: over a tenth of a second they turn evenly.
        """
        return max(0.1, 3 * self.step_s)

    @cached_property
    def _steps(self) -> Array:
        """Rotation vectors (k - 1, 3) from each sample to the next, in the sensor's frame."""
        return 0.5 * (self.gyro_rad_s[:-1] + self.gyro_rad_s[1:]) * np.diff(self.timestamp_s)[:, None]

    @cached_property
    def _at_samples(self) -> Rotation:
        """Orientation at each sample (k,), in the frame of the sensor at the first one."""
        quaternions = Rotation.from_rotvec(np.vstack([np.zeros((1, 3)), self._steps])).as_quat()
        shift = 1
        while shift < len(quaternions):  # a product of all rotations before, by doubling
            before, after = Rotation.from_quat(quaternions[:-shift]), Rotation.from_quat(quaternions[shift:])
            quaternions[shift:] = (before * after).as_quat()
            shift *= 2
        return Rotation.from_quat(quaternions)

    @cached_property
    def _summed(self) -> Array:
        """Integral over time of the orientation's matrices up to each sample (k, 3, 3), seconds."""
        matrices = self._at_samples.as_matrix()
        steps = 0.5 * (matrices[:-1] + matrices[1:]) * np.diff(self.timestamp_s)[:, None, None]
        return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])

    def _places(self, times_s: Array) -> tuple[Indices, Array]:
        """Return the sample before each time (n,), and the fraction of the step after it."""
        before = np.clip(np.searchsorted(self.timestamp_s, times_s, side="right") - 1, 0, len(self.timestamp_s) - 2)
        return before, (times_s - self.timestamp_s[before]) / (self.timestamp_s[before + 1] - self.timestamp_s[before])

    def orientation(self, times_s: Array) -> Rotation:
        """Return the orientation at times (n,) within the log, by the gyroscope, in the frame of its first sample.

        Rates are constant between two samples, at their mean.
        """
        before, fraction = self._places(times_s)
        return self._at_samples[before] * Rotation.from_rotvec(fraction[:, None] * self._steps[before])

    def nearest_quaternions(self, times_s: Array) -> Array:
        """Return the orientation (..., 4) at the samples nearest to times (...,)."""
        before, fraction = self._places(times_s)
        return np.asarray(self._quaternions[before + (fraction > 0.5)])

    @cached_property
    def _quaternions(self) -> Array:
        return np.asarray(self._at_samples.as_quat())

    def knows(self, from_s: Array, to_s: Array) -> Mask:
        """Return whether the log has no gap between two times (...,) each, and reaches over both."""
        of_gaps = np.flatnonzero(np.diff(self.timestamp_s) > self.longest_gap_s)
        starts_s, ends_s = self.timestamp_s[of_gaps], self.timestamp_s[of_gaps + 1]
        inside = (from_s >= self.timestamp_s[0]) & (to_s <= self.timestamp_s[-1])
        return np.asarray(inside & (np.searchsorted(starts_s, to_s) <= np.searchsorted(ends_s, from_s, side="right")))

    def turns_between(self, from_s: Array, to_s: Array) -> Array:
        """Return the turn (n, 3) from one time to another by the gyroscope, a rotation vector in the sensor's frame."""
        return np.asarray((self.orientation(from_s).inv() * self.orientation(to_s)).as_rotvec())

    def turns_by_bias(self, from_s: Array, to_s: Array) -> Array:
        """Return the derivatives (n, 3, 3) of the turns by a bias of the rates, to first order.

        Source: Forster, Carlone, Dellaert, Scaramuzza, "On-manifold preintegration for real-time visual-inertial
        odometry", T-RO 2017, section VI-C.
        """
        last = self.orientation(to_s)
        integral = self._integral(to_s) - self._integral(from_s)
        turns = self.turns_between(from_s, to_s)
        return np.asarray(-np.linalg.inv(left_jacobians(-turns)) @ (np.swapaxes(last.as_matrix(), 1, 2) @ integral))

    def _integral(self, times_s: Array) -> Array:
        before, fraction = self._places(times_s)
        seconds = fraction * (self.timestamp_s[before + 1] - self.timestamp_s[before])
        middle = self._at_samples[before] * Rotation.from_rotvec(0.5 * fraction[:, None] * self._steps[before])
        return np.asarray(self._summed[before] + middle.as_matrix() * seconds[:, None, None])


def clipped_samples(gyro_rad_s: Array, accel_m_s2: Array) -> Mask:
    """Return (k, 2) whether gyroscope and accelerometer were at the end of their scale in any axis at each sample."""
    scales = (gyro_rad_s, _FULL_SCALES_RAD_S), (accel_m_s2, _FULL_SCALES_M_S2)
    return np.column_stack([_is_clipped(values, full_scales) for values, full_scales in scales])


def _is_clipped(values: Array, full_scales: Array) -> Mask:
    """Return whether an axis (k, 3) has its extreme value, where that is the end of a scale; (k,)."""
    found = np.zeros(len(values), dtype=bool)
    for axis in values.T:
        for extreme in (axis.max(), axis.min()):
            is_there = axis == extreme
            held = is_there[2:] & is_there[1:-1] & is_there[:-2]
            num_times = np.count_nonzero(np.diff(held.astype(np.int8), prepend=0) == 1)
            is_full = np.any(np.abs(np.abs(extreme) / full_scales - 1) < _FULL_SCALE_ERROR)
            found |= is_there & (num_times >= (1 if is_full else _NUM_TIMES))
    return found
