"""Local frame of a site's anchors: metres around them, whatever coordinates they were given in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.geometry.georeference import Georeference, georeference_at
from rangesfm.ranging.anchors.anchor import Anchor


@dataclass(frozen=True)
class Site:
    """Local frame of a survey's anchors.

    Attributes:
        offset_m: (3,) given coordinates minus local coordinates.
        georeference: place of the local frame on the Earth; None without a coordinate system.
    """

    offset_m: Array
    georeference: Georeference | None = None

    def local(self, coordinates: Array, crs: str | None, path: Path | None = None) -> Array:
        """Return (n, 3) further coordinates in the local frame.

        Args:
            crs: their coordinate system; None: the same frame as the anchors'. path: their file, for messages.

        Raises:
            InputError: only one of the site and the coordinates has a coordinate system.
        """
        if (crs is None) != (self.georeference is None):
            which = ("these coordinates", "the anchors") if crs else ("the anchors", "these coordinates")
            raise InputError(
                f"{which[0]} have a coordinate system and {which[1]} have none, expected both or none", path
            )
        if crs is None or self.georeference is None:
            return coordinates - self.offset_m
        return self.georeference.local(coordinates, crs)


def local_site(
    anchors: tuple[Anchor, ...], frame: str, crs: str | None, path: Path | None = None
) -> tuple[Site, tuple[Anchor, ...]]:
    """Return a local frame for anchors, and the anchors in it.

    Args:
        anchors: the anchors as given.
        frame: frame of their positions, one of ANCHOR_FRAMES; only "site" is moved.
        crs: coordinate system of the positions, which gives a local frame east, north, up; None: metres in any frame.
        path: the anchor file, for messages.

    Raises:
        InputError: there is a coordinate system but no position or another frame than "site", or the coordinate system
            is not valid at the positions.
    """
    given = np.array([np.full(3, np.nan) if a.position_m is None else a.position_m for a in anchors]).reshape(-1, 3)
    known = np.isfinite(given).all(axis=1)
    if frame != "site" or not known.any():
        if crs is not None:
            what = "no anchor has a position" if frame == "site" or not known.any() else f"the frame is {frame!r}"
            raise InputError(f"[anchors] crs is {crs}, which is for anchors surveyed in a site frame, but {what}", path)
        return Site(np.zeros(3)), anchors
    site, local = site_of(given, crs, path)
    return site, _at(anchors, local)


def site_of(coordinates: Array, crs: str | None, path: Path | None = None) -> tuple[Site, Array]:
    """Return a local frame for coordinates (n, 3) of a site, and the coordinates in it; NaN rows stay NaN.

    Raises:
        InputError: the coordinate system is not valid at these points.
    """
    if crs is not None:
        try:
            georeference, local = georeference_at(coordinates, crs)
        except InputError as error:
            raise InputError(str(error), path) from None
        return Site(np.zeros(3), georeference), local
    known = coordinates[np.isfinite(coordinates).all(axis=1)]
    middle = known.mean(axis=0)
    # Far from the origin, measured in the size of the site, least squares lose digits: a turn of the map about the
    # origin is then nearly a shift. The offset is in whole metres, so that adding it again restores every digit.
    is_far = np.linalg.norm(middle) > np.linalg.norm(np.ptp(known, axis=0))
    offset = np.round(middle) if is_far else np.zeros(3)
    return Site(offset), coordinates - offset


def _at(anchors: tuple[Anchor, ...], positions: Array) -> tuple[Anchor, ...]:
    return tuple(
        anchor if anchor.position_m is None else replace(anchor, position_m=position)
        for anchor, position in zip(anchors, positions, strict=True)
    )
