"""Trajectory: the camera's path in the world of one model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.util.geometry.similarity import Similarity

if TYPE_CHECKING:
    import pycolmap

ROUNDING_S = 1e-6
"""Rounding error of the difference of two times in seconds since 1970."""
MIN_NUM_KEYFRAMES = 4
"""Fewest keyframes whose ranges tell anything of a map: three lie in one plane with any anchor."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of the registered keyframes (COLMAP frames), sorted by time where times are known.

    The pose of a rig is that of its reference camera, so that ``cam`` means the rig frame.

    Attributes:
        frame_ids: (n,) int, COLMAP's frame ids.
        image_names: n names, the reference camera's photo of each frame.
        timestamps_s: (n,) seconds on the camera's clock, strictly increasing; None if unknown.
        centers: (n, 3) projection centres in the world, in the world's unit.
        world_from_cam: (n, 3, 3) rotations.
        time_resolution_s: step to which the times were rounded or truncated; 0 if they are exact.
    """

    frame_ids: Indices
    image_names: tuple[str, ...]
    timestamps_s: Array | None
    centers: Array
    world_from_cam: Array
    time_resolution_s: float = 0.0

    def __len__(self) -> int:
        return len(self.image_names)

    def transformed(self, new_from_old: Similarity) -> Trajectory:
        """Return the path in another world."""
        turned = new_from_old.rotation @ self.world_from_cam
        return replace(self, centers=new_from_old.apply(self.centers), world_from_cam=turned)

    def as_in(self, model: pycolmap.Reconstruction) -> Trajectory:
        """Return the path of the same keyframes in another model."""
        return trajectory_from_reconstruction(model, self.times_by_name or None)

    @property
    def times_s(self) -> Array:
        """The ``timestamps_s`` of a path that must have them.

        Raises:
            InputError: it has none.
        """
        if self.timestamps_s is None:
            raise InputError("the photos have no times: give image times")
        return self.timestamps_s

    @property
    def times_by_name(self) -> dict[str, float]:
        """Times of the keyframes by name of the photo; empty if unknown."""
        times = self.timestamps_s
        return {} if times is None else dict(zip(self.image_names, times.tolist(), strict=True))

    def timed(self, timestamps_s: Mapping[str, float]) -> Trajectory:
        """Return the keyframes whose photo has a time, in the order of these times, given by the photos' names."""
        known = [row for row, name in enumerate(self.image_names) if name in timestamps_s]
        rows = sorted(known, key=lambda row: timestamps_s[self.image_names[row]])
        names = tuple(self.image_names[row] for row in rows)
        times = np.array([timestamps_s[name] for name in names], dtype=np.float64)
        turns = self.world_from_cam[rows]
        return Trajectory(self.frame_ids[rows], names, times, self.centers[rows], turns, self.time_resolution_s)

    def resized(self, factor: float, frame: str) -> Trajectory:
        """Return the path scaled by a factor around a fixed point.

        In the frame "first_camera" the fixed point is the first keyframe, which defines that frame. In a site frame it
        is the mean of the path, because ranges to surveyed anchors determine that point whatever the scale.
        """
        fixed_point = self.centers[0] if frame == "first_camera" else self.centers.mean(axis=0)
        return self.transformed(Similarity(factor, np.eye(3), (1.0 - factor) * fixed_point))


@dataclass(frozen=True)
class OnPath:
    """Places of n moments on a path of keyframes: ``(1 - fraction) * before + fraction * after``.

    Attributes:
        before, after: (n,) indices of keyframes; -1 for a moment without a place.
        fraction: (n,) of the later one, in [0, 1].
    """

    before: Indices
    after: Indices
    fraction: Array

    @classmethod
    def at_keyframes(cls, index: Indices) -> OnPath:
        """Return the places of n moments at keyframes, given (n,) indices of these; -1 for no place."""
        return cls(index, index, np.zeros(len(index)))

    @property
    def nearest(self) -> Indices:
        """Index of the nearer keyframe (n,)."""
        return np.where(self.fraction < 0.5, self.before, self.after)

    def subset(self, rows: Mask | Indices) -> OnPath:
        """Return some of the places."""
        return OnPath(self.before[rows], self.after[rows], self.fraction[rows])

    def between(self, values: Array) -> Array:
        """Return the (n, d) values on the straight lines between those (k, d) of the keyframes."""
        fraction = self.fraction[:, None]
        return np.asarray((1 - fraction) * values[self.before] + fraction * values[self.after])

    def moved(self, rows: Mask, keyframes: Indices | int) -> OnPath:
        """Return the places with some of the moments, ``rows`` (n,), at keyframes."""
        before, after = np.where(rows, keyframes, self.before), np.where(rows, keyframes, self.after)
        return OnPath(before, after, np.where(rows, 0.0, self.fraction))


