"""GSI files of Leica's surveying instruments: the coordinates of each measured point."""

from __future__ import annotations

import re
from collections.abc import Iterator

_WORD = re.compile(r"(\d\d)[\d.]{3}([\d.])([+-])(\w{16}|\w{8})(?=\s|$)", re.ASCII)
_BLOCK = re.compile(r"\*?11\d{4}[+-]", re.ASCII)
_POINT = "11"
# Word indices of east, north and height: of the point that was measured, or else of the station.
_COORDINATES = (("81", "82", "83"), ("84", "85", "86"))
# Length of one unit in the last place, in metres, by the digit for units.
_METRES = {"0": 1e-3, "1": 0.3048e-3, "6": 1e-4, "7": 0.3048e-4, "8": 1e-5}


def is_gsi(head: str) -> bool:
    """Return whether a file with this beginning is a GSI file with measured points."""
    return _BLOCK.match(head.lstrip()) is not None


def gsi_records(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield point, east, north and height (metres) of each block that has coordinates, with its line number."""
    for line, block in enumerate(text.split("\n"), 1):
        words = {found[1]: found for found in _WORD.finditer(block)}
        indices = next((three for three in _COORDINATES if {*three} & words.keys()), None)
        if _BLOCK.match(block.lstrip()) and _POINT in words and indices is not None:
            names = ("east m", "north m", "height m")
            values = (_metres(words[index]) if index in words else "" for index in indices)
            yield line, {"point": words[_POINT][4].lstrip("0") or "0", **dict(zip(names, values))}


def _metres(word: re.Match[str]) -> str:
    """Return a word's value in metres as text, or the word as it is, which is no number, if its unit is not known."""
    unit_m = _METRES.get(word[2])
    return word[0] if unit_m is None or not word[4].isdigit() else f"{int(word[3] + word[4]) * unit_m:.5f}"
