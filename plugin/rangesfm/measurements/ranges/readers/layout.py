"""Layout of a table of text, found from its first rows: separator, header row, and the form of the cells.

Logs in which every value comes with its name are tables, too: JSON, ``rostopic echo``, ``anchor=A1 range=2.34``, and
GSI files of surveying instruments.
"""

from __future__ import annotations

import ast
import csv
import json
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers.times import CIVIL_TIME, TIME_OF_DAY, spelt_date, time_in_front
from rangesfm.measurements.ranges.readers.vocabulary import (
    ANCHOR,
    BIAS,
    ID,
    LENGTHS,
    POINT,
    STDDEV,
    TAG,
    TIMES,
    named_length_unit,
    words_of,
)
from rangesfm.util.files.folders import IMAGE_EXTENSIONS
from rangesfm.util.files.text_tables import MAX_NUMBER, TextTable, num_cells, read_head, read_text
from rangesfm.util.geometry.reference import QUATERNION_TOLERANCE
from rangesfm.util.units import UNITS_PER_METRE

_ANGLE = re.compile(
    r"([NSEW]?) ?(-?)(\d{1,3}(?:\.\d+)?) ?(?:°|º|deg) ?(?:(\d{1,2}(?:\.\d+)?) ?['’′])? ?"
    r"(?:(\d{1,2}(?:\.\d+)?) ?(?:\"|''|″|”))? ?([NSEW]?)",
    re.ASCII,
)


def _spelt_angle(text: str) -> float | None:
    """Return the degrees of an angle in degrees, minutes and seconds, south and west negative; None for other text."""
    found = _ANGLE.fullmatch(text.replace(",", "."))
    if found is None or bool(found[1]) + bool(found[2]) + bool(found[6]) > 1:
        return None
    size = float(found[3]) + float(found[4] or 0) / 60 + float(found[5] or 0) / 3600
    return -size if found[2] or "S" in (found[1], found[6]) or "W" in (found[1], found[6]) else size


# fmt: off
MISSING = (
    "", "nan", "-nan", "inf", "-inf", "none", "null", "nil", "na", "n/a", "#n/a", "-", "--",
    "timeout", "error", "err", "fail", "failed", "invalid", "lost",
)
# fmt: on
"""Texts in small letters of a cell that holds no number."""

_SEPARATORS = "\t;|, "  # the comma and the blank come last, because numbers may contain commas and times blanks
_NUM_ROWS = 1000  # rows from which the layout is found
_MOST_OF_LIST = 64  # lines of a list that somebody wrote
_MAX_NUM_WORDS = 20  # lines of text before the table
_MAX_SHARE_OF_WORDS = 0.02  # lines of text inside the table, as a share of all
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?", re.ASCII)
# Numbers whose thousands are set apart: 2,600,000.5, 2.600.000 or 2.600,5, and 2'600'000.5 or with blanks.
_THOUSANDS = {
    ",": re.compile(r"[-+]?\d{1,3}(?:,\d{3})+\.\d+", re.ASCII),
    ".": re.compile(r"[-+]?\d{1,3}(?:(?:\.\d{3})+,\d+|(?:\.\d{3}){2,})", re.ASCII),
    "'\u2019 \xa0\u202f": re.compile(r"[-+]?\d{1,3}(?:['\u2019 \xa0\u202f]\d{3})+(?:[.,]\d+)?", re.ASCII),
}
# Numbers that may be thousands or decimals, by their only mark: 2.832.
_THOUSANDS_OR_DECIMALS = {mark: re.compile(rf"[-+]?[1-9]\d{{0,2}}[{mark}]\d{{3}}", re.ASCII) for mark in ".,"}
_FINE_UNITS = ("mm", "cm")  # units of which nobody measures thousandths
SHORTEST_M = 0.05
"""Lengths of a site that are all shorter than this, metres, may be something else."""
# Words in the names of columns of numbers below a thousand, and of ids.
_BELOW_THOUSAND = STDDEV | BIAS | ANCHOR | POINT | ID | {"error", "err"}
_GROUPED = re.compile(r"[-+]?\d[\d,.'\u2019 \xa0\u202f]*", re.ASCII)
# Exiftool prints heights as 415.2 m Above Sea Level.
_WITH_UNIT = re.compile(rf"({_DECIMAL_COMMA.pattern}|{_NUMBER.pattern}) ?([A-Za-z]+)(?: Above Sea Level)?", re.ASCII)
_DATE = re.compile(r"\d{4}([-/.])\d\d?\1\d\d?|\d\d?([-/.])\d\d?\2\d{4}", re.ASCII)
_UNITS = {*TIMES, *LENGTHS, "dbm"} - {"d", "h"}  # 1d may be an id

