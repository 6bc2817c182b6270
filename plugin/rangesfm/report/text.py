"""Numbers and texts in the form in which the report shows them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

from markupsafe import Markup

from rangesfm import progress
from rangesfm.errors import number_text
from rangesfm.util.geometry.numerics import NORMAL_95

NOTHING = "–"


def known(value: float | None) -> float:
    """Return a number of a result, or NaN where it is unknown or not finite."""
    return math.nan if value is None or not math.isfinite(value) else float(value)


def fixed(value: float | None, decimals: int, unit: str = "", *, nothing: str = NOTHING) -> str:
    """Return a number with a fixed number of decimals and a unit, or ``nothing`` where it is unknown or not finite."""
    number = known(value)
    if math.isnan(number):
        return nothing
    return _with_unit(number, f".{decimals}f", unit)


def signed(value: float | None, decimals: int, unit: str = "") -> str:
    """Return a number as ``fixed`` does, with a plus sign before positive numbers."""
    number = known(value)
    return NOTHING if math.isnan(number) else _with_unit(number, f"+.{decimals}f", unit)


def _with_unit(number: float, spec: str, unit: str) -> str:
    return number_text(number, spec).replace("-", "−") + (f"\u00a0{unit}" if unit else "")


def count(value: float | None) -> str:
    """Return a whole number with thin spaces between thousands."""
    number = known(value)
    return NOTHING if math.isnan(number) else f"{round(number):,}".replace(",", "\u202f")


def rough(value: float | None, unit: str) -> str:
    """Return a number with two digits and its unit, or "open" where nothing determines it."""
    number = known(value)
    return "open" if math.isnan(number) else f"{number:.2g}\u00a0{unit}"


def percent(share: float | None) -> str:
    """Return a fraction as a percentage with two digits, or "open" where nothing determines it."""
    return rough(None if share is None else 100 * share, "%")


def decimals_for(stddev: float | None, *, default: int) -> int:
    """Return the number of decimals that shows two digits of a standard deviation."""
    if stddev is None or stddev <= 0:
        return default
    return min(max(1 - math.floor(math.log10(stddev)), 0), 12)


def duration(seconds: float | None) -> str:
    """Return a duration as text ("5 min 03 s") with spaces at which the browser breaks no line."""
    number = known(seconds)
    return NOTHING if math.isnan(number) else progress.format_duration(number).replace(" ", "\u00a0")


def sentence(text: str) -> str:
    """Return a message as a sentence: it begins with a capital letter and ends with a full stop."""
    whole = text[:1].upper() + text[1:]
    return whole if whole.endswith((".", "!", "?")) else f"{whole}."


def plain(value: Any) -> str:
    """Return any JSON value as text on one line."""
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}".replace("-", "−", 1) if value < 0 else f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(map(plain, value)) or NOTHING
    if isinstance(value, dict):
        return "; ".join(f"{key}: {plain(inner)}" for key, inner in value.items()) or NOTHING
    return str(value)


def keyed(key: str, value: Any, text: str, *, times: float = 1.0) -> str:
    """Return the text of a number of ``result.json``, marked in HTML with its key (joined by dots) and its full value.

    The text of any other value is returned unmarked.

    Args:
        times: factor of the number that the text shows, if it shows another unit or half a 95 % interval.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return text
    factor = "" if times == 1.0 else Markup(' data-times="{}"').format(repr(times))
    return Markup('<data value="{}" data-key="{}"{}>{}</data>').format(repr(float(value)), key, factor, text)


def within_95(key: str, stddev: float | None, decimals: int, unit: str = "") -> str:
    """Return half of the 95 % interval of a number, marked with the key of its standard deviation; see ``keyed``."""
    half = None if stddev is None else NORMAL_95 * stddev
    return keyed(key, stddev, fixed(half, decimals, unit), times=NORMAL_95)


def said_once(texts: Iterable[str], others: Sequence[str] = ()) -> list[str]:
    """Return the texts without repetitions.

    A text is left out if the others contain it, or if an earlier one begins with the same words up to the first comma,
    semicolon, colon or bracket: that is the same measure with other numbers.
    """
    said, measures = " ".join(others), set[str]()
    kept = []
    for text in texts:
        measure = re.split(r"[,;:(]", text)[0].strip()
        if text and text not in said and measure not in measures:
            kept.append(text)
        measures.add(measure)
    return kept
