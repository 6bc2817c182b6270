"""Units of length that files give numbers in."""

from typing import Final

FOOT_M: Final = 0.3048
"""Metres of the international foot."""

UNITS_PER_METRE: Final = {
    "m": 1.0,
    "cm": 100.0,
    "mm": 1000.0,
    "dm": 10.0,
    "km": 1e-3,
    "ft": 1 / FOOT_M,
    "in": 12 / FOOT_M,
    "yd": 1 / (3 * FOOT_M),
}

TAKEN_FOR_METRES: Final = {"mm": "millimetres", "cm": "centimetres", "ft": "feet", "in": "inches"}
"""Units whose numbers people take for metres, in words."""