NamedValues = dict[str, str]
_BLOCK = "\n---\n"  # end of a message of rostopic echo
_NAMED = re.compile(
    r"(?<![\w.:/])([A-Za-z]\w*)(?: ?= ?|: +(?!\w+=))(\"[^\"]*\"|[^\s,;\[\]{}]+)"
    rf"|\b({'|'.join(sorted(ANCHOR | TAG))}) #?(\w*\d\w*)\b(?! ?[=:])",  # Anchor 0x01 distance: 3.45 m
    re.ASCII | re.IGNORECASE,
)
_ESP_IDF = re.compile(r"[EWIDV] \((\d{1,10})\) ", re.ASCII)  # I (5230) uwb: and what the board says; ms since its start
_KEY = re.compile(r"([A-Za-z_]\w*):(?: +(.*))?", re.ASCII)
# Smallest share of lines or blocks with named values, and of lines with JSON, in a file of records. Boards print other
# lines beside JSON.
_MIN_SHARE_NAMED, _MIN_SHARE_JSON = 0.9, 0.5


@dataclass(frozen=True)
class ColumnSample:
    """A column with its name and its first cells.

    Attributes:
        unit: unit after each of its numbers in the file, "" if there is none.
        thousands: characters that set thousands apart there, "" if there are none.
        has_commas: whether numbers have decimal commas there.
        spelling: what the cells are in another form there: "dates", "angles" in degrees, minutes and seconds,
            "lengths" with units of their own, which are in metres here, or "".
        note: line for the user about how its numbers were read; "" if they say it.
        thousands_are_open: whether its numbers may have their thousands set apart there, or decimals.
    """

    name: str
    cells: tuple[str, ...]
    unit: str = ""
    thousands: str = ""
    has_commas: bool = False
    spelling: str = ""
    note: str = ""
    thousands_are_open: bool = False

    @cached_property
    def words(self) -> list[str]:
        return words_of(f"{self.name} {self.unit}")

    @cached_property
    def numbers(self) -> Array:
        """Values of the cells that are numbers of a size with which one can calculate."""
        values = np.array([float(cell) for cell in self.cells if _NUMBER.fullmatch(cell)], np.float64)
        return values[np.abs(values) <= MAX_NUMBER]

    @cached_property
    def filled(self) -> list[str]:
        return [cell for cell in self.cells if cell.lower() not in MISSING]

    @cached_property
    def kind(self) -> str:
        """Kind of the cells that are not empty: "numbers", "times" (civil times), "dates", "text" or "nothing"."""
        patterns = {"numbers": (_NUMBER,), "times": (CIVIL_TIME, TIME_OF_DAY), "dates": (_DATE,)}
        for kind, those in patterns.items():
            if self.filled and all(any(pattern.fullmatch(cell) for pattern in those) for cell in self.filled):
                return kind
        return "text" if self.filled else "nothing"

    @cached_property
    def is_without_zone(self) -> bool:
        """Whether the cells are civil times some of which do not say their zone."""
        return self.kind == "times" and not all(
            (match := CIVIL_TIME.fullmatch(cell)) and match[5] for cell in self.filled
        )

    @cached_property
    def is_whole(self) -> bool:
        """Whether it holds whole numbers, of which at least one has a size with which one can calculate."""
        return len(self.numbers) > 0 and self.kind == "numbers" and bool(np.all(self.numbers == np.round(self.numbers)))

    @cached_property
    def num_distinct(self) -> int:
        return len(set(self.cells))

    @cached_property
    def names_photos(self) -> bool:
        return bool(self.cells) and all(cell.lower().endswith(IMAGE_EXTENSIONS) for cell in self.cells)

    @property
    def is_usual(self) -> bool:
        """Whether its cells in the file have the usual form, as far as is known."""
        return not (self.unit or self.thousands or self.has_commas or self.spelling)

    def usual(self, cell: str) -> str:
        """Convert a cell of the column in the file to the usual form: decimal points, no units, 2026-01-31.

        A cell that has another form than the others is left as it is.
        """
        if self.spelling == "dates":
            return spelt_date(cell) or cell
        if self.spelling == "angles":
            return cell if (angle := _spelt_angle(cell)) is None else f"{angle:.12g}"
        found = _WITH_UNIT.fullmatch(cell) if self.unit else None
        own = found[2].lower() if found and self.spelling == "lengths" else ""
        number = found[1] if found and (found[2] == self.unit or own in LENGTHS) else cell
        if self.thousands and _GROUPED.fullmatch(number):
            number = re.sub(f"[{re.escape(self.thousands)}]", "", number).replace(",", ".")
        if self.has_commas and _DECIMAL_COMMA.fullmatch(number):
            number = number.replace(",", ".")
        is_length = own in LENGTHS and _NUMBER.fullmatch(number)
        return f"{float(number) / UNITS_PER_METRE[LENGTHS[own]]:.12g}" if is_length else number

    def in_usual_form(self, mark_of_thousands: str = "") -> ColumnSample:
        """Return the column with the form of its cells found out, and these in the usual form.

        Args:
            mark_of_thousands: that sets thousands apart in other columns of the table, if it is known.
        """
        if self.filled and all(map(spelt_date, self.filled)):
            return replace(self, spelling="dates").with_usual_cells()
        if self.filled and not any(_spelt_angle(cell) is None for cell in self.filled):
            return replace(self, spelling="angles").with_usual_cells()
        matches = [_WITH_UNIT.fullmatch(cell) for cell in self.filled]
        units = {match[2] if match else "" for match in matches}
        are_lengths = len(units) > 1 and all(unit.lower() in LENGTHS for unit in units)
        unit = "m" if are_lengths else next(iter(units)) if len(units) == 1 else ""
        column = replace(self, unit=unit if unit.lower() in _UNITS else "", spelling="lengths" * are_lengths)
        cells = [match[1] if match and column.unit else cell for match, cell in zip(matches, self.filled)]
        column = replace(
            column,
            thousands=next((marks for marks, pattern in _THOUSANDS.items() if any(map(pattern.fullmatch, cells))), ""),
            has_commas=any(map(_DECIMAL_COMMA.fullmatch, cells)),
        )
        if are_lengths:
            column = replace(
                column, note=f"numbers of {self.name} have units of their own ({', '.join(sorted(units))})"
            )
        if column.thousands or column.spelling or not _BELOW_THOUSAND.isdisjoint(column.words):
            return column.with_usual_cells()
        if mark_of_thousands and _may_be_thousands(cells, mark_of_thousands):
            number = next(cell for cell in cells if mark_of_thousands in cell)
            return column.with_thousands(mark_of_thousands, number).with_usual_cells()
        return column._with_thousands_by_unit(cells).with_usual_cells()

    def _with_thousands_by_unit(self, cells: Sequence[str]) -> ColumnSample:
        """Return the column with what its unit tells of thousands: nobody measures 2.832 mm.

        Args:
            cells: without the unit.
        """
        unit = named_length_unit(f"{self.name} {self.unit}")
        mark = "," if self.has_commas else "."
        if unit not in _FINE_UNITS or not _may_be_thousands(cells, mark):
            return self
        numbers = [cell for cell in cells if mark in cell]
        if any(cell.isdigit() and int(cell) > 0 for cell in cells):  # whole ones would have the same decimals
            return self.with_thousands(mark, numbers[0])
        longest = max(abs(float(number.replace(mark, "."))) for number in numbers)
        if longest < SHORTEST_M * UNITS_PER_METRE[unit]:
            return replace(self, thousands_are_open=True)
        return replace(self, note=f"numbers of {self.name} such as {numbers[0]} have decimals, not thousands set apart")

    def with_thousands(self, mark: str, number: str) -> ColumnSample:
        """Return the column with thousands that a mark sets apart, as in one of its numbers, and a note about it."""
        note = f"numbers of {self.name} have their thousands set apart: {number} is {number.replace(mark, '')}"
        return replace(self, thousands=mark, has_commas=self.has_commas and mark != ",", note=note)

    def shows_mark_of_thousands(self, cells: Sequence[str]) -> str:
        """Return the mark that sets thousands apart in the whole table, by these cells in the file; "" if none says it.

        Of numbers with decimal commas, one such as 2,5 says it.
        """
        if self.has_commas:
            return "" if _may_be_thousands(cells, ",") else "."
        return self.thousands if self.thousands in (".", ",") else ""

    def with_usual_cells(self) -> ColumnSample:
        """Return the column, in whose form the cells are, with these in the usual form."""
        return self if self.is_usual else replace(self, cells=tuple(map(self.usual, self.cells)))

    def __str__(self) -> str:
        if self.kind == "numbers" and len(self.numbers):
            return f"{self.name} ({self.numbers.min():.10g} to {self.numbers.max():.10g})"
        if self.kind == "nothing":
            return f"{self.name} (nothing)"
        shown = next((cell for cell in self.filled if not _NUMBER.fullmatch(cell)), self.filled[0])
        return f"{self.name} ({self.kind}, {shown!r})"


