"""The anchor file: the canonical CSV, or any table of points whose columns are recognized by their names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from types import MappingProxyType

import numpy as np

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.guess import (
    MAX_NUM_IDS,
    by_id_rather_than_index,
    columns_by_name,
    is_named_time,
    is_range,
    names_of,
)
from rangesfm.measurements.ranges.readers.layout import ColumnSample, Layout, find_layout
from rangesfm.measurements.ranges.readers.lists import (
    AXES,
    TableForm,
    coordinates_of_point,
    metres,
    unclear_table,
)
from rangesfm.measurements.ranges.readers.unclear import Choice, UnclearFileError
from rangesfm.options import BIAS_M, COORDINATE_M, STDDEV_OR_EXACT_M
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import NO_NAMES, TextTable, repeated, write_user_table
from rangesfm.util.geometry.georeference import GEOGRAPHIC

_MAX_NUM_WAYS = 6  # ways to read a list that are offered
_BESIDE = terms.LINKING | terms.BESIDE_COORDINATE | terms.RANGE
# Words in the names of columns by quantity, and those beside them.
_IN_POINTS = {
    "anchor_id": (terms.ANCHOR | terms.ID | terms.POINT, terms.LINKING),
    **{axis: (terms.COORDINATES[axis], _BESIDE | terms.ANCHOR | terms.POINT) for axis in AXES},
    "position_stddev": (terms.STDDEV, _BESIDE),
    "range_bias": (terms.BIAS, _BESIDE),
    "range_bias_stddev": (terms.STDDEV | terms.BIAS, _BESIDE),
}
QUANTITIES = tuple(_IN_POINTS)
# Coordinates beyond this, metres, are not local but those of a surveyed grid.
LOCAL_M = 500.0


def read_anchors(
    path: AnyPath, *, columns: Mapping[str, str] = MappingProxyType({}), unit: str | None = None
) -> tuple[Anchor, ...]:
    """Read the anchors in a file; see ``read_anchor_list``."""
    return read_anchor_list(path, columns=columns, unit=unit)[0]


def read_anchor_list(
    path: AnyPath, *, columns: Mapping[str, str] = MappingProxyType({}), unit: str | None = None
) -> tuple[tuple[Anchor, ...], tuple[str, ...]]:
    """Read ``anchor_id,x_m,y_m,z_m[,position_stddev_m,range_bias_m,range_bias_stddev_m]``, or another table of points.

    Coordinates are empty for an anchor of unknown position. The optional cells may be empty as well. In other tables,
    columns are recognized by their names, such as ``Point;East [m];North [m];Height [m]``; an instrument's GSI file
    is such a table, too.

    Args:
        path: the file.
        columns: name of the column of each quantity (QUANTITIES), or its number in a table without names;
            without any they are recognized.
        unit: unit of the coordinates, one of UNITS_PER_METRE; None: that in the names of the columns, else metres.

    Returns:
        The anchors in the order of the file, and lines for the user about how the file was read.

    Raises:
        UnclearFileError: the columns are not known for sure; the advice says what to type.
        InputError: an anchor appears twice, a position is incomplete, or a cell is not a number. The error gives the
            line.
    """
    table = ANCHORS.read(Path(path), columns or NO_NAMES, unit)
    return _anchors(table), table.told


def write_anchors(anchors: Sequence[Anchor], path: AnyPath) -> None:
    """Write an anchor file that ``read_anchors`` reads, with empty cells for unknown values.

    Raises:
        InputError: the file cannot be written.
    """
    rows = []
    for anchor in anchors:
        place = 4 * [None] if anchor.position_m is None else [*anchor.position_m, anchor.position_stddev_m]
        bias = 2 * [None] if anchor.range_bias_stddev_m is None else [anchor.range_bias_m, anchor.range_bias_stddev_m]
        rows.append([anchor.anchor_id, *("" if number is None else f"{number:.4f}" for number in (*place, *bias))])
    write_user_table(Path(path), [*ANCHORS.names.values()], rows)


def find_points(form: TableForm, path: Path, layout: Layout) -> dict[str, str] | None:
    """Return the name of the column of each quantity; None if the table is not one of points.

    Args:
        form: the kind of points, such as ANCHORS.

    Raises:
        UnclearFileError: it may be one, but the columns are not known for sure.
    """
    by_quantity = _by_name(layout) if layout.has_names else _by_values(layout)
    found = {form.own.get(quantity, quantity): those for quantity, those in by_quantity.items()}
    ids, axes = found[form.required[0]], {axis: found[axis] for axis in AXES}
    degrees = {} if axes["x"] and axes["y"] else _degrees(layout)
    is_about_anchors = not terms.ABOUT_ANCHORS.isdisjoint(terms.words_of(path.stem))
    is_named = layout.has_names and any((terms.ANCHOR | terms.POINT) & {*column.words} for column in ids)
    num_axes = sum(map(bool, axes.values()))
    may_be = bool(ids) and (
        num_axes == 3 or (is_named and num_axes == 2) or (bool(degrees) and bool(is_named or axes["z"]))
    )
    if _is_of_times(layout, ids) or not (
        may_be or (is_about_anchors and any(column.kind == "numbers" for column in layout.columns))
    ):
        return None
    columns = {quantity: those[0].name for quantity, those in found.items() if those and quantity in form.names}
    doubts, choices = [], list[Choice]()
    for quantity, what in zip(form.required, ("the anchor's id", "x", "y", "z (height)")):
        several = found[quantity]
        if len(several) > 1:
            doubts.append(f"any of {names_of(several)} may be {what}")
            choices += [form.choice(f"if {one.name} is {what}", {**columns, quantity: one.name}) for one in several]
        elif not several and not degrees:
            doubts.append(f"no column seems to be {what}")
    if not doubts and degrees:
        named = columns | degrees
        doubts.append(f"{degrees['y']} and {degrees['x']} are degrees, of no known coordinate system")
        choices = [form.choice("if that is WGS 84", named, crs=GEOGRAPHIC)] if "z" in named else []
    elif not doubts:
        for doubt, those in _doubts_about_axes(form, layout, columns):
            doubts.append(doubt)
            choices += those
    if not doubts:
        return columns
    if not choices and not degrees:
        choices = [*_ways_to_complete(form, layout, columns)]
    unknown = {quantity: "NAME" for quantity in form.required if quantity not in columns | degrees}
    choices = choices or [form.choice("with the names of the columns", columns | degrees | unknown)]
    raise unclear_table(form.what, path, layout, doubts, choices)


def find_or_ask(form: TableForm, path: Path, layout: Layout) -> dict[str, str] | None:
    """Do the same, and ask about a short table that is like a list of points as well."""
    columns = find_points(form, path, layout)
    if columns is None and (unclear := like_points(form, path)) is not None:
        raise unclear
    return columns


ANCHORS = TableForm(
    "anchors",
    {quantity: quantity if quantity == "anchor_id" else f"{quantity}_m" for quantity in QUANTITIES},
    ("anchor_id", *AXES),
    find_or_ask,
    "anchor_columns",
    aliases={"": "anchor_id", "id": "anchor_id", "Anchor_ID": "anchor_id", "x": "x_m", "y": "y_m", "z": "z_m"},
)


def like_points(form: TableForm, path: Path) -> UnclearFileError | None:
    """Return the question for a short table that is like a list of points, but whose names are not known; else None."""
    layout = find_layout(path)
    if layout is None or not layout.has_names or len(layout.columns[0].cells) > MAX_NUM_IDS:
        return None
    first, *others = layout.columns
    numbers = [column.name for column in others if column.kind == "numbers"]
    is_other = any(column.names_photos or is_range(column) or is_named_time(column) for column in layout.columns)
    if is_other or first.num_distinct < len(first.cells) or not _may_be_id(first) or len(numbers) < len(AXES):
        return None
    ways = [dict(zip(AXES, numbers[k : k + 3])) for k in range(len(numbers) - 2)]
    choices = [
        form.choice(f"if {', '.join(way.values())} are x, y, z of {first.name}", {form.required[0]: first.name, **way})
        for way in ways
    ]
    return unclear_table(form.what, path, layout, ["the names of the columns are not known"], choices)


def _ways_to_complete(form: TableForm, layout: Layout, columns: Mapping[str, str]) -> Iterator[Choice]:
    """Yield the ways to give each quantity that has no column yet one that may hold it, by its values."""
    free = [column for column in layout.columns if column.name not in columns.values()]
    may_be = {quantity: [one.name for one in free if one.kind == "numbers"] for quantity in AXES}
    may_be[form.required[0]] = [one.name for one in free if one.num_distinct == len(one.cells) and _may_be_id(one)]
    missing = [quantity for quantity in form.required if quantity not in columns]
    ways = [way for way in product(*(may_be[quantity] for quantity in missing)) if len({*way}) == len(way)]
    for way in ways if missing and len(ways) <= _MAX_NUM_WAYS else ():
        when = " and ".join(f"{name} is {quantity}" for quantity, name in zip(missing, way))
        yield form.choice(f"if {when}", {**columns, **dict(zip(missing, way))})


def _may_be_id(column: ColumnSample) -> bool:
    return column.kind == "text" or column.is_whole


def _by_name(layout: Layout) -> dict[str, list[ColumnSample]]:
    """Return the columns that may hold each quantity by their names; an id also by its place and its cells."""
    photos = [column for column in layout.columns if column.names_photos]
    found = columns_by_name([column for column in layout.columns if column not in photos], _IN_POINTS)
    others = found.pop("")
    found["anchor_id"] = by_id_rather_than_index(found["anchor_id"])
    found |= {axis: coordinates_of_point(found[axis]) for axis in AXES}
    if not found["anchor_id"] and all(found[axis] for axis in AXES):
        texts = [column for column in others if column.kind == "text" and column.num_distinct == len(column.cells)]
        nameless = [column for column in layout.columns[:1] if column.name == "column 1"]
        found["anchor_id"] = nameless or (texts if len(texts) == 1 else [])
    return found


def _by_values(layout: Layout) -> dict[str, list[ColumnSample]]:
    """Return the columns of a table without names: an id with three numbers after it, and perhaps a code."""
    found: dict[str, list[ColumnSample]] = {quantity: [] for quantity in QUANTITIES}
    first, *others = (column for column in layout.columns if column.kind != "nothing")
    numbers = [column for column in others if column.kind == "numbers"]
    if len(numbers) > 3:
        numbers = [column for column in numbers if not _is_code(column)]
    is_id = first.num_distinct == len(first.cells) and _may_be_id(first)
    is_short = len(first.cells) <= MAX_NUM_IDS and len(others) <= 4
    if is_id and is_short and len(numbers) == 3 and numbers == others[:3]:
        found["anchor_id"] = [first]
        found |= {axis: [column] for axis, column in zip(AXES, numbers)}
    return found


def _is_code(column: ColumnSample) -> bool:
    """Return whether all numbers of a column are one whole number, as a total station's code of a kind of point."""
    return column.is_whole and column.num_distinct == 1 and len(column.cells) > 1 and column.cells[0].isdigit()


