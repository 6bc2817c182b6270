"""Tables in text: reading and writing of CSV and similar files, and the layout of tables that commands print.

A table in a file has a header row. ``#`` comments and blank lines may be anywhere. A byte order mark, any line ending,
Windows-1252 and quoted cells are understood. Every error is an InputError with the line.

A written table is read back unchanged. A first cell that begins with ``#`` is quoted, because its row would otherwise
be a comment. Text that a spreadsheet would compute as a formula gets an apostrophe in front. Spreadsheets mark text in
the same way, and reading removes the apostrophe.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import re
import zlib
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Categories
from rangesfm.errors import InputError, printable
from rangesfm.option_model import Bounds
from rangesfm.util.files.atomic import new_file
from rangesfm.util.files.contents import AnyPath, open_regular, stand_in

MAX_NUMBER = 1e100
"""The largest number in any file; its squares are finite."""
A_NUMBER: Final = Bounds(-MAX_NUMBER, MAX_NUMBER, "")
"""Bounds of every number that can be squared."""
NO_NAMES: Final[Mapping[str, str]] = MappingProxyType({})
FOUND: Final = ""
"""Separator that is found from the header row."""
_HEAD_BYTES = 1 << 16
_GZIP_MARK = b"\x1f\x8b"
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
# Beginning of a formula, also in the full-width characters of East Asian keyboards, after any apostrophes.
_FORMULA = re.compile(r"'*\s*[=+\-@\uff1d\uff0b\uff0d\uff20]")
_MAY_BEGIN_FORMULA = frozenset("'=+-@\uff1d\uff0b\uff0d\uff20 \u3000\xa0\t")
_WINDOWS = "cp1252"
# Signs of Windows-1252 beside its letters that occur in tables: units, quotes, dashes, and the blank of thousands.
_WINDOWS_SIGNS = "\xb0\xb2\xb3\xb5\xb1\xa7\xb7\xa0\u20ac\u2018\u2019\u201c\u201d\u201e\u2013\u2014\u2026"


@dataclass(frozen=True)
class TextTable:
    """Columns of a file, n rows. A column is called by its name in the file, or by the quantity that it holds.

    Attributes:
        line: (n,) 1-based line of each row.
        cells: the cells of each column.
        names: the name in the file of each column that is called by its quantity.
        units: the unit of the numbers of each column, where it is not a part of its name.
        missing: texts of a cell, in small letters, that counts as empty.
        notes: lines for the user about how the file was read.
    """

    path: Path
    line: npt.NDArray[np.int64]
    cells: Mapping[str, list[str]]
    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    missing: Collection[str] = ("",)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.line)

    def where(self, chosen: Sequence[bool]) -> TextTable:
        """Return the table with the rows that are true in ``chosen``."""
        cells = {name: [*compress(texts, chosen)] for name, texts in self.cells.items()}
        return replace(self, line=self.line[np.array(chosen)], cells=cells)

    def by_quantity(self, columns: Mapping[str, str]) -> TextTable:
        """Return the table with columns by quantity, given the name of each; those that the file lacks are left out."""
        names = {quantity: name for quantity, name in columns.items() if name in self}
        cells = {quantity: self.cells[name] for quantity, name in names.items()}
        units = {quantity: self.units.get(name, "") for quantity, name in names.items()}
        return replace(self, cells=cells, names=names, units=units)

    def __contains__(self, column: str) -> bool:
        return column in self.cells

    def heading(self, column: str) -> str:
        """Return the name of a column in the file and its unit."""
        return f"{self.names.get(column, column)} {self.units.get(column, '')}".strip()

    @property
    def told(self) -> tuple[str, ...]:
        """The notes, each with the name of the file."""
        return tuple(f"{self.path.name}: {note}" for note in self.notes)

    def text(self, column: str, *, empty: str | None = None) -> list[str]:
        """Return the cells without surrounding blanks.

        ``empty`` replaces empty cells and a missing column; None refuses them.
        """
        if column not in self and empty is not None:
            return [empty] * len(self)
        texts = [_without_mark(cell.strip()) for cell in self.cells[column]]
        if "" in texts:
            if empty is None:
                raise self.error(texts.index(""), column, "some text")
            texts = [text or empty for text in texts]
        return texts

    def begins_with_number(self, column: str) -> bool:
        """Return whether the first cell of the column is a number, or there is no cell."""
        cells = self.cells[column]
        return not cells or _number(cells[0]) is not None

    def categories(self, column: str, *, empty: str | None = None) -> Categories:
        """Return the cells like ``text``, but as categories, which is fast where few texts differ."""
        raw = Categories.from_texts(self.cells[column])
        names = [_without_mark(name.strip()) for name in raw.names]
        if "" in names and empty is None:
            raise self.error(int(np.argmax(raw.index == names.index(""))), column, "some text")
        kinds = Categories.from_texts([name or str(empty) for name in names])
        return Categories(kinds.names, kinds.index[raw.index])

    def numbers(
        self,
        column: str,
        *,
        empty: float | None = None,
        missing: Collection[str] = (),
        bounds: Bounds = A_NUMBER,
        expected: str = "",
    ) -> npt.NDArray[np.float64]:
        """Return the cells as finite numbers (n,).

        Args:
            empty: value of empty cells and of a missing column; if it is None, empty cells are refused.
            missing: texts of a cell that counts as empty, beside those of the table.
            bounds: bounds of valid numbers; A_NUMBER: every number that can be squared.
            expected: description of a valid cell, for messages; empty: by the bounds.

        Raises:
            InputError: a cell is not valid; the error gives the line.
        """
        any_number = bounds is A_NUMBER
        expected = expected or ("a number" if any_number else str(bounds)) + ", or nothing" * (empty is not None)
        if column not in self and empty is not None:
            return np.full(len(self), empty)
        cells = self.cells[column]
        values = np.array(list(map(_number, cells)), np.float64)
        bad = np.flatnonzero(~np.isfinite(values)).tolist()
        for row in bad:
            if empty is None or cells[row].strip().lower() not in (*self.missing, *missing):
                raise self.error(row, column, expected)
            values[row] = empty
        wrong = ~bounds.hold(values)
        wrong[bad] = False
        self.refuse(wrong, column, f"{expected}, at most {MAX_NUMBER:g}" if any_number else expected)
        return values

    def error(self, row: int, column: str, expected: str) -> InputError:
        """Return the error that says what is in ``column`` of the 0-based ``row``, and what was expected."""
        cell = self.cells[column][row].strip()
        found = "empty" if not cell else cell if _number(cell) is not None else f"'{printable(cell)}'"
        name = self.names.get(column, column)
        return InputError(f"{name} is {found}, expected {expected}", self.path, int(self.line[row]))

    def refuse(self, wrong: npt.NDArray[np.bool_], column: str, expected: str) -> None:
        """Raise the error of the first row that is true in ``wrong`` (n,), if there is one."""
        if wrong.any():
            raise self.error(int(np.argmax(wrong)), column, expected)


def read_table(
    path: AnyPath,
    required: Sequence[str],
    optional: Sequence[str] = (),
    *,
    aliases: Mapping[str, str] = NO_NAMES,
    separator: str = ",",
) -> TextTable:
    """Read the named columns of a file; other columns are ignored.

    Args:
        aliases: other names of columns in the file, ``{name in the file: name}``.
        separator: one character; a blank means any run of blanks; FOUND: by the header row.

    Raises:
        InputError: the file is missing, empty or not text, lacks a column, or has a row with too
            few or too many cells.
    """
    path = Path(path)
    rows = ((line, row) for line, row in enumerate(read_text(path).split("\n"), 1) if _has_content(row))
    header_line, header_row = next(rows, (0, ""))
    if not header_row:
        raise InputError(f"the file is empty, expected a header row with {_listed(required)}", path)
    separator = separator or guess_separator(header_row)
    if len(separator) != 1 or separator in '"\r\n\0#':
        raise InputError(f"separator is {separator!r}, expected one character", path)
    known = (*required, *optional)
    found = [cell.strip() for cell in _split_row(header_row, separator, path, header_line)]
    names = [name if name in known else aliases.get(name, name) for name in found]
    if all(_number(name) is not None for name in names):
        raise InputError(f"no header row, expected {_expected(required, optional)}", path, header_line)
    _check_names(names, required, optional, path, header_line)
    wanted = {name: names.index(name) for name in known if name in names}
    lines: list[int] = []
    columns: dict[str, list[str]] = {name: [] for name in wanted}
    for line, row in rows:
        if row == header_row:  # in joined files the header row is repeated
            continue
        cells = _split_row(row, separator, path, line)
        while len(cells) > len(names) and not cells[-1].strip():  # spreadsheets end rows with empty cells
            cells.pop()
        if len(cells) != len(names):
            raise InputError(f"has {num_cells(cells)}, the header row has {len(names)}", path, line)
        lines.append(line)
        for name, index in wanted.items():
            columns[name].append(cells[index])
    return TextTable(path, np.array(lines, dtype=np.int64), columns)


def read_without_header(
    path: AnyPath,
    columns: Sequence[str],
    optional: Sequence[str] = (),
    *,
    has_more: bool = False,
    is_no_row: Callable[[str], object] = lambda line: line.startswith("#"),
) -> TextTable:
    """Read a file whose columns are known and not named in it, set apart by commas, semicolons, tabs or blanks.

    Args:
        optional: columns after the others that a row may lack.
        has_more: whether rows may have further cells, which are ignored.
        is_no_row: says which lines are not rows, given without blanks in front of them.

    Raises:
        InputError: there is no row, or one has too few or too many cells.
    """
    path, expected, most = Path(path), " ".join(columns), len(columns) + len(optional)
    lines, rows = list[int](), list[list[str]]()
    for line, text in enumerate(read_text(path).split("\n"), 1):
        if not text.strip() or is_no_row(text.lstrip()):
            continue
        ways = [text.split(separator) for separator in (",", ";", "\t", None)]
        cells = next((cells for cells in ways if len(cells) >= len(columns)), max(ways, key=len))
        if len(cells) < len(columns) or (len(cells) > most and not has_more):
            raise InputError(f"has {num_cells(cells)}, expected {expected}", path, line)
        lines.append(line)
        rows.append([*(cell.strip() for cell in cells), *[""] * most][:most])
    if not rows:
        raise InputError(f"holds no row, expected {expected}", path)
    cells_of = dict(zip((*columns, *optional), map(list, zip(*rows, strict=True)), strict=True))
    return TextTable(path, np.array(lines, dtype=np.int64), cells_of)


def num_cells(cells: Sequence[str]) -> str:
    """Return how many cells a row has, for messages."""
    return f"{len(cells)} cell{'s' * (len(cells) != 1)}"


def write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a CSV file, complete or not at all."""
    with new_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        plain = csv.writer(file, lineterminator="\n")
        quoted = csv.writer(file, lineterminator="\n", quoting=csv.QUOTE_ALL)
        for row in (header, *rows):
            cells = [
                f"'{cell}" if cell[:1] in _MAY_BEGIN_FORMULA and _FORMULA.match(cell) and not is_number(cell) else cell
                for cell in row
            ]
            (plain if _has_content(cells[0]) else quoted).writerow(cells)


