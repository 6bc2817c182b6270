"""Numbers as a reader likes them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

from markupsafe import Markup

from rangesfm import progress

NOTHING = "–"


def _known(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def fixed(value: float | None, decimals: int, unit: str = "", *, nothing: str = NOTHING) -> str:
    """With so many decimals and a unit; ``nothing`` for what is not known."""
    number = _known(value)
    if number is None:
        return nothing
    text = f"{round(number, decimals) + 0.0:.{decimals}f}"  # no minus before what rounds to zero
    return text.replace("-", "−") + (f"\u00a0{unit}" if unit else "")


def signed(value: float | None, decimals: int, unit: str = "") -> str:
    """As ``fixed``, with a sign before positive numbers too."""
    number = _known(value)
    return ("+" if number is not None and number > 0 else "") + fixed(value, decimals, unit)


def count(value: float | None) -> str:
    """A whole number with thin spaces between thousands."""
    number = _known(value)
    return NOTHING if number is None else f"{round(number):,}".replace(",", "\u202f")


def rough(value: float | None, unit: str) -> str:
    """In two digits with a unit; "open" for what nothing determines."""
    number = _known(value)
    return "open" if number is None else f"{number:.2g}\u00a0{unit}"


def percent(share: float) -> str:
    """A share in two digits."""
    return rough(100 * share, "%")


def mistake(name: str, subject: str) -> str:
    """In a few words, for a row of a table or of a figure."""
    of_anchor = name.removeprefix("anchor's ").removeprefix("anchor ")
    return f"anchor {subject}: {of_anchor}" if of_anchor != name else f"{name} {subject}".strip()


def decimals_for(stddev: float | None, *, default: int) -> int:
    """Decimals that show two digits of the stddev."""
    if stddev is None or stddev <= 0:
        return default
    return min(max(1 - math.floor(math.log10(stddev)), 0), 12)


def duration(seconds: float | None) -> str:
    """As hours, minutes and seconds, no finer than needed."""
    number = _known(seconds)
    return NOTHING if number is None else progress.duration(number).replace(" ", "\u00a0")


def sentence(text: str) -> str:
    """A message as a sentence of its own: it begins with a capital and ends with a full stop."""
    whole = text[:1].upper() + text[1:]
    return whole if whole.endswith((".", "!", "?")) else f"{whole}."


def plain(value: Any) -> str:
    """Any JSON value on one line."""
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


def keyed(key: str, value: Any, text: str) -> str:
    """A number of ``result.json`` as the reader sees it, marked with its key (joined by dots) and its full value.

    What is no number stands as it is.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return text
    return Markup('<data value="{}" data-key="{}">{}</data>').format(repr(float(value)), key, text)


def said_once(texts: Iterable[str], others: Sequence[str] = ()) -> list[str]:
    """Texts without those that the others say already, or that begin as one before with the same measure."""
    said, measures = " ".join(others), set[str]()
    kept = []
    for text in texts:
        measure = re.split(r"[,;:(]", text)[0].strip()
        if text and text not in said and measure not in measures:
            kept.append(text)
        measures.add(measure)
    return kept
