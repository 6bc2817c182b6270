"""Places of an antenna on the path of the keyframes, on which ranges and positions depend alike."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.util.geometry.motion_prior import learn_motion
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import OnPath, Trajectory, is_too_long


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


def places_on_path(
    trajectory: Trajectory,
    arms_in_cam_m: Array,
    at: OnPath,
    *,
    max_gap_s: float,
    time_resolution_s: float,
) -> PlacesOnPath:
    """Return the places of n moments between keyframes, interpolated by a motion model if the keyframes have times.

    Args:
        arms_in_cam_m: (n, 3) lever arms. at: -1 for a moment without a place.
        max_gap_s: longest time between two keyframes between which poses are interpolated.
        time_resolution_s: step to which the moments were rounded.
    """
    rows, num = np.flatnonzero(at.before >= 0), len(at.before)
    own, arms_m = at.subset(rows), np.full((num, 3), np.nan)
    centers, offsets, stddev, arm_stddev_m = arms_m.copy(), np.zeros((num, 3)), np.zeros(num), np.zeros(num)
    if trajectory.timestamps_s is None or len(trajectory) < 2:
        arms_m[rows] = np.einsum("nij,nj->ni", trajectory.world_from_cam[own.before], arms_in_cam_m[rows])
    else:
        is_bridged = ~is_too_long(np.diff(trajectory.timestamps_s), max_gap_s)
        arms_m[rows], arm_stddev_m[rows] = _interpolated_lever_arms(trajectory, arms_in_cam_m[rows], own, is_bridged)
        offsets[rows], own_stddev = _interpolated_centers(trajectory, own, is_bridged)
        stddev[rows] = np.hypot(own_stddev, _timing_stddev(time_resolution_s, trajectory, own, max_gap_s))
    centers[rows] = own.between(trajectory.centers) + offsets[rows]
    on_keyframes = (at.before, at.after, at.fraction)
    return PlacesOnPath(*on_keyframes, centers, offsets, arms_m, stddev, arm_stddev_m)


def _interpolated_centers(trajectory: Trajectory, at: OnPath, is_bridged: Mask) -> tuple[Array, Array]:
    """Return the offsets (n, 3) of the centres from the straight lines between keyframes, in model units.

    Also returns the standard deviation (n,) of each coordinate.
    """
    motion = learn_motion(trajectory.times_s, trajectory.centers, is_bridged)
    offsets, stddev = np.zeros((len(at.before), 3)), np.full(len(at.before), motion.noise_stddev)
    between = at.fraction > 0
    offsets[between], stddev[between] = motion.beyond_chord(at.before[between], at.fraction[between])
    return offsets, stddev


def _interpolated_lever_arms(
    trajectory: Trajectory, tags_in_cam_m: Array, at: OnPath, is_bridged: Mask
) -> tuple[Array, Array]:
    """Return the lever arms (n, 3) in the world, and the standard deviation (n,) of each coordinate, metres.

    The rotation vectors from keyframe to keyframe, in the camera's frame, are summed up and treated as coordinates of a
    motion. This is valid while successive rotations are small or have the same axis.
    """
    to_next = Rotation.from_matrix(np.swapaxes(trajectory.world_from_cam[:-1], 1, 2) @ trajectory.world_from_cam[1:])
    turned = np.vstack([np.zeros((1, 3)), np.cumsum(to_next.as_rotvec(), axis=0)])
    motion = learn_motion(trajectory.times_s, turned, is_bridged)
    stddev = np.full(len(at.before), motion.noise_stddev)
    between = at.fraction > 0
    beyond, stddev[between] = motion.beyond_chord(at.before[between], at.fraction[between])
    arms = tags_in_cam_m.copy()
    turns = at.fraction[between, None] * to_next.as_rotvec()[at.before[between]] + beyond
    if len(turns):  # SciPy before 1.16 cannot make an empty set of rotations
        arms[between] = Rotation.from_rotvec(turns).apply(arms[between])
    # A rotation moves the end of the arm in two of the three directions.
    stddev_m = np.sqrt(2 / 3) * stddev * np.linalg.norm(tags_in_cam_m, axis=1)
    return np.einsum("nij,nj->ni", trajectory.world_from_cam[at.before], arms), stddev_m


def _timing_stddev(log_resolution_s: float, trajectory: Trajectory, at: OnPath, max_gap_s: float) -> Array:
    """Return the standard deviation (n,) of each coordinate due to rounded times of photos and ranges, in model units.

    Uniform rounding to a step has the standard deviation step / sqrt(12). It is independent for each time.
    """
    times, centers = trajectory.timestamps_s, trajectory.centers
    log_stddev_s, photo_stddev_s = log_resolution_s / np.sqrt(12), trajectory.time_resolution_s / np.sqrt(12)
    if times is None or len(times) < 2 or not log_stddev_s + photo_stddev_s > 0:
        return np.zeros(len(at.before))
    gaps = np.diff(times)
    # Across a long gap ranges are used only if the camera stood still.
    speeds = np.where(is_too_long(gaps, max_gap_s), 0, np.linalg.norm(np.diff(centers, axis=0), axis=1) / gaps)
    around = np.concatenate([[0.0], speeds, [0.0]])
    is_at, following = at.before == at.after, around[at.before + 1]
    speed = np.where(is_at, np.maximum(around[at.before], following), following)
    photo_share = np.where(is_at, 1.0, np.hypot(1 - at.fraction, at.fraction))
    return np.asarray(speed / np.sqrt(3) * np.hypot(log_stddev_s, photo_share * photo_stddev_s))
