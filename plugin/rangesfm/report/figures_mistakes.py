"""Figure of the tests of mistakes: which mistakes were found, and how much the others may change the scale."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.report.content import Content
from rangesfm.report.plot import Figure, Mark, Panel, Series
from rangesfm.report.text import percent, rough, signed
from rangesfm.result.entries import MistakeEntry

MAX_NUM_ROWS = 16
# Ends of the two axes (ratio; percent of the scale). Larger values are drawn at the edge.
_MOST_EVIDENCE, _MOST_EFFECT_PERCENT = 3.0, 20.0
_ROW_HEIGHT_PX = 22.0
_COLORS = {"found": "before", "not found": "after", "would not be found, however large": "rejected"}


def mistakes_figure(content: Content) -> Iterator[Figure]:
    """Yield the figure of the mistakes: evidence on the left, largest hidden effect on the scale on the right.

    The mistakes found come first, then those that may change the scale most, up to ``MAX_NUM_ROWS``.
    """
    tests = sorted(content.summary.tests, key=lambda test: (not test.rejected, -_effect_percent(test)))
    shown = [test for test in tests if test.rejected or _effect_percent(test) > 0][:MAX_NUM_ROWS]
    if not shown:
        return
    evidence = _panel(
        "Evidence",
        "Evidence of the ranges for each mistake, and the limit of chance",
        "evidence (1: limit of chance)",
        shown,
        [math.sqrt(max(test.statistic, 0.0) / test.threshold) if test.threshold > 0 else 0.0 for test in shown],
        [_size(test) for test in shown],
        _MOST_EVIDENCE,
        lines=(("beyond chance", 1.0),),
    )
    low, high = content.summary.scale.interval_95 or (1.0, 1.0)
    could_hide = _panel(
        "What could go unnoticed",
        "Largest change of the scale by a mistake of each kind that is just not found",
        "change of the scale %",
        shown,
        [_effect_percent(test) for test in shown],
        [_smallest(test) for test in shown],
        _MOST_EFFECT_PERCENT,
        bands=(("half of the scale's 95 % interval", 0.0, 50 * math.log(high / low)),),
    )
    caption = (
        "Tests of possible mistakes. Left: the evidence for each mistake in the measurements, with its estimated size; "
        "beyond the line it is more than chance explains. Right: how much a mistake may change the scale that is just "
        "too small to be found, with that size. Values beyond an axis are drawn at its edge; the table has them."
    )
    yield Figure("mistake_tests", caption, (evidence, could_hide), layout="views")


def _panel(
    title: str,
    description: str,
    label: str,
    tests: Sequence[MistakeEntry],
    values: Sequence[float],
    right: Sequence[str],
    most: float,
    **of_panel: Any,
) -> Panel:
    end = min(1.15 * max(1.0, *values), most)
    series, marks, rows = [], [], []
    for row, (test, value, told) in enumerate(zip(tests, values, right, strict=True)):
        kind, to = _kind(test), min(value, end)
        series.append(Series(kind, _COLORS[kind], np.array([[0.0, row], [to, row]]), "line"))
        marks.append(Mark(kind, _COLORS[kind], "disc", to, row, "", test.words))
        rows.append((float(row), mistake_in_words(test.name, test.subject), told))
    return Panel(
        title,
        description,
        (label, ""),
        tuple(series),
        marks=tuple(marks),
        x_range=(0.0, end),
        y_range=(len(tests) - 0.5, -0.5),
        size=(200.0, _ROW_HEIGHT_PX * len(tests) + 10),
        rows=tuple(rows),
        **of_panel,
    )


def _kind(test: MistakeEntry) -> str:
    found, unfound, never = _COLORS
    if test.rejected:
        return found
    return unfound if test.smallest_detectable is not None else never


def _effect_percent(test: MistakeEntry) -> float:
    """Return the largest change of the scale in percent by such a mistake that is just not found.

    Infinite where no size of it would be found; 0 where the effect was not computed.
    """
    if test.effect_on_scale is not None:
        return 100 * test.effect_on_scale
    return 0.0 if test.rejected or test.smallest_detectable is not None else math.inf


def _size(test: MistakeEntry) -> str:
    if test.size is None:
        return ""
    return signed(100 * test.size, 1, "%") if test.unit == "1" else signed(test.size, 2, test.unit)


def _smallest(test: MistakeEntry) -> str:
    if test.smallest_detectable is None:
        return "never found"
    return percent(test.smallest_detectable) if test.unit == "1" else rough(test.smallest_detectable, test.unit)
