"""Figures of the ranges: residuals over time and their distribution, and true errors where a reference tells them."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.observations import RangeStatus
from rangesfm.report.content import Content, in_natural_order
from rangesfm.report.plot import WIDE_SIZE, Figure, Panel, Series, running_median
from rangesfm.result.ranges_as_used import RangesAsUsed

NUM_HISTOGRAM_BINS = 60
NUM_MEDIAN_BINS = 48
MAX_NUM_DRAWN = 6_000
"""Ranges that a figure has a dot for; medians and histograms are of all."""

PANEL_SIZE = (270.0, 125.0)


def residuals_over_time(content: Content) -> Figure | None:
    """One panel for each anchor: residuals of its ranges before and after the refinement."""
    ranges = content.ranges
    if ranges is None or not _has_residuals(ranges):
        return None
    panels = tuple(_residual_panel(content, ranges, anchor_id) for anchor_id in in_natural_order(ranges.anchor_id))
    caption = (
        "Range residuals over time, predicted minus measured, with their running median. A steady offset is a bias; "
        "a slow wave is drift or a clock. What lies beyond an axis is drawn at its edge."
    )
    caption += _thinned(len(ranges.status))
    return Figure("range_residuals", caption, panels, layout="panels", table="ranges")


def residual_histogram(content: Content) -> Figure | None:
    """Distribution of the residuals of the ranges used, before and after."""
    ranges = content.ranges
    if ranges is None or not _has_residuals(ranges):
        return None
    limit = _residual_limit(ranges)
    edges = np.linspace(-limit, limit, NUM_HISTOGRAM_BINS + 1)
    outlines = []
    for name, color, residuals in _both(ranges):
        known = residuals[ranges.is_used & np.isfinite(residuals)]
        heights = np.histogram(np.clip(known, -limit, limit), edges)[0].astype(float)
        if heights.any():
            outlines.append(Series(name, color, outline(edges, heights), "filled"))
    highest = max(float(series.points[:, 1].max()) for series in outlines)
    panel = Panel(
        "",
        "Histogram of the range residuals before and after the refinement",
        "predicted − measured m",
        "ranges",
        tuple(outlines),
        x_range=(-limit, limit),
        y_range=(0.0, 1.08 * highest),
        verticals=((0.0, "ink"),),
    )
    caption = "Residuals of the ranges used. Real radios lean to long measurements, which here are negative."
    return Figure("range_residual_histogram", caption, (panel,))


def outline(edges: Array, heights: Array) -> Array:
    """The line around the bars of a histogram."""
    return np.column_stack([np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])])


def absolute_errors(content: Content) -> Figure | None:
    """True errors of the ranges: measured, and as both maps have them, by the reference's camera positions."""
    ranges, true_m = content.ranges, content.true_ranges_m
    if ranges is None or true_m is None:
        return None
    rows = np.flatnonzero(np.isfinite(true_m))
    if len(rows) == 0:
        return None
    stride = _stride(len(rows))
    times, time_label = _times(content, ranges)
    errors = [("measured", "rejected", ranges.range_m)]
    errors += [(name, color, residuals + ranges.range_m) for name, color, residuals in _both(ranges)]
    x_range = (float(times[rows].min()), float(times[rows].max()))
    dots, lines = [], []
    for name, color, values in errors:
        points = np.column_stack([times[rows], np.abs(values - true_m)[rows]])
        if np.isfinite(points[:, 1]).any():
            dots.append(Series(name, color, points[::stride]))
            lines.append(Series(name, color, running_median(points, x_range, NUM_MEDIAN_BINS), "line", is_data=False))
    sizes = np.concatenate([series.points[:, 1] for series in dots])
    panel = Panel(
        "",
        "Absolute range errors over time",
        time_label,
        "absolute error m",
        (*dots, *lines),
        x_range=x_range,
        y_range=(0.0, 1.1 * max(float(np.nanquantile(sizes, 0.98)), 1e-3)),
        size=WIDE_SIZE,
    )
    caption = (
        "How far ranges are from those of the reference: as measured, by the scaled map, and by the refined one, with "
        "their running medians. Ranges taken at a photo, to anchors where this map has them."
    )
    caption += _thinned(len(rows))
    return Figure("absolute_range_errors", caption, (panel,), table="range_errors")


def _residual_panel(content: Content, ranges: RangesAsUsed, anchor_id: str) -> Panel:
    times, time_label = _times(content, ranges)
    time_range = (float(np.nanmin(times)), float(np.nanmax(times)))
    limit = _residual_limit(ranges)
    is_mine = np.array(ranges.anchor_id, dtype=str) == anchor_id
    is_used = is_mine & ranges.is_used
    is_rejected = is_mine & (np.array(ranges.status, dtype=str) == RangeStatus.OUTLIER.label)
    final = _both(ranges)[-1][2]
    is_drawn = np.arange(len(times)) % _stride(len(times)) == 0
    series = [Series("rejected", "rejected", np.column_stack([times, final])[is_rejected & is_drawn])]
    medians = []
    for name, color, residuals in _both(ranges):
        points = np.column_stack([times, residuals])
        series.append(Series(name, color, points[is_used & is_drawn]))
        line = running_median(points[is_used], time_range, NUM_MEDIAN_BINS)
        medians.append(Series(name, color, line, "line", is_data=False))
    return Panel(
        f"Anchor {anchor_id}",
        f"Range residuals of anchor {anchor_id} over time",
        time_label,
        "residual m",
        (*series, *medians),
        x_range=time_range,
        y_range=(-limit, limit),
        zero_line=True,
        size=PANEL_SIZE,
    )


def _stride(num: int) -> int:
    """Every how many-th range is drawn."""
    return max(1, -(-num // MAX_NUM_DRAWN))


def _thinned(num: int) -> str:
    """What a caption says where not all are drawn."""
    return "" if _stride(num) == 1 else f" One range in {_stride(num)} is drawn; the medians are of all."


def _both(ranges: RangesAsUsed) -> list[tuple[str, str, Array]]:
    """Name, color and residuals before and, where there are any, after the refinement."""
    both = [("scaled", "before", ranges.residual_scaled_m), ("refined", "after", ranges.residual_refined_m)]
    return both if np.isfinite(ranges.residual_refined_m).any() else both[:1]


def _times(content: Content, ranges: RangesAsUsed) -> tuple[Array, str]:
    times = content.range_times_s
    if times is None or not np.isfinite(times).any():
        return np.arange(len(ranges.status), dtype=np.float64), "range number"
    return times, "time s"


def _has_residuals(ranges: RangesAsUsed) -> bool:
    return bool(np.isfinite(ranges.residual_scaled_m[ranges.is_used]).any())


def _residual_limit(ranges: RangesAsUsed) -> float:
    """Half the height of the residual axes: room for nearly all ranges used, before and after."""
    sizes = [np.abs(residuals[ranges.is_used & np.isfinite(residuals)]) for _, _, residuals in _both(ranges)]
    return max(1.15 * max(float(np.quantile(size, 0.995)) for size in sizes if len(size)), 1e-3)
