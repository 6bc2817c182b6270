"""Seeded damage to files: to bytes, and to the cells and lines of text."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

_CELL_ENDS = re.compile(rb"[,;\t \n=:()\[\]\"']")
# Cells that break parsers of numbers, names and structure, or exceed their limits.
_CELLS = (
    *(
        b"",
        b" ",
        b"0",
        b"-0",
        b"-1",
        b"1",
        b"nan",
        b"inf",
        b"-inf",
        b"1e308",
        b"-1e308",
        b"1e309",
        b"5e-324",
        b"1e-300",
    ),
    *(b"9007199254740993", b"18446744073709551616", b"-9223372036854775809", b"1" * 400, b"1_000"),
    *(b"0x10", b"1e5000", b"2026-13-45T99:99:99Z", b"0000-00-00T00:00:00", b"9999-12-31T23:59:59+99:99", b"24:60:61"),
    *(b"tag", b"A1", b"x", b"true", b"None", b"../../x", b"/etc/passwd", b"a" * 70, b"<script>alert(1)</script>"),
    *(
        "ä".encode(),
        "\u202e".encode(),
        "\u0663".encode(),
        "\u2028".encode(),
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\x00",
        b"\x85",
    ),
    *(
        b"\x85",
        b'"',
        b"'",
        b"#",
        b"\\",
        b"%s",
        b"\r",
        b"\r\n",
        b"\n\n",
        b",",
        b",,",
        b";",
        b"\t",
        b"[",
        b"]",
        b"{",
        b"}",
        b"[[",
    ),
)
_MAX_REPEATS = 40


def mutated(data: bytes, rng: random.Random, max_size: int) -> bytes:
    """Return ``data`` with one to four changes, no longer than ``max_size``."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(_CHANGES)(data, rng)[:max_size]
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:start] + data[end:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:end] + data[start:end] * rng.randrange(1, _MAX_REPEATS) + data[end:]


def _insert(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.choice(_CELLS) + data[place:]


def _change_cell(data: bytes, rng: random.Random) -> bytes:
    ends = [0, *(match.end() for match in _CELL_ENDS.finditer(data)), len(data) + 1]
    number = rng.randrange(len(ends) - 1)
    return data[: ends[number]] + rng.choice(_CELLS) + data[ends[number + 1] - 1 :]


def _move_lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    line = lines.pop(rng.randrange(len(lines)))
    for _ in range(rng.randrange(3)):
        lines.insert(rng.randrange(len(lines) + 1), line)
    return b"\n".join(lines)


_CHANGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *(_flip, _cut, _remove, _repeat, _insert, _insert, _change_cell, _change_cell, _change_cell, _move_lines),
)