def _degrees(layout: Layout) -> dict[str, str]:
    """Return the columns of longitude and latitude as x and y; empty unless there are both."""
    named = {
        axis: [column.name for column in layout.columns if words & {*column.words}]
        for axis, words in terms.DEGREES.items()
    }
    return {axis: names[0] for axis, names in named.items()} if all(named.values()) else {}


def _is_of_times(layout: Layout, ids: Sequence[ColumnSample]) -> bool:
    """Return whether a table holds ranges or positions over time; each anchor may have the time of its survey."""
    has_times = layout.has_names and any(map(is_named_time, layout.columns))
    is_of_ranges = any(map(is_range, layout.columns))
    return has_times and (is_of_ranges or not ids or ids[0].num_distinct < len(ids[0].cells))


def _doubts_about_axes(
    form: TableForm, layout: Layout, columns: Mapping[str, str]
) -> Iterator[tuple[str, list[Choice]]]:
    """Yield what is not sure about the axes, with the choices there are: their order, and their units."""
    by_name = {column.name: column for column in layout.columns}
    order = [column.name for column in layout.columns]
    x, y = columns["x"], columns["y"]
    swapped = {**columns, "x": y, "y": x}
    if not layout.has_names:
        largest = max((float(np.abs(by_name[columns[axis]].numbers).max(initial=0.0)) for axis in AXES), default=0.0)
        # In a surveyed grid, north often comes before east.
        if largest > LOCAL_M or len(order) > 4:
            first = form.choice("if the numbers are x, y, z or east, north, height", columns)
            second = form.choice("if they are north, east, height (PNEZD)", swapped)
            yield "a table without names, in which either east or north may come first", [first, second]
    elif order.index(y) < order.index(x) and {"x", "y"} == {*by_name[x].words, *by_name[y].words} - terms.LENGTH_UNIT:
        choices = [
            form.choice(f"if {x} is north", swapped),
            form.choice(f"if {x} is east and {y} is north", columns),
        ]
        yield f"{y} comes before {x}, as where surveyors call north x", choices
    units = {axis: terms.named_length_unit(f"{columns[axis]} {by_name[columns[axis]].unit}") for axis in AXES}
    if None in units.values() and {*units.values()} - {None, "m"}:
        told = sorted({unit for unit in units.values() if unit})
        choices = [form.choice(f"if all are in {unit}", columns, unit=unit) for unit in told]
        yield f"some of the coordinates are in {' and '.join(told)}, others have no unit", choices