def _without_mark(cell: str) -> str:
    """Return the content of a written cell, without the apostrophe that marks it as text."""
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


def write_user_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a CSV file to a path that the user gave.

    Raises:
        InputError: it cannot be written.
    """
    try:
        write_table(path, header, rows)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from error


def repeated(keys: Iterable[Hashable]) -> tuple[int, int] | None:
    """Return the index of the first key that repeats an earlier one, and that one's index; None if all differ."""
    first: dict[Hashable, int] = {}
    return next(((k, first[key]) for k, key in enumerate(keys) if first.setdefault(key, k) != k), None)


def read_text(path: AnyPath, *, errors: str = "strict") -> str:
    """Read a whole text file with line feeds as line ends, without a byte order mark.

    It is UTF-8, UTF-16 with its byte order mark, or Windows-1252, in which many spreadsheets save CSV.

    Args:
        errors: "strict": bytes that are not text raise an InputError; "replace": they are replaced.
    """
    data = _read_bytes(path)
    try:
        text = data.decode(_encoding(data), errors)
    except UnicodeDecodeError as error:
        if not _is_windows_text(data):
            line = data.count(b"\n", 0, error.start) + 1
            raise InputError(f"not UTF-8 text (byte 0x{data[error.start]:02x}): save it as UTF-8", path, line) from None
        text = data.decode(_WINDOWS)
    text = text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    return _with_plain_minus(text)


