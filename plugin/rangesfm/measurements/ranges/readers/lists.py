"""Lists in tables of any layout: anchors with their positions, and photos with their times.

Their columns are recognized as those of logs are. If that is not sure, the user is asked, with the flags to type. Every
row of a list counts: a line that is not a row of the table is an error.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, printable
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.guess import described
from rangesfm.measurements.ranges.readers.layout import MISSING, NO_CURE, ColumnSample, Layout, find_layout
from rangesfm.measurements.ranges.readers.units import UNITS_PER_METRE, named_length_unit
from rangesfm.option_model import Bounds
from rangesfm.util.files.text_tables import FOUND, NO_NAMES, TextTable, read_head, read_table

AXES = ("x", "y", "z")
_MAX_NUM_WAYS = 6  # ways to read a list that are offered


@dataclass(frozen=True)
class Choice:
    """One way to read a list.

    Attributes:
        when: the case in which it is right, for the user.
        flags: flags and their values that choose it.
    """

    when: str
    flags: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.when}, add {shlex.join(self.flags)}"


class UnclearListError(InputError):
    """A list whose columns or units are not known for sure. The advice gives the flags for each way to read it.

    Attributes:
        what: the kind of list, such as "anchors".
        choices: the ways to read it.
        about: lines that say what was found, and what is not sure.
    """

    def __init__(self, what: str, path: Path, layout: Layout, why: Sequence[str], choices: Sequence[Choice]):
        self.what, self.choices, self._layout, self._why = what, tuple(choices), layout, tuple(why)
        self.about = (f"found: {', '.join(described(layout.columns))}", f"not sure: {'; '.join(why)}")
        self.message = f"a table of {what} whose columns are not known for sure"
        super().__init__(self.message, path, advice=[*self.about, *map(str, self.choices)])

    def about_other(self, what: str, quantities: Mapping[str, str], flags: Mapping[str, str]) -> UnclearListError:
        """Return the same error about another kind of list, with its quantities and flags in place of these."""
        choices = [
            Choice(choice.when, tuple(_renamed(flag, quantities, flags) for flag in choice.flags))
            for choice in self.choices
        ]
        assert self.path is not None
        return UnclearListError(what, Path(self.path), self._layout, self._why, choices)

    def asking(self, questions: Sequence[str]) -> InputError:
        """Return an error with the same text and other advice."""
        return InputError(self.message, self.path, advice=questions)


def _renamed(text: str, quantities: Mapping[str, str], flags: Mapping[str, str]) -> str:
    for old, new in flags.items():
        text = new + text.removeprefix(old) if text.startswith(old) else text
    for old, new in quantities.items():
        text = re.sub(rf"(^|,){old}=", rf"\g<1>{new}=", text)
    return text


def columns_flag(flag: str, columns: Mapping[str, str]) -> tuple[str, str]:
    """Return a flag with columns by quantity as the user types them."""
    return f"--{flag}", ",".join(f"{quantity}={name}" for quantity, name in columns.items())


def ways_to_complete(
    columns: Mapping[str, str], candidates: Mapping[str, Sequence[str]]
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the ways to give all quantities columns of their own, each after the case in which it is right.

    Args:
        columns: name of the column of each quantity that is known.
        candidates: names of the columns that may hold each of the others.
    """
    ways = [way for way in product(*candidates.values()) if len({*way}) == len(way)]
    for way in ways if candidates and len(ways) <= _MAX_NUM_WAYS else ():
        more = dict(zip(candidates, way, strict=True))
        yield f"if {' and '.join(f'{name} is {quantity}' for quantity, name in more.items())}", {**columns, **more}


def layout_of_list(path: Path, what: str, expected: str) -> Layout:
    """Return the layout of the table in a file; ``what`` and ``expected`` are words for the InputError without one."""
    layout = find_layout(path)
    if layout is None:
        found = f"no table of {what}" if read_head(path).strip() else "the file is empty"
        raise InputError(f"{found}, {expected}", path)
    return layout


def columns_by_user(
    given: Mapping[str, str], quantities: Sequence[str], required: Sequence[str], layout: Layout, path: Path
) -> dict[str, str]:
    """Return the columns that the user named, in the order of the quantities.

    Args:
        required: quantities that must be among them, such as "x", or "timestamp or image_name" of which one must be.

    Raises:
        InputError: a quantity is unknown or missing, or the table has no such column.
    """
    for quantity, name in given.items():
        if quantity not in quantities:
            message = f"quantity in columns is '{printable(quantity)}', expected one of {', '.join(quantities)}"
            raise InputError(message, path)
        if name not in layout.units:
            raise InputError(f"no column {printable(name)}; found {printable(', '.join(layout.units))}", path)
    if missing := [those for those in required if given.keys().isdisjoint(those.split(" or "))]:
        expected = f"{', '.join(required[:-1])} and {required[-1]}"
        raise InputError(f"columns do not name {', '.join(missing)}, expected {expected}", path)
    return {quantity: given[quantity] for quantity in quantities if quantity in given}


