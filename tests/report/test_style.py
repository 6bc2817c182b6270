"""The page's colours are readable in both themes (WCAG 2 AA)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import rangesfm.report

STYLE = (Path(rangesfm.report.__file__).with_name("assets") / "page.css").read_text(encoding="utf-8")


def colors_of(theme: str) -> dict[str, str]:
    light, dark = re.findall(r":root \{(.*?)\}", STYLE, flags=re.DOTALL)
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", light if theme == "light" else dark))


def contrast(first: str, second: str) -> float:
    """Contrast ratio as WCAG 2 defines it."""

    def luminance(color: str) -> float:
        channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    darker, lighter = sorted((luminance(first), luminance(second)))
    return (lighter + 0.05) / (darker + 0.05)


def test_contrast_is_that_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_texts_are_readable(theme: str) -> None:
    colors = colors_of(theme)
    backgrounds = ["page", "card", "green-soft", "amber-soft", "red-soft", "off-soft"]
    pairs = [("ink", background) for background in backgrounds] + [("muted", "page"), ("muted", "card")]
    pairs += [("card", light) for light in ("green", "amber", "red", "off")]
    assert {
        pair: contrast(*(colors[name] for name in pair)) for pair in pairs if contrast(*(colors[n] for n in pair)) < 4.5
    } == {}


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_lines_and_marks_stand_out_from_the_card(theme: str) -> None:
    colors = colors_of(theme)
    marks = ("before", "after", "true-scale", "reference", "anchor", "rejected", "green", "amber", "red")
    assert [mark for mark in marks if contrast(colors[mark], colors["card"]) < 3.0] == []
    in_view = ("before", "after", "third", "fourth", "reference", "anchor", "chosen", "residual-negative")
    assert [mark for mark in in_view if contrast(colors[mark], colors["stage"]) < 3.0] == []