def _anchors(table: TextTable) -> tuple[Anchor, ...]:
    if not len(table):
        raise InputError("names no anchor, expected one per line", table.path)
    anchor_ids = table.text("anchor_id")
    if again := repeated(anchor_ids):
        row, first = again
        message = f"anchor {anchor_ids[row]} is in line {table.line[first]} already, expected each once"
        raise InputError(message, table.path, int(table.line[row]))
    positions = np.column_stack([metres(table, axis, COORDINATE_M, np.nan) for axis in AXES])
    unknown = np.isnan(positions)
    incomplete = unknown.any(axis=1) & ~unknown.all(axis=1)
    if np.any(incomplete):
        row = int(np.argmax(incomplete))
        axis = AXES[int(np.argmax(unknown[row]))]
        raise table.error(row, axis, "all three coordinates or none")
    position_stddevs = metres(table, "position_stddev", STDDEV_OR_EXACT_M, 0.0)
    biases = metres(table, "range_bias", BIAS_M, 0.0)
    bias_stddevs = metres(table, "range_bias_stddev", STDDEV_OR_EXACT_M, np.nan)
    return tuple(
        Anchor(
            anchor_id=anchor_id,
            position_m=None if np.isnan(positions[row, 0]) else positions[row],
            position_stddev_m=float(position_stddevs[row]),
            range_bias_m=float(biases[row]),
            range_bias_stddev_m=None if np.isnan(bias_stddevs[row]) else float(bias_stddevs[row]),
        )
        for row, anchor_id in enumerate(anchor_ids)
    )
