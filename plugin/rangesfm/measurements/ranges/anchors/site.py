"""Local frame of a site's anchors: metres around them, whatever coordinates they were given in."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, number_text
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.util.geometry.georeference import Georeference, georeference_at, is_geographic

# The fifth decimal of a degree is about a metre.
_DECIMALS_OF_DEGREES = 5
WIDEST_DEG = 0.5
"""Degrees of longitude or latitude that a survey spans at most; one in metres spans more."""
# The size of degrees is at least so many times their spread, and they are written to less than this.
_MIN_SHARE_OF_SIZE, _FINEST_M = 1000.0, 1e-4
_LARGEST_DEG = np.array([180.0, 90.0])


def coordinates_text(coordinates_m: Array) -> str:
    """Return coordinates (k,) in metres for the user: to the centimetre, however far from zero they are."""
    return ", ".join(number_text(round(x, 2), ".15g") for x in coordinates_m.tolist())


@dataclass(frozen=True)
class Site:
    """Local frame of a survey's anchors. No user knows its coordinates: texts have those that were given.

    Attributes:
        offset_m: (3,) given coordinates minus local coordinates.
        georeference: place of the local frame on the Earth; None without a coordinate system.
    """

    offset_m: Array = field(default_factory=lambda: np.zeros(3))
    georeference: Georeference | None = None

    def local(self, coordinates: Array, crs: str, path: Path | None = None) -> Array:
        """Return (n, 3) further coordinates in the local frame.

        Args:
            crs: their coordinate system; empty: the same frame as the anchors'. path: their file, for messages.

        Raises:
            InputError: only one of the site and the coordinates has a coordinate system.
        """
        if bool(crs) != (self.georeference is not None):
            which = ["these coordinates", "those of the anchors or control points"]
            has, lacks = which if crs else reversed(which)
            advice = "give it, such as EPSG:2056, by --anchor_crs, --point_crs or --position_crs"
            raise InputError(f"{has} have a coordinate system and {lacks} have none, expected both: {advice}", path)
        if self.georeference is None:
            return coordinates - self.offset_m
        return self.georeference.local(coordinates, crs)

    def given(self, positions_m: Array) -> Array:
        """Return positions (n, 3) of the local frame in the coordinates in which the site was given."""
        return positions_m + self.offset_m if self.georeference is None else self.georeference.projected(positions_m)

    def coordinate_text(self, position_m: Array, axis: int, decimals: int) -> str:
        """Return one of the coordinates in which a position (3,) of the local frame was given, for the user.

        Args:
            axis: 0 to 2. decimals: of a metre; degrees get as many more as say the same.
        """
        decimals += _DECIMALS_OF_DEGREES if axis < 2 and self._has_degrees else 0
        return number_text(float(self.given(position_m[None])[0, axis]), f".{decimals}f")

    def place_text(self, position_m: Array) -> str:
        """Return the coordinates in which a position (3,) of the local frame is given, to the centimetre or as fine."""
        *plan, height = self.given(position_m[None])[0].tolist()
        decimals = 2 + (_DECIMALS_OF_DEGREES if self._has_degrees else 0)
        return ", ".join(number_text(round(x, k), ".15g") for x, k in zip((*plan, height), (decimals, decimals, 2)))

    @property
    def _has_degrees(self) -> bool:
        return self.georeference is not None and is_geographic(self.georeference.crs)

    def height_text(self, position_m: Array) -> str:
        """Return the height with which a position (3,) of the local frame was given, metres, for the user."""
        return coordinates_text(self.given(position_m[None])[0, 2:])


def local_site(
    anchors: tuple[Anchor, ...], frame: str, crs: str, path: Path | None = None
) -> tuple[Site, tuple[Anchor, ...]]:
    """Return a local frame for anchors, and the anchors in it.

    Args:
        anchors: the anchors as given.
        frame: frame of their positions, one of ANCHOR_FRAMES; only "site" is moved.
        crs: coordinate system of the positions, which gives a local frame east, north, up; empty: metres in any frame.
        path: the anchor file, for messages.

    Raises:
        InputError: there is a coordinate system but no position or another frame than "site", or the coordinate system
            is not valid at the positions.
    """
    given = np.array([np.full(3, np.nan) if a.position_m is None else a.position_m for a in anchors]).reshape(-1, 3)
    known = np.isfinite(given).all(axis=1)
    if frame != "site" or not known.any():
        if crs:
            what = "no anchor has a position" if frame == "site" or not known.any() else f"the frame is {frame!r}"
            raise InputError(f"[anchors] crs is {crs}, which is for anchors surveyed in a site frame, but {what}", path)
        return Site(), anchors
    site, local = site_of(given, crs, path)
    return site, _at(anchors, local)


def site_of(coordinates: Array, crs: str, path: Path | None = None) -> tuple[Site, Array]:
    """Return a local frame for coordinates (n, 3) of a site, and the coordinates in it; NaN rows stay NaN.

    Raises:
        InputError: the coordinate system is not valid at these points, or they are degrees of no known system.
    """
    if crs:
        try:
            georeference, local = georeference_at(coordinates, crs)
        except InputError as error:
            raise InputError(str(error), path) from None
        return Site(georeference=georeference), local
    known = coordinates[np.isfinite(coordinates).all(axis=1)]
    if _are_degrees(known):
        (x, y), (to_x, to_y) = known[:, :2].min(axis=0), known[:, :2].max(axis=0)
        raise InputError(
            f"coordinates look like degrees (x from {x:.7g} to {to_x:.7g}, y from {y:.7g} to {to_y:.7g}), expected "
            "metres, or their system, such as EPSG:4979 for longitude, latitude and height (--anchor_crs, --point_crs, "
            "--position_crs)",
            path,
        )
    middle = np.median(known, axis=0)  # of most of them, even if one lacks its decimal point
    # Far from the origin, measured in the size of the site, least squares lose digits: a turn of the map about the
    # origin is then nearly a shift. The offset is in whole metres, so that adding it again restores every digit.
    is_far = np.linalg.norm(middle) > np.linalg.norm(np.ptp(known, axis=0))
    offset = np.round(middle) if is_far else np.zeros(3)
    return Site(offset), coordinates - offset


def _are_degrees(known: Array) -> bool:
    """Return whether the first two of coordinates (n, 3) are degrees and not metres."""
    places = known[:, :2]
    spread, size = np.ptp(places, axis=0), np.abs(places).max(axis=0)
    tenths_of_mm = places / _FINEST_M
    is_finer = np.abs(tenths_of_mm - np.round(tenths_of_mm)) > 1e-3
    return bool(
        np.all(size <= _LARGEST_DEG)
        and np.all((spread > 0) & (spread < WIDEST_DEG))
        and size.max() > _MIN_SHARE_OF_SIZE * spread.max()
        and is_finer.mean() > 1 / 2
    )


def _at(anchors: tuple[Anchor, ...], positions: Array) -> tuple[Anchor, ...]:
    return tuple(
        anchor if anchor.position_m is None else replace(anchor, position_m=position)
        for anchor, position in zip(anchors, positions, strict=True)
    )
