"""Positions of a tag at its ranges, where its path is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference


def tag_positions(
    log: RangeLog,
    path: Reference,
    tag_in_cam_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float,
) -> Array:
    """Return the position of the tag's antenna at each range, interpolated between known positions.

    Args:
        log: n ranges, by time or by name of a photo or place, like the path.
        path: positions of the tag's antenna; or of the camera, with rotations, if ``tag_in_cam_m`` is given.
        tag_in_cam_m: (3,) lever arm, the antenna in the frame whose positions are known, metres.
        time_offset_s: time of the path = time of the range + offset.
        max_gap_s: positions are interpolated between known ones up to this far apart in time, seconds.

    Returns:
        (n, 3) positions in metres, NaN where they are not known.

    Raises:
        InputError: the log is by time and the path by name or the reverse, there is a lever arm but no rotations, or no
            range is at a known position.
    """
    if type(log.moments) is not type(path.moments):
        ours, theirs = ("name", "time") if isinstance(log.moments, ByPhoto) else ("time", "name")
        raise InputError(f"the ranges are by {ours} and the positions by {theirs}, expected the same", log.source)
    moments = log.moments.later(time_offset_s)
    positions, rotations = path.poses(moments, max_gap_s)
    lever = np.asarray(tag_in_cam_m, dtype=np.float64)
    if np.any(lever != 0):
        if rotations is None:
            raise InputError("a lever arm needs the rotations qx,qy,qz,qw besides the positions")
        positions = positions + rotations @ lever
    if len(log) and not np.isfinite(positions).any():
        raise InputError(path.why_nothing_is_known("ranges", moments, max_gap_s), log.source)
    return positions