def _may_be_thousands(cells: Sequence[str], mark: str) -> bool:
    """Return whether all numbers with a decimal mark among cells may have it before their last three digits instead."""
    pattern = _THOUSANDS_OR_DECIMALS[mark]
    return any(mark in cell for cell in cells) and all(mark not in cell or pattern.fullmatch(cell) for cell in cells)


@dataclass(frozen=True)
class Layout:
    """Layout of a table of text.

    Attributes:
        columns: the columns with the cells of the first rows.
        has_names: whether the file names its columns.
        read_cells: reads all rows as they are in the file. The argument is that of ``read``.
        are_records: whether the rows are records, in which values may be missing.
    """

    columns: tuple[ColumnSample, ...]
    has_names: bool
    read_cells: Callable[[bool], TextTable]
    are_records: bool = False

    @property
    def names(self) -> list[str]:
        return [column.name for column in self.columns]

    def read(self, *, every_row: bool = False) -> TextTable:
        """Read all rows.

        Args:
            every_row: whether a line that is not a row of the table is an error. Otherwise a few are left out.

        Raises:
            InputError: lines are not rows of the table.
        """
        table = self.read_cells(every_row)
        unusual = [column for column in self.columns if not column.is_usual]
        return replace(
            table,
            cells={**table.cells, **{one.name: [*map(one.usual, table.text(one.name, empty=""))] for one in unusual}},
            units={column.name: column.unit for column in self.columns},
            missing=MISSING,
            notes=(
                *table.notes,
                *["numbers have decimal commas"] * any(one.has_commas for one in unusual),
                *(column.note for column in self.columns if column.note),
            ),
        )


