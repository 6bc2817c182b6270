"""Whether the full problem is solved: what is left to gain, in metres and in stddevs."""

from __future__ import annotations

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm import ceres
from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import pose_of

# Damping by a smaller one is felt.
_FREE_TRUST_REGION_RADIUS = 1e8
# Of half the sum of squares in stddevs: where the optimum is no further below, nothing that the map says is further
# than 0.05 of its stddev from what it says there.
_MAX_GAIN_LEFT = 0.5 * 0.05**2
# Likewise; of what a free step promised, and no step kept.
_MAX_PROMISE_LEFT = 0.5
# Relative, of the last step: with more than that, the cost still falls by orders of magnitude.
_MAX_LAST_GAIN = 1e-4
# What the steps to come add up to, in the size of the last one: at least and at most.
_NUM_STEPS_LEFT = (0.1, 10.0)


class Stillness:
    """How far the keyframes go from step to step, and by how much the cost falls.

    Attributes:
        is_still: whether neither will matter any more.
    """

    def __init__(self, metric: pycolmap.Reconstruction, residual_stddev: float, tolerance_m: float) -> None:
        self.is_still = False
        self._metric, self._residual_stddev, self._tolerance_m = metric, residual_stddev, tolerance_m
        self._centers = keyframe_centers(metric)
        self._last_m = self._last_gain = self._promise = 0.0

    @property
    def is_stuck(self) -> bool:
        """Whether a free step would gain what matters if residuals were linear, and smaller ones did not get there."""
        return self._promise > _MAX_PROMISE_LEFT

    def is_over(self, step: ceres.Step) -> bool:
        """Whether to stop: nothing is left to gain, or nothing in steps that the solver dares not make larger.

        Steps to come are taken to be each smaller than its last by as much as this one: Gauss-Newton's are so in the
        end. A long path may bend by metres for next to no cost, and a map that little holds may sway by centimetres
        for as little: keyframes are still, or the cost.
        """
        if step.trust_region_radius >= _FREE_TRUST_REGION_RADIUS:
            self._promise = step.expected_gain / self._residual_stddev**2
        if not step.is_successful:
            self._last_m = self._last_gain = 0.0
            return False
        before, self._centers = self._centers, keyframe_centers(self._metric)
        moved_m, gain = farthest(before, self._centers), step.gain / self._residual_stddev**2
        is_near = _left(moved_m, self._last_m) <= self._tolerance_m or _left(gain, self._last_gain) <= _MAX_GAIN_LEFT
        self._last_m, self._last_gain = moved_m, gain
        self._promise -= gain
        is_over = is_near and step.gain <= _MAX_LAST_GAIN * step.cost
        self.is_still = is_over and step.trust_region_radius >= _FREE_TRUST_REGION_RADIUS
        return is_over


def _left(now: float, last: float) -> float:
    """What a series adds up to from here on."""
    num = now / (last - now) if now < last else np.inf
    return now * float(np.clip(num, *_NUM_STEPS_LEFT))


def farthest(before: Array, after: Array) -> float:
    """Distance of the point that moved most."""
    return float(np.linalg.norm(after - before, axis=1).max())


def keyframe_centers(metric: pycolmap.Reconstruction) -> Array:
    """(n, 3) origins of the rig frames in the world."""
    poses = np.array([pose_of(metric.frame(frame_id)).params for frame_id in metric.reg_frame_ids()])
    return np.asarray(-Rotation.from_quat(poses[:, :4]).inv().apply(poses[:, 4:]))
