"""Files of control and check points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.distances.tape import CHECK, CLICKED_STDDEV_PX, CONTROL, Marker
from rangesfm.distances.tape_file import read_markers
from rangesfm.errors import InputError
from rangesfm.files.text_tables import (
    FOUND,
    TextTable,
    has_columns,
    is_number,
    is_plain_table,
    read_head,
    read_table,
    read_text,
    repeated,
)
from rangesfm.options import COORDINATE_M, PIXEL, STDDEV_M, PointOptions
from rangesfm.positions.control_points import ControlPoint, ControlPoints
from rangesfm.positions.position_log import crs_of_line
from rangesfm.ranging.anchors.anchor_file import find_anchor_columns, like_anchors
from rangesfm.ranging.readers.layout import MISSING, Layout, find_layout
from rangesfm.ranging.readers.lists import UnclearListError, check_columns, read_list
from rangesfm.ranging.readers.units import UNITS_PER_METRE, named_length_unit
from rangesfm.ranging.readers.vocabulary import KIND

POINT_COLUMNS = ("marker", "x_m", "y_m", "z_m")
_CANONICAL = {"marker": "marker", "x": "x_m", "y": "y_m", "z": "z_m", "stddev": "stddev_m", "kind": "kind"}
QUANTITIES = tuple(_CANONICAL)
_AXES = ("x", "y", "z")
_KINDS = (CONTROL, CHECK)
_EXPECTED = f"expected a table with {','.join(POINT_COLUMNS)}"
_NUM_GCP_NUMBERS, _GCP_COLUMNS = 5, "geo_x geo_y geo_z im_x im_y image_name [gcp_name]"


def read_control_points(options: PointOptions, markers_path: Path | None) -> ControlPoints | None:
    """Read ``marker,x_m,y_m,z_m[,stddev_m,kind]`` or another table of points, or ODM's ``gcp_list.txt``.

    A point without a kind is a control point.

    Args:
        options: which name the file.
        markers_path: file of the marks in photos; None: those of ``gcp_list.txt``, or printed tags.

    Raises:
        UnclearListError: the columns are not known for sure; the advice says what to type.
        InputError: a file is not valid; the error gives the line.
    """
    path = options.path
    if path is None:
        return None
    head = read_head(path)
    if not head.strip():
        raise InputError(f"the file is empty, {_EXPECTED}", path)
    markers = {} if markers_path is None else read_markers(markers_path)
    read = _gcp_list if is_gcp_list(head) else _table
    found = replace(read(path, options, head), markers_path=markers_path)
    return found.with_more(markers)


def is_gcp_list(head: str) -> bool:
    """Return whether a file with this beginning is ODM's list of ground control points."""
    first, *rows = [line for line in head.split("\n") if line.strip() and not line.startswith("#")] or [""]
    cells = [row.split() for row in rows]
    are_points = any(len(row) > _NUM_GCP_NUMBERS and all(map(is_number, row[:_NUM_GCP_NUMBERS])) for row in cells)
    return crs_of_line(first) is not None and are_points


def is_point_file(head: str) -> bool:
    """Return whether a file with this beginning holds coordinates of marks."""
    return has_columns(head, POINT_COLUMNS) or is_gcp_list(head)


def _table(path: Path, options: PointOptions, head: str) -> ControlPoints:
    if not options.columns and options.unit is None and is_plain_table(head, POINT_COLUMNS):
        table = read_table(path, POINT_COLUMNS, ["stddev_m", "kind"], separator=FOUND)
        return _points(table, _CANONICAL, dict.fromkeys(QUANTITIES, "m"), ("",), options, [])
    layout = find_layout(path)
    if layout is None:
        raise InputError(f"no table, {_EXPECTED}", path)
    columns = _columns_by_user(options.columns, layout, path) if options.columns else _found_columns(path, layout, head)
    table, notes = read_list(layout, columns)
    by_name = {column.name: column.unit for column in layout.columns}
    own = {quantity: named_length_unit(f"{name} {by_name[name]}") for quantity, name in columns.items()}
    units = {quantity: (options.unit if quantity in _AXES else None) or unit or "m" for quantity, unit in own.items()}
    return _points(table, columns, units, MISSING, options, notes)


def _found_columns(path: Path, layout: Layout, head: str) -> dict[str, str]:
    """Return the name of the column of each quantity: as in the canonical CSV, else recognized as in one of anchors."""
    if has_columns(head, POINT_COLUMNS):
        return {quantity: name for quantity, name in _CANONICAL.items() if name in layout.units}
    try:
        found = find_anchor_columns(path, layout)
        if found is None and (unclear := like_anchors(path)) is not None:
            raise unclear
    except UnclearListError as error:
        raise error.about_other("points", {"anchor_id": "marker"}, {"--anchor_": "--point_"}) from None
    if found is None:
        raise InputError(f"no columns of points; found {', '.join(layout.units)}; {_EXPECTED}", path)
    own = {"anchor_id": "marker", "position_stddev": "stddev"}
    columns = {own.get(quantity, quantity): name for quantity, name in found.items() if "bias" not in quantity}
    kinds = [
        column.name
        for column in layout.columns
        if {*column.words} & KIND and {cell.strip().lower() for cell in column.cells} <= {*_KINDS, ""}
    ]
    return columns | ({"kind": kinds[0]} if len(kinds) == 1 else {})