def are_quaternions(columns: Sequence[ColumnSample]) -> bool:
    """Return whether four columns of numbers are unit quaternions."""
    if len({len(column.numbers) for column in columns}) > 1 or not len(columns[0].numbers):
        return False
    lengths = np.linalg.norm([column.numbers for column in columns], axis=0)
    return bool(np.all(np.abs(lengths - 1.0) < QUATERNION_TOLERANCE))


def find_layout(path: Path, separator: str = "") -> Layout | None:
    """Find the layout of a file; None if it has no table."""
    if table := _read_records(path):
        first_rows = (ColumnSample(name, tuple(table.text(name, empty="")[:_NUM_ROWS])) for name in table.cells)
        return Layout(tuple(column.in_usual_form() for column in first_rows), True, lambda _: table, True)
    lines = read_head(path).split("\n")
    # The last line may be cut off, where the beginning ends or the recording did, but not in a short list.
    whole = lines if len(lines) <= _MOST_OF_LIST else lines[:-1]
    numbered = [(number, line) for number, line in enumerate(whole, 1) if line.strip()]
    content = [(number, line) for number, line in numbered if not _is_comment(line)][:_NUM_ROWS]
    split = next(filter(None, (_split(content, one) for one in separator or _SEPARATORS)), None)
    if split is None:
        return None
    rows, separator = split
    num = Counter(map(len, rows)).most_common(1)[0][0]
    first = next(k for k, row in enumerate(rows) if len(row) == num)
    if first and len(rows[first - 1]) == num - 1 and not any(row[-1] for row in rows[first:] if len(row) == num):
        first -= 1  # the rows end in a separator and the header does not
    elif first and len(rows[first - 1]) == num + 1 and not rows[first - 1][-1]:
        first -= 1  # the header ends in a separator and the rows do not
        rows[first] = rows[first][:-1]
    while separator == " " and _is_title(rows[first:], num):
        first += 1
    first += _num_padded(rows[first:], num)
    body = [row for row in rows[first:] if len(row) == num]
    names, num_skipped = None, content[first][0] - 1
    below = body[1:] if len(rows[first]) == num else body
    again = [row for row in below if row != rows[first]]  # in joined files the header row is repeated
    if _is_header(rows[first], again) or _is_header(rows[first], again[1:]):
        names, num_skipped, body = rows[first], content[first][0], again
        if len(body) > 1 and len(names) == num and _is_second_header(body[0], body[1:]):
            names, num_skipped = [" ".join(both) for both in zip(names, body[0])], content[first + 1][0]
            body = body[1:]
    elif comments := [line for number, line in numbered if number < content[first][0] and _is_comment(line)]:
        cells = _cells(comments[-1].lstrip("#%/ \t"), separator)
        names = cells if len(cells) == num and not any(map(_NUMBER.fullmatch, cells)) else None
    if not body:
        return None
    header = tuple(_unique(names or [str(k + 1) for k in range(num)], num))
    samples = [ColumnSample(name, tuple(row[k] for row in body)) for k, name in enumerate(header)]
    columns = [one if separator == "," and "," in "".join(one.cells) else one.in_usual_form() for one in samples]
    marks = {mark for one, sample in zip(columns, samples) if (mark := one.shows_mark_of_thousands(sample.filled))}
    if len(marks) == 1:
        columns = [one if one is sample else sample.in_usual_form(*marks) for one, sample in zip(columns, samples)]
    header_row = rows[first] if num_skipped >= content[first][0] else ()
    return Layout(
        tuple(columns),
        names is not None,
        lambda every_row: read_rows(path, header, separator, num_skipped, header_row, every_row=every_row),
    )


