"""Large plain tables, fast: cells are found and numbers read for all rows at once.

Plain are tables of ASCII text without quotes and comments, in which every row has as many cells as the
header. Whatever else there may be is left to the reader of all tables, which also knows what to say.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_CHUNK_ROWS = 1 << 16
_MAX_WIDTH = 40
_KEY_BYTES = 8
_MAX_PASSES = 32
_NOT_PLAIN = ('"', "#", "\0")
_ZERO, _POINT, _MINUS, _LINE_END = b"0.-\n"
_MAX_EXACT = 2.0**53  # whole numbers below, divided by a power of ten up to 1e22, are rounded once: as by float()
_MAX_DIGITS = 22


@dataclass(frozen=True)
class PlainColumn:
    """The n cells of one column.

    Attributes:
        data: the whole table with _MAX_WIDTH bytes before and after it.
        start, end: (n,) where in it each cell begins and where the separator after it stands.
    """

    data: npt.NDArray[np.uint8]
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.start)

    def texts(self) -> list[str]:
        """The cells; those of equal text are one string."""
        width = int(np.max(self.end - self.start, initial=1))
        if width > _MAX_WIDTH:
            return [bytes(self.data[start:end]).decode("ascii") for start, end in zip(self.start, self.end)]
        width = max(width, 1)
        windows = np.lib.stride_tricks.sliding_window_view(self.data, width)
        raw: list[bytes] = []
        for first in range(0, len(self.start), _CHUNK_ROWS):
            start, end = self.start[first : first + _CHUNK_ROWS], self.end[first : first + _CHUNK_ROWS]
            cells = windows[start]
            cells[np.arange(width) >= (end - start)[:, np.newaxis]] = 0
            raw += cells.view(f"S{width}").ravel().tolist()
        text_of = {cell: cell.decode("ascii") for cell in dict.fromkeys(raw)}
        return list(map(text_of.__getitem__, raw))

    def categories(self) -> tuple[list[str], npt.NDArray[np.int64]]:
        """The different cells, in order of first appearance, and (n,) which of them each cell is."""
        if int(np.max(self.end - self.start, initial=0)) > _KEY_BYTES:
            texts = self.texts()
            index_of = {text: index for index, text in enumerate(dict.fromkeys(texts))}
            return list(index_of), np.fromiter(map(index_of.__getitem__, texts), np.int64, len(texts))
        keys = self._keys()
        index = np.full(len(keys), -1)
        found: list[np.uint64] = []
        first = 0
        # A few names, as nodes of a radio have: one pass for each is faster than sorting.
        while first < len(keys) and len(found) < _MAX_PASSES:
            key = keys[first]
            index[keys == key] = len(found)
            found.append(key)
            unknown = index[first:] < 0
            first = first + int(np.argmax(unknown)) if unknown.any() else len(keys)
        if first < len(keys):
            values, first_row, index = np.unique(keys, return_index=True, return_inverse=True)
            order = np.argsort(first_row)
            rank = np.empty_like(order)
            rank[order] = np.arange(len(order))
            found, index = list(values[order]), rank[index]
        return [int(key).to_bytes(_KEY_BYTES, sys.byteorder).rstrip(b"\0").decode("ascii") for key in found], index

    def _keys(self) -> npt.NDArray[np.uint64]:
        """(n,) the bytes of each cell as one number."""
        windows = np.lib.stride_tricks.sliding_window_view(self.data, _KEY_BYTES)
        keys = np.empty(len(self.start), np.uint64)
        for first in range(0, len(keys), _CHUNK_ROWS):
            rows = slice(first, first + _CHUNK_ROWS)
            cells = windows[self.start[rows]]
            cells[np.arange(_KEY_BYTES) >= (self.end[rows] - self.start[rows])[:, np.newaxis]] = 0
            keys[rows] = cells.view(np.uint64).ravel()
        return keys

    def numbers(self) -> npt.NDArray[np.float64] | None:
        """The cells just as float() reads them; None if any is not plain.

        Plain are a minus (or none), digits that make no more than 2**53, and a point among them (or none).
        """
        values = np.empty(len(self.start))
        for first in range(0, len(values), _CHUNK_ROWS):
            rows = slice(first, first + _CHUNK_ROWS)
            chunk = _parse_decimals(self.data, self.start[rows], self.end[rows])
            if chunk is None:
                return None
            values[rows] = chunk
        return values


def find_columns(text: str, num_columns: int, separator: str) -> list[PlainColumn] | None:
    """The columns of the rows in ``text``; None if they are not plain."""
    if not text.isascii() or not separator.isascii() or separator.isspace() or num_columns < 2:
        return None
    if any(character in text for character in _NOT_PLAIN):
        return None
    padding = b"\n" * _MAX_WIDTH
    last_line_end = b"" if text.endswith("\n") or not text else b"\n"
    data = np.frombuffer(b"".join([padding, text.encode("ascii"), last_line_end, padding]), np.uint8)
    inner = data[_MAX_WIDTH:-_MAX_WIDTH]
    is_cut = (inner == ord(separator)) | (inner == _LINE_END)
    cuts = np.flatnonzero(is_cut) + _MAX_WIDTH
    if len(cuts) % num_columns:
        return None
    ends_line = (data[cuts] == _LINE_END).reshape(-1, num_columns)
    if np.any(ends_line[:, :-1]) or not np.all(ends_line[:, -1]):
        return None
    starts = np.concatenate([[_MAX_WIDTH], cuts + 1])[:-1].reshape(-1, num_columns)
    ends = cuts.reshape(-1, num_columns)
    return [PlainColumn(data, starts[:, column], ends[:, column]) for column in range(num_columns)]


def _parse_decimals(
    data: npt.NDArray[np.uint8], start: npt.NDArray[np.int64], end: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64] | None:
    """Numbers from their digits; None if there is anything else.

    Cells are aligned at their ends, so that digits after the point, mostly as many in each, share a place.
    """
    length = end - start
    width = int(length.max())
    negative = data[start] == _MINUS
    num_digits = length - negative
    if num_digits.min() < 1 or width > _MAX_DIGITS:
        return None
    cells = np.lib.stride_tricks.sliding_window_view(data, width)[end - width]
    if num_digits.min() < width:
        cells[np.arange(width) < (width - num_digits)[:, np.newaxis]] = _ZERO
    is_point = cells == _POINT
    num_points = np.count_nonzero(is_point, axis=1)
    if num_points.max() > 1 or np.any(num_digits == num_points):
        return None
    cells[is_point] = _ZERO
    digits = cells - _ZERO  # unsigned: what is less than a 0 becomes large
    if digits.max() > 9:
        return None
    after_point = np.where(num_points > 0, width - 1 - is_point.argmax(axis=1), 0)
    whole = _whole_numbers(digits.astype(np.float64), is_point, after_point, num_points)
    values = np.where(negative, -whole, whole) / 10.0**after_point
    return None if whole.max() >= _MAX_EXACT else values


def _whole_numbers(
    digits: npt.NDArray[np.float64],
    is_point: npt.NDArray[np.bool_],
    after_point: npt.NDArray[np.int64],
    num_points: npt.NDArray[np.int64],
) -> npt.NDArray[np.float64]:
    """The numbers that all digits of each row make without its point, which counts as a digit 0 here.

    The digits before the point move one place down. Exact below _MAX_EXACT, and above it where less is not.
    """
    place = np.arange(digits.shape[1])[::-1]
    power = 10.0**place
    if np.all(num_points == num_points[0]) and np.all(after_point == after_point[0]):
        shifted = np.where(place > after_point[0], power / 10, power) if num_points[0] else power
        return np.asarray(digits @ shifted, np.float64)
    before = (place > after_point[:, np.newaxis]) & (num_points > 0)[:, np.newaxis]
    return np.asarray((digits * before) @ (power / 10) + (digits * ~before) @ power, np.float64)