def coordinates_of_point(columns: Sequence[ColumnSample]) -> list[ColumnSample]:
    """Return, of the columns that may be one coordinate, those of the measured point itself, as it is in the map.

    A table may have estimated coordinates beside these, those of the base station, and those on the ellipsoid.
    """
    # Alone in a name, est is east in French.
    kept = [one for one in columns if terms.ESTIMATED.isdisjoint(one.words) or {*one.words} <= terms.ESTIMATED]
    for others in (terms.BASE, terms.ELLIPSOIDAL):
        kept = [one for one in kept or columns if others.isdisjoint(one.words)] or [*(kept or columns)]
    return kept


@dataclass(frozen=True)
class ListRows:
    """The rows of a list.

    Attributes:
        table: the rows. columns: name of the column of each quantity that the list has. units: their units of length.
        missing: texts of a cell, in small letters, that counts as empty.
        notes: lines for the user about how the file was read; empty for a canonical CSV.
    """

    table: TextTable
    columns: Mapping[str, str]
    units: Mapping[str, str]
    missing: Sequence[str]
    notes: tuple[str, ...] = ()

    def text(self, quantity: str, empty: str | None = None) -> list[str]:
        """Return the cells of a quantity; ``empty`` replaces those that are empty or missing, and None refuses them."""
        if quantity not in self.columns and empty is not None:
            return [empty] * len(self.table)
        return self.table.text(self.columns[quantity], empty=empty)

    def metres(self, quantity: str, bounds: Bounds, empty: float | None = None) -> Array:
        """Return lengths (n,) in metres; else as for ``text``."""
        if quantity not in self.columns and empty is not None:
            return np.full(len(self.table), empty)
        name, unit = self.columns[quantity], self.units[quantity]
        expected = str(bounds) + ", or nothing" * (empty is not None) + f" (here in {unit})" * (unit != "m")
        filled = None if empty is None else np.nan
        values = self.table.numbers(name, empty=filled, missing=self.missing, expected=expected)
        values = values / UNITS_PER_METRE[unit]
        self.table.refuse(~(np.isnan(values) | bounds.hold(values)), name, expected)
        return np.where(np.isnan(values), np.nan if empty is None else empty, values)


def read_canonical_rows(
    path: Path, names: Mapping[str, str], required: Sequence[str], aliases: Mapping[str, str] = NO_NAMES
) -> ListRows:
    """Read a canonical CSV, whose lengths are in metres.

    Args:
        names: name of the column of each quantity. required: names of those that it must have.
        aliases: as for ``read_table``.

    Raises:
        InputError: as ``read_table``.
    """
    optional = [name for name in names.values() if name not in required]
    table = read_table(path, required, optional, aliases=aliases, separator=FOUND)
    columns = {quantity: name for quantity, name in names.items() if name in table}
    return ListRows(table, columns, dict.fromkeys(columns, "m"), ("",))


def length_units(
    layout: Layout, columns: Mapping[str, str], unit: str | None = None, of: Sequence[str] = AXES
) -> tuple[dict[str, str], list[str]]:
    """Return the unit of each quantity, with a line for the user if it is not metres.

    Args:
        columns: name of the column of each quantity.
        unit: of the quantities ``of``; None: that in the names of their columns or their cells, else metres. A quantity
            without a unit of its own has that of the first of these.
    """
    named = {quantity: named_length_unit(f"{name} {layout.units[name]}") for quantity, name in columns.items()}
    units = {quantity: unit or named[quantity] or "m" for quantity in of}
    others = sorted({*units.values()} - {"m"})
    notes = [f"{'distances' if of[0] == 'distance' else 'coordinates'} are in {' and '.join(others)}"] if others else []
    usual = units[of[0]] if of else "m"
    return {quantity: units.get(quantity) or own or usual for quantity, own in named.items()}, notes


def read_rows(
    path: Path, layout: Layout, columns: Mapping[str, str], unit: str | None = None, of: Sequence[str] = AXES
) -> ListRows:
    """Read the rows of a list of any layout; arguments as for ``length_units``.

    Raises:
        InputError: a line is not a row of the table.
    """
    table, notes = layout.read(every_row=True)
    # The layout leaves commas in a table with commas as they are, because such a cell may be a list of numbers.
    uncured = [column for column in layout.columns if column.name in columns.values() and column.cure == NO_CURE]
    cured = {column.name: column.cured().cure for column in uncured}
    cells = {name: [*map(cure, table.text(name, empty=""))] for name, cure in cured.items() if cure != NO_CURE}
    taken = ", ".join(f"{quantity} = {name}" for quantity, name in columns.items())
    unused = [name for name in layout.units if name not in columns.values()]
    notes.insert(0, f"columns taken: {taken}" + (f"; not used: {printable(', '.join(unused))}" if unused else ""))
    units, more = length_units(layout, columns, unit, of)
    told = tuple(f"{path.name}: {note}" for note in (*notes, *more))
    return ListRows(replace(table, cells={**table.cells, **cells}), columns, units, MISSING, told)