def read_rows(
    path: Path,
    header: Sequence[str],
    separator: str,
    num_skipped: int = 0,
    names: Sequence[str] = (),
    *,
    every_row: bool = False,
) -> TextTable:
    """Read all rows without empty ones. A few other lines (text, a truncated line, a repeated header) are left out.

    Args:
        header: the columns.
        num_skipped: lines before the first row.
        names: cells of the header row, which may be repeated.
        every_row: whether the first of the other lines is an error; otherwise a note says how many there are.
    """
    numbered = enumerate(read_text(path).split("\n")[num_skipped:], num_skipped + 1)
    content = [(line, _cells(text, separator)) for line, text in numbered if text.strip() and not _is_comment(text)]
    content = [(line, row) for line, row in content if any(row)]
    rows = [(line, row) for line, row in content if len(row) == len(header) and row != names]
    odd = [(line, row) for line, row in content if len(row) != len(header)]
    if odd and (every_row or len(odd) > 1 + _MAX_SHARE_OF_WORDS * len(content)):
        line, row = odd[0]
        raise InputError(f"has {num_cells(row)}, the header row has {len(header)}", path, line)
    lost = (
        [f"{len(odd)} lines that are not rows of the table are left out, the first is line {odd[0][0]}"] if odd else []
    )
    columns = list(zip(*(row for _, row in rows))) or [()] * len(header)
    cells = {name: [*column] for name, column in zip(header, columns)}
    return TextTable(path, np.array([line for line, _ in rows], np.int64), cells, notes=tuple(lost))


