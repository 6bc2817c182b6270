"""Which columns of a table of positions hold the time or the photo, the coordinates and their errors.

What names and values leave open is asked, with a command for each meaning.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, product
from pathlib import Path

import numpy as np

from rangesfm.measurements.ranges.anchors.anchor_file import LOCAL_M
from rangesfm.measurements.ranges.anchors.site import WIDEST_DEG
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.guess import Guess, columns_by_name, find_time, is_rising, named_photos
from rangesfm.measurements.ranges.readers.layout import ColumnSample, Layout, are_quaternions
from rangesfm.measurements.ranges.readers.lists import (
    AXES,
    TableForm,
    coordinates_of_point,
    unclear_table,
)
from rangesfm.measurements.ranges.readers.unclear import Choice

STDDEVS = tuple(f"stddev_{axis}" for axis in AXES)
COVARIANCES = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_KEYS = {"timestamp", "image_name"}
_MAX_NUM_WAYS = 4
_AXES_BY_NAME = {
    axis: (terms.COORDINATES[axis] | terms.DEGREES.get(axis, frozenset()), terms.BESIDE_COORDINATE | terms.TAG)
    for axis in AXES
}


def find_position_columns(form: TableForm, path: Path, layout: Layout) -> dict[str, str]:
    """Return the name of the column of each quantity.

    Raises:
        UnclearFileError: it may be several; the advice has a command for each.
    """
    guess = Guess()
    photos = [column for column in layout.columns if column.names_photos][:1] or named_photos(layout)[:1]
    free = [column for column in layout.columns if column not in photos]
    if layout.has_names:
        free = find_time(free, guess)
        photos = photos or ([] if guess.columns else _labels(free))
    elif not photos and (rising := [column for column in free if column.kind == "times" or is_rising(column)]):
        guess.columns["timestamp"] = rising[0].name
    if photos:
        guess.columns = {"image_name": photos[0].name}
    free = [column for column in free if column.name not in guess.columns.values()]
    axes = (_axes_by_name if layout.has_names else _axes_by_values)(free, guess)
    if not _KEYS & guess.columns.keys():
        guess.doubts.insert(0, "no column seems to be the time or the photo")
    _add_errors(free, guess.columns)
    if guess.doubts:
        raise unclear_table(form.what, path, layout, guess.doubts, [*_choices(form, free, guess.columns, axes)])
    return guess.columns


POSITIONS = TableForm(
    "positions",
    {
        "timestamp": "timestamp_s",
        "image_name": "image_name",
        **{name: f"{name}_m" for name in (*AXES, "stddev", *STDDEVS)},
        **{name: f"{name}_m2" for name in COVARIANCES},
        "quality": "quality",
    },
    ("timestamp or image_name", *AXES),
    find_position_columns,
    "position_columns",
    also=("date", "nanoseconds", "tag_id"),
)


def is_degrees(name: str, axis: str) -> bool:
    """Return whether the name of a column says that it holds longitudes (x) or latitudes (y)."""
    return axis in terms.DEGREES and not terms.DEGREES[axis].isdisjoint(terms.words_of(name))


def _labels(columns: Sequence[ColumnSample]) -> list[ColumnSample]:
    """Return the column that names the photos as photogrammetric programs label cameras."""
    wanted = terms.POINT | terms.ID | terms.FILE | {"camera", "cam"}
    return [
        column
        for column in columns
        if column.kind == "text" and column.num_distinct == len(column.cells) and {*column.words} <= wanted
    ][:1]


def _axes_by_name(free: Sequence[ColumnSample], found: Guess) -> dict[str, dict[str, str]]:
    """Find x, y, z by their names; else return the columns that they may be, by the case in which they are."""
    numbers = [column for column in free if column.kind == "numbers"]
    if not any("pz" in column.words for column in numbers):  # the other two are a camera's principal point
        numbers = [column for column in numbers if {"px", "py"}.isdisjoint(column.words)]
    may_be = columns_by_name(numbers, _AXES_BY_NAME)
    of_axis = {axis: [column.name for column in coordinates_of_point(may_be[axis])] for axis in AXES}
    groups = [*_triples(numbers)]
    if all(len(those) == 1 for those in of_axis.values()):
        found.columns |= {axis: those[0] for axis, those in of_axis.items()}
    elif len(groups) == 1:
        found.columns |= groups[0]
    else:
        for axis, those in of_axis.items():
            if len(those) == 1 and not groups:
                found.columns[axis] = those[0]
            else:
                found.doubts.append(f"{'no column seems' if not those else 'several columns seem'} to be {axis}")
        return {f"{', '.join(group.values())} are x, y, z": group for group in groups}
    return {}


def _triples(columns: Sequence[ColumnSample]) -> Iterator[dict[str, str]]:
    """Yield the columns whose names differ in x, y and z only, such as p_RS_R_x, without those of turns and motion."""
    groups: dict[tuple[str, ...], dict[str, str]] = defaultdict(dict)
    for column in columns:
        axes = [word for word in column.words if word in AXES]
        others = tuple(word for word in column.words if word not in AXES)
        if len(axes) == 1 and terms.NO_POSITION.isdisjoint(others) and terms.STDDEV.isdisjoint(others):
            groups[others].setdefault(axes[0], column.name)
    yield from (group for group in groups.values() if len(group) == len(AXES))


def _axes_by_values(free: Sequence[ColumnSample], found: Guess) -> dict[str, dict[str, str]]:
    """Do the same in a table without names: they are three numbers before a quaternion, or the only three."""
    numbers = [column for column in free if column.kind == "numbers"]
    before = [k for k in range(3, len(numbers) - 3) if are_quaternions(numbers[k : k + 4])]
    places = numbers[before[0] - 3 : before[0]] if before else numbers
    may_be_ids = not before and any(all(map(str.isdigit, column.cells)) for column in places[:2])
    if len(places) != len(AXES) or may_be_ids:
        found.doubts.append("a table without names, of which any three numbers may be x, y, z")
        return {}
    names = [column.name for column in places]
    east_first, north_first = (dict(zip(order, names)) for order in (AXES, ("y", "x", "z")))
    largest = max(float(np.abs(column.numbers).max(initial=0.0)) for column in places)
    if before or not (largest > LOCAL_M or _may_be_degrees(places)):
        found.columns |= east_first
        return {}
    found.doubts.append("a table without names, in which either x (east, longitude) or y may come first")
    return {
        "the numbers are x, y, z or east, north, height or longitude, latitude, height": east_first,
        "they are north, east, height or latitude, longitude, height": north_first,
    }


def _may_be_degrees(places: Sequence[ColumnSample]) -> bool:
    """Return whether the first two of three numbers may be degrees: nobody walks less than half a metre."""
    spread = [float(np.ptp(column.numbers)) if len(column.numbers) else 0.0 for column in places[:2]]
    return max(spread) < WIDEST_DEG and all(column.num_distinct > 1 for column in places[:2])


def _add_errors(free: Sequence[ColumnSample], columns: dict[str, str]) -> None:
    for column in free:
        words = {*column.words} - terms.LENGTH_UNIT
        if column.name in columns.values():
            continue
        if words & terms.STDDEV:
            of_axes = [f"stddev_{axis}" for axis in AXES if words & (terms.COORDINATES[axis] | terms.IN_PLANE[axis])]
            for quantity in of_axes or ["stddev"]:
                columns.setdefault(quantity, column.name)
        elif words & terms.TAG and words <= terms.TAG | terms.ID:
            columns.setdefault("tag_id", column.name)
        elif words & terms.QUALITY and words <= terms.QUALITY | terms.BESIDE_QUALITY and column.is_whole:
            columns.setdefault("quality", column.name)


def _choices(
    form: TableForm, free: Sequence[ColumnSample], columns: Mapping[str, str], axes: Mapping[str, dict[str, str]]
) -> Iterator[Choice]:
    """Yield the ways to read the table, each with a whole command; one with NAME where values tell nothing."""
    has_key, has_axes = bool(_KEYS & columns.keys()), columns.keys() >= {*AXES}
    keys = {"": dict[str, str]()} if has_key else dict(_possible_keys(free))
    places = axes or ({"": {}} if has_axes else dict(_possible_places(free)))
    ways = [*product(keys.items(), places.items())]
    for (is_key, key), (are_axes, place) in islice(ways, _MAX_NUM_WAYS):
        taken = {**columns, **key, **place}
        if len({*taken.values()}) == len(taken):
            yield form.choice(f"if {' and '.join(filter(None, (is_key, are_axes)))}", taken)
    if not ways:
        unknown = {key: "NAME" for key in (*(() if has_key else ("timestamp",)), *AXES) if key not in columns}
        yield form.choice("with the names of the columns", {**columns, **unknown})


def _possible_keys(free: Sequence[ColumnSample]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the columns that may be the time or the photo, after what they would be."""
    for column in free:
        if column.kind == "text" and column.num_distinct == len(column.cells):
            yield f"{column.name} is the photo", {"image_name": column.name}
        elif column.kind == "times" or is_rising(column):
            yield f"{column.name} is the time", {"timestamp": column.name}


def _possible_places(free: Sequence[ColumnSample]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the columns that may be x, y and z, after what they would be."""
    numbers = [column for column in free if column.kind == "numbers"]
    for places in zip(*(numbers[k:] for k in range(len(AXES)))):
        names = [column.name for column in places]
        those = f"{', '.join(names)} are"
        yield f"{those} x, y, z", dict(zip(AXES, names))
        if _may_be_degrees(places):
            order = ("y", "x", "z")
            yield f"{those} latitude, longitude, height (--position_crs EPSG:4326)", dict(zip(order, names))
