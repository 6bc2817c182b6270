"""Places of an antenna on the path of the keyframes, on which ranges and positions depend alike."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import OnPath, Trajectory


@dataclass(frozen=True)
class PlacesOnPath(OnPath):
    """Places of an antenna at n moments on the path of an unscaled model.

    The antenna is at ``centers + tag_from_center``, with both vectors in the axes of the model's world. The centres are
    in the world's unit, and the lever arm is in metres, so that a similarity scales the centres and never the lever
    arm. Centres are ``(1 - fraction) * c_before + fraction * c_after + center_offsets``. The offset is the deviation of
    a curved path from the straight line.

    Attributes:
        centers: (n, 3) camera centres in model units; NaN without a place.
        center_offsets: (n, 3) deviation from the straight line, in model units.
        tag_from_center: (n, 3) lever arm in the axes of the world, metres.
        center_stddev: (n,) standard deviation of each coordinate of the interpolated centre, model units. At a keyframe
            with an exact time it is the keyframes' own error, as far as keyframes close in time show one.
        arm_stddev_m: (n,) standard deviation of each coordinate of the lever arm, metres.
    """

    centers: Array
    center_offsets: Array
    tag_from_center: Array
    center_stddev: Array
    arm_stddev_m: Array


@dataclass(frozen=True)
class AntennaPlaces(OnPath):
    """Places of an antenna at n times.

    Each is ``(1 - fraction) * p_before + fraction * p_after + offset`` with ``p = center + world_from_rig @ arm``.

    Attributes:
        interval_s: (n,) time between the two, 0 at a keyframe.
        offset_m: (n, 3) deviation of the curved path from the straight line, in the metric world; in the unit of an
            unscaled model for places of the camera on its path.
    """

    interval_s: Array
    offset_m: Array

    @classmethod
    def nowhere(cls, num: int) -> AntennaPlaces:
        """Return n times without a place."""
        none = np.full(num, -1, dtype=np.int64)
        return cls(none, none, np.zeros(num), np.zeros(num), np.zeros((num, 3)))

    def subset(self, rows: Mask | Indices) -> AntennaPlaces:
        """Return some of the places."""
        return AntennaPlaces(*(getattr(self, field.name)[rows] for field in fields(self)))

    def joined(self, others: AntennaPlaces) -> AntennaPlaces:
        """Return these places followed by others."""
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(self))
        return AntennaPlaces(*map(np.concatenate, pairs))

    def at(self, poses: Poses, arms_m: Array, later_s: float = 0.0) -> Array:
        """Return the (n, 3) places.

        Args:
            arms_m: (n, 3) antennas in the rig's frame. later_s: how much later than assumed the antenna was there.
        """
        first, last = (self._at_keyframe(poses, index, arms_m) for index in (self.before, self.after))
        fraction = self._fraction(later_s)[:, None]
        return np.asarray((1 - fraction) * first + fraction * last + self.offset_m)

    def centers(self, poses: Poses, later_s: float = 0.0) -> Array:
        """Return the (n, 3) places of the rig's origin on the straight lines between keyframes."""
        fraction = self._fraction(later_s)[:, None]
        return np.asarray((1 - fraction) * poses.centers[self.before] + fraction * poses.centers[self.after])

    def _fraction(self, later_s: float) -> Array:
        if not later_s:
            return self.fraction
        is_between = self.before != self.after
        return self.fraction + later_s * np.divide(
            1.0, self.interval_s, where=is_between, out=np.zeros(len(is_between))
        )

    @staticmethod
    def _at_keyframe(poses: Poses, index: Indices, arms_m: Array) -> Array:
        turned: Array = np.einsum("nij,nj->ni", poses.world_from_rig[index], arms_m)
        return poses.centers[index] + turned

    def on_map(
        self, path: Trajectory, arms_in_cam_m: Array, arms_m: Array, metric_from_sfm: Similarity
    ) -> AntennaPlaces:
        """Return the places in a metric map, given those of the camera on the path of an unscaled model.

        Args:
            path: on which the places are. arms_in_cam_m: (n, 3) antennas in the rig's frame.
            arms_m: (n, 3) these in the axes of the path's world, as they turn between keyframes.
            metric_from_sfm: from the world of the path to that of the map.
        """
        unmoved = Poses(path.world_from_cam, np.zeros_like(path.centers))
        turned_m = replace(self, offset_m=np.zeros_like(self.offset_m)).at(unmoved, arms_in_cam_m)
        beyond_m = metric_from_sfm.scale * self.offset_m + arms_m - turned_m
        return replace(self, offset_m=beyond_m @ metric_from_sfm.rotation.T)

    @property
    def keyframes(self) -> Indices:
        """(n, 2) keyframes before and after."""
        return np.column_stack([self.before, self.after])

    def by_pose(self, poses: Poses, arms_m: Array, directions: Array, later_s: float = 0.0) -> Array:
        """Return the derivatives (n, d, 2, 6) by the two keyframes of the places along (n, d, 3) directions."""
        fraction = self._fraction(later_s)
        found = np.empty((*directions.shape[:2], 2, 6))
        for k, (index, share) in enumerate(((self.before, 1 - fraction), (self.after, fraction))):
            in_rig = directions @ poses.world_from_rig[index]
            found[:, :, k, :3] = share[:, None, None] * np.cross(arms_m[:, None], in_rig)
            found[:, :, k, 3:] = share[:, None, None] * directions
        return found

    def by_arm(self, poses: Poses, directions: Array, later_s: float = 0.0) -> Array:
        """Return the derivatives (n, d, 3) by the lever arm of the places along (n, d, 3) directions."""
        fraction = self._fraction(later_s)[:, None, None]
        first, last = (directions @ poses.world_from_rig[index] for index in (self.before, self.after))
        return np.asarray((1 - fraction) * first + fraction * last)

    def by_time(self, poses: Poses, arms_m: Array, directions: Array) -> Array:
        """Return the derivatives (n, d, 1) by the time, per second, of the places along (n, d, 3) directions."""
        first, last = (self._at_keyframe(poses, index, arms_m) for index in (self.before, self.after))
        is_between = self.before != self.after
        per_second = np.divide(1.0, self.interval_s, where=is_between, out=np.zeros(len(is_between)))
        return np.asarray(np.einsum("ndi,ni->nd", directions, (last - first) * per_second[:, None])[:, :, None])