def _is_comment(line: str) -> bool:
    """Return whether a line is a comment of Python, MATLAB or C; rostopic's ``%time`` is a name, not a comment."""
    return line.lstrip().startswith(("#", "% ", "%%", "//"))


def _split(content: list[tuple[int, str]], separator: str) -> tuple[list[list[str]], str] | None:
    """Return the cells of all rows and the separator, or None if most rows do not have the same number of cells."""
    rows = [_cells(line, separator) for _, line in content]
    if not rows or (separator == "," and sum(_has_decimal_commas(line) for _, line in content) > len(rows) / 2):
        return None
    num, count = Counter(map(len, rows)).most_common(1)[0]
    return (rows, separator) if num > 1 and count >= max(2, len(rows) - _MAX_NUM_WORDS, len(rows) / 2) else None


def _has_decimal_commas(line: str) -> bool:
    """Return whether all commas of a line are decimal ones, of numbers that blanks set apart."""
    numbers = sum(_DECIMAL_COMMA.fullmatch(word) is not None for word in line.split())
    return numbers > 1 and numbers == line.count(",")


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]
    except csv.Error:
        return [line]


def _is_header(row: list[str], rows: list[list[str]]) -> bool:
    """Return whether a row has words where those below it have numbers or times, and no values of its own there.

    Whole numbers may be names, as ids of anchors are, if another cell of the row is a word.
    """
    below = [ColumnSample("", tuple(cells)).in_usual_form() for cells in zip(*rows)]
    cells = [ColumnSample("", (cell,)).in_usual_form() for cell in row]
    if not rows:
        return all(cell.kind == "text" for cell in cells)
    of_values = [cell for cell, column in zip(cells, below) if column.kind in ("numbers", "times")]
    values = [cell.cells[0] for cell in of_values if cell.kind in ("numbers", "times")]
    words = [cell for cell in cells if cell.kind == "text" and not any(map(str.isdigit, cell.cells[0]))]
    may_be_names = all(map(str.isdigit, values)) and bool(words)
    return any(cell.kind == "text" for cell in of_values) and (not values or may_be_names)


def _is_second_header(row: list[str], rows: list[list[str]]) -> bool:
    """Return whether a row below the header holds units, or more of the names."""
    return _is_header(row, rows) and not any(map(_NUMBER.fullmatch, row))


def _is_title(rows: list[list[str]], num: int) -> bool:
    """Return whether the first of some rows is a line of text that has as many words as the table has columns."""
    body = [row for row in rows if len(row) == num]
    return (
        len(body) > 2
        and len(rows[0]) == len(rows[1]) == num
        and _is_header(body[0], body[2:])
        and _is_second_header(body[1], body[2:])
        and not {word for cell in body[1] for word in words_of(cell)} <= _UNITS
    )


def _num_padded(rows: list[list[str]], num: int) -> int:
    """Return the number of lines of title above the header, which spreadsheets fill up with empty cells."""
    for k, row in enumerate(rows[:_MAX_NUM_WORDS] if "" in rows[0] else ()):
        has_more = k == 0 or (len(row) == num and row.count("") < rows[0].count(""))
        if has_more and _is_header(row, [below for below in rows[k + 1 :] if len(below) == num]):
            return k
    return 0


