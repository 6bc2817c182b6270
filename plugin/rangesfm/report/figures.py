"""The report's figures. Orange is before the refinement, blue after it, everywhere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.observations import RangeStatus
from rangesfm.report.checks import larger_stddev
from rangesfm.report.content import Content, as_number, in_natural_order
from rangesfm.report.markup import Child, Markup, element
from rangesfm.report.svg import Chart, equal_chart, legend, running_median
from rangesfm.report.text import signed
from rangesfm.result_folder import RangesAsUsed

Array = npt.NDArray[np.float64]

NUM_HISTOGRAM_BINS = 60
NUM_MEDIAN_BINS = 48
MAX_NUM_POINTS_DRAWN = 6000
MIN_LABEL_DISTANCE_PX = 12.0
AXES = ("x", "y", "z")


def figure(caption: str, *parts: Child) -> Markup:
    """A figure with its caption."""
    return element("figure", parts, element("figcaption", caption))


def residuals_over_time(content: Content) -> Markup | None:
    """One panel for each anchor: residuals of its ranges before and after the refinement."""
    ranges = content.ranges
    if ranges is None or not _has_residuals(ranges):
        return None
    panels = [
        element("div", element("h3", f"Anchor {anchor_id}"), _residual_panel(content, ranges, anchor_id))
        for anchor_id in in_natural_order(ranges.anchor_id)
    ]
    caption = (
        "Range residuals over time, predicted minus measured, with their running median. A steady offset is a bias; "
        "a slow wave is drift or a clock. What lies beyond an axis is drawn at its edge."
    )
    entries = _before_after_legend(ranges, ("rejected", "rejected"))
    return figure(caption, entries, element("div", panels, class_="panels"))


def _residual_panel(content: Content, ranges: RangesAsUsed, anchor_id: str) -> Markup:
    times, time_label = content.range_times_s, "time s"
    if times is None or not np.isfinite(times).any():
        times, time_label = np.arange(len(ranges.status), dtype=np.float64), "range number"
    time_range = (float(np.nanmin(times)), float(np.nanmax(times)))
    limit = _residual_limit(ranges)
    chart = Chart(360, 172, time_range, (-limit, limit))
    chart.axes(time_label, "residual m", num_x_ticks=5)
    chart.horizontal(0.0, "zero")
    is_mine = np.array(ranges.anchor_id, dtype=str) == anchor_id
    is_rejected = is_mine & (np.array(ranges.status, dtype=str) == RangeStatus.OUTLIER.label)
    is_used = is_mine & ranges.is_used
    both = {"before": ranges.residual_scaled_m, "after": ranges.residual_refined_m}
    final = both["after"] if np.isfinite(both["after"]).any() else both["before"]
    chart.dots(np.column_stack([times, final])[is_rejected], "rejected")
    points = {class_: np.column_stack([times, residuals])[is_used] for class_, residuals in both.items()}
    for class_ in both:
        chart.dots(points[class_], class_)
    for class_ in both:
        chart.line(running_median(points[class_], time_range, NUM_MEDIAN_BINS), class_)
    return chart.render(f"Range residuals of anchor {anchor_id} over time")


def residual_histogram(content: Content) -> Markup | None:
    """Distribution of the residuals of the ranges used, before and after."""
    ranges = content.ranges
    if ranges is None or not _has_residuals(ranges):
        return None
    limit = _residual_limit(ranges)
    edges = np.linspace(-limit, limit, NUM_HISTOGRAM_BINS + 1)
    both = {"before": ranges.residual_scaled_m, "after": ranges.residual_refined_m}
    counts = {
        class_: np.histogram(np.clip(residuals[_is_known(ranges, residuals)], -limit, limit), edges)[0].astype(float)
        for class_, residuals in both.items()
    }
    chart = Chart(460, 250, (-limit, limit), (0.0, max(1.0, 1.08 * max(c.max() for c in counts.values()))), left=58)
    chart.axes("predicted − measured m", "ranges", num_x_ticks=7)
    for class_, heights in counts.items():
        if heights.any():
            outline = np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])
            chart.line(np.column_stack([np.repeat(edges, 2), outline]), f"{class_} filled")
    chart.vertical(0.0, "zero")
    return figure(
        "Residuals of the ranges used. Real radios lean to long measurements, which here are negative.",
        _before_after_legend(ranges),
        chart.render("Histogram of the range residuals before and after the refinement"),
    )


def scale_per_anchor(content: Content) -> Markup | None:
    """The scale from each anchor alone against the joint one with its stddev."""
    summary = content.summary
    joint, stddev = summary.number("scale", "value"), larger_stddev(summary)
    given = summary.table("scale", "per_anchor")
    values = {anchor_id: as_number(given[anchor_id]) for anchor_id in in_natural_order(given)}
    alone = {anchor_id: value for anchor_id, value in values.items() if value is not None}
    if joint is None or len(alone) < 2:
        return None
    half = 1.25 * max([*(abs(value - joint) for value in alone.values()), stddev or 0.0, 1e-4 * joint])
    height = 24 * len(alone) + 56
    chart = Chart(460, height, (joint - half, joint + half), (len(alone) - 0.5, -0.5), left=64, right=74)
    if stddev is not None:
        chart.band(joint - stddev, joint + stddev, "interval")
    chart.axes("scale m per unit", "", num_x_ticks=4, num_y_ticks=0)
    chart.vertical(joint, "joint")
    for row, (anchor_id, value) in enumerate(alone.items()):
        percent = signed(100.0 * (value / joint - 1.0), 2, "%")
        chart.label(chart.x_range[0], row, anchor_id, dx=-8, dy=4, anchor="end")
        chart.label(chart.x_range[1], row, percent, dx=8, dy=4)
        chart.disc(value, row, "after-fill", f"anchor {anchor_id}: {value:.6g} m per unit, {percent}")
    return figure(
        "The scale from each anchor alone, and how far it is from the joint one. Line and band: the joint scale "
        "and one standard deviation. The spread of the anchors is the most honest error bar there is.",
        legend([("joint", "joint scale"), ("interval", "± one standard deviation"), ("after-disc", "one anchor")]),
        chart.render("Scale from each anchor alone against the joint scale"),
    )


def trajectory_views(content: Content) -> Markup | None:
    """The path in plan and in elevation, before and after, with the reference, the anchors and the map's points."""
    path = content.final
    if path is None or len(path) == 0:
        return None
    views = [_trajectory_view(content, name, axes, signs) for name, axes, signs in _views(content)]
    entries = [("before", "scaled")]
    entries += [("after", "refined")] if content.refined is not None else []
    entries += [("reference", "reference")] if content.reference_m is not None else []
    entries += [("anchor", "anchor")] if content.anchors_m else []
    caption = f"The camera's path in metres, in the {'site' if content.frame == 'site' else 'first camera'} frame."
    if content.points_m is not None and len(content.points_m):
        drawn = min(len(content.points_m), MAX_NUM_POINTS_DRAWN)
        entries.append(("map-point", "map"))
        caption += f" {drawn} of the map's {len(content.points_m)} points are drawn, as far as they are near."
    return figure(caption, legend(entries), element("div", views, class_="views"))


