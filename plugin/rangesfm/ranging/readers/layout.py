"""How a table of text is laid out, by its first rows: separator, header row or none, decimal commas."""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.files.tables import Table, read_head
from rangesfm.ranging.readers.records import read_records
from rangesfm.ranging.readers.times import CIVIL_TIME, TIME_OF_DAY
from rangesfm.ranging.readers.units import words_of

# fmt: off
MISSING = (
    "", "nan", "-nan", "inf", "-inf", "none", "null", "nil", "na", "n/a", "#n/a", "-", "--",
    "timeout", "error", "err", "fail", "failed", "invalid", "lost",
)
# fmt: on
"""What stands in a cell without a number, in small letters."""

_SEPARATORS = "\t;|, "  # a comma may stand in numbers, a blank in times
_NUM_ROWS = 1000
_MAX_NUM_WORDS = 20  # lines before the table
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
_DECIMAL_COMMA = re.compile(r"-?\d+,\d+")
_DATE = re.compile(r"\d{4}([-/.])\d\d?\1\d\d?|\d\d?([-/.])\d\d?\2\d{4}", re.ASCII)


@dataclass(frozen=True)
class Column:
    """A column by its name and its first cells."""

    name: str
    cells: tuple[str, ...]

    @cached_property
    def words(self) -> list[str]:
        return words_of(self.name)

    @cached_property
    def numbers(self) -> Array:
        """Of the cells that are finite ones."""
        values = np.array([float(cell) for cell in self.cells if _NUMBER.fullmatch(cell)], np.float64)
        return values[np.isfinite(values)]

    @cached_property
    def kind(self) -> str:
        """What the cells are, but for empty ones: numbers, civil times, dates, text or nothing."""
        filled = [cell for cell in self.cells if cell.lower() not in MISSING]
        patterns = {"numbers": (_NUMBER,), "times": (CIVIL_TIME, TIME_OF_DAY), "dates": (_DATE,)}
        for kind, those in patterns.items():
            if filled and all(any(pattern.fullmatch(cell) for pattern in those) for cell in filled):
                return kind
        return "text" if filled else "nothing"

    @cached_property
    def is_whole(self) -> bool:
        return self.kind == "numbers" and bool(np.all(self.numbers == np.round(self.numbers)))

    @cached_property
    def num_distinct(self) -> int:
        return len(set(self.cells))

    def __str__(self) -> str:
        if self.kind == "numbers" and len(self.numbers):
            return f"{self.name} ({self.numbers.min():.10g} to {self.numbers.max():.10g})"
        return f"{self.name} ({self.kind}{'' if self.kind == 'nothing' else f', {self.cells[0]!r}'})"


@dataclass(frozen=True)
class Layout:
    """A table as ``read_table`` takes it: see there.

    Attributes:
        columns: what the first rows have under each name of the header.
        has_names: whether the file names its columns.
        table: all of it, where it is no text in rows.
    """

    header: tuple[str, ...]
    separator: str
    num_skipped: int = 0
    decimal_comma: bool = False
    columns: tuple[Column, ...] = ()
    has_names: bool = True
    table: Table | None = None


def find_layout(path: Path, separator: str | None = None) -> Layout | None:
    """The layout of a file; None if it has no two rows alike."""
    if table := read_records(path):
        first_rows = (Column(name, tuple(table.text(name, empty="")[:_NUM_ROWS])) for name in table.columns)
        return Layout(table.columns, ",", columns=tuple(first_rows), table=table)
    lines = read_head(path).split("\n")
    numbered = [(number, line) for number, line in enumerate(lines[:-1] or lines, 1) if line.strip()]
    content = [(number, line) for number, line in numbered if not line.lstrip().startswith("#")][:_NUM_ROWS]
    split = next(filter(None, (_split(content, one) for one in separator or _SEPARATORS)), None)
    if split is None:
        return None
    rows, separator = split
    num = Counter(map(len, rows)).most_common(1)[0][0]
    first = next(k for k, row in enumerate(rows) if len(row) == num)
    if first and len(rows[first - 1]) == num - 1 and not any(row[-1] for row in rows[first:] if len(row) == num):
        first -= 1  # only the rows end in a separator
    decimal_comma = separator != "," and any(map(_DECIMAL_COMMA.fullmatch, rows[-1]))
    if decimal_comma:
        rows[first + 1 :] = [[cell.replace(",", ".") for cell in row] for row in rows[first + 1 :]]
    body = [row for row in rows[first:] if len(row) == num]
    names, num_skipped = None, content[first][0] - 1
    below = body[1:] if len(rows[first]) == num else body
    if _is_header(rows[first], below) or _is_header(rows[first], below[1:]):
        names, num_skipped = rows[first], content[first][0]
        body = below
        if len(body) > 1 and len(names) == num and _is_header(body[0], body[1:]):  # their units
            names, num_skipped = [" ".join(both) for both in zip(names, body[0])], content[first + 1][0]
            body = body[1:]
    elif comments := [line for number, line in numbered if number < content[first][0] and line.lstrip()[0] == "#"]:
        cells = _cells(comments[-1].lstrip("# \t"), separator)
        names = cells if len(cells) == num and not any(map(_NUMBER.fullmatch, cells)) else None
    header = tuple(_unique(names or [str(k + 1) for k in range(num)], num))
    columns = tuple(Column(name, tuple(row[k] for row in body)) for k, name in enumerate(header))
    return Layout(header, separator, num_skipped, decimal_comma, columns, names is not None) if body else None


def _split(content: list[tuple[int, str]], separator: str) -> tuple[list[list[str]], str] | None:
    """The cells of all rows, if most have the same number of them."""
    rows = [_cells(line, separator) for _, line in content]
    if not rows:
        return None
    num, count = Counter(map(len, rows)).most_common(1)[0]
    return (rows, separator) if num > 1 and count >= max(2, len(rows) - _MAX_NUM_WORDS, len(rows) / 2) else None


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]
    except csv.Error:
        return [line]


def _is_header(row: list[str], rows: list[list[str]]) -> bool:
    """Whether a row has words where those below it have numbers or times."""
    below = [Column("", tuple(cells)) for cells in zip(*rows)]
    return any(
        column.kind in ("numbers", "times") and cell and Column("", (cell,)).kind == "text"
        for cell, column in zip(row, below)
    ) or (not rows and all(Column("", (cell,)).kind == "text" for cell in row))


def _unique(names: list[str], num: int) -> list[str]:
    filled = [name or f"column {k + 1}" for k, name in enumerate([*names, *[""] * (num - len(names))])]
    return [name if filled.index(name) == k else f"{name} ({k + 1})" for k, name in enumerate(filled)]