def _unique(names: list[str], num: int) -> list[str]:
    filled = [name or f"column {k + 1}" for k, name in enumerate([*names, *[""] * (num - len(names))])]
    return [name if filled.index(name) == k else f"{name} ({k + 1})" for k, name in enumerate(filled)]


def _read_records(path: Path) -> TextTable | None:
    """Read a file of records as a table, or return None if it is not one.

    A record that holds several ranges gives a row for each. A cell is empty if its record has no such value.
    """
    head = read_head(path).lstrip()
    if _GSI_BLOCK.match(head):
        numbered = [*_gsi_records(read_text(path, errors="replace"))]
    elif head.startswith(("{", "[{")) or _share_json(head) > _MIN_SHARE_JSON:
        numbered = list(_json_records(read_text(path)))
    elif _share_named(head) > _MIN_SHARE_NAMED:
        text = read_text(path, errors="replace")
        numbered = list(_blocks(text) if _BLOCK in text else _named_records(text))
    else:
        return None
    names = tuple(dict.fromkeys(name for _, record in numbered for name in record))
    cells = {name: [record.get(name, "") for _, record in numbered] for name in names}
    return TextTable(path, np.array([line for line, _ in numbered], np.int64), cells) if names else None


def _share_named(head: str) -> float:
    """Return the share of complete lines or blocks that hold at least two named values."""
    units = [unit for _, unit in _units(head)][:-1]
    return sum(len(_NAMED.findall(unit)) > 1 for unit in units) / len(units) if units else 0.0


def _share_json(head: str) -> float:
    """Return the share of complete lines that end in a JSON object, whatever is in front of it."""
    rows = [row for row in head.split("\n")[:-1] if row.strip()]
    return sum(any(True for _ in _json_records(row)) for row in rows) / len(rows) if rows and "{" in head else 0.0


