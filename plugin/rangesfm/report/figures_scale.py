"""Figures of the scale (anchor by anchor, candidates of the paper, consensus) and of the time offset."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rangesfm.report.content import Content
from rangesfm.report.plot import WIDE_SIZE, Figure, Mark, Series, every_nth, figure_of, from_zero, time_axis
from rangesfm.report.text import signed
from rangesfm.result.result_tables import ScaleCandidates, ScaleConsensus, TimeOffsetCurve
from rangesfm.util.files.folders import natural_order

MAX_NUM_CANDIDATES = 3000
CANDIDATE_AXIS = (-1.0, 4.0)
"""Ends of the axis of candidates, in units of the scale. Candidates themselves are unbounded."""


def scale_per_anchor_figure(content: Content) -> Iterator[Figure]:
    """Yield the figure of the scale from each anchor alone, beside that of all anchors and its 95 % interval."""
    scale, joint = content.summary.scale, content.summary.metric_from_sfm.scale
    values = {anchor_id: scale.per_anchor[anchor_id] for anchor_id in sorted({*scale.per_anchor}, key=natural_order)}
    alone = {anchor_id: value for anchor_id, value in values.items() if value is not None}
    if len(alone) < 2:
        return
    half = 1.25 * max([abs(end - joint) for end in (*alone.values(), *(scale.interval_95 or ()), 1.0001 * joint)])
    marks, rows = [], []
    for row, (anchor_id, value) in enumerate(alone.items()):
        percent = signed(100.0 * (value / joint - 1.0), 2, "%")
        rows.append((float(row), anchor_id, percent))
        title = f"anchor {anchor_id}: {value:.6g} m per unit, {percent}"
        marks.append(Mark("one anchor", "after", "disc", value, row, "", title))
    yield figure_of(
        "scale_per_anchor",
        "The scale from each anchor alone, and its difference from the scale from all of them before the refinement "
        "(the line). Band: the 95 % interval of the scale. An error of a single anchor, such as a wrong position, "
        "shows here.",
        "Scale from each anchor alone against the scale from all",
        ("scale m per unit", ""),
        (),
        lines=(("all anchors", joint),),
        bands=(("95 % interval", *scale.interval_95),) if scale.interval_95 else (),
        marks=tuple(marks),
        x_range=(joint - half, joint + half),
        y_range=(len(alone) - 0.5, -0.5),
        size=(322.0, 24.0 * len(alone) + 10),
        rows=tuple(rows),
    )


def candidates(content: Content) -> Iterator[Figure]:
    """Yield the figure of the 2018 paper: both candidates of each range over time."""
    table, scale = content.result.read(ScaleCandidates), content.summary.metric_from_sfm.scale
    if not table:
        return
    stride = every_nth(len(table), MAX_NUM_CANDIDATES)
    times, label = time_axis(table.timestamp_s[::stride])
    found = np.array([[times.min(), scale], [times.max(), scale]])
    caption = (
        "The method of Lee, Zhu, Giorgi and Günther (2018): two scales, its candidates, make a range fit the path. "
        "The true one is constant over time, the other is not. They swap where the path turns towards an anchor or "
        "away from it. Values beyond the axis are drawn at its edge."
    )
    if stride > 1:
        caption += f" One range in {stride} is drawn; scale_candidates.csv has all."
    yield figure_of(
        "scale_candidates",
        caption,
        "Both candidates of the scale over time",
        (label, "candidate m per unit"),
        (
            Series("alpha0", "before", np.column_stack([times, table.alpha0[::stride]])),
            Series("alpha1", "after", np.column_stack([times, table.alpha1[::stride]])),
            Series("scale found", "reference", found, "dashed", is_data=False),
        ),
        y_range=(CANDIDATE_AXIS[0] * scale, CANDIDATE_AXIS[1] * scale),
        size=WIDE_SIZE,
    )


def consensus(content: Content) -> Iterator[Figure]:
    """Yield the figure of how many ranges agree with each scale."""
    table = content.result.read(ScaleConsensus)
    if not table:
        return
    curve = Series("ranges that agree", "after", np.column_stack([table.scale, table.num_agreeing]), "filled")
    yield figure_of(
        "scale_consensus",
        "Number of ranges that agree with each scale within their tolerance; anchor positions are those estimated. A "
        "sound survey has one high, narrow peak at the scale found (the line).",
        "Number of ranges that agree with each scale",
        ("scale m per unit", "ranges"),
        (curve,),
        lines=(("scale found", content.summary.metric_from_sfm.scale),),
        y_range=from_zero([curve]),
    )


def clock_curve(content: Content) -> Iterator[Figure]:
    """Yield the figure of how badly the ranges fit for each time offset between the clocks."""
    table = content.result.read(TimeOffsetCurve)
    if not table:
        return
    offset = content.summary.time_offset.value_s
    yield figure_of(
        "time_offset_curve",
        "Misfit of the ranges for each time offset between the clocks. A sound survey has one sharp minimum, at the "
        "line.",
        "Misfit of the ranges for each clock offset",
        ("time offset s", "misfit"),
        [Series("misfit", "after", np.column_stack([table.time_offset_s, table.cost]), "line")],
        lines=() if offset is None else (("offset used", offset),),
    )
