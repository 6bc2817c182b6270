"""Starting points for the nonlinear range equation, for each case of known and unknown anchors.

For a given scale, the squared range equation is linear in the positions of the anchors or of the path. So a sweep over
scales (and rotations), with a small robust linear solve at each, finds every basin without a first guess. For anchors
known in the frame of the path, maximum consensus over the scale is exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.anchors.point_fit import ENOUGH_TO_SEARCH, multilaterate
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    RangeState,
    antenna_positions,
    cost_at,
    solve,
)
from rangesfm.util.geometry.numerics import SIGNIFICANT_STDDEVS, UNDETERMINED
from rangesfm.util.geometry.robust_statistics import SAME_COST
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, off_origin, path_shape, round_middle, rounding_of
from rangesfm.util.processes.threads import side_by_side

_T = TypeVar("_T")

# Number of scales of a sweep, and the largest over the smallest.
_NUM_SCALES, _SCALE_SPAN = 80, 200.0
# Numbers of rotations of a sweep, without and with a known vertical: the latter are 6 degrees apart. Rounds of
# reweighting for each.
_NUM_ROTATIONS, _NUM_HEADINGS, _NUM_ROUNDS = 400, 60, 4
MAX_NUM_STARTS = 12
"""Most candidates of a search that are refined: of a sweep by each kind of residuals, a consensus, or triples."""
# Trials closer to each other than this, in the logarithm of the scale and in radians, converge to the same minimum.
_BASIN_LOG_SCALE, _BASIN_ROTATION_RAD = 0.3, 0.6
# Maxima of the number of agreeing ranges are told apart on a logarithmic grid of the scale with this step. Maxima below
# the given share of the highest one are dropped.
_LOG_CELL, _MIN_SHARE_OF_BEST = 0.02, 0.5


def spread_subset(problem: RangeProblem, max_num_per_anchor: int) -> RangeProblem:
    """Return evenly spaced ranges of each anchor, at most ``max_num_per_anchor`` of each."""
    return problem.subset(spread_rows(problem, max_num_per_anchor))


def spread_rows(problem: RangeProblem, max_num_per_anchor: int) -> Indices:
    """Return the ascending rows of evenly spaced ranges of each anchor, at most ``max_num_per_anchor`` of each."""
    rows = []
    for k in range(problem.num_anchors):
        of_anchor = np.flatnonzero(problem.anchor_index == k)
        count = min(len(of_anchor), max_num_per_anchor)
        rows.append(of_anchor[np.linspace(0, len(of_anchor) - 1, count).astype(np.int64)] if count else of_anchor)
    return np.sort(np.concatenate(rows))


def scale_candidates(problem: RangeProblem) -> Array:
    """Return scales to try, ascending.

    A range changes by no more than the antenna moves. So differences of ranges over differences of centres bound the
    scale from below; the upper quartile tolerates outliers.

    Raises:
        GeometryError: no range changes along the path.
    """
    small = spread_subset(problem, 60)
    ratios = []
    for k in range(small.num_anchors):
        rows = small.anchor_index == k
        centers, ranges = small.centers[rows], small.range_m[rows]
        first, second = np.triu_indices(len(ranges), 1)
        moved = np.linalg.norm(centers[first] - centers[second], axis=1)
        far = moved > max(0.5 * moved.max(initial=0.0), rounding_of(centers))
        changed = np.abs(ranges[first] - ranges[second])
        ratios.append(np.where(changed > rounding_of(ranges), changed, 0.0)[far] / moved[far])
    ratio = np.concatenate(ratios)
    lower = float(np.quantile(ratio, 0.75)) if len(ratio) else 0.0
    if not lower > 0:
        raise GeometryError("the scale is not determined: the camera hardly moved, or no range changed as it did")
    return lower * 0.3 * np.geomspace(1.0, _SCALE_SPAN, _NUM_SCALES)


def first_camera_starts(problem: RangeProblem) -> list[RangeState]:
    """Return starts for anchors that are all known in the frame of the model, by exact consensus over the scale."""
    return [
        RangeState(replace(IDENTITY, scale=scale), problem.anchor_mean_m.copy(), problem.bias_mean_m.copy())
        for scale in consensus_scales(problem)
    ]


def unknown_anchor_starts(problem: RangeProblem) -> list[RangeState]:
    """Return starts for unknown anchors: a sweep over the scale, in which each anchor is solved linearly."""
    small = spread_subset(problem, ENOUGH_TO_SEARCH)
    scales = scale_candidates(problem)
    anchors, costs = multilaterate_all(small, scales)
    best = dict.fromkeys(i for kind in costs for i in _lowest_minima(kind))
    starts = [RangeState(replace(IDENTITY, scale=scales[i]), anchors[i], problem.bias_mean_m.copy()) for i in best]
    return [choose_sides(small, start)[0] for start in starts]


def _lowest_minima(costs: Array) -> list[int]:
    """Return indices of the lowest local minima of a sweep's costs, lowest first."""
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    minima = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
    return [int(i) for i in minima[np.argsort(costs[minima], kind="stable")][:MAX_NUM_STARTS]]