def _columns_by_user(columns: Mapping[str, str], layout: Layout, path: Path) -> dict[str, str]:
    check_columns(columns, QUANTITIES, layout, path)
    if missing := [quantity for quantity in ("marker", *_AXES) if quantity not in columns]:
        raise InputError(f"columns do not name {', '.join(missing)}, expected marker, x, y and z", path)
    return {quantity: columns[quantity] for quantity in QUANTITIES if quantity in columns}


def _points(
    table: TextTable,
    names: Mapping[str, str],
    units: Mapping[str, str],
    missing: Sequence[str],
    options: PointOptions,
    notes: Sequence[str],
) -> ControlPoints:
    """Return the points of a table, given the column and the unit of each quantity."""
    if not len(table):
        raise InputError("names no point, expected one per line", table.path)
    markers = table.text(names["marker"])
    if again := repeated(markers):
        raise table.error(again[0], names["marker"], "each point once")

    def metres(quantity: str) -> Array:
        per_metre = UNITS_PER_METRE[units[quantity]]
        values = table.numbers(names[quantity], expected=str(COORDINATE_M)) / per_metre
        table.refuse(~COORDINATE_M.hold(values), names[quantity], str(COORDINATE_M))
        return values

    positions = np.column_stack([metres(axis) for axis in _AXES])
    stddevs, is_given = np.full(len(table), options.stddev_m), names.get("stddev", "") in table
    if is_given:
        per_metre = UNITS_PER_METRE[units["stddev"]]
        stddevs = table.numbers(names["stddev"], empty=options.stddev_m * per_metre, missing=missing) / per_metre
        table.refuse(~STDDEV_M.hold(stddevs), names["stddev"], str(STDDEV_M))
    kinds = [CONTROL] * len(table)
    if names.get("kind", "") in table:
        kinds = [kind.lower() for kind in table.text(names["kind"], empty=CONTROL)]
        table.refuse(np.array([kind not in _KINDS for kind in kinds]), names["kind"], f"{CONTROL} or {CHECK}")
    rows = zip(markers, positions, stddevs.tolist(), kinds, table.line.tolist(), strict=True)
    points = tuple(ControlPoint(*row) for row in rows)
    told = tuple(f"{table.path.name}: {note}" for note in notes)
    return ControlPoints(points, {}, is_given, None, table.path, None, told)


def _gcp_list(path: Path, options: PointOptions, _head: str) -> ControlPoints:
    """Read ODM's ``gcp_list.txt``: the coordinate system, then lines of a point and its pixel in one photo.

    A point without a name is known by its coordinates.
    """
    crs, points, marks = None, dict[str, ControlPoint](), dict[str, list[tuple[str, list[float], int]]]()
    for line, text in enumerate(read_text(path).split("\n"), 1):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        if crs is None:
            crs = crs_of_line(text)
            continue
        numbers, image_name, rest = _cells_of_gcp(text, path, line)
        name = rest or next(
            (known.name for known in points.values() if known.position_m.tolist() == numbers[:3]),
            f"point {len(points) + 1}",
        )
        point = ControlPoint(name, np.array(numbers[:3]), options.stddev_m, CONTROL, line)
        if points.setdefault(name, point).position_m.tolist() != numbers[:3]:
            message = f"point {name} has other coordinates than in line {points[name].line}, expected the same"
            raise InputError(message, path, line)
        marks.setdefault(name, []).append((image_name, numbers[3:], line))
    markers = {name: _marker(name, seen, path) for name, seen in marks.items()}
    return ControlPoints(tuple(points.values()), markers, False, crs, path)


def _cells_of_gcp(text: str, path: Path, line: int) -> tuple[list[float], str, str]:
    """Return the five numbers, the photo and the name (may be empty) of a line of ``gcp_list.txt``."""
    cells = text.split("\t") if text.count("\t") >= _NUM_GCP_NUMBERS else text.split()
    cells = [cell.strip() for cell in cells]
    check: Sequence[Callable[[float], bool]] = [COORDINATE_M.hold] * 3 + [PIXEL.hold] * 2
    try:
        numbers = [float(cell) for cell in cells[:_NUM_GCP_NUMBERS]]
        is_right = len(cells) > _NUM_GCP_NUMBERS and all(holds(x) for holds, x in zip(check, numbers, strict=True))
    except ValueError:
        is_right = False
    if not is_right:
        raise InputError(f"is no line of a point, expected {_GCP_COLUMNS}", path, line)
    return numbers, cells[_NUM_GCP_NUMBERS], cells[_NUM_GCP_NUMBERS + 1] if len(cells) > _NUM_GCP_NUMBERS + 1 else ""


def _marker(name: str, seen: Sequence[tuple[str, list[float], int]], path: Path) -> Marker:
    photos, pixels, lines = zip(*seen, strict=True)
    if again := repeated(photos):
        raise InputError(f"point {name} is twice in {photos[again[0]]}, expected once", path, lines[again[0]])
    return Marker(photos, np.array(pixels), lines, CLICKED_STDDEV_PX)
