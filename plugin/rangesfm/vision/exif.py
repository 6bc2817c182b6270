"""What cameras write into their photos beside the pixels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from PIL import Image

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_LATITUDE, _LONGITUDE, _ALTITUDE = 2, 4, 6
_LATITUDE_REF, _LONGITUDE_REF, _ALTITUDE_REF = 1, 3, 5
_TOO_BAD = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)  # what Pillow's readers raise


def exif_tags(path: Path) -> dict[int, Any]:
    """Tags of the photo and of its exposure, by number; none if the file has none or is no image."""
    try:
        with Image.open(path) as image:
            exif = image.getexif()
            return {**exif, **exif.get_ifd(_EXIF_IFD)}
    except _TOO_BAD:
        return {}


def exif_position(path: Path) -> tuple[float, float, float] | None:
    """Latitude and longitude in degrees (WGS 84) and altitude in metres, 0 where it says none; None without a place."""
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(_GPS_IFD)
        latitude = _degrees(tags[_LATITUDE], tags.get(_LATITUDE_REF) == "S")
        longitude = _degrees(tags[_LONGITUDE], tags.get(_LONGITUDE_REF) == "W")
        below = tags.get(_ALTITUDE_REF) in (1, b"\x01")
        altitude_m = float(tags.get(_ALTITUDE, 0.0)) * (-1 if below else 1)
    except (*_TOO_BAD, LookupError, TypeError, ZeroDivisionError):
        return None
    place = latitude, longitude, altitude_m
    return place if all(map(math.isfinite, place)) else None


def _degrees(parts: Any, is_negative: bool) -> float:
    degrees, minutes, seconds = map(float, parts)
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if is_negative else 1)
