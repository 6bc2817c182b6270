"""Positions of an antenna over time or by photo, as a system wrote them, from files of any of its formats."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.errors import InputError
from rangesfm.util.files.text_tables import repeated
from rangesfm.util.geometry.moments import ByTime, Moments

# The coordinate system in a file's first line, as in ODM's files: by number, by PROJ's parameters, or as a zone of UTM.
_CRS = re.compile(r"\s*(?:(EPSG:\d+)|(\+(?:proj|init)=.+)|WGS ?84\s+UTM\s+(\d{1,2})\s*([NS])\w*)\s*", re.IGNORECASE)
_EPSG = re.compile(r"EPSG\W{1,5}(\d{4,5})\b", re.IGNORECASE)


def crs_of_line(text: str) -> str:
    """Return the coordinate system that a line consists of; empty if it is none."""
    found = _CRS.fullmatch(text)
    if found is None:
        return ""
    number, parameters, zone, half = found.groups()
    return number or parameters or f"EPSG:{(326 if half.upper() == 'N' else 327) * 100 + int(zone)}"


def is_no_row(line: str) -> bool:
    """Return whether a line without blanks in front of it is a comment or a coordinate system."""
    return line.startswith("#") or bool(crs_of_line(line))


def crs_in_head(head: str) -> str:
    """Return the coordinate system that a file names before its rows: a line of its own, or a number in a comment."""
    for line in head.split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            return crs_of_line(line)
        if crs := crs_in_text(line):
            return crs
    return ""


def crs_in_text(text: str) -> str:
    """Return the coordinate system of a text by its number; that at the end of WKT is that of the whole system."""
    numbers = _EPSG.findall(text)
    return f"EPSG:{numbers[-1]}" if numbers else ""


@dataclass(frozen=True)
class PositionLog:
    """n positions of an antenna.

    Attributes:
        position_m: (n, 3) in the site's frame, or in ``crs`` as they were read.
        covariance_m2: (n, 3, 3) in the axes east, north, up or x, y, z; NaN where the file does not give it.
        moments: when the positions were taken: by time on the system's clock, rising, or by photo.
        line: (n,) lines in the file.
        path: the file, for messages. format: name of its format.
        crs: coordinate system of the positions as they were read; empty if neither their format nor the user says it.
        notes: lines for the user about how the file was read.
    """

    position_m: Array
    covariance_m2: Array
    moments: Moments
    line: Indices
    path: Path | None = None
    format: str = "table"
    crs: str = ""
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position_m)

    def moved_to(self, position_m: Array) -> PositionLog:
        """Return the log with other positions (n, 3)."""
        return replace(self, position_m=position_m)

    @staticmethod
    def in_time_order(
        path: Path,
        format: str,
        position_m: Array,
        moments: Moments,
        line: Sequence[int] | Indices,
        *,
        covariance_m2: Array,
        notes: Sequence[str] = (),
    ) -> PositionLog:
        """Make a log in the order of time, without rows that have no position or the time of an earlier one.

        It has no coordinate system.

        Raises:
            InputError: there is no position, or a photo has two.
        """
        total, told = len(position_m), list(notes)
        rows = np.flatnonzero(np.isfinite(position_m).all(axis=1))
        num = len(rows)
        if not num:
            lost = f"holds no position in any of {total} rows" if total else "holds no position"
            raise InputError(f"{lost} (read as {format})", path)
        if num < total:
            told.append(f"{total - num} of {total} rows have no position (no fix) and are left out")
        if isinstance(moments, ByTime):
            order = rows[np.argsort(moments.timestamp_s[rows], kind="stable")]
            rows = order[np.append(True, np.diff(moments.timestamp_s[order]) > 0)]
            if len(rows) < num:
                told.append(f"{num - len(rows)} of {num} positions have the time of an earlier one and are left out")
        elif again := repeated(moments.subset(rows).image_name):
            row, first = rows[list(again)]
            message = f"photo {moments.image_name[row]} is in line {line[first]} already, expected each once"
            raise InputError(message, path, int(line[row]))
        return PositionLog(
            position_m[rows],
            covariance_m2[rows],
            moments.subset(rows),
            np.asarray(line, dtype=np.int64)[rows],
            path,
            format,
            notes=tuple(f"{path.name}: {note}" for note in told),
        )
