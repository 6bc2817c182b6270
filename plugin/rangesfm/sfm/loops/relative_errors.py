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

    def covariances(self, held: int, others: Indices) -> Array:
        """Return the (k, 6, 6) covariances of k keyframes where keyframe ``held`` and what it sees are exact."""
        carried = self.carried(held, others)
        modes = self.frames.modes[others] - carried @ self.frames.modes[held]
        rest = carried @ self.frames.rests[held] @ np.swapaxes(carried, 1, 2)
        return np.asarray(modes @ np.swapaxes(modes, 1, 2) + rest + self.frames.rests[others])

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
