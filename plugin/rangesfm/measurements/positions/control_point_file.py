"""Files of control and check points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.metashape import is_metashape_file, read_metashape_markers
from rangesfm.measurements.lengths.tape import CHECK, CONTROL, Mark
from rangesfm.measurements.lengths.tape_file import markers_of_marks
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.position_log import crs_in_head, crs_in_text, crs_of_line, is_no_row
from rangesfm.measurements.ranges.anchors.anchor_file import find_or_ask
from rangesfm.measurements.ranges.readers.layout import Layout
from rangesfm.measurements.ranges.readers.lists import AXES, TableForm, metres
from rangesfm.measurements.ranges.readers.vocabulary import KIND
from rangesfm.options import COORDINATE_M, PIXEL, STDDEV_M, PointOptions
from rangesfm.util.files.text_tables import TextTable, is_number, read_head, read_without_header, repeated

_KINDS = (CONTROL, CHECK)
_GCP_COLUMNS = ("geo_x", "geo_y", "geo_z", "im_x", "im_y", "image_name")


def read_control_points(options: PointOptions) -> ControlPoints:
    """Read ``marker,x_m,y_m,z_m[,stddev_m,kind]`` another table, ODM's ``gcp_list.txt``, or Metashape's markers.

    A point without a kind is a control point.

    Args:
        options: which name the file; none: there are no points.

    Raises:
        UnclearFileError: the columns are not known for sure; the advice says what to type.
        InputError: a file is not valid; the error gives the line.
    """
    path = options.path
    if path is None:
        return ControlPoints()
    head = read_head(path)
    if is_gcp_list(head):
        return _gcp_list(path, options)
    if is_metashape_file(head):
        return _metashape(path, options)
    return _points(POINTS.read(path, options.columns, options.unit), options)


def is_gcp_list(head: str) -> bool:
    """Return whether a file with this beginning is ODM's list of ground control points."""
    first, *rows = [line for line in head.split("\n") if line.strip() and not line.startswith("#")] or [""]
    cells = [row.split() for row in rows]
    are_points = any(len(row) >= len(_GCP_COLUMNS) and all(map(is_number, row[:5])) for row in cells)
    return bool(crs_of_line(first)) and are_points


def is_point_file(head: str) -> bool:
    """Return whether a file with this beginning holds coordinates of marks."""
    return POINTS.has_usual_names(head) or is_gcp_list(head)


def _find_columns(form: TableForm, path: Path, layout: Layout) -> dict[str, str] | None:
    """Return the name of the column of each quantity: as in the canonical CSV, else recognized as in one of anchors."""
    if {form.names[quantity] for quantity in form.required} <= {*layout.names}:
        return {quantity: name for quantity, name in form.names.items() if name in layout.names}
    columns = find_or_ask(form, path, layout)
    if columns is None:
        return None
    kinds = [
        column.name
        for column in layout.columns
        if {*column.words} & KIND and {cell.strip().lower() for cell in column.cells} <= {*_KINDS, ""}
    ]
    return columns | ({"kind": kinds[0]} if len(kinds) == 1 else {})


POINTS = TableForm(
    "points",
    {"marker": "marker", "x": "x_m", "y": "y_m", "z": "z_m", "stddev": "stddev_m", "kind": "kind"},
    ("marker", *AXES),
    _find_columns,
    "point_columns",
    own={"anchor_id": "marker", "position_stddev": "stddev"},
)


def _points(table: TextTable, options: PointOptions) -> ControlPoints:
    if not len(table):
        raise InputError("names no point, expected one per line", table.path)
    markers = table.text("marker")
    if again := repeated(markers):
        raise table.error(again[0], "marker", "each point once")
    positions = np.column_stack([metres(table, axis, COORDINATE_M) for axis in AXES])
    stddevs = metres(table, "stddev", STDDEV_M, options.stddev_m)
    kinds = [kind.lower() for kind in table.text("kind", empty=CONTROL)]
    if (wrong := np.array([kind not in _KINDS for kind in kinds])).any():
        table.refuse(wrong, "kind", f"{CONTROL} or {CHECK}")
    each = zip(markers, positions, stddevs.tolist(), kinds, table.line.tolist(), strict=True)
    points = tuple(ControlPoint(*row) for row in each)
    return ControlPoints(points, {}, "stddev" in table, "", table.path, table.told)


def _gcp_list(path: Path, options: PointOptions) -> ControlPoints:
    """Read ODM's ``gcp_list.txt``: the coordinate system, then lines of a point and its pixel in one photo.

    A point without a name is known by its coordinates.
    """
    table = read_without_header(path, _GCP_COLUMNS, ("gcp_name",), has_more=True, is_no_row=is_no_row)
    bounds = [COORDINATE_M] * 3 + [PIXEL] * 2
    numbers = np.column_stack([table.numbers(name, bounds=each) for name, each in zip(_GCP_COLUMNS, bounds)])
    points, marks = dict[str, ControlPoint](), dict[str, list[Mark]]()
    names, photos = table.text("gcp_name", empty=""), table.text("image_name")
    for line, name, photo, row in zip(table.line.tolist(), names, photos, numbers, strict=True):
        place, pixel = row[:3].tolist(), row[3:].tolist()
        name = name or next(
            (known.name for known in points.values() if known.position_m.tolist() == place), f"point {len(points) + 1}"
        )
        point = ControlPoint(name, row[:3], options.stddev_m, CONTROL, line)
        if points.setdefault(name, point).position_m.tolist() != place:
            message = f"point {name} has other coordinates than in line {points[name].line}, expected the same"
            raise InputError(message, path, line)
        marks.setdefault(name, []).append((photo, pixel, line))
    crs = crs_in_head(read_head(path))
    return ControlPoints(tuple(points.values()), markers_of_marks(marks, path), False, crs, path)


def _metashape(path: Path, options: PointOptions) -> ControlPoints:
    """Read Metashape's markers; those whose coordinates are not enabled are check points, as there."""
    read = read_metashape_markers(path)
    points = tuple(
        ControlPoint(name, np.array(place), stddev or options.stddev_m, CONTROL if is_enabled else CHECK, line)
        for name, (place, stddev, is_enabled, line) in read.places.items()
    )
    if not points:
        raise InputError("its markers have no coordinates: give them in another file, and this one by --markers", path)
    are_stated = all(stddev for _, stddev, _, _ in read.places.values())
    return ControlPoints(points, markers_of_marks(read.seen, path), are_stated, crs_in_text(read.system), path)
