"""PathSamples: the antenna's path sampled evenly in time, to be tried against a radio log at any offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import AssociationOptions
from rangesfm.ranging.association import associate
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.observations import RangeStatus

# Between samples this close a straight line is off by less than a millimetre, even at 10 m/s^2.
_SAMPLE_STEP_S = 0.025
# Photos of more than seven hours are sampled more coarsely.
_MAX_NUM_SAMPLES = 1 << 20


@dataclass(frozen=True)
class PathSamples:
    """m camera poses, ``step_s`` apart, from ``start_s`` on (camera's clock).

    Attributes:
        centers: (m, 3) camera centres, model units; 0 where unknown.
        tag_from_center: (num_tags, m, 3) lever arms turned into the world, metres.
        is_known: (m,) whether the camera's pose is known then.
    """

    start_s: float
    step_s: float
    centers: Array
    tag_from_center: Array
    is_known: Mask

    def __len__(self) -> int:
        return len(self.is_known)

    def knows(self, times_s: Array) -> Mask:
        """(n,) times at which the pose is known."""
        place = (times_s - self.start_s) / self.step_s
        inside = (place >= 0) & (place < len(self) - 1)
        before = np.where(inside, place, 0).astype(np.int64)
        return np.asarray(inside & self.is_known[before] & self.is_known[np.minimum(before + 1, len(self) - 1)])

    def tag(self, times_s: Array, tag: Indices, scale: float) -> tuple[Array, Array]:
        """Where the antenna of a tag is at known times, and how it moves.

        Args:
            times_s: (n,)
            tag: (n,) which one.
            scale: metres per model unit; infinite to leave the lever arm out.

        Returns:
            (n, 3) positions, model units; (n, 3) velocities, model units a second.
        """
        place = (times_s - self.start_s) / self.step_s
        before = np.clip(place, 0, len(self) - 2).astype(np.int64)
        points = self.centers + self.tag_from_center / scale
        here = points[tag, before]
        step = points[tag, before + 1] - here
        return here + (place - before)[:, None] * step, step / self.step_s


def moving_path(trajectory: Trajectory, tags_in_cam_m: Array, options: AssociationOptions) -> PathSamples:
    """The path where ranges would be interpolated between keyframes; ``tags_in_cam_m``: (num_tags, 3)."""
    assert trajectory.timestamps_s is not None, "a path in time needs times"
    start_s = float(trajectory.timestamps_s[0])
    span_s = float(trajectory.timestamps_s[-1]) - start_s
    step_s = max(_SAMPLE_STEP_S, span_s / _MAX_NUM_SAMPLES)
    times = start_s + step_s * np.arange(int(span_s / step_s) + 1)
    probe = RangeLog.from_arrays(["probe"] * len(times), np.ones(len(times)), timestamp_s=times)
    # A negative tolerance: a sample next to a keyframe is interpolated like all others.
    options = options.model_copy(update={"max_time_difference_s": -1.0})
    by_tag = [associate(probe, trajectory, tag_in_cam_m, options=options) for tag_in_cam_m in tags_in_cam_m]
    places = by_tag[0]
    is_known = (places.status == RangeStatus.USED) & (places.before != places.after)
    known = is_known[:, None]
    tag_from_center = np.stack([np.where(known, places_of_tag.tag_from_center, 0.0) for places_of_tag in by_tag])
    return PathSamples(start_s, step_s, np.where(known, places.centers, 0.0), tag_from_center, is_known)
