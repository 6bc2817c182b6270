"""Turns of an inertial sensor, by its gyroscope alone: its orientation over time, and the turns between photos."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.util.geometry.rotations import cross_matrices

_SLIGHT_TURN = 1e-4  # radians, below which a Jacobian is its series


@dataclass(frozen=True)
class GyroTurns:
    """Orientation of a sensor whose rates are constant between two samples, at their mean.

    Attributes:
        times_s: (k,) rising.
        rates_rad_s: (k, 3) in the sensor's frame, without bias.
        longest_gap_s: time without samples over which the orientation is not known.
    """

    times_s: Array
    rates_rad_s: Array
    longest_gap_s: float

    @cached_property
    def _steps(self) -> Array:
        """Rotation vectors (k - 1, 3) from each sample to the next, in the sensor's frame."""
        return 0.5 * (self.rates_rad_s[:-1] + self.rates_rad_s[1:]) * np.diff(self.times_s)[:, None]

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
        steps = 0.5 * (matrices[:-1] + matrices[1:]) * np.diff(self.times_s)[:, None, None]
        return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])

    def _places(self, times_s: Array) -> tuple[Indices, Array]:
        """Return the sample before each time (n,), and the fraction of the step after it."""
        before = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self.times_s) - 2)
        return before, (times_s - self.times_s[before]) / (self.times_s[before + 1] - self.times_s[before])

    def orientation(self, times_s: Array) -> Rotation:
        """Return the orientation at times (n,) within the log."""
        before, fraction = self._places(times_s)
        return self._at_samples[before] * Rotation.from_rotvec(fraction[:, None] * self._steps[before])

    def nearest_quaternions(self, times_s: Array) -> Array:
        """Return the orientation (..., 4) at the samples nearest to times (...,)."""
        before, fraction = self._places(times_s)
        return np.asarray(self._quaternions[before + (fraction > 0.5)])

    @cached_property
    def _quaternions(self) -> Array:
        return np.asarray(self._at_samples.as_quat())

    def know(self, from_s: Array, to_s: Array) -> Mask:
        """Return whether the log has no gap between two times (...,) each, and reaches over both."""
        of_gaps = np.flatnonzero(np.diff(self.times_s) > self.longest_gap_s)
        starts_s, ends_s = self.times_s[of_gaps], self.times_s[of_gaps + 1]
        inside = (from_s >= self.times_s[0]) & (to_s <= self.times_s[-1])
        return np.asarray(inside & (np.searchsorted(starts_s, to_s) <= np.searchsorted(ends_s, from_s, side="right")))

    def between(self, from_s: Array, to_s: Array) -> Array:
        """Return the turn (n, 3) from one time to another as a rotation vector in the sensor's frame."""
        return np.asarray((self.orientation(from_s).inv() * self.orientation(to_s)).as_rotvec())

    def by_bias(self, from_s: Array, to_s: Array) -> Array:
        """Return the derivatives (n, 3, 3) of the turns by a bias of the rates, to first order.

        Source: Forster, Carlone, Dellaert, Scaramuzza, "On-manifold preintegration for real-time visual-inertial
        odometry", T-RO 2017, section VI-C.
        """
        last = self.orientation(to_s)
        integral = self._integral(to_s) - self._integral(from_s)
        turns = self.between(from_s, to_s)
        return np.asarray(-inverse_right_jacobians(turns) @ (np.swapaxes(last.as_matrix(), 1, 2) @ integral))

    def _integral(self, times_s: Array) -> Array:
        before, fraction = self._places(times_s)
        seconds = fraction * (self.times_s[before + 1] - self.times_s[before])
        middle = self._at_samples[before] * Rotation.from_rotvec(0.5 * fraction[:, None] * self._steps[before])
        return np.asarray(self._summed[before] + middle.as_matrix() * seconds[:, None, None])


def inverse_right_jacobians(vectors: Array) -> Array:
    """Return the inverse right Jacobians (n, 3, 3) of rotations Exp(v): Log(Exp(v) Exp(d)) = v + J^-1 d.

    Source: Solà et al., "A micro Lie theory for state estimation in robotics", eq. 144.
    """
    angle = np.linalg.norm(vectors, axis=1)
    cross = cross_matrices(vectors)
    safe = np.maximum(angle, _SLIGHT_TURN)
    factor = np.where(angle < _SLIGHT_TURN, 1 / 12, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)))
    return np.asarray(np.eye(3) + 0.5 * cross + factor[:, None, None] * (cross @ cross))
