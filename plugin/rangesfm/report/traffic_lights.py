"""Quality checks as cards: a traffic light, the value, and the limits beside it."""

from __future__ import annotations

from rangesfm.report.checks import Check
from rangesfm.report.markup import Markup, element
from rangesfm.report.text import fixed

SYMBOLS = {"green": "✓", "amber": "!", "red": "✕", "off": "–"}
WORDS = {"green": "good", "amber": "doubtful", "red": "poor", "off": "not measured"}


def traffic_light(light: str) -> Markup:
    """A coloured disc that says the same by its symbol."""
    word = WORDS[light]
    return element("span", SYMBOLS[light], class_=f"light {light}", role="img", aria_label=word, title=word)


def card(check: Check) -> Markup:
    """One check."""
    return element(
        "div",
        element("div", traffic_light(check.light), element("h3", check.name), class_="check-name"),
        element("p", fixed(check.value, check.decimals, check.unit, nothing="not measured"), class_="check-value"),
        *_measured_against(check),
        element("p", check.meaning, class_="small"),
        class_=f"check {check.light}",
    )


def _measured_against(check: Check) -> list[Markup]:
    if check.no_matter is not None:
        return [element("p", check.no_matter, class_="small")]
    return [_gauge(check), element("p", _limits(check), class_="small")]


def _limits(check: Check) -> str:
    relation = "≥" if check.larger_is_better else "≤"
    green, amber = (
        fixed(limit, 0 if limit >= 1 else 2, check.unit) for limit in (check.green_limit, check.amber_limit)
    )
    return f"green {relation} {green} · amber {relation} {amber}"


def _gauge(check: Check) -> Markup:
    """The three zones to scale, with a needle at the value."""
    end = 100.0 if check.larger_is_better else 1.5 * check.amber_limit
    low, high = sorted((100.0 * check.green_limit / end, 100.0 * check.amber_limit / end))
    colors = ("red", "amber", "green") if check.larger_is_better else ("green", "amber", "red")
    zones = [
        element("i", class_=f"zone {color}", style=f"width:{width:.1f}%")
        for color, width in zip(colors, (low, high - low, 100.0 - high))
    ]
    needle = None
    if check.value is not None:
        needle = element("b", class_="needle", style=f"left:{min(max(100.0 * check.value / end, 0.0), 100.0):.1f}%")
    return element("div", zones, needle, class_="gauge", aria_hidden="true")