def _with_plain_minus(text: str) -> str:
    """Return a text with minus signs of typesetting in front of digits as those that programs write."""
    return re.sub("\u2212(?=[0-9.,])", "-", text) if "\u2212" in text else text


def read_head(path: AnyPath) -> str:
    """Read the first part of a file like ``read_text``; bytes that are not text are replaced."""
    data = _read_bytes(path, _HEAD_BYTES)
    encoding = _WINDOWS if _is_windows_text(data) else _encoding(data)
    return _with_plain_minus(data.decode(encoding, errors="replace").replace("\r\n", "\n").replace("\r", "\n"))


def header_names(text: str, separator: str = FOUND) -> list[str]:
    """Return the cells of the first line that is neither blank nor a comment; empty if it is not a row of cells."""
    row = next(filter(_has_content, text.split("\n")), "")
    try:
        return [cell.strip() for cell in _split_row(row, separator or guess_separator(row), Path(), 1)]
    except InputError:
        return []


def has_columns(text: str, required: Collection[str], aliases: Mapping[str, str] = NO_NAMES) -> bool:
    """Return whether the header row in a file's beginning names the required columns, as ``read_table`` reads it."""
    return {*required} <= {aliases.get(name, name) for name in header_names(text)}


def is_plain_table(text: str, required: Collection[str], aliases: Mapping[str, str] = NO_NAMES) -> bool:
    """Return whether a file's beginning has the required columns and no decimal commas, as ``read_table`` reads it."""
    header_row = next(filter(_has_content, text.split("\n")), "")
    return has_columns(text, required, aliases) and ("," in header_row or "," not in text)


