"""Georeference: a local frame of metres (x east, y north, z up) at a place on the Earth.

Everything inside works in the local frame, where numbers are small and a metre is a metre; projected coordinates, which
stretch it, and large ones exist only in files. Transformations are PROJ's, through pyproj (the extra ``geo``), without
network: a vertical datum that needs a grid is not known, and heights are taken as ellipsoidal ones of their system.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.geometry.similarity import IDENTITY, Similarity

if TYPE_CHECKING:
    from pyproj import Transformer


GEOGRAPHIC = "EPSG:4979"
"""WGS 84: longitude and latitude in degrees, ellipsoidal height in metres; always in this order here."""

# Around the area for which a coordinate system was made.
_MARGIN_DEG = 1.0

_ENU = (
    "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
    "+step +proj=topocentric +ellps=WGS84 +lon_0={lon_deg!r} +lat_0={lat_deg!r} +h_0={height_m!r}"
)


@dataclass(frozen=True)
class Georeference:
    """Where a metric map lies on the Earth.

    Attributes:
        lat_deg, lon_deg, height_m: WGS 84, the origin of the local frame.
        crs: coordinate system in which files give coordinates, as "EPSG:2056".
        enu_from_world: rigid, from the map's world to the local frame.
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    crs: str = GEOGRAPHIC
    enu_from_world: Similarity = IDENTITY

    def geographic(self, points: Array) -> Array:
        """(n, 3) longitude, latitude (degrees) and height of points in the map's world."""
        return _apply(self._enu_from_geographic, self.enu_from_world.apply(points), inverse=True)

    def projected(self, points: Array) -> Array:
        """(n, 3) coordinates in ``crs`` (east or longitude first) of points in the map's world."""
        return _apply(_geographic_from(self.crs), self.geographic(points), inverse=True)

    @cached_property
    def _enu_from_geographic(self) -> Transformer:
        pipeline = _ENU.format(lon_deg=self.lon_deg, lat_deg=self.lat_deg, height_m=self.height_m)
        transformer: Transformer = _pyproj().Transformer.from_pipeline(pipeline)
        return transformer


def georeference_at(coordinates: Array, crs: str) -> tuple[Georeference, Array]:
    """The local frame around the middle of points (n, 3) in ``crs``, and the points in it, in metres.

    They are east or longitude first, then height; NaN rows stay NaN. InputError if the system is not known, or does not
    hold where they are.
    """
    geographic = _apply(_geographic_from(crs), coordinates)
    if not _holds_at(crs, geographic[np.isfinite(coordinates).all(axis=1)]):
        raise InputError(f"coordinates lie outside of where {crs} holds: are they east, north, height?")
    lon_deg, lat_deg, height_m = np.nanmean(geographic, axis=0).tolist()
    georeference = Georeference(lat_deg, lon_deg, height_m, crs)
    return georeference, _apply(georeference._enu_from_geographic, geographic)


def georeference_of_anchor(
    anchor_in_world_m: Array,
    place: tuple[float, float, float],
    *,
    up_in_world: Array,
    forward_in_world: Array,
    heading_deg: float,
    crs: str = GEOGRAPHIC,
) -> Georeference:
    """The local frame of a map of which one anchor's place on the Earth and one direction's heading are known.

    Args:
        place: latitude and longitude in degrees, ellipsoidal height in metres (WGS 84), the frame's origin.
        up_in_world: (3,) against gravity.
        forward_in_world: (3,) a direction; InputError if it is vertical.
        heading_deg: its azimuth, from north through east.
    """
    up = up_in_world / np.linalg.norm(up_in_world)
    level = forward_in_world - (forward_in_world @ up) * up
    if np.linalg.norm(level) < 1e-3 * np.linalg.norm(forward_in_world):
        raise InputError(
            "a heading needs a direction that is not vertical, and the first camera looks straight up or down"
        )
    ahead = level / np.linalg.norm(level)
    right = np.cross(ahead, up)
    heading = np.deg2rad(heading_deg)
    north = np.cos(heading) * ahead - np.sin(heading) * right
    rotation = np.stack([np.cross(north, up), north, up])
    enu_from_world = Similarity(1.0, rotation, -rotation @ anchor_in_world_m)
    lat_deg, lon_deg, height_m = place
    return Georeference(lat_deg, lon_deg, height_m, crs, enu_from_world)


def check_crs(crs: str) -> None:
    """Raise InputError unless PROJ knows this coordinate system."""
    _geographic_from(crs)


def is_geographic(crs: str) -> bool:
    """Whether the system counts in degrees."""
    return bool(_pyproj().CRS.from_user_input(crs).is_geographic)


def _holds_at(crs: str, geographic: Array) -> bool:
    """Whether (n, 3) places lie where the system is meant to be used; formulas give some place for any nonsense."""
    if not np.isfinite(geographic).all():
        return False
    area = _pyproj().CRS.from_user_input(crs).area_of_use
    if area is None:
        return True
    lon, lat = geographic[:, 0], geographic[:, 1]
    west, east = lon >= area.west - _MARGIN_DEG, lon <= area.east + _MARGIN_DEG
    within_lon = west | east if area.west > area.east else west & east  # across the date line
    return bool(np.all(within_lon & (lat >= area.south - _MARGIN_DEG) & (lat <= area.north + _MARGIN_DEG)))


def _geographic_from(crs: str) -> Transformer:
    pyproj = _pyproj()
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise InputError(f"unknown coordinate system {crs!r}, expected one of PROJ's, as EPSG:2056") from None
    if len(system.axis_info) < 3 and not system.is_compound:
        system = system.to_3d()
    transformer: Transformer = pyproj.Transformer.from_crs(system, GEOGRAPHIC, always_xy=True)
    return transformer


def _apply(transformer: Any, points: Array, *, inverse: bool = False) -> Array:
    direction = "INVERSE" if inverse else "FORWARD"
    # As lists: an array of one number some versions of pyproj take for the number, which numpy warns of.
    columns = np.asarray(points, dtype=np.float64).T.tolist()
    return np.column_stack(transformer.transform(*columns, direction=direction))


def _pyproj() -> Any:
    try:
        import pyproj
    except ImportError:
        raise InputError("coordinate systems need pyproj: pip install 'rangesfm[geo]'") from None
    return pyproj
