"""Errors of the pose of one keyframe relative to that of another in a refined map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.util.geometry.map_errors import MapErrors, PartErrors
from rangesfm.util.geometry.rotations import cross_matrices


@dataclass(frozen=True)
class RelativeErrors:
    """Joint errors of n keyframes, as errors of one keyframe where another one is held.

    Attributes:
        centers: (n, 3) origins of the rigs, metres.
        frames: errors of these n keyframes, in their order.
    """

    centers: Array
    frames: PartErrors

    @classmethod
    def of_keyframes(cls, errors: MapErrors, frame_ids: Indices, centers: Array) -> RelativeErrors:
        """Return the errors of keyframes, given by the ids (n,) of their frames and their centres (n, 3)."""
        known = errors.parts["frame"]
        rows = [known.row_of[frame_id] for frame_id in frame_ids.tolist()]
        frames = PartErrors(tuple(frame_ids.tolist()), known.modes[rows], known.rests[rows], known.by_scale[rows])
        return cls(centers, frames)

    @property
    def stddev_m(self) -> Array:
        """Return the (n,) standard deviation of a coordinate of each keyframe."""
        variance = np.sum(self.frames.modes[:, 3:] ** 2, axis=(1, 2))
        return np.asarray(np.sqrt((variance + np.trace(self.frames.rests[:, 3:, 3:], axis1=1, axis2=2)) / 3))

    def carried(self, held: int, others: Indices) -> Array:
        """Return how k keyframes err if they keep their places relative to one that errs, (k, 6, 6).

        The six numbers are a turn about the axes of the world (rad) and a shift (metres).
        """
        carried = np.tile(np.eye(6), (len(others), 1, 1))
        carried[:, 3:, :3] = -cross_matrices(self.centers[others] - self.centers[held])
        return carried

    def variances(self, held: int, others: Indices, by_frame: Array) -> Array:
        """Return the (k,) total variances of what depends on k keyframes, where keyframe ``held`` is exact.

        Args:
            by_frame: (k, d, 6) derivatives of d numbers by each of the keyframes.
        """
        by_held = by_frame @ self.carried(held, others)
        modes = by_frame @ self.frames.modes[others] - by_held @ self.frames.modes[held]
        rests = by_frame @ self.frames.rests[others] * by_frame + by_held @ self.frames.rests[held] * by_held
        return np.asarray(np.sum(modes**2, axis=(1, 2)) + np.sum(rests, axis=(1, 2)))

    def covariance(self, frames: Indices, by_frame: Array) -> Array:
        """Return the (6, 6) covariance of what depends on the errors of k keyframes.

        Args:
            frames: (k,) indices; one may be there twice.
            by_frame: (k, 6, 6) derivatives.
        """
        unique, place = np.unique(frames, return_inverse=True)
        total = np.zeros((len(unique), 6, 6))
        np.add.at(total, place, by_frame)
        modes = np.sum(total @ self.frames.modes[unique], axis=0)
        rests = total @ self.frames.rests[unique] @ np.swapaxes(total, 1, 2)
        return np.asarray(modes @ modes.T + rests.sum(axis=0))