def _units(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text, or its blocks if it has any, each with the number of its first line."""
    line, end = 1, _BLOCK if _BLOCK in text else "\n"
    for unit in text.split(end):
        if unit.strip():
            yield line, unit
        line += unit.count("\n") + end.count("\n")


def _named_records(text: str) -> Iterator[tuple[int, NamedValues]]:
    """Yield the record of each line or block, with its line number.

    A time without a name comes first, as "time". A name that is repeated gets a number.
    """
    for line, unit in _units(text):
        time = CIVIL_TIME.search(unit) or TIME_OF_DAY.search(unit)
        counted = _ESP_IDF.match(unit)
        record = {"time": time[0]} if time else {"time_ms": counted[1]} if counted else {}
        num = Counter[str]()
        for found in _NAMED.finditer(unit):
            name, value = filter(None, found.groups())
            num[name] += 1
            record[name if num[name] == 1 else f"{name}.{num[name]}"] = value.strip('"')
        yield line, record


def _blocks(text: str) -> Iterator[tuple[int, NamedValues]]:
    for line, unit in _units(text):
        rows = [row for row in unit.split("\n") if row.strip() not in ("", "---")]
        lines = [(len(row) - len(row.lstrip()), row.strip()) for row in rows]
        yield from ((line, record) for record in _flat(_nested(lines)))


def _nested(lines: Sequence[tuple[int, str]]) -> Any:
    """Return the content of indented lines of YAML, as far as printed messages use it."""
    indent, first = lines[0] if lines else (0, "")
    is_list = first.startswith("- ") or first == "-"
    if not is_list and not _KEY.fullmatch(first):
        return _value(first)
    # The items of a list may have the same indentation as the list's key.
    starts = [k for k, (at, text) in enumerate(lines) if at == indent and (is_list or not text.startswith("-"))]
    parts = [lines[k:stop] for k, stop in zip(starts, [*starts[1:], len(lines)])]
    if is_list:
        return [_nested([(at + 2, text[2:]) for at, text in part[:1] if text[2:]] + [*part[1:]]) for part in parts]
    keys = [(_KEY.fullmatch(part[0][1]), part[1:]) for part in parts]
    return {key[1]: _value(key[2]) if key[2] else _nested(inner) for key, inner in keys if key}


def _value(text: str) -> Any:
    try:
        return json.loads(text) if text.startswith("[") else text.strip("'\"")
    except (ValueError, RecursionError):
        return text


def _json_records(text: str) -> Iterator[tuple[int, NamedValues]]:
    """Yield each record with its line number. A time in front of an object is in its records as "received_time".

    Objects may also be written as Python writes them, with single quotes.
    """
    decoder, at, line, counted = json.JSONDecoder(), 0, 1, 0
    while (begin := text.find("{", at)) >= 0:
        line, counted = line + text.count("\n", counted, begin), begin
        time = time_in_front(text[at:begin].rpartition("\n")[2])
        try:
            if text.startswith("{'", begin):
                end = (text.find("\n", begin) + 1 or len(text) + 1) - 1
                value, at = _python_literal(text[begin:end].rstrip()), end
            else:
                value, at = decoder.raw_decode(text, begin)
        except (ValueError, SyntaxError, MemoryError, RecursionError):  # a truncated line, or not a record
            at = begin + 1
            continue
        records = _flat(value) if isinstance(value, dict) else []
        yield from ((line, {**record, "received_time": time} if time else record) for record in records)


def _python_literal(text: str) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)  # of escapes in the texts
        return ast.literal_eval(text)


def _flat(value: Any) -> list[NamedValues]:
    """Return a record for each object in the value's lists, with the values outside of lists, or else one record."""
    common, each = _common_and_each(value, "")
    return [{**common, **record} for record in each] or [common]


def _common_and_each(value: Any, name: str) -> tuple[NamedValues, list[NamedValues]]:
    if isinstance(value, list) and value and all(isinstance(inner, (dict, list)) for inner in value):
        found = [_common_and_each(inner, name) for inner in value]
        return {}, [{**common, **record} for common, each in found for record in each or [{}]]
    if not isinstance(value, (dict, list)):
        return {name: "null" if value is None else str(value)}, []
    within = f"{name}." if name else ""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    found = [_common_and_each(item, f"{within}{key}") for key, item in inner]
    whole = {key: cell for common, _ in found for key, cell in common.items()}
    return whole, [record for _, each in found for record in each]


_GSI_WORD = re.compile(r"(\d\d)[\d.]{3}([\d.])([+-])(\w{16}|\w{8})(?=\s|$)", re.ASCII)
_GSI_BLOCK = re.compile(r"\*?11\d{4}[+-]", re.ASCII)
_GSI_POINT = "11"
# Word indices of east, north and height: of the point that was measured, or else of the station.
_GSI_COORDINATES = (("81", "82", "83"), ("84", "85", "86"))
# Length of one unit in the last place, in metres, by the digit for units.
_GSI_METRES = {"0": 1e-3, "1": 0.3048e-3, "6": 1e-4, "7": 0.3048e-4, "8": 1e-5}


def _gsi_records(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield point, east, north and height (metres) of each block that has coordinates, with its line number."""
    for line, block in enumerate(text.split("\n"), 1):
        words = {found[1]: found for found in _GSI_WORD.finditer(block)}
        indices = next((three for three in _GSI_COORDINATES if {*three} & words.keys()), None)
        if _GSI_BLOCK.match(block.lstrip()) and _GSI_POINT in words and indices is not None:
            names = ("east m", "north m", "height m")
            values = (_metres(words[index]) if index in words else "" for index in indices)
            yield line, {"point": words[_GSI_POINT][4].lstrip("0") or "0", **dict(zip(names, values))}


def _metres(word: re.Match[str]) -> str:
    """Return a word's value in metres as text, or the word as it is, which is no number, if its unit is not known."""
    unit_m = _GSI_METRES.get(word[2])
    return word[0] if unit_m is None or not word[4].isdigit() else f"{int(word[3] + word[4]) * unit_m:.5f}"