def site_starts(problem: RangeProblem, seed: int = 0) -> list[RangeState]:
    """Return starts for surveyed anchors when the path's place among them is unknown.

    For given scale and rotation the squared range equation is linear in the translation.
    """
    known = np.flatnonzero(np.isfinite(problem.anchor_stddev_m))
    rows = np.flatnonzero(np.isin(problem.anchor_index, known))
    per_anchor = max(ENOUGH_TO_SEARCH // max(len(known), 1), 8)
    small = spread_subset(problem.subset(rows), per_anchor)
    if problem.gravity is None:
        rotations = Rotation.random(_NUM_ROTATIONS, rng=np.random.default_rng(seed))
        rotations = Rotation.concatenate([Rotation.identity(), rotations])
    else:
        rotations = problem.gravity.level_rotations(_NUM_HEADINGS)
    turns, scales = rotations.as_matrix(), scale_candidates(problem)[::2].tolist()
    trials: list[tuple[float, Similarity]] = []
    placed = side_by_side(lambda scale: _translations(small, scale, turns), scales)
    for scale, (translations, costs) in zip(scales, placed, strict=True):
        for i in np.argsort(costs)[:MAX_NUM_STARTS]:
            trials.append((float(costs[i]), Similarity(scale, turns[i], translations[i])))
    anchors = np.where(np.isfinite(problem.anchor_mean_m), problem.anchor_mean_m, 0.0)
    ranked = [trial for _, trial in sorted(trials, key=lambda trial: trial[0])]
    found = each_once(ranked, _in_one_basin, MAX_NUM_STARTS)
    return [RangeState(similarity, anchors.copy(), problem.bias_mean_m.copy()) for similarity in found]


def _in_one_basin(one: Similarity, other: Similarity) -> bool:
    turn = np.trace(one.rotation.T @ other.rotation)
    is_near = abs(np.log(one.scale / other.scale)) < _BASIN_LOG_SCALE
    return bool(is_near and turn > 1 + 2 * np.cos(_BASIN_ROTATION_RAD))


def each_once(ranked: Iterable[_T], are_same: Callable[[_T, _T], bool], max_num: int) -> list[_T]:
    """Return the first of each group of equal items, at most ``max_num``."""
    kept: list[_T] = []
    for each in ranked:
        if len(kept) < max_num and not any(are_same(each, other) for other in kept):
            kept.append(each)
    return kept


def sphere_swaps(problem: RangeProblem, state: RangeState) -> list[RangeState]:
    """Return maps that fit as well if the path lies on a sphere (or a flat circle) and all anchors are unknown.

    About the centre of a sphere, rho^2 = scale^2 radius^2 + |a|^2 - 2 scale a.c. The ranges determine only the sum of
    the first two terms, and the third depends on scale times a alone. So the radius of the path and the distance of an
    anchor from its centre can be exchanged.
    """
    middle, radius = round_middle(problem.centers)
    placed = state.metric_from_model
    from_middle = state.anchors_m - placed.apply(middle)
    swaps = []
    for growth in np.linalg.norm(from_middle[np.unique(problem.anchor_index)], axis=1) / (placed.scale * radius):
        if growth > UNDETERMINED:  # an anchor in the centre has no direction from it in which it could move away
            grown = replace(placed, scale=float(placed.scale * growth))
            swaps.append(RangeState(grown, grown.apply(middle) + from_middle / growth, state.bias_m))
    return swaps


def choose_sides(problem: RangeProblem, state: RangeState) -> tuple[RangeState, Array, Array]:
    """Put each unknown anchor on the side of the path's plane that fits better, with the scale held fixed.

    If both sides fit equally well, the side of the plane's normal is taken.

    Returns:
        the state, the (m, 3) places on the other side, and (m,) by how much the robust cost is higher there; inf for
        known anchors, and where both sides lead to one place.
    """
    anchors, rise = state.anchors_m.copy(), np.full(problem.num_anchors, np.inf)
    others = anchors.copy()
    shape = path_shape(state.metric_from_model.apply(problem.centers))
    normal = shape.axes[:, 2]
    for k in np.flatnonzero(np.isinf(problem.anchor_stddev_m)):
        alone = anchor_alone(problem, int(k), state.metric_from_model)
        if not len(alone.range_m):
            continue
        # Starts on the plane itself would be equal for both sides and stay equal.
        height = abs(float((anchors[k] - shape.centroid) @ normal))
        height = max(height, 0.1 * float(np.median(alone.range_m)))
        on_plane = anchors[k] - ((anchors[k] - shape.centroid) @ normal) * normal
        fits = []
        for side in (height, -height):
            at = RangeState(IDENTITY, (on_plane + side * normal)[None], state.bias_m[k : k + 1])
            fits.append(solve(alone, at, tolerance=1e-8))
        if not math.isclose(fits[0].cost, fits[1].cost, rel_tol=SAME_COST, abs_tol=SAME_COST):
            fits.sort(key=lambda fit: fit.cost)
        anchors[k], others[k] = (fit.state.anchors_m[0] for fit in fits)
        first, second = (fit.state for fit in fits)
        middle = 0.5 * (first.anchors_m + second.anchors_m), 0.5 * (first.bias_m + second.bias_m)
        # Both starts may lead to one place, up to the tolerance; then the cost has no ridge between the two.
        if cost_at(alone, RangeState(IDENTITY, *middle)) > max(fit.cost for fit in fits):
            rise[k] = fits[1].cost - fits[0].cost
    return replace(state, anchors_m=anchors), others, rise


def complete_unknown_anchors(problem: RangeProblem, state: RangeState) -> RangeState:
    """Place the unknown anchors, given the place of the path."""
    anchors = state.anchors_m.copy()
    small = spread_subset(problem, ENOUGH_TO_SEARCH)
    for k in np.flatnonzero(np.isinf(problem.anchor_stddev_m)):
        alone = anchor_alone(small, int(k), state.metric_from_model)
        if len(alone.range_m):
            anchors[k], _ = multilaterate(alone.tag_from_center, alone.range_m - problem.bias_mean_m[k])
    return choose_sides(small, replace(state, anchors_m=anchors))[0]


def anchor_alone(problem: RangeProblem, k: int, metric_from_model: Similarity) -> RangeProblem:
    """Return the problem of one anchor with the path given: centres are already metric, and the scale has no effect."""
    part = problem.of_anchor(k)
    tags = antenna_positions(part, metric_from_model)
    return replace(
        part,
        centers=np.zeros_like(tags),
        tag_from_center=tags,
        bias_stddev_m=np.zeros(1),
        common_bias_stddev_m=0.0,
    )


def multilaterate_all(problem: RangeProblem, scales: Array) -> tuple[Array, Array]:
    """Locate each anchor from the tag's positions, at each of s scales.

    Returns:
        (s, m, 3) anchors, and (2, s) means of two kinds of robust residuals. Residuals of the linear equation are more
        informative if an anchor is badly placed. Residuals of the distances are needed if the path lies on a sphere,
        where the linear equation can fit at any scale.
    """
    anchors, costs = np.zeros((len(scales), problem.num_anchors, 3)), np.zeros((2, len(scales)))
    unit = 3 * float(np.median(problem.stddev_m))
    for k in np.unique(problem.anchor_index):
        part = problem.of_anchor(int(k))
        tags = scales[:, None, None] * part.centers + part.tag_from_center
        ranges = part.range_m - problem.bias_mean_m[k]
        anchors[:, k], residuals = multilaterate(tags, ranges)
        off = np.linalg.norm(tags - anchors[:, k, None], axis=-1) - ranges
        costs += np.sum(np.log1p((np.stack([residuals, off]) / unit) ** 2), axis=-1)
    return anchors, costs / len(problem.range_m)


def _translations(problem: RangeProblem, scale: float, rotations: Array) -> tuple[Array, Array]:
    """Return the best translation for each rotation, and a robust cost.

    It is a point at the ranges from all places anchor - R (scale c + r).
    """
    anchors, path = problem.anchor_mean_m[problem.anchor_index], scale * problem.centers + problem.tag_from_center
    ranges = problem.range_m - problem.bias_mean_m[problem.anchor_index]
    places = anchors - path @ np.swapaxes(rotations, 1, 2)
    translations, _ = multilaterate(places, ranges, _NUM_ROUNDS)
    off = np.abs(np.linalg.norm(places - translations[:, None], axis=2) - ranges)
    return translations, np.mean(np.minimum(off, 3 * np.median(off, axis=1, keepdims=True)), axis=1)


def consensus_scales(problem: RangeProblem) -> list[float]:
    """Return the scales that most ranges agree on, best first.

    The first is the exact maximum of the number of agreeing ranges; the others are lower local maxima.

    Raises:
        GeometryError: no positive scale explains any range.
    """
    bias_stddev = np.where(np.isfinite(problem.bias_stddev_m), problem.bias_stddev_m, 0.0)[problem.anchor_index]
    # A range agrees with a scale if noise and bias together may well be the difference.
    tolerance = SIGNIFICANT_STDDEVS * np.hypot(problem.stddev_m, bias_stddev)
    ranges = problem.range_m - problem.bias_mean_m[problem.anchor_index]
    offset = problem.tag_from_center - problem.anchor_mean_m[problem.anchor_index]
    starts, ends = agreeing_intervals(problem.centers, offset, ranges, tolerance)
    if not len(starts):
        raise GeometryError("no scale explains any range: are the anchors given in the first camera's frame?")
    return _hilltops(*local_maxima(starts, ends))


def _hilltops(scales: Array, counts: Indices) -> list[float]:
    """Return the highest scale of each local maximum on the grid, best first."""
    cells = np.floor(np.log(scales) / _LOG_CELL).astype(np.int64)
    first = np.unique(cells, return_index=True)[1]
    best = np.maximum.reduceat(counts, first)
    beside = np.diff(cells[first]) == 1
    lower = np.concatenate([[0], np.where(beside, best[:-1], 0)])
    higher = np.concatenate([np.where(beside, best[1:], 0), [0]])
    # Of equal neighbouring cells the first counts as the maximum.
    tops = np.flatnonzero((best > lower) & (best >= higher) & (best >= _MIN_SHARE_OF_BEST * best.max()))
    tops = tops[np.argsort(-best[tops], kind="stable")][:MAX_NUM_STARTS]
    ends = np.append(first[1:], len(scales))
    return [float(scales[first[top] + np.argmax(counts[first[top] : ends[top]])]) for top in tops]


def agreeing_intervals(centers: Array, offset: Array, ranges: Array, tolerance: Array) -> tuple[Array, Array]:
    """Return positive scales for which ``| ||scale c + offset|| - range | <= tolerance``, range by range.

    The squared distance is a parabola in the scale, so the set is one interval, or two where the path comes nearer to
    the anchor than the range and then leaves again.

    Args:
        centers, offset: (n, 3). ranges, tolerance: (n,).

    Returns:
        interval starts and ends, up to 2 n, in no particular order.
    """
    a = np.where(off_origin(centers), np.sum(centers**2, axis=1), 0.0)
    b = np.sum(centers * offset, axis=1)
    d = np.sum(offset**2, axis=1)
    outer_low, outer_high, reaches = _roots(a, b, d - (ranges + tolerance) ** 2)
    inner_low, inner_high, enters = _roots(a, b, d - np.maximum(ranges - tolerance, 0.0) ** 2)
    enters &= ranges > tolerance
    starts = np.concatenate([outer_low[reaches], inner_high[reaches & enters]])
    ends = np.concatenate([np.where(enters, inner_low, outer_high)[reaches], outer_high[reaches & enters]])
    starts = np.maximum(starts, 0.0)
    keep = ends > starts
    return starts[keep], ends[keep]


def _roots(a: Array, b: Array, c: Array) -> tuple[Array, Array, Mask]:
    """Return the roots of ``a x^2 + 2 b x + c``, and a mask of where they are real and a is not 0 (there is motion)."""
    discriminant = b**2 - a * c
    real = (discriminant > 0) & (a > 0)
    root = np.sqrt(np.where(real, discriminant, 0.0))
    safe = np.where(a > 0, a, 1.0)
    return (-b - root) / safe, (-b + root) / safe, real


def local_maxima(starts: Array, ends: Array) -> tuple[Array, Indices]:
    """Return the stretches where more closed intervals overlap than just before and just after.

    Such a stretch lies between a start and the next end, with no other start between them. The time is O(n log n).
    Starts and ends are sorted separately, because sorting numbers is many times faster than sorting an index to them.

    Args:
        starts, ends: (n,) of the intervals, n > 0.

    Returns:
        (k,) ascending middles of the stretches, and the number of intervals that contain each.
    """
    starts, ends = np.sort(starts), np.sort(ends)
    num_ended = np.searchsorted(ends, starts, side="left")
    next_start = np.append(starts[1:], np.inf)
    tops = np.flatnonzero(ends[num_ended] < next_start)
    counts = tops + 1 - num_ended[tops]
    return 0.5 * (starts[tops] + ends[num_ended[tops]]), counts
