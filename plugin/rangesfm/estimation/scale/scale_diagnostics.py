"""Tables to plot that show how the scale was found: the paper's candidates and the consensus over the scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.scale.starts import agreeing_intervals
from rangesfm.measurements.ranges.scale.two_candidate import two_candidate
from rangesfm.util.geometry.numerics import SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.trajectory import Trajectory

NUM_CURVE_POINTS = 601
CURVE_FACTOR = 3.0
"""The curve runs from the scale divided by this factor to the scale times it."""


@dataclass(frozen=True)
class ScaleDiagnostics:
    """Tables beside a ScaleEstimate; all scales are in metres per SfM unit.

    Attributes:
        candidate_rows: (k,) rows of the log whose ranges have candidates.
        candidates: (k, 2) the smaller and the larger candidate of each.
        curve_scales: (m,) increasing scales.
        num_agreeing: (m,) number of ranges that agree with each scale.
    """

    candidate_rows: Indices
    candidates: Array
    curve_scales: Array
    num_agreeing: Indices


def scale_diagnostics(estimate: ScaleEstimate, trajectory: Trajectory) -> ScaleDiagnostics:
    """Return the tables of an estimate on its unscaled path, with its anchors and its rotation held fixed."""
    observations, log, placed = estimate.observations, estimate.observations.log, estimate.metric_from_sfm
    anchors = np.array([anchor.position_m for anchor in estimate.anchors], dtype=np.float64)[log.anchor_index]
    rows = np.flatnonzero(np.isfinite(estimate.errors.stddev_m) & np.isfinite(anchors).all(axis=1))
    tags, range_m = observations.tag_from_center[rows] @ placed.rotation.T, log.range_m[rows]

    def about(held: Array) -> tuple[Array, Array]:
        """Return centres in SfM units and anchors in metres, both along the metric axes and relative to a place."""
        return (observations.centers[rows] - held) @ placed.rotation.T, anchors[rows] - placed.apply(held)

    # In the paper the first camera is the origin.
    centers, anchor_m = about(trajectory.centers[0])
    table = two_candidate(centers, tags, anchor_m, range_m)
    # The path is stretched about a fixed point: its middle in a site, otherwise the first camera.
    centers, anchor_m = about(trajectory.centers.mean(axis=0) if estimate.frame == "site" else trajectory.centers[0])
    bias = np.array([anchor.range_bias_m for anchor in estimate.anchors])[log.anchor_index[rows]]
    tolerance = SIGNIFICANT_STDDEVS * estimate.errors.stddev_m[rows]
    starts, ends = agreeing_intervals(centers, tags - anchor_m, range_m - bias, tolerance)
    scales = placed.scale * np.geomspace(1 / CURVE_FACTOR, CURVE_FACTOR, NUM_CURVE_POINTS)
    num_begun = np.searchsorted(np.sort(starts), scales, side="right")
    return ScaleDiagnostics(
        candidate_rows=np.zeros(0, dtype=np.int64) if table is None else rows[table.rows],
        candidates=np.zeros((0, 2)) if table is None else table.duplets,
        curve_scales=scales,
        num_agreeing=np.asarray(num_begun - np.searchsorted(np.sort(ends), scales, side="left")),
    )
