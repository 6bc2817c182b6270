"""Lists in tables of any layout: anchors with their positions, and photos with their times.

Their columns are recognized as those of logs are. If that is not sure, the user is asked, with the flags to type. Every
row of a list counts: a line that is not a row of the table is an error.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from rangesfm.errors import InputError, printable
from rangesfm.files.text_tables import TextTable
from rangesfm.ranging.readers.guess import described
from rangesfm.ranging.readers.layout import ColumnSample, Layout

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


def check_columns(given: Mapping[str, str], quantities: Collection[str], layout: Layout, path: Path) -> None:
    """Check columns that the user named.

    Raises:
        InputError: a quantity is unknown, or the table has no such column.
    """
    for quantity, name in given.items():
        if quantity not in quantities:
            message = f"quantity in columns is '{printable(quantity)}', expected one of {', '.join(quantities)}"
            raise InputError(message, path)
        if name not in layout.units:
            raise InputError(f"no column {printable(name)}; found {printable(', '.join(layout.units))}", path)


def read_list(layout: Layout, columns: Mapping[str, str]) -> tuple[TextTable, list[str]]:
    """Read the rows of a list, with lines for the user about what was taken.

    Args:
        layout: layout of the file.
        columns: name of the column of each quantity.

    Raises:
        InputError: a line is not a row of the table.
    """
    table, notes = layout.read(every_row=True)
    # The layout leaves commas in a table with commas as they are, because such a cell may be a list of numbers.
    cured = {column.name: column.cured() for column in column_samples(layout, columns.values()) if column.cure is None}
    cells = {name: [*map(one.cure, table.text(name, empty=""))] for name, one in cured.items() if one.cure}
    taken = ", ".join(f"{quantity} = {name}" for quantity, name in columns.items())
    unused = [name for name in layout.units if name not in columns.values()]
    notes.insert(0, f"columns taken: {taken}" + (f"; not used: {printable(', '.join(unused))}" if unused else ""))
    return replace(table, cells={**table.cells, **cells}), notes


def column_samples(layout: Layout, names: Iterable[str]) -> list[ColumnSample]:
    """Return the columns with these names, in the order of the file."""
    wanted = {*names}
    return [column for column in layout.columns if column.name in wanted]
