"""Reference: known camera poses for comparison."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import InputError, printable
from rangesfm.options import COORDINATE_M, TIME_S
from rangesfm.util.files.clock_times import span_text
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.photo_names import rows_of_photos
from rangesfm.util.files.text_tables import (
    FOUND,
    TextTable,
    has_columns,
    header_names,
    read_head,
    read_table,
    read_without_header,
    repeated,
    write_table,
)
from rangesfm.util.geometry.moments import ByPhoto, ByTime, Moments
from rangesfm.util.geometry.trajectory import OnPath, Trajectory, places_in_time

POSITION_COLUMNS = ("x_m", "y_m", "z_m")
QUATERNION_COLUMNS = ("qx", "qy", "qz", "qw")
QUATERNION_TOLERANCE = 1e-2
"""Largest difference of the length of a quaternion in a file from 1; some programs write only a few digits."""
_NANOSECONDS = re.compile(r"\d{19}(?:\.0*)?", re.ASCII)
MAX_TIME_DIFFERENCE_S = 0.01
"""A sample this close in time is used without interpolation; at 1 m/s it is off by a centimetre at most."""


@dataclass(frozen=True)
class Reference:
    """n known camera poses.

    Attributes:
        positions_m: (n, 3) projection centres in the reference's frame, metres.
        moments: when the poses are known: by photo, or by time on the camera's clock, strictly increasing.
        world_from_cam: (n, 3, 3) rotations of COLMAP's camera frame (x right, y down, z forward), or None.
        notes: lines for the user about how the file was read.
    """

    positions_m: Array
    moments: Moments
    world_from_cam: Array | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.moments) != len(self):
            raise ValueError(f"a reference of {len(self)} poses at {len(self.moments)} moments")
        if isinstance(self.moments, ByTime) and not np.all(np.diff(self.moments.timestamp_s) > 0):
            raise ValueError("timestamps increase strictly")

    def __len__(self) -> int:
        return len(self.positions_m)

    def positions_at(self, trajectory: Trajectory, max_gap_s: float = 0.05) -> tuple[Array, Array | None]:
        """Return the reference poses of a trajectory's keyframes; see ``poses``.

        Raises:
            InputError: the reference is by time and the trajectory has no times.
        """
        return self.poses(self.moments_of(trajectory), max_gap_s)

    def moments_of(self, trajectory: Trajectory) -> Moments:
        """Return the photos or times of a trajectory's keyframes, whichever the reference is by; errors as above."""
        if isinstance(self.moments, ByPhoto):
            return ByPhoto(trajectory.image_names)
        if trajectory.timestamps_s is None:
            raise InputError("the reference is by time, but the photos have no times (images.csv)")
        return ByTime(trajectory.timestamps_s)

    def poses(self, moments: Moments, max_gap_s: float) -> tuple[Array, Array | None]:
        """Return the reference poses at n moments.

        Poses by photo are found by name. Poses by time are interpolated linearly (rotations on the shortest arc)
        between two samples at most ``max_gap_s`` apart. In longer gaps and at the ends, the nearest sample is taken if
        it is within MAX_TIME_DIFFERENCE_S.

        Args:
            moments: by photo or by time on the camera's clock, as those of the reference.

        Returns:
            (n, 3) positions in metres and (n, 3, 3) rotations, NaN where unknown; rotations are None if the reference
            has none.
        """
        if isinstance(moments, ByPhoto):
            at = OnPath.at_keyframes(rows_of_photos(moments.image_name, self.moments.image_name))
        else:
            times_s, known_s = moments.timestamp_s, self.moments.timestamp_s
            at = places_in_time(times_s, known_s, max_gap_s=max_gap_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
        is_known, positions = at.before >= 0, np.full((len(moments), 3), np.nan)
        at = at.subset(is_known)
        positions[is_known] = at.between(self.positions_m)
        if self.world_from_cam is None:
            return positions, None
        rotations = np.full((len(moments), 3, 3), np.nan)
        if len(at.before):  # SciPy before 1.16 cannot make an empty set of rotations
            start, end = (Rotation.from_matrix(self.world_from_cam[index]) for index in (at.before, at.after))
            turned = start * Rotation.from_rotvec(at.fraction[:, None] * (start.inv() * end).as_rotvec())
            rotations[is_known] = turned.as_matrix()
        return positions, rotations

    def why_nothing_is_known(self, of: str, moments: Moments, max_gap_s: float = 0.05) -> str:
        """Return a one-line message that explains why no keyframe or range is at a known position.

        Args:
            of: "keyframes" or "ranges", with their ``moments`` as for ``poses``.
        """
        why = f"none of the {of} is at a known position: "
        if len(self) == 0 or len(moments) == 0:
            return f"{why}there are {len(self)} known positions, or no {of}"
        if isinstance(moments, ByPhoto):
            known, first = printable(self.moments.image_name[0]), printable(moments.image_name[0])
            return f"{why}the first known position is of photo '{known}', the first of the {of} of photo '{first}'"
        known_s, times_s = self.moments.timestamp_s, moments.timestamp_s
        spacing = np.diff(known_s)
        return (
            f"{why}positions are known from {span_text(known_s[0], known_s[-1])}"
            + (f", {np.median(spacing):.3f} s apart" if len(spacing) else "")
            + f", the {of} are from {span_text(times_s.min(), times_s.max())}; positions are interpolated between "
            f"known times at most {max_gap_s:g} s apart"
        )


NO_REFERENCE = Reference(np.zeros((0, 3)), ByPhoto(()))


def is_reference_file(head: str) -> bool:
    """Return whether a file with this beginning is a reference: positions by photo or time, or a TUM trajectory."""
    names = header_names(head)
    if is_tum_row(names):
        return abs(float(np.linalg.norm([float(name) for name in names[-4:]])) - 1.0) <= QUATERNION_TOLERANCE
    return any(has_columns(head, [key, *POSITION_COLUMNS]) for key in ("image_name", "timestamp_s"))


def read_reference(path: AnyPath) -> Reference:
    """Read ``reference.csv`` or a TUM trajectory.

    The CSV file has a header row: ``image_name`` or ``timestamp_s``, then ``x_m,y_m,z_m`` and optionally
    ``qx,qy,qz,qw`` (world from camera). A TUM file has no header row, and lines of ``timestamp tx ty tz qx qy qz qw``,
    separated by blanks.

    Raises:
        InputError: the file is not valid; the error gives the line if it is known.
    """
    path = Path(path)
    names = header_names(read_head(path))
    if path.suffix == ".tum" or is_tum_row(names):
        return _from_table(tum_table(path), "timestamp_s")
    if names and not {"image_name", "timestamp_s"} & set(names):
        found = printable(", ".join(names))
        raise InputError(f"no column image_name or timestamp_s; found {found}; expected one of them", path)
    key = "image_name" if "image_name" in names else "timestamp_s"
    return _from_table(read_table(path, [key, *POSITION_COLUMNS], QUATERNION_COLUMNS, separator=FOUND), key)


def write_reference(reference: Reference, path: Path) -> Path:
    """Write a ``reference.csv`` that ``read_reference`` reads, and return its path."""
    columns = [np.asarray(reference.positions_m)]
    names: tuple[str, ...] = POSITION_COLUMNS
    if reference.world_from_cam is not None:
        columns.append(Rotation.from_matrix(reference.world_from_cam).as_quat())
        names += QUATERNION_COLUMNS
    moments, is_by_image = reference.moments, isinstance(reference.moments, ByPhoto)
    keys = moments.image_name if is_by_image else [f"{time:.9f}" for time in moments.timestamp_s]
    rows = ([key, *(f"{value:.9f}" for value in row)] for key, row in zip(keys, np.hstack(columns)))
    write_table(path, ["image_name" if is_by_image else "timestamp_s", *names], rows)
    return path


def is_tum_row(cells: Sequence[str]) -> bool:
    """Return whether a row holds a TUM pose rather than names."""
    try:
        return len([float(cell) for cell in cells]) == 1 + len(POSITION_COLUMNS) + len(QUATERNION_COLUMNS)
    except ValueError:
        return False


def tum_table(path: Path) -> TextTable:
    """Read the lines of a TUM trajectory as a table.

    Raises:
        InputError: a line does not have eight cells, or there is none.
    """
    table = read_without_header(path, ("timestamp_s", *POSITION_COLUMNS, *QUATERNION_COLUMNS))
    return replace(table, cells={**table.cells, "timestamp_s": _in_seconds(table.cells["timestamp_s"])})


def _in_seconds(cells: list[str]) -> list[str]:
    """Return times in seconds, where all of them are nanoseconds since 1970, as ORB-SLAM3 writes them."""
    if not all(re.fullmatch(_NANOSECONDS, cell) for cell in cells):
        return cells
    return [f"{cell[:-9]}.{cell[-9:]}" for cell in (cell.partition(".")[0] for cell in cells)]


def _from_table(table: TextTable, key: str) -> Reference:
    if len(table) == 0:
        raise InputError("no pose in the file, only its header row", table.path)
    table, notes = _with_positions(table)
    positions = np.column_stack([table.numbers(column, bounds=COORDINATE_M) for column in POSITION_COLUMNS])
    rotations = _rotations(table)
    if key == "image_name":
        if again := repeated(table.text(key)):
            raise table.error(again[0], key, "each one once")
        return Reference(positions, ByPhoto(tuple(table.text(key))), rotations, notes)
    times = table.numbers(key, bounds=TIME_S)
    _, order = np.unique(times, return_index=True)  # motion capture may write two poses with one rounded time
    if num_again := len(times) - len(order):
        told = f"{num_again} of {len(times)} poses have the time of an earlier one and are left out"
        notes = (*notes, f"{table.path.name}: {told}")
    turns = None if rotations is None else rotations[order]
    return Reference(positions[order], ByTime(times[order]), turns, notes)


def _with_positions(table: TextTable) -> tuple[TextTable, tuple[str, ...]]:
    """Return the rows that have a position, with a note if others are left out."""
    places = [table.numbers(column, empty=np.nan, missing=("", "nan", "null")) for column in POSITION_COLUMNS]
    has_place = [not all(map(math.isnan, place)) for place in zip(*places, strict=True)]
    if all(has_place):
        return table, ()
    if not any(has_place):
        raise InputError(f"holds no position in any of {len(table)} rows", table.path)
    note = f"{table.path.name}: {has_place.count(False)} of {len(table)} rows have no position and are left out"
    return table.where(has_place), (note,)


def _rotations(table: TextTable) -> Array | None:
    missing = [column for column in QUATERNION_COLUMNS if column not in table]
    if len(missing) == len(QUATERNION_COLUMNS):
        return None
    if missing:
        raise InputError(
            f"no column {missing[0]}; expected all of {', '.join(QUATERNION_COLUMNS)}, or none", table.path
        )
    quaternions = np.column_stack([table.numbers(column) for column in QUATERNION_COLUMNS])
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > QUATERNION_TOLERANCE)
    if len(wrong):
        message = f"the quaternion qx,qy,qz,qw has length {lengths[wrong[0]]:.4g}, expected 1"
        raise InputError(message, table.path, int(table.line[wrong[0]]))
    rotations: Array = Rotation.from_quat(quaternions).as_matrix()
    return rotations