def keyframes_around(times: Array, keyframe_times: Array) -> OnPath:
    """Return the keyframes before and after each time (n,), however far they are.

    Times outside the path belong to its first or last two keyframes, with a fraction of 0 or 1.
    """
    last = len(keyframe_times) - 1
    after = np.clip(np.searchsorted(keyframe_times, times), min(1, last), last)
    before = np.maximum(after - 1, 0)
    gap = keyframe_times[after] - keyframe_times[before]
    fraction = np.clip((times - keyframe_times[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    return OnPath(before, after, fraction)


def is_too_long(gaps_s: npt.ArrayLike, max_gap_s: float) -> Mask:
    """Return which gaps between keyframes (n,) are too long for interpolation, with a tolerance for rounded times."""
    return np.asarray(gaps_s) > max_gap_s + ROUNDING_S


def places_in_time(times: Array, keyframe_times: Array, *, max_gap_s: float, max_difference_s: float) -> OnPath:
    """Return the places of times (n,): between two keyframes that are close in time, or else at one that is near.

    Args:
        max_gap_s: longest time between two keyframes. max_difference_s: longest time to a keyframe.
    """
    around = keyframes_around(times, keyframe_times)
    gap = keyframe_times[around.after] - keyframe_times[around.before]
    is_inside = (times >= keyframe_times[0]) & (times <= keyframe_times[-1])
    is_between = is_inside & (gap > 0) & ~is_too_long(gap, max_gap_s)
    is_near = np.abs(times - keyframe_times[around.nearest]) <= max_difference_s
    return around.moved(~is_between, np.where(is_near, around.nearest, -1))


def first_camera_from(trajectory: Trajectory, scale: float = 1.0) -> Similarity:
    """Return the similarity, a rigid motion by default, from the world of a path to the frame of its first camera."""
    rotation = trajectory.world_from_cam[0].T
    return Similarity(scale, rotation, -scale * rotation @ trajectory.centers[0])


def moved_similarity(similarity: Similarity, step: Array, path: Trajectory) -> Similarity:
    """Return a similarity moved by (7,) logarithm of the scale, turn and shift about the first camera of a path."""
    origin = similarity.apply(path.centers[:1])[0]
    rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ similarity.rotation
    scale = similarity.scale * float(np.exp(np.clip(step[0], -1.0, 1.0)))
    return Similarity(scale, rotation, origin + step[4:] - scale * rotation @ path.centers[0])


def trajectory_from_reconstruction(
    reconstruction: pycolmap.Reconstruction,
    timestamps_s: Mapping[str, float] | None = None,
    *,
    time_resolution_s: float = 0.0,
) -> Trajectory:
    """Return the path of a model's registered frames.

    Args:
        reconstruction: a COLMAP model with registered frames.
        timestamps_s: camera-clock time of each photo by name; frames whose photo has
            no time are left out. None: the path has no times and is ordered by name.
        time_resolution_s: step to which the times were rounded or truncated.
    """
    frames = map(reconstruction.frame, reconstruction.reg_frame_ids())
    named = sorted(((_reference_image_name(reconstruction, frame), frame) for frame in frames), key=itemgetter(0))
    poses = [pose_of(frame) for _, frame in named]
    path = Trajectory(
        np.array([frame.frame_id for _, frame in named], dtype=np.int64),
        tuple(name for name, _ in named),
        None,
        np.array([pose.tgt_origin_in_src() for pose in poses], dtype=np.float64).reshape(-1, 3),
        np.array([pose.rotation.matrix().T for pose in poses], dtype=np.float64).reshape(-1, 3, 3),
        time_resolution_s,
    )
    return path if timestamps_s is None else path.timed(timestamps_s)


def joined_trajectory(parts: Sequence[Trajectory]) -> tuple[Trajectory, list[Indices]]:
    """Join several parts in one world into one path; also return, for each part, the indices of its keyframes in it.

    Either all parts have times or none. The order is that of ``trajectory_from_reconstruction``.
    """
    names = np.array([name for part in parts for name in part.image_names], dtype=object)
    times = [part.timestamps_s for part in parts if part.timestamps_s is not None]
    order = np.lexsort((names.astype(str), *([np.concatenate(times)] if times else [])))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    ends = np.cumsum([len(part) for part in parts])
    path = Trajectory(
        np.concatenate([part.frame_ids for part in parts])[order],
        tuple(names[order].tolist()),
        np.concatenate(times)[order] if times else None,
        np.concatenate([part.centers for part in parts])[order],
        np.concatenate([part.world_from_cam for part in parts])[order],
        max(part.time_resolution_s for part in parts),
    )
    return path, np.split(place, ends[:-1])


def is_one_after_the_other(path: Trajectory) -> bool:
    """Return whether no two keyframes have the same time; in a map joined from several cameras' maps they may."""
    return path.timestamps_s is None or bool(np.all(np.diff(path.timestamps_s) > 0))


def pose_of(frame: pycolmap.Frame) -> pycolmap.Rigid3d:
    """Return rig_from_world of a registered frame as a view, so that writing to its ``params`` moves the frame."""
    pose = frame.rig_from_world
    if pose is None:
        raise ValueError(f"frame {frame.frame_id} has no pose")
    return pose


def photos_by_frame(reconstruction: pycolmap.Reconstruction) -> dict[str, tuple[str, ...]]:
    """Return the names of each frame's photos, by the photo that stands for the frame in a trajectory."""
    return {
        _reference_image_name(reconstruction, frame): tuple(
            reconstruction.image(data_id.id).name for data_id in frame.image_ids
        )
        for frame in reconstruction.frames.values()
    }


def _reference_image_name(reconstruction: pycolmap.Reconstruction, frame: pycolmap.Frame) -> str:
    """Return the name of the frame's photo from the reference camera, or of its first photo by name if it has none."""
    images = [reconstruction.image(data_id.id) for data_id in frame.image_ids]
    reference = [image for image in images if image.is_ref_in_frame()]
    return str(min(image.name for image in reference or images))
