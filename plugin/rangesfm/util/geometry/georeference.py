"""Georeference: a local frame in metres (x east, y north, z up) at a place on the Earth.

All computations use the local frame, where coordinates are small and distances are true. Projected coordinates, which
are large and distort distances, appear in files only. The transformations are PROJ's, through pyproj (the extra
``geo``), without network access. Vertical datums that need a grid are therefore not available, and heights are taken
as ellipsoidal heights of their system.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.installed_versions import missing_extra
from rangesfm.util.geometry.similarity import IDENTITY, Similarity

if TYPE_CHECKING:
    from pyproj import Transformer


GEOGRAPHIC = "EPSG:4979"
"""WGS 84: longitude and latitude in degrees, ellipsoidal height in metres; always in this order here."""
GEOCENTRIC = "EPSG:4978"
"""WGS 84: x, y, z from the centre of the Earth in metres (ECEF)."""

# Points may lie this far outside the area for which a coordinate system was made.
_MARGIN_DEG = 1.0

_ENU = (
    "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
    "+step +proj=topocentric +ellps=WGS84 +lon_0={lon_deg!r} +lat_0={lat_deg!r} +h_0={height_m!r}"
)


@dataclass(frozen=True)
class Georeference:
    """Place of a metric map on the Earth.

    Attributes:
        lat_deg, lon_deg, height_m: origin of the local frame, WGS 84.
        crs: coordinate system of coordinates in files, such as "EPSG:2056".
        enu_from_world: rigid transformation from the map's world to the local frame.
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    crs: str = GEOGRAPHIC
    enu_from_world: Similarity = IDENTITY

    def geographic(self, points: Array) -> Array:
        """Return longitude, latitude (degrees) and height (metres) of points in the map's world, both (n, 3)."""
        return _apply(self._enu_from_geographic, self.enu_from_world.apply(points), inverse=True)

    def projected(self, points: Array) -> Array:
        """Return the coordinates in ``crs`` (east or longitude first) of points in the map's world, both (n, 3)."""
        return _apply(_geographic_from(self.crs), self.geographic(points), inverse=True)

    def local(self, coordinates: Array, crs: str) -> Array:
        """Return points in the map's world, given in a coordinate system, both (n, 3).

        Raises:
            InputError: the coordinate system is unknown, or is not valid at these points.
        """
        geographic = geographic_of(coordinates, crs)
        return self.enu_from_world.inverse().apply(_apply(self._enu_from_geographic, geographic))

    @cached_property
    def _enu_from_geographic(self) -> Transformer:
        pipeline = _ENU.format(lon_deg=self.lon_deg, lat_deg=self.lat_deg, height_m=self.height_m)
        transformer: Transformer = _pyproj().Transformer.from_pipeline(pipeline)
        return transformer


def georeference_at(coordinates: Array, crs: str) -> tuple[Georeference, Array]:
    """Return a local frame at the mean of some points, and the points (n, 3) in that frame, in metres.

    Args:
        coordinates: (n, 3) points in ``crs``: east or longitude, north or latitude, height. NaN rows stay NaN.

    Raises:
        InputError: the coordinate system is unknown, or is not valid at these points.
    """
    geographic = geographic_of(coordinates, crs)
    lon_deg, lat_deg, height_m = np.nanmean(geographic, axis=0).tolist()
    georeference = Georeference(lat_deg, lon_deg, height_m, crs)
    return georeference, _apply(georeference._enu_from_geographic, geographic)


def rotation_to_enu(lon_deg: float, lat_deg: float) -> Array:
    """Return the (3, 3) rotation from geocentric axes to east, north, up at a place."""
    lon, lat = np.deg2rad((lon_deg, lat_deg))
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.stack([east, np.cross(up, east), up])


def geographic_of(coordinates: Array, crs: str) -> Array:
    """Return longitude and latitude in degrees and height in metres, (n, 3), of points in a coordinate system.

    Raises:
        InputError: the coordinate system is unknown, or is not valid at these points.
    """
    geographic = _apply(_geographic_from(crs), coordinates)
    if not _holds_at(crs, geographic[np.isfinite(coordinates).all(axis=1)]):
        raise InputError(f"coordinates lie outside the area in which {crs} is valid: are they east, north, height?")
    return geographic


def georeference_of_anchor(
    anchor_in_world_m: Array,
    place: tuple[float, float, float],
    *,
    up_in_world: Array,
    forward_in_world: Array,
    heading_deg: float,
) -> Georeference:
    """Return the georeference of a map from the place of one anchor on the Earth and the heading of one direction.

    Args:
        anchor_in_world_m: (3,) position of the anchor in the map's world, metres.
        place: its latitude and longitude in degrees, and ellipsoidal height in metres (WGS 84); origin of the frame.
        up_in_world: (3,) direction opposite to gravity.
        forward_in_world: (3,) direction whose heading is known.
        heading_deg: azimuth of that direction, from north through east.

    Raises:
        InputError: the direction is vertical.
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
    return Georeference(lat_deg, lon_deg, height_m, GEOGRAPHIC, enu_from_world)


def check_crs(crs: str) -> None:
    """Check that PROJ knows this coordinate system, and raise InputError if not."""
    _geographic_from(crs)


def is_geographic(crs: str) -> bool:
    """Return whether the coordinates of this system are longitude and latitude in degrees."""
    return bool(_pyproj().CRS.from_user_input(crs).is_geographic)


def _holds_at(crs: str, geographic: Array) -> bool:
    """Return whether points (n, 3) lie in the system's area of use; the formulas give some result for wrong input, too.

    Args:
        geographic: longitude and latitude in degrees, and height.
    """
    if not np.isfinite(geographic).all():
        return False
    area = _pyproj().CRS.from_user_input(crs).area_of_use
    if area is None:
        return True
    lon, lat = geographic[:, 0], geographic[:, 1]
    west, east = lon >= area.west - _MARGIN_DEG, lon <= area.east + _MARGIN_DEG
    within_lon = west | east if area.west > area.east else west & east  # an area may cross the date line
    return bool(np.all(within_lon & (lat >= area.south - _MARGIN_DEG) & (lat <= area.north + _MARGIN_DEG)))


def _geographic_from(crs: str) -> Transformer:
    pyproj = _pyproj()
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise InputError(
            f"unknown coordinate system {crs!r}, expected one that PROJ knows, such as EPSG:2056"
        ) from None
    if len(system.axis_info) < 3 and not system.is_compound:
        system = system.to_3d()
    transformer: Transformer = pyproj.Transformer.from_crs(system, GEOGRAPHIC, always_xy=True)
    return transformer


def _apply(transformer: Any, points: Array, *, inverse: bool = False) -> Array:
    direction = "INVERSE" if inverse else "FORWARD"
    # Lists are passed, because some versions of pyproj take an array of one number for a number, and numpy warns.
    columns = np.asarray(points, dtype=np.float64).T.tolist()
    return np.column_stack(transformer.transform(*columns, direction=direction))


def _pyproj() -> Any:
    try:
        import pyproj
    except ImportError:
        raise missing_extra("coordinate systems need pyproj", "geo") from None
    return pyproj
