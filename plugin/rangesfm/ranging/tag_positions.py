"""Where the tag was at each range, from a known path of the tag or of the camera that carries it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.geometry.reference import Reference
from rangesfm.ranging.log import RangeLog


def tag_positions(
    log: RangeLog,
    path: Reference,
    tag_in_cam_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float,
) -> Array:
    """The tag's antenna at each range, interpolated between the known positions.

    Args:
        log: n ranges, by time or by photo (or any name of a place) as the path.
        path: positions of the tag's antenna; or of the camera, with rotations, if ``tag_in_cam_m`` is given.
        tag_in_cam_m: (3,) the antenna in the frame whose positions are known.
        time_offset_s: time of the path = time of the range + offset.
        max_gap_s: between known positions further apart nothing is interpolated.

    Returns:
        (n, 3) metres, NaN where the path does not say.

    Raises:
        InputError: one is by time and the other by name, a lever arm without rotations, or nothing in common.
    """
    positions, rotations = _poses(log, path, time_offset_s, max_gap_s)
    lever = np.asarray(tag_in_cam_m, dtype=np.float64)
    if np.any(lever != 0):
        if rotations is None:
            raise InputError("a lever arm needs the rotations qx,qy,qz,qw beside the positions")
        positions = positions + rotations @ lever
    if len(log) and not np.isfinite(positions).any():
        times_s = None if log.timestamp_s is None else log.timestamp_s + time_offset_s
        raise InputError(path.why_nothing_is_known("ranges", log.image_name, times_s, max_gap_s), log.source)
    return positions


def _poses(log: RangeLog, path: Reference, time_offset_s: float, max_gap_s: float) -> tuple[Array, Array | None]:
    if log.image_name is not None:
        if path.image_names is None:
            raise InputError("the ranges are by name and the positions by time, expected both alike", log.source)
        return path.poses_of(log.image_name)
    if path.timestamps_s is None:
        raise InputError("the ranges are by time and the positions by name, expected both alike", log.source)
    assert log.timestamp_s is not None
    return path.poses_at(log.timestamp_s + time_offset_s, max_gap_s)
