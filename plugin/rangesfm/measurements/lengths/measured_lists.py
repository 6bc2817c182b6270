"""Lists of taped lengths, of pairs of points, and of marks in photos: tables of any layout, known by their columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from rangesfm.errors import InputError, printable
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.guess import columns_by_name, names_of
from rangesfm.measurements.ranges.readers.layout import ColumnSample, Layout
from rangesfm.measurements.ranges.readers.lists import TableForm

_Found = Mapping[str, Sequence[ColumnSample]]
"""Columns that may hold each quantity."""
_BESIDE_LENGTH = terms.LENGTH_UNIT | terms.PLAIN
_IN_LENGTHS = {
    "distance": (terms.LENGTH, _BESIDE_LENGTH),
    "stddev": (terms.STDDEV, terms.LENGTH | _BESIDE_LENGTH),
    "kind": (terms.KIND, _BESIDE_LENGTH),
}
_IN_MARKS = {
    "image_name": terms.NAMING_PHOTOS,
    "marker": (terms.POINT | terms.MARK | terms.ID, frozenset[str]()),
    **{axis: (words, terms.PIXEL) for axis, words in terms.PIXEL_AXES.items()},
}


def _only_columns(
    by_name: Callable[[Layout], _Found | None],
    by_values: Callable[[Layout], _Found | None],
    form: TableForm,
    path: Path,
    layout: Layout,
) -> dict[str, str] | None:
    """Return the name of the column of each quantity, as ``TableForm.find``, where it is the only one that may be it.

    Args:
        by_name: returns the columns that may hold each quantity by their names, or None if others say that it is no
            such list.
        by_values: the same for a table without names.
    """
    found = (by_name if layout.has_names else by_values)(layout)
    if found is None:
        return None
    for quantity in form.required:
        if (num := len(those := found.get(quantity, []))) != 1:
            which = f"columns {names_of(those)} may all be" if num else "no column is"
            listed = printable(", ".join(layout.names))
            message = f"a table of {form.what} in which {which} {form.names[quantity]}; found {listed}"
            raise InputError(f"{message}; {form.expected}", path)
    return {quantity: those[0].name for quantity, those in found.items() if len(those) == 1}


def _ends(columns: Sequence[ColumnSample]) -> tuple[list[ColumnSample], list[ColumnSample]]:
    """Return the columns that may be the first and the second end: von, nach; point 1, point 2; else two texts."""
    start, end = ([c for c in columns if {*c.words} & words] for words in (terms.FROM, terms.TO))
    if start and end:
        return start, end
    about = terms.POINT | terms.MARK | terms.ANCHOR | terms.PHOTO | terms.ID | terms.TAG | {"end", "ende"}
    first, second = (
        [c for c in columns if {*c.words} & words and {*c.words} <= words | about] for words in terms.FIRST_AND_SECOND
    )
    if first and second:
        return first, second
    texts = [c for c in columns if c.kind == "text" and not {*c.words} & terms.REMARK]
    return (texts[:1], texts[1:]) if len(texts) == 2 else ([], [])


def _lengths_by_name(layout: Layout) -> _Found | None:
    of = columns_by_name(layout.columns, _IN_LENGTHS)
    others = of.pop("")
    if not of["distance"]:  # a column that is called cm
        of["distance"] = [column for column in others if column.words and {*column.words} <= terms.LENGTH_UNIT]
        others = [column for column in others if column not in of["distance"]]
    start, end = _ends(others)
    if any(column.kind not in ("text", "nothing") for column in others if column not in (*start, *end)):
        return None  # other numbers: a log of ranges, or a list of something else
    return {"from": start, "to": end, **of}


def _lengths_by_value(layout: Layout) -> _Found | None:
    kinds = [column.kind for column in layout.columns]
    if kinds[2:] not in (["numbers"], ["numbers", "numbers"]):
        return None
    return dict(zip(("from", "to", "distance", "stddev"), ([column] for column in layout.columns)))


def _marks_by_name(layout: Layout) -> _Found | None:
    photos = [column for column in layout.columns if column.names_photos]
    of = columns_by_name((column for column in layout.columns if column not in photos), _IN_MARKS)
    if any({*column.words} & terms.COORDINATES["z"] for column in of.pop("")):
        return None  # a list of points in space
    return {**of, "image_name": [column for column in layout.columns if column in (*photos, *of["image_name"])]}


def _marks_by_value(layout: Layout) -> _Found | None:
    photos = [column for column in layout.columns if column.names_photos]
    numbers = [column for column in layout.columns if column.kind == "numbers"]
    others = [column for column in layout.columns if column not in (*photos, *numbers)]
    if not others and len(numbers) == 3:  # markers that have numbers for names
        others, numbers = numbers[:1], numbers[1:]
    pixels: Iterator[list[ColumnSample]] = ([column] for column in numbers)
    return {"marker": others, "image_name": photos, **dict(zip(("x", "y"), pixels))} if len(numbers) == 2 else None


LENGTHS = TableForm(
    "taped distances",
    {"from": "from", "to": "to", "distance": "distance_m", "stddev": "stddev_m", "kind": "kind"},
    ("from", "to", "distance"),
    partial(_only_columns, _lengths_by_name, _lengths_by_value),
)
_ENDS = ("from", "to")
PAIRS = TableForm(
    "pairs of points",
    dict(zip(_ENDS, _ENDS)),
    _ENDS,
    partial(
        _only_columns,
        lambda layout: dict(zip(_ENDS, _ends(layout.columns))),
        lambda layout: dict(zip(_ENDS, ([column] for column in layout.columns))),
    ),
)
MARKS = TableForm(
    "marks in photos",
    {"marker": "marker", "image_name": "image_name", "x": "x_px", "y": "y_px"},
    ("marker", "image_name", "x", "y"),
    partial(_only_columns, _marks_by_name, _marks_by_value),
)
