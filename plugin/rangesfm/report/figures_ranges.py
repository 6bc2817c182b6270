"""Figures of ranges: residuals and true errors of a result, the ranges of a log, and the error curve of a radio."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.errors.error_curve import ErrorCurve
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.report.content import Content
from rangesfm.report.plot import (
    WIDE_SIZE,
    Figure,
    Panel,
    Range,
    Series,
    every_nth,
    figure_of,
    from_zero,
    histogram,
    running_median,
    time_axis,
)
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.util.files.clock_times import time_text
from rangesfm.util.files.folders import natural_order
from rangesfm.util.geometry.moments import ByPhoto

NUM_HISTOGRAM_BINS = 60
NUM_MEDIAN_BINS = 48
MAX_NUM_DRAWN = 6_000
"""Largest number of dots in a figure. Medians and histograms use all ranges."""

PANEL_SIZE = (270.0, 125.0)
_SIZE_ALONE = (660.0, 330.0)
_COLORS = {"measured": "rejected", "scaled": "before", "refined": "after"}


def residuals_over_time(content: Content) -> Iterator[Figure]:
    """Yield the figure of range residuals over time, with a panel for each anchor.

    The dots are of the final map alone: those of two maps, one over the other, would have the colour of neither.
    """
    ranges = content.ranges
    if not _of_used(ranges):
        return
    panels = tuple(
        _residual_panel(content, ranges, anchor_id) for anchor_id in sorted({*ranges.anchor_id}, key=natural_order)
    )
    caption = (
        "Range residuals (predicted minus measured) over time: dots of the final map, and running medians of the "
        "ranges used. A steady offset is a bias; a slow wave is drift of the map or an error of the time offset. "
        "Values beyond an axis are drawn at its edge." + _thinned(len(ranges.status))
    )
    yield Figure("range_residuals", caption, panels, layout="panels", table="ranges")


def residual_histogram(content: Content) -> Iterator[Figure]:
    """Yield the histogram of the residuals of the ranges used, before and after the refinement."""
    ranges = content.ranges
    if not _of_used(ranges):
        return
    limit = _residual_limit(ranges)
    edges = np.linspace(-limit, limit, NUM_HISTOGRAM_BINS + 1)
    outlines = [
        Series(name, _COLORS[name], histogram(known, edges), "filled") for name, known in _of_used(ranges).items()
    ]
    yield figure_of(
        "range_residual_histogram",
        "Residuals of the ranges used. Real radios measure too long more often than too short; such residuals are "
        "negative.",
        "Histogram of the range residuals before and after the refinement",
        ("predicted − measured m", "ranges"),
        outlines,
        x_range=(-limit, limit),
        y_range=from_zero(outlines),
        lines=(("", 0.0),),
    )


def absolute_errors(content: Content) -> Iterator[Figure]:
    """Yield the figure of the true errors of ranges: as measured, and as predicted by both maps.

    The true ranges follow from the camera positions of the reference.
    """
    ranges, true_m = content.ranges, content.true_ranges_m
    rows = np.flatnonzero(np.isfinite(true_m))
    if not len(rows):
        return
    times, time_label = time_axis(content.range_times_s)
    lengths = {"measured": ranges.range_m}
    lengths |= {name: residuals + ranges.range_m for name, residuals in ranges.residuals_by_model_m.items()}
    points = {name: np.column_stack([times, np.abs(m - true_m)])[rows] for name, m in lengths.items()}
    points = {name: errors for name, errors in points.items() if np.isfinite(errors[:, 1]).any()}
    x_range = (float(times[rows].min()), float(times[rows].max()))
    dots = [
        Series(name, _COLORS[name], errors[:: every_nth(len(rows), MAX_NUM_DRAWN)]) for name, errors in points.items()
    ]
    sizes = np.concatenate([series.points[:, 1] for series in dots])
    yield figure_of(
        "absolute_range_errors",
        "Absolute errors of ranges against the reference: as measured, as predicted by the scaled map and by the "
        "refined map, with their running medians. Shown are ranges that were taken at a photo; anchor positions are "
        "those of this map." + _thinned(len(rows)),
        "Absolute range errors over time",
        (time_label, "absolute error m"),
        [*dots, *(_median(name, _COLORS[name], errors, x_range) for name, errors in points.items())],
        table="range_errors",
        x_range=x_range,
        y_range=(0.0, 1.1 * max(float(np.nanquantile(sizes, 0.98)), 1e-3)),
        size=WIDE_SIZE,
    )


def _residual_panel(content: Content, ranges: RangesAsUsed, anchor_id: str) -> Panel:
    times, time_label = time_axis(content.range_times_s)
    time_range = (float(np.nanmin(times)), float(np.nanmax(times)))
    limit = _residual_limit(ranges)
    is_mine = np.array(ranges.anchor_id, dtype=str) == anchor_id
    is_used = is_mine & ranges.is_used
    is_rejected = is_mine & (np.array(ranges.status, dtype=str) == RangeStatus.OUTLIER.label)
    is_drawn = np.arange(len(times)) % every_nth(len(times), MAX_NUM_DRAWN) == 0
    points = {name: np.column_stack([times, m]) for name, m in ranges.residuals_by_model_m.items()}
    *_, final = points.values()
    return Panel(
        f"Anchor {anchor_id}",
        f"Range residuals of anchor {anchor_id} over time",
        (time_label, "residual m"),
        (
            Series("used", "after", final[is_used & is_drawn]),
            Series("rejected", "red", final[is_rejected & is_drawn]),
            *(
                _median(f"{name}, median", _COLORS[name], of_model[is_used], time_range)
                for name, of_model in points.items()
            ),
        ),
        x_range=time_range,
        y_range=(-limit, limit),
        zero_line=True,
        size=PANEL_SIZE,
    )


def _median(name: str, color: str, points: Array, x_range: Range) -> Series:
    return Series(name, color, running_median(points, x_range, NUM_MEDIAN_BINS), "line", is_data=False)


def _thinned(num: int) -> str:
    """Return the remark of a caption that not all ranges are drawn, or an empty text."""
    stride = every_nth(num, MAX_NUM_DRAWN)
    return "" if stride == 1 else f" One range in {stride} is drawn; the medians use all."


def _of_used(ranges: RangesAsUsed) -> dict[str, Array]:
    """Return the known residuals of the ranges used, by model ("scaled", "refined"), in metres."""
    used = {name: residuals[ranges.is_used] for name, residuals in ranges.residuals_by_model_m.items()}
    return {name: residuals[np.isfinite(residuals)] for name, residuals in used.items() if np.isfinite(residuals).any()}


def _residual_limit(ranges: RangesAsUsed) -> float:
    """Return half the height of the residual axes in metres, with room for nearly all ranges used."""
    return max(1.15 * max(float(np.quantile(np.abs(known), 0.995)) for known in _of_used(ranges).values()), 1e-3)


def plot_ranges(log: RangeLog) -> Figure:
    """Return the figure of all ranges of a log over time, with a colour for each anchor.

    Where the log names photos in place of times, the horizontal axis is the number of the range.
    """
    is_by_photo, first_s = isinstance(log.moments, ByPhoto), log.timestamp_s.min()
    x = np.arange(len(log)) if is_by_photo else log.timestamp_s - first_s
    series = []
    for i, anchor_id in enumerate(log.anchor_ids):
        hue = colorsys.hsv_to_rgb(i / len(log.anchor_ids), 0.8, 0.75)
        color = "#" + "".join(f"{round(255 * part):02x}" for part in hue)
        series.append(Series(anchor_id, color, np.column_stack([x, log.range_m])[log.anchor_index == i]))
    label = "range" if is_by_photo else f"s since {time_text(first_s)}"
    y_range = (0.0, 1.05 * float(log.range_m.max()))
    return figure_of("ranges", "", "Ranges over time", (label, "m"), series, y_range=y_range, size=_SIZE_ALONE)


def plot_error_curve(curve: ErrorCurve, distance_m: Array, error_m: Array, noise_stddev_m: float) -> Figure:
    """Return the figure of a radio's error curve with two stddevs on either side.

    Args:
        distance_m, error_m: (n,) of the ranges that it was learnt from. noise_stddev_m: of these about the curve.
    """
    shown = 5 * noise_stddev_m

    def line(name: str, kind: str, num_stddevs: int) -> Series:
        at_m = curve.error_m + num_stddevs * curve.stddev_m
        return Series(name, "after", np.column_stack([curve.distance_m, at_m]), kind)

    return figure_of(
        "error_curve",
        "",
        "Errors of ranges over their distance",
        ("distance, m", "measured minus true, m"),
        (
            Series("errors", "rejected", np.column_stack([distance_m, error_m])),
            line("curve", "line", 0),
            line("± two standard deviations", "dashed", 2),
            line("± two standard deviations", "dashed", -2),
        ),
        y_range=(float(curve.error_m.min()) - shown, float(curve.error_m.max()) + shown),
        size=_SIZE_ALONE,
    )