def _views(content: Content) -> list[tuple[str, tuple[int, int], tuple[int, int]]]:
    """Name, horizontal and vertical axis of each view, and their signs on the page."""
    path = content.final
    assert path is not None
    extents = np.ptp(path.centers, axis=0)
    if content.frame == "site":
        along = 0 if extents[0] >= extents[1] else 1
        return [("Plan", (0, 1), (1, 1)), ("Elevation", (along, 2), (1, 1))]
    # A camera looks along +z and its y axis points down.
    along = 0 if extents[0] >= extents[2] else 2
    return [("Plan", (0, 2), (1, 1)), ("Elevation", (along, 1), (1, -1))]


def _trajectory_view(content: Content, name: str, axes: tuple[int, int], signs: tuple[int, int]) -> Markup:
    def seen(points: Array) -> Array:
        return points[:, axes] * np.array(signs, dtype=np.float64)

    paths = [(class_, path) for class_, path in (("before", content.scaled), ("after", content.refined)) if path]
    anchors = [(anchor_id, seen(position[None])[0]) for anchor_id, position in content.anchors_m.items()]
    shown = [seen(path.centers) for _, path in paths] + [position[None] for _, position in anchors]
    shown += [seen(content.reference_m)] if content.reference_m is not None else []
    chart = equal_chart(np.concatenate(shown), 460, max_height=400)
    chart.axes(f"{AXES[axes[0]]} m", f"{'−' if signs[1] < 0 else ''}{AXES[axes[1]]} m")
    if content.points_m is not None:
        chart.dots(_near(seen(_thinned(content.points_m)), chart), "map-point")
    for class_, path in paths:
        chart.line(seen(path.centers), class_)
    if content.reference_m is not None:
        chart.line(seen(content.reference_m), "reference")
    for names, (x, y) in _joined(anchors, chart):
        chart.marker(x, y, "anchor-mark", f"anchor {names}")
        chart.label(x, y, names, dx=8, dy=4)
    return element("div", element("h3", name), chart.render(f"{name} of the camera's path with the anchors"))


def _joined(anchors: list[tuple[str, Array]], chart: Chart) -> list[tuple[str, Array]]:
    """Anchors that fall on one another in this view share a label."""
    groups: list[tuple[list[str], Array]] = []
    for anchor_id, position in anchors:
        near = (ids for ids, other in groups if chart.pixels_between(position, other) < MIN_LABEL_DISTANCE_PX)
        ids = next(near, None)
        if ids is None:
            groups.append(([anchor_id], position))
        else:
            ids.append(anchor_id)
    return [(", ".join(ids), position) for ids, position in groups]


def _near(points: Array, chart: Chart) -> Array:
    (x_low, x_high), (y_low, y_high) = chart.x_range, chart.y_range
    inside = (points[:, 0] > x_low) & (points[:, 0] < x_high) & (points[:, 1] > y_low) & (points[:, 1] < y_high)
    return points[inside]


def _thinned(points: Array) -> Array:
    """An even sample of what may be very many."""
    if len(points) <= MAX_NUM_POINTS_DRAWN:
        return points
    return points[np.random.default_rng(0).choice(len(points), MAX_NUM_POINTS_DRAWN, replace=False)]


def _before_after_legend(ranges: RangesAsUsed, *more: tuple[str, str]) -> Markup:
    entries = [("before", "scaled")]
    if np.isfinite(ranges.residual_refined_m).any():
        entries.append(("after", "refined"))
    return legend([*entries, *more])


def _has_residuals(ranges: RangesAsUsed) -> bool:
    return bool(np.isfinite(ranges.residual_scaled_m[ranges.is_used]).any())


def _is_known(ranges: RangesAsUsed, residuals: Array) -> npt.NDArray[np.bool_]:
    return np.asarray(ranges.is_used & np.isfinite(residuals))


def _residual_limit(ranges: RangesAsUsed) -> float:
    """Half the height of the residual axes: room for nearly all ranges used, before and after."""
    sizes = [
        np.abs(residuals[_is_known(ranges, residuals)])
        for residuals in (ranges.residual_scaled_m, ranges.residual_refined_m)
    ]
    return max(1.15 * max(float(np.quantile(size, 0.995)) for size in sizes if len(size)), 1e-3)
