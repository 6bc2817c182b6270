"""How the scale came about, in tables to plot: the paper's candidates and consensus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.scale.consensus import TOLERANCE_STDDEVS, agreeing_intervals
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.two_candidate import two_candidate

NUM_CURVE_POINTS = 601
CURVE_FACTOR = 3.0
"""The curve runs from the scale over this factor to the scale times it."""


@dataclass(frozen=True)
class ScaleDiagnostics:
    """Tables beside a ScaleEstimate, all scales in metres per SfM unit.

    Attributes:
        candidate_rows: (k,) ranges of the log that have candidates.
        candidates: (k, 2) of each, the smaller and the larger.
        curve_scales: (m,) increasing.
        num_agreeing: (m,) ranges that agree with each.
    """

    candidate_rows: Indices
    candidates: Array
    curve_scales: Array
    num_agreeing: Indices


def scale_diagnostics(estimate: ScaleEstimate, trajectory: Trajectory) -> ScaleDiagnostics:
    """The tables of an estimate, its anchors and its rotation taken as found.

    Args:
        trajectory: the unscaled path that the estimate is of.
    """
    anchors = np.array([anchor.position_m for anchor in estimate.anchors], dtype=np.float64)
    anchor_of_range = anchors[estimate.observations.log.anchor_index]
    rows = np.flatnonzero(np.isfinite(estimate.errors.stddev_m) & np.isfinite(anchor_of_range).all(axis=1))
    candidate_rows, candidates = _candidates(estimate, trajectory, rows, anchor_of_range[rows])
    scales = estimate.value * np.geomspace(1 / CURVE_FACTOR, CURVE_FACTOR, NUM_CURVE_POINTS)
    return ScaleDiagnostics(
        candidate_rows=candidate_rows,
        candidates=candidates,
        curve_scales=scales,
        num_agreeing=_num_agreeing(estimate, trajectory, rows, anchor_of_range[rows], scales),
    )


def _candidates(
    estimate: ScaleEstimate, trajectory: Trajectory, rows: Indices, anchor_m: Array
) -> tuple[Indices, Array]:
    """As in the paper: the first camera is the origin."""
    centers, tags, anchors = _about(estimate, trajectory.centers[0], rows, anchor_m)
    table = two_candidate(centers, tags, anchors, estimate.observations.log.range_m[rows])
    if table is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    return rows[table.rows], table.duplets


def _num_agreeing(
    estimate: ScaleEstimate, trajectory: Trajectory, rows: Indices, anchor_m: Array, scales: Array
) -> Indices:
    """The path stretches about what holds it: in a site its middle, else the first camera."""
    held = trajectory.centers.mean(axis=0) if estimate.frame == "site" else trajectory.centers[0]
    centers, tags, anchors = _about(estimate, held, rows, anchor_m)
    log = estimate.observations.log
    bias = np.array([anchor.range_bias_m for anchor in estimate.anchors])[log.anchor_index[rows]]
    tolerance = TOLERANCE_STDDEVS * estimate.errors.stddev_m[rows]
    starts, ends = agreeing_intervals(centers, tags - anchors, log.range_m[rows] - bias, tolerance)
    begun = np.searchsorted(np.sort(starts), scales, side="right")
    return np.asarray(begun - np.searchsorted(np.sort(ends), scales, side="left"))


def _about(estimate: ScaleEstimate, held: Array, rows: Indices, anchor_m: Array) -> tuple[Array, Array, Array]:
    """Centres in SfM units, lever arms and anchors in metres, all along the metric axes about a place of the path."""
    placed, observations = estimate.metric_from_sfm, estimate.observations
    centers = (observations.centers[rows] - held) @ placed.rotation.T
    tags = observations.tag_from_center[rows] @ placed.rotation.T
    return centers, tags, anchor_m - placed.apply(held)
