"""Figure of the loops: matches between photos of distant times, across the path."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.report.content import Content
from rangesfm.report.plot import Figure, Panel, Series, View, equal_view, views_of
from rangesfm.result.result_tables import LoopPairs


def loops_figure(content: Content) -> Figure | None:
    """Return plan and elevation of the path with the loops that were closed, and those that the ranges contradict."""
    pairs, path = content.result.read(LoopPairs), content.final
    if pairs is None or not pairs.status or path is None:
        return None
    at = dict(zip(path.image_names, path.centers, strict=True))

    def chords(status: str) -> Array:
        known = [(at[first], at[second]) for first, second in pairs.pairs(status) if first in at and second in at]
        ends = np.array(known, dtype=np.float64).reshape(-1, 2, 3)
        return np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1).reshape(-1, 3)

    lines = {
        "matches of neighbours, as before": ("before", path.centers, "line"),
        "matches that close loops": ("after", chords("closed"), "line"),
        "contradicted by the ranges": ("reference", chords("contradicted"), "dashed"),
    }
    views = tuple(_view(lines, view) for view in views_of(path.centers, content.summary.frame))
    caption = "Which photos are tied together: along the path by neighbours in time, across it by loops."
    return Figure("loops", caption, views, layout="views")


def _view(lines: dict[str, tuple[str, Array, str]], view: View) -> Panel:
    series = [
        Series(name, color, view.seen(points), kind) for name, (color, points, kind) in lines.items() if len(points)
    ]
    return view.panel("matches between photos", " m", series, equal_view(series[0].points))