def guess_separator(row: str) -> str:
    """Return the most frequent of comma, semicolon and tab in a row, or a blank if it has none of them."""
    separator = max(",;\t", key=row.count)
    return separator if separator in row else " "


def _read_bytes(path: AnyPath, num: int = -1) -> bytes:
    """Return the first bytes of a file, all by default, unpacked if it is packed; errors are InputErrors."""
    data = _stored_bytes(path, num)
    if what := stand_in(path, data):
        raise InputError(what, path)
    return data


def _stored_bytes(path: AnyPath, num: int) -> bytes:
    try:
        with open_regular(path) as file:
            if os.fstat(file.fileno()).st_size == 0:  # like the kernel's own files, some of which never end
                return b""
            packed = file.read(len(_GZIP_MARK)) == _GZIP_MARK
            file.seek(0)
            if not packed:
                return file.read(num)
            with gzip.open(file) as unpacked:
                return unpacked.read(num)
    except FileNotFoundError:
        raise InputError("no such file", path) from None
    except IsADirectoryError:
        raise InputError("is a folder, expected a file", path) from None
    except (OSError, ValueError, EOFError, zlib.error) as error:  # ValueError comes with a name that no file can have
        raise InputError(f"cannot be read ({getattr(error, 'strerror', None) or error})", path) from None


def _encoding(data: bytes) -> str:
    return "utf-16" if data.startswith(_UTF16_MARKS) else "utf-8-sig"


def _is_windows_text(data: bytes) -> bool:
    """Return whether the beginning of a file is no UTF-8 but text in Windows-1252 as people write it in tables."""
    try:
        data.decode(_encoding(data))
        return False
    except UnicodeDecodeError as error:
        if error.reason == "unexpected end of data":  # the beginning ends inside a character of UTF-8
            return False
    if data.startswith(_UTF16_MARKS) or any(byte < 32 and byte not in b"\t\n\r\f" for byte in set(data)):
        return False
    try:
        unusual = set(data.decode(_WINDOWS)) - set(map(chr, range(128)))
    except UnicodeDecodeError:
        return False
    # The last character, byte 0xff, is what erased memory holds, and hardly any language writes it.
    return all((character.isalpha() and character != "\xff") or character in _WINDOWS_SIGNS for character in unusual)


def _has_content(line: str) -> bool:
    return line.lstrip()[:1] not in "#"  # the empty string is in every string


def _split_row(row: str, separator: str, path: Path, line: int) -> list[str]:
    if '"' not in row:
        return row.split(None if separator == " " else separator)
    try:
        cells = next(csv.reader([row], delimiter=separator, skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise InputError(f"not a row of cells ({error})", path, line) from None
    return cells


def _check_names(names: list[str], required: Sequence[str], optional: Sequence[str], path: Path, line: int) -> None:
    for name in required:
        if name not in names:
            found, expected = _listed(names), _expected(required, optional)
            raise InputError(f"no column {name}; found {found}; expected {expected}", path, line)
    for name in (*required, *optional):
        if names.count(name) > 1:
            raise InputError(f"{names.count(name)} columns are named {name}, expected one", path, line)


def _expected(required: Sequence[str], optional: Sequence[str]) -> str:
    return _listed(required) + (f" (and possibly {_listed(optional)})" if optional else "")


def is_number(cell: str) -> bool:
    """Return whether a cell is a number."""
    return _number(cell) is not None


def _number(cell: str) -> float | None:
    """Return a cell as a float, or None if it is not a number; Python's own notation ``1_000`` is not one."""
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _listed(names: Iterable[str]) -> str:
    return printable(", ".join(names))


def align_rows(rows: Iterable[Sequence[str]], *, num_left: int = 1) -> str:
    """Format rows as lines of text with aligned columns, by the width of characters on a terminal.

    Args:
        rows: rows of equal length; text that looks like markup is shown as it is.
        num_left: number of left-aligned columns; the others are right-aligned.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    for row in rows:
        while len(table.columns) < len(row):
            table.add_column(justify="left" if len(table.columns) < num_left else "right", no_wrap=True)
        table.add_row(*map(Text, row))
    lines = io.StringIO()
    Console(file=lines, width=1 << 20).print(table)  # wide enough that nothing is cut
    return "\n".join(line.rstrip() for line in lines.getvalue()[:-1].split("\n"))
