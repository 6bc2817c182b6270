"""Positions of an antenna over time or by photo, as a system wrote them, from files of any of its formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.errors import InputError

GEOGRAPHIC = "EPSG:4979"
"""WGS 84: longitude and latitude in degrees, ellipsoidal height in metres."""


@dataclass(frozen=True)
class PositionLog:
    """n positions of an antenna; exactly one of times and names of photos is given.

    Attributes:
        position_m: (n, 3) in the site's frame, or in ``crs`` as they were read.
        covariance_m2: (n, 3, 3) in the axes east, north, up or x, y, z; NaN where the file does not give it.
        timestamp_s: (n,) on the system's clock, rising; or None.
        image_name: names of the n photos; or None.
        line: (n,) lines in the file.
        path: the file, for messages. format: name of its format.
        crs: coordinate system of the positions by the format; None if it does not say.
        notes: lines for the user about how the file was read.
    """

    position_m: Array
    covariance_m2: Array
    timestamp_s: Array | None
    image_name: tuple[str, ...] | None
    line: Indices
    path: Path | None = None
    format: str = "table"
    crs: str | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position_m)

    def moved_to(self, position_m: Array) -> PositionLog:
        """Return the log with other positions (n, 3)."""
        return replace(self, position_m=position_m)

    @classmethod
    def of(
        cls,
        path: Path,
        format: str,
        position_m: Array,
        line: Sequence[int] | Indices,
        *,
        times_s: Array | None = None,
        image_name: Sequence[str] | None = None,
        covariance_m2: Array | None = None,
        crs: str | None = None,
        notes: Sequence[str] = (),
    ) -> PositionLog:
        """Make a log in the order of time, without positions of a time that an earlier one has.

        Raises:
            InputError: there is no position.
        """
        num = len(position_m)
        if not num:
            raise InputError(f"holds no position (read as {format})", path)
        covariance_m2 = np.full((num, 3, 3), np.nan) if covariance_m2 is None else covariance_m2
        rows, told = np.arange(num), list(notes)
        if times_s is not None:
            order = np.argsort(times_s, kind="stable")
            rows = order[np.append(True, np.diff(times_s[order]) > 0)]
            if len(rows) < num:
                told.append(f"{num - len(rows)} of {num} positions have the time of an earlier one and are left out")
        return cls(
            position_m[rows],
            covariance_m2[rows],
            None if times_s is None else times_s[rows],
            None if image_name is None else tuple(image_name),
            np.asarray(line, dtype=np.int64)[rows],
            path,
            format,
            crs,
            tuple(f"{path.name}: {note}" for note in told),
        )
