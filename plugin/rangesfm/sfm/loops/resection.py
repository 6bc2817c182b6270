"""A loop: the pose of a photo by the points of another one that it was matched with, and its test against the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.special import chdtrc

from rangesfm.arrays import Array, Indices
from rangesfm.sfm.loops.relative_errors import RelativeErrors

MAX_CHANCE = 1e-6
"""Probability by chance of a difference between photos and map below which a loop is taken for a wrong one. A survey
has thousands of pairs, of which none should be lost by chance."""

# Largest error of a match, in pixels: that of COLMAP's two-view geometries, which these matches have passed.
_MAX_ERROR_PX = pycolmap.TwoViewGeometryOptions().ransac.max_error


@dataclass(frozen=True)
class Loop:
    """A verified pair of photos, with what it says about the poses of their keyframes.

    Attributes:
        image_ids: of the pair, smaller first.
        held, moved: indices of the keyframe whose points are known, and of the one that is placed by them.
        turn, shift: (3,) from the pose of ``moved`` in the map to the pose by the points: rotation vector about the
            axes of the world (rad), and movement of the rig's origin (metres).
        frames, by_frame: (k,), (k, 6, 6) keyframes on whose errors the pose by the points depends, and how.
        noise: (6, 6) covariance of the pose by the points that is due to the features alone.
    """

    image_ids: tuple[int, int]
    held: int
    moved: int
    turn: Array
    shift: Array
    frames: Indices
    by_frame: Array
    noise: Array

    def chance(self, errors: RelativeErrors) -> float:
        """Return the probability that the photos differ this much from the map, by chance."""
        frames = np.append(self.frames, self.moved)
        covariance = self.noise + errors.covariance(frames, np.concatenate([self.by_frame, -np.eye(6)[None]]))
        difference = np.concatenate([self.turn, self.shift])
        squared = float(difference @ np.linalg.solve(covariance, difference))
        return float(chdtrc(len(difference), squared))

    def covariance(self, errors: RelativeErrors) -> Array:
        """Return the (6, 6) covariance of the pose by the points where the pose of ``held`` is exact."""
        carried = errors.carried(self.held, np.array([self.moved]))
        frames = np.append(self.frames, self.held)
        return self.noise + errors.covariance(frames, np.concatenate([self.by_frame, -carried]))


def resection_options(seed: int) -> pycolmap.AbsolutePoseEstimationOptions:
    """Return COLMAP's options for a resection, with the error that matches may have and the seed of its draws."""
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed, options.ransac.max_error = seed, _MAX_ERROR_PX
    return options
