"""Tables that people write, of any layout: anchors, points, lengths, marks, positions, and photos with their times.

Their columns are recognized as those of logs are. If that is not sure, the user is asked, with the flags to type. Every
row of a list counts: a line that is not a row of the table is an error.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, printable
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.columns import read_timestamps
from rangesfm.measurements.ranges.readers.guess import described
from rangesfm.measurements.ranges.readers.layout import MISSING, SHORTEST_M, ColumnSample, Layout, find_layout
from rangesfm.measurements.ranges.readers.unclear import Choice, UnclearFileError, columns_typed
from rangesfm.option_model import Bounds
from rangesfm.util.files.text_tables import (
    FOUND,
    NO_NAMES,
    TextTable,
    has_columns,
    header_names,
    is_plain_table,
    read_head,
    read_table,
)
from rangesfm.util.units import UNITS_PER_METRE

AXES = ("x", "y", "z")
# Largest plausible median time between two photos or positions, in seconds.
_SLOWEST_S = 120.0


def unclear_table(
    what: str, path: Path, layout: Layout, why: Sequence[str], choices: Sequence[Choice]
) -> UnclearFileError:
    """Return the error that asks how a table is to be read; ``why`` says what is not sure."""
    about = (f"found: {', '.join(described(layout.columns))}", f"not sure: {'; '.join(why)}")
    return UnclearFileError(what, path, about, choices)


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
class TableForm:
    """A kind of table that people write: its canonical CSV, and how the columns of other tables are found.

    Attributes:
        what: what it lists, for messages.
        names: name of the column of each quantity in the canonical CSV. Those of lengths end in ``_m``.
        required: quantities that it must have, such as "x", or "timestamp or image_name" of which one is enough.
        find: returns the name of the column of each quantity in another table, or None if it is no such table, given
            this form, the file and its layout.
        flag: by which the user gives the columns; empty if one cannot.
        also: quantities that only other tables have.
        aliases: other names of columns in the canonical CSV, as for ``read_table``.
        own: names here of quantities that have other ones in similar lists, by these.
    """

    what: str
    names: Mapping[str, str]
    required: Sequence[str]
    find: Callable[[TableForm, Path, Layout], Mapping[str, str] | None]
    flag: str = ""
    also: Sequence[str] = ()
    aliases: Mapping[str, str] = field(default_factory=dict)
    own: Mapping[str, str] = field(default_factory=dict)

    @property
    def _ways(self) -> list[list[str]]:
        """The columns of a canonical CSV, in each way to choose them."""
        each = (quantity.split(" or ") for quantity in self.required)
        return [[self.names[quantity] for quantity in way] for way in product(*each)]

    @property
    def quantities(self) -> tuple[str, ...]:
        """All quantities that such a table may have."""
        return (*self.names, *self.also)

    def choice(self, when: str, columns: Mapping[str, str], **flags: str) -> Choice:
        """Return a way to read a table, by the columns of quantities and other flags for the same table."""
        table = self.flag.removesuffix("columns")
        typed = {quantity: columns[quantity] for quantity in self.quantities if quantity in columns}
        return Choice(when, {self.flag: columns_typed(typed), **{table + flag: value for flag, value in flags.items()}})

    @property
    def expected(self) -> str:
        """What a file is expected to hold, for messages."""
        each = (" or ".join(self.names[one] for one in quantity.split(" or ")) for quantity in self.required)
        return f"expected a table with {','.join(each)}"

    def has_usual_names(self, head: str) -> bool:
        """Return whether a file with this beginning has the columns of the canonical CSV, whatever its numbers are."""
        return any(has_columns(head, way, self.aliases) for way in self._ways)

    def is_canonical(self, head: str) -> bool:
        """Return whether a file with this beginning has the columns of the canonical CSV, and no decimal commas."""
        return any(is_plain_table(head, way, self.aliases) for way in self._ways)

    def is_such(self, path: Path) -> bool:
        """Return whether a file is such a table by the names of its columns."""
        layout = find_layout(path)
        if layout is None:
            return self.is_canonical(read_head(path))
        try:
            return layout.has_names and self.find(self, path, layout) is not None
        except InputError:
            return False

    def read_canonical(self, path: Path, separator: str = FOUND) -> TextTable:
        """Read a canonical CSV, whose lengths are in metres; errors as of ``read_table``."""
        found = {self.aliases.get(name, name) for name in header_names(read_head(path), separator)}
        way = next((way for way in self._ways if {*way} <= found), self._ways[0])
        optional = [name for name in self.names.values() if name not in way]
        table = read_table(path, way, optional, aliases=self.aliases, separator=separator).by_quantity(self.names)
        return replace(table, missing=MISSING)

    def read(
        self, path: Path, columns: Mapping[str, str] = NO_NAMES, unit: str | None = None, *, every_row: bool = True
    ) -> TextTable:
        """Read a file of any layout, with columns by quantity.

        Args:
            columns: name of the column of each quantity, or its number in a table without names; empty: recognized.
            unit: unit of the required lengths; None: that in the names of their columns or in their cells, else metres.
                A length without a unit of its own has that of the first of these.
            every_row: whether a line that is not a row of the table is an error. Otherwise a few are left out.

        Raises:
            UnclearFileError: the columns are not known for sure; the advice says what to type.
            InputError: the file is no such table, or a line is not a row of it.
        """
        if not columns and unit is None and self.is_canonical(read_head(path)):
            return self.read_canonical(path)
        layout = find_layout(path)
        if layout is None:
            found = f"no table of {self.what}" if read_head(path).strip() else "the file is empty"
            raise InputError(f"{found}, {self.expected}", path)
        taken = self._columns_by_user(columns, layout, path) if columns else self.find(self, path, layout)
        if taken is None:
            found = printable(", ".join(layout.names))
            raise InputError(f"no columns of {self.what}; found {found}; {self.expected}", path)
        _require_clear_numbers(layout, taken.values(), path)
        table = layout.read(every_row=every_row)
        # The layout leaves commas in a table with commas as they are, because such a cell may be a list of numbers.
        left = [
            column.in_usual_form() for column in layout.columns if column.name in taken.values() and column.is_usual
        ]
        left = [column for column in left if not column.is_usual]
        cells = {one.name: [*map(one.usual, table.text(one.name, empty=""))] for one in left}
        unused = printable(", ".join(name for name in layout.names if name not in taken.values()))
        notes = (
            columns_taken(taken, layout.has_names or bool(columns)) + f"; not used: {unused}" * bool(unused),
            *table.notes,
            *(column.note for column in left if column.note),
        )
        table = replace(table, cells={**table.cells, **cells}, notes=notes).by_quantity(taken)
        return self._with_lengths(table, unit)

    def _columns_by_user(self, given: Mapping[str, str], layout: Layout, path: Path) -> dict[str, str]:
        """Return the columns that the user named, in the order of the quantities.

        Raises:
            InputError: a quantity is unknown or missing, or the table has no such column.
        """
        quantities = self.quantities
        for quantity, name in given.items():
            if quantity not in quantities:
                message = f"quantity in columns is '{printable(quantity)}', expected one of {', '.join(quantities)}"
                raise InputError(message, path)
            if name not in layout.names:
                raise InputError(f"no column {printable(name)}; found {printable(', '.join(layout.names))}", path)
        if missing := [those for those in self.required if given.keys().isdisjoint(those.split(" or "))]:
            expected = f"{', '.join(self.required[:-1])} and {self.required[-1]}"
            raise InputError(f"columns do not name {', '.join(missing)}, expected {expected}", path)
        return {quantity: given[quantity] for quantity in quantities if quantity in given}

    def _with_lengths(self, table: TextTable, unit: str | None) -> TextTable:
        """Return the table with the unit of each length."""
        lengths = [quantity for quantity, name in self.names.items() if name.endswith("_m") and quantity in table]
        named = {quantity: terms.named_length_unit(table.heading(quantity)) for quantity in lengths}
        first = [quantity for quantity in self.required if quantity in lengths]
        units = {quantity: unit or named[quantity] or "m" for quantity in first}
        what = "distances" if "distance" in units else "coordinates"
        if len({*units.values()}) > 1:
            note = [f"{what}: {', '.join(f'{quantity} in {own}' for quantity, own in units.items())}"]
        else:
            note = [f"{what} are in {own}" for own in {*units.values()} - {"m"}]
        units = {quantity: units.get(quantity) or own or units[first[0]] for quantity, own in named.items()}
        return replace(table, units={**table.units, **units}, notes=(*table.notes, *note))


def _require_clear_numbers(layout: Layout, names: Collection[str], path: Path) -> None:
    """Raise InputError if numbers of columns may have their thousands set apart, or decimals."""
    for column in layout.columns:
        if column.name in names and column.thousands_are_open:
            number = next(cell for cell in column.filled if re.search("[.,]", cell))
            whole, unit = re.sub("[.,]", "", number), terms.named_length_unit(f"{column.name} {column.unit}")
            message = f"{column.name} is {number}, which may be {whole} {unit} or less than {SHORTEST_M:g} m"
            raise InputError(f"{message}: write it as {whole} or {number}0", path)


def columns_taken(columns: Mapping[str, str], are_named: bool) -> str:
    """Return a line for the user that says which columns hold the quantities."""
    by_values = "" if are_named else " (by their numbers and values: the table has no names)"
    return f"columns taken: {', '.join(f'{quantity} = {name}' for quantity, name in columns.items())}{by_values}"


def metres(table: TextTable, quantity: str, bounds: Bounds, empty: float | None = None) -> Array:
    """Return lengths (n,) in metres; ``empty`` as for ``TextTable.numbers``.

    Raises:
        InputError: one is out of the bounds.
    """
    unit = table.units.get(quantity) or "m"
    expected = str(bounds) + ", or nothing" * (empty is not None) + f" (here in {unit})" * (unit != "m")
    values = table.numbers(quantity, empty=None if empty is None else np.nan, expected=expected)
    values = values / UNITS_PER_METRE[unit]
    is_empty = np.isnan(values)
    if quantity in table:
        table.refuse(~(is_empty | bounds.hold(values)), quantity, expected)
    return values if empty is None else np.where(is_empty, empty, values)


def times_by_row(table: TextTable, what: str, said: str | None, flag: str) -> tuple[Array, str, list[str]]:
    """Return the times (n,) of photos or of positions in seconds, their unit, and lines for the user.

    Args:
        what: what the table lists. said: unit that the user gave. flag: by which one gives it, without dashes.

    Raises:
        UnclearFileError: the unit is not known for sure.
        InputError: a cell is not a time.
    """
    notes = list[str]()

    def ask(units: Sequence[str], why: str) -> InputError:
        choices = [Choice(f"if they are {one}", {flag: one}) for one in units]
        layout = find_layout(table.path)
        assert layout is not None
        return unclear_table(what, table.path, layout, [f"the times have {why}"], choices)

    times_s, unit = read_timestamps(table, said, notes, ask, slowest_s=_SLOWEST_S)
    return times_s, unit, notes
