"""Figures of the scale: anchor by anchor, the paper's candidates, consensus, resampling; and of the clocks."""

from __future__ import annotations

import numpy as np

from rangesfm.report.content import Content, in_natural_order
from rangesfm.report.figures_ranges import outline
from rangesfm.report.plot import WIDE_SIZE, Figure, LegendEntry, Mark, Panel, Series
from rangesfm.report.text import signed

NUM_BOOTSTRAP_BINS = 40
MAX_NUM_CANDIDATES = 3000
CANDIDATE_AXIS = (-1.0, 4.0)
"""Ends of the axis of candidates, in units of the scale: they have no bounds of their own."""


def scale_per_anchor(content: Content) -> Figure | None:
    """The scale from each anchor alone against the joint one with its stddev."""
    scale = content.summary.scale
    joint, stddev = scale.value, scale.larger_stddev
    values = {anchor_id: scale.per_anchor[anchor_id] for anchor_id in in_natural_order(scale.per_anchor)}
    alone = {anchor_id: value for anchor_id, value in values.items() if value is not None}
    if len(alone) < 2:
        return None
    half = 1.25 * max([*(abs(value - joint) for value in alone.values()), stddev or 0.0, 1e-4 * joint])
    marks, rows = [], []
    for row, (anchor_id, value) in enumerate(alone.items()):
        percent = signed(100.0 * (value / joint - 1.0), 2, "%")
        rows.append((float(row), anchor_id, percent))
        marks.append(
            Mark(
                "one anchor", "after", "disc", value, row, "", f"anchor {anchor_id}: {value:.6g} m per unit, {percent}"
            )
        )
    panel = Panel(
        "",
        "Scale from each anchor alone against the joint scale",
        "scale m per unit",
        "",
        (),
        tuple(marks),
        x_range=(joint - half, joint + half),
        y_range=(len(alone) - 0.5, -0.5),
        size=(322.0, 24.0 * len(alone) + 10),
        verticals=((joint, "ink"),),
        bands=() if stddev is None else ((joint - stddev, joint + stddev, "interval"),),
        rows=tuple(rows),
    )
    caption = (
        "The scale from each anchor alone, and how far it is from the joint one. Line and band: the joint scale "
        "and one standard deviation. The spread of the anchors is the most honest error bar there is."
    )
    legend = (_line("joint scale"), *((_band("± one standard deviation"),) if stddev is not None else ()))
    return Figure("scale_per_anchor", caption, (panel,), legend=legend)


def candidates(content: Content) -> Figure | None:
    """The paper's figure: both candidates of each range over time."""
    table, scale = content.candidates, content.summary.scale.value
    if table is None or len(table.alpha0) == 0:
        return None
    stride = -(-len(table.alpha0) // MAX_NUM_CANDIDATES)
    times, alpha0, alpha1 = (column[::stride] for column in (table.timestamp_s, table.alpha0, table.alpha1))
    times = times - np.min(times, initial=np.inf, where=np.isfinite(times))
    label = "time s"
    if not np.isfinite(times).all():
        times, label = np.arange(len(times), dtype=np.float64), "range number"
    both = [
        Series("alpha0", "before", np.column_stack([times, alpha0])),
        Series("alpha1", "after", np.column_stack([times, alpha1])),
        Series(
            "scale found", "reference", np.array([[times.min(), scale], [times.max(), scale]]), "dashed", is_data=False
        ),
    ]
    panel = Panel(
        "",
        "Both candidates of the scale over time",
        label,
        "candidate m per unit",
        tuple(both),
        y_range=(CANDIDATE_AXIS[0] * scale, CANDIDATE_AXIS[1] * scale),
        size=WIDE_SIZE,
    )
    caption = (
        "Each range has two possible scales. The true one is constant over time, the other is not; where the path "
        "turns towards or away from an anchor they change places. What lies beyond the axis is drawn at its edge."
    )
    if stride > 1:
        caption += f" One range in {stride}; scale_candidates.csv holds all."
    return Figure("scale_candidates", caption, (panel,))


def consensus(content: Content) -> Figure | None:
    """How many ranges agree with each scale."""
    table = content.consensus
    if table is None or len(table.scale) == 0:
        return None
    curve = Series("ranges that agree", "after", np.column_stack([table.scale, table.num_agreeing]), "filled")
    panel = Panel(
        "",
        "Number of ranges that agree with each scale",
        "scale m per unit",
        "ranges",
        (curve,),
        y_range=(0.0, 1.08 * max(float(table.num_agreeing.max()), 1.0)),
        verticals=_joint(content),
    )
    caption = (
        "How many ranges fit to each scale within their tolerance, anchors where the estimate has them. One high, "
        "narrow peak at the scale found (the line) is what a sound survey looks like."
    )
    return Figure("scale_consensus", caption, (panel,), legend=(_line("scale found"),))


def bootstrap(content: Content) -> Figure | None:
    """The scale when blocks of time are drawn anew."""
    table = content.bootstrap
    if table is None or len(table.scale) < 2:
        return None
    values = table.scale
    low, high = np.quantile(values, [0.005, 0.995])
    margin = max(0.15 * (high - low), 1e-6 * abs(high))
    edges = np.linspace(low - margin, high + margin, NUM_BOOTSTRAP_BINS + 1)
    heights = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].astype(float)
    interval = content.summary.scale.interval_95
    panel = Panel(
        "",
        "Histogram of resampled scales",
        "scale m per unit",
        "resamples",
        (Series("resampled", "after", outline(edges, heights), "filled"),),
        x_range=(float(edges[0]), float(edges[-1])),
        y_range=(0.0, 1.08 * max(float(heights.max()), 1.0)),
        verticals=_joint(content),
        bands=() if interval is None else ((*interval, "interval"),),
    )
    caption = f"{len(values)} scales from blocks of time drawn anew. The band is the 95 % interval of the scale."
    legend = (_line("scale found"), *((_band("95 % interval"),) if interval is not None else ()))
    return Figure("scale_bootstrap", caption, (panel,), legend=legend)


def clock_curve(content: Content) -> Figure | None:
    """How well each clock offset fits."""
    table = content.clock_curve
    if table is None or len(table.cost) == 0:
        return None
    offset = content.summary.time_offset.value_s
    curve = Series("misfit", "after", np.column_stack([table.time_offset_s, table.cost]), "line")
    panel = Panel(
        "",
        "Misfit of the ranges for each clock offset",
        "time offset s",
        "misfit",
        (curve,),
        verticals=() if offset is None else ((offset, "ink"),),
    )
    caption = "Misfit of the ranges for each offset between the clocks. One sharp valley at the line is what is wanted."
    return Figure("time_offset_curve", caption, (panel,), legend=() if offset is None else (_line("offset used"),))


def _joint(content: Content) -> tuple[tuple[float, str], ...]:
    return ((content.summary.scale.value, "ink"),)


def _line(text: str) -> LegendEntry:
    return LegendEntry(text, "ink", "upright")


def _band(text: str) -> LegendEntry:
    return LegendEntry(text, "interval", "strip")
