"""What possible mistakes in ranges have in common: their effects on the residuals, limits, and corrections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.measurements.mistakes import Correction, Mistake
from rangesfm.measurements.ranges.anchors.point_fit import multilaterate
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.scale.range_equation import antenna_positions
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.util.geometry.numerics import ROUNDING

# Step, in the unit of a mistake, of the difference quotient for its effect: then rounding and curvature spoil it by
# about the same.
_SMALL = np.sqrt(ROUNDING)

MEASURE_AGAIN = "measure it again, or run with it unknown (leave its coordinates in the anchors' file empty)"
"""Remedy for an anchor that is not where its coordinates say."""


def at_size(mistake: Mistake, problem: Linearized, sizes: Array) -> Mistake:
    """Return a mistake with its effect linearised about an estimate, as large mistakes are not linear."""
    longer_m = mistake.correction(sizes).longer_m
    if not np.any(longer_m):
        return mistake
    steps = [mistake.correction(sizes + _SMALL * unit).longer_m for unit in np.eye(len(sizes))]
    slopes = [(step - longer_m) / _SMALL for step in steps]
    return replace(mistake, columns=-problem.bins.mean(np.stack(slopes, axis=1)))


def is_given(problem: Linearized, anchor: int) -> bool:
    """Return True if an anchor's position was given."""
    given = problem.on_map.problem
    return bool(np.isfinite(given.anchor_mean_m[anchor]).all() and np.isfinite(given.anchor_stddev_m[anchor]))


def longest_m(problem: Linearized, anchors: Sequence[int]) -> float:
    """Return the longest range to some anchors, of those that take part.

    It bounds the errors of ranges and positions: no range is too long by more than itself.
    """
    given = problem.on_map.problem
    is_of = (problem.bins.robust_weight > 0) & np.isin(given.anchor_index, anchors)
    return float(np.max(given.range_m[is_of]))


def duration_s(problem: Linearized) -> float:
    """Return the time between the first and the last range; clocks that differ by more have no moment in common."""
    return float(np.ptp(problem.on_map.time_s))


def of_anchor_place(problem: Linearized, anchor: int, directions: Array) -> Array:
    """Return the effect of an anchor that is off its given position along directions (3, k), towards its true place."""
    stddev_m, columns = problem.on_map.problem.anchor_stddev_m, np.zeros((len(problem.residual), directions.shape[1]))
    if problem.columns.anchor[anchor] < 0:
        is_of = (problem.bins.anchor_index == anchor)[:, None]
        columns[: len(problem.bins)] = np.where(is_of, problem.gradient.by_tag @ directions, 0.0)
        return columns
    has_rows = (problem.columns.anchor >= 0) & np.isfinite(stddev_m)
    row = len(problem.bins) + 3 * np.count_nonzero(has_rows[:anchor])
    columns[row : row + 3] = directions / stddev_m[anchor]
    return columns


def longer(rows: Callable[[], Mask]) -> Callable[[Array], Correction]:
    """Return the function that corrects some ranges for a constant error, given its size."""
    return lambda size: Correction(longer_m=np.where(rows(), size[0], 0.0))


def too_long(size: Array) -> str:
    return f"read about {abs(size[0]):.2f} m too {'long' if size[0] > 0 else 'short'}"


def corrected(on_map: RangesOnMap, correction: Correction) -> RangesOnMap:
    """Return the ranges with anchors, lever arms, times and lengths corrected; ``left_out`` is not applied."""
    problem, mean_m = on_map.problem, on_map.problem.anchor_mean_m.copy()
    anchors_m, stddevs_m = on_map.state.anchors_m.copy(), problem.anchor_stddev_m.copy()
    for name, position in correction.anchors_m.items():
        k = on_map.anchor_ids.index(name)
        mean_m[k] = np.full(3, np.nan) if position is None else position
        anchors_m[k] = where_ranges_meet(on_map, k) if position is None else position
        stddevs_m[k] = np.inf if position is None else stddevs_m[k]
    on_map = replace(on_map, state=replace(on_map.state, anchors_m=anchors_m)).with_problem(
        replace(
            problem,
            anchor_mean_m=mean_m,
            anchor_stddev_m=stddevs_m,
            range_m=problem.range_m - correction.longer_m,
        )
    )
    if on_map.posed.velocity is not None and np.any(correction.time_shift_s):
        shift_s = np.broadcast_to(correction.time_shift_s, len(on_map.time_s))
        on_map = _taken_later(on_map, shift_s, on_map.posed.velocity)
    if correction.tag_moves_m:
        moves = np.array([correction.tag_moves_m.get(tag, np.zeros(3)) for tag in on_map.tag_ids])
        turned = np.einsum("nij,nj->ni", on_map.posed.model_from_cam, moves[on_map.tag_index])
        problem = on_map.problem
        on_map = on_map.with_problem(replace(problem, tag_from_center=problem.tag_from_center + turned))
    return on_map


def where_ranges_meet(on_map: RangesOnMap, k: int) -> Array:
    """Return the place (3,) of an anchor by its ranges alone, from the tag's places on the map."""
    problem, rows = on_map.problem, on_map.problem.anchor_index == k
    tags_m = antenna_positions(problem, on_map.state.metric_from_model)[rows]
    return multilaterate(tags_m, problem.range_m[rows] - problem.bias_mean_m[k])[0]


def _taken_later(on_map: RangesOnMap, shift_s: Array, velocity: Array) -> RangesOnMap:
    """Return the ranges moved along the path to later times.

    Each takes the place of the range nearest to its new time, extrapolated by the velocity (n, 3) there.
    """
    problem, taken_s = on_map.problem, on_map.time_s + shift_s
    order = np.argsort(on_map.time_s, kind="stable")
    rising_s = on_map.time_s[order]
    after = np.clip(np.searchsorted(rising_s, taken_s), 1, len(order) - 1)
    at = order[np.where(taken_s - rising_s[after - 1] < rising_s[after] - taken_s, after - 1, after)]
    arms = np.einsum("nji,nj->ni", on_map.posed.model_from_cam, problem.tag_from_center)
    turned = on_map.posed.model_from_cam[at]
    centers = problem.centers[at] + velocity[at] * (taken_s - on_map.time_s[at])[:, None]
    ranges = replace(problem, centers=centers, tag_from_center=np.einsum("nij,nj->ni", turned, arms))
    posed = replace(on_map.posed, ranges=ranges, model_from_cam=turned, velocity=velocity[at])
    return replace(on_map, posed=posed)
