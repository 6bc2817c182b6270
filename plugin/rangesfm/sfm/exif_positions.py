"""Positions of photos from their EXIF data, with what these say of their accuracy."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.positions.position_formats import AUTONOMOUS_STDDEV_M
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.sfm.image_times import list_images
from rangesfm.sfm.photo_files import GpsData, gps_data
from rangesfm.util.geometry.georeference import GEOGRAPHIC
from rangesfm.util.geometry.moments import ByPhoto

_STATUS, _VOID, _DILUTION, _HORIZONTAL_ERROR = 9, "V", 11, 31
# A horizontal error is said as the radius within which 68 % of the positions are: 1.51 standard deviations of a
# coordinate. Heights by satellites are worse by about half.
_RADIUS_68, _OF_HEIGHT = 1.51, 1.5
# Standard deviations by RTK east, north and up, metres, in the XMP data of drones by DJI.
_RTK = tuple(re.compile(rb'RtkStd%s\s*(?:=\s*"|>)\s*([0-9.]+)' % axis) for axis in (b"Lon", b"Lat", b"Hgt"))


def read_exif_positions(folder: Path) -> PositionLog:
    """Read the positions in the EXIF data of the photos in a folder.

    Without a word about their accuracy, they are taken for those of a receiver without corrections.

    Raises:
        InputError: no photo has a position.
    """
    found = {name: data for name in list_images(folder) if (data := gps_data(folder / name)) is not None}
    # Some receivers write zeros where they do not know where they are.
    found = {
        name: data for name, data in found.items() if data.tags.get(_STATUS) != _VOID and data.degrees != (0.0, 0.0)
    }
    at = {
        name: [*data.degrees[::-1], data.altitude_m] for name, data in found.items() if math.isfinite(data.altitude_m)
    }
    if not at:
        raise InputError("no photo in it has an EXIF position with an altitude", folder)
    stddevs_m = np.array([_stddevs_m(found[name]) for name in at])
    flat = f"{len(found) - len(at)} of {len(found)} EXIF positions have no altitude and are left out"
    log = PositionLog.in_time_order(
        folder,
        "exif",
        np.array([*at.values()]),
        ByPhoto(tuple(at)),
        np.zeros(len(at), dtype=np.int64),
        covariance_m2=stddevs_m[:, :, None] ** 2 * np.eye(3),
        notes=[flat] if len(at) < len(found) else [],
    )
    return replace(log, crs=GEOGRAPHIC)


def _stddevs_m(data: GpsData) -> Array:
    """Return the (3,) standard deviations east, north and up."""
    by_rtk = [float(match[1]) for pattern in _RTK if (match := pattern.search(data.xmp)) is not None]
    if len(by_rtk) == len(_RTK) and min(by_rtk) > 0:
        return np.array(by_rtk)
    radius_m, dilution = (data.number(tag) for tag in (_HORIZONTAL_ERROR, _DILUTION))
    of_coordinate = radius_m / _RADIUS_68 if radius_m else AUTONOMOUS_STDDEV_M * max(dilution or 1.0, 1.0)
    return of_coordinate * np.array([1.0, 1.0, _OF_HEIGHT])
