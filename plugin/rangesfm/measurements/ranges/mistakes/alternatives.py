"""Mistakes that have no size: swapped labels, mixed-up axes, another unit. Each is tried as a whole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import Correction, Mistake, in_axes
from rangesfm.measurements.ranges.mistakes.effects import (
    MEASURE_AGAIN,
    corrected,
    where_ranges_meet,
)
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeFit,
    RangeProblem,
    RangeState,
    predicted_ranges,
    solve,
)
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.starts import multilaterate_all, spread_rows
from rangesfm.util.geometry.robust_statistics import CAUCHY
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points
from rangesfm.util.units import FOOT_M

# Ranges of each anchor in a refit: alternatives are only compared.
_NUM_PER_ANCHOR = 25
LEAST_USED = 0.4
"""Least share of an anchor's ranges that fit a map on which it is about where it is said to be."""
_UNITS_M = {
    "the anchors' coordinates are in feet": FOOT_M,
    "the ranges are in feet, or metres among the anchors' coordinates were taken for feet and converted": 1 / FOOT_M,
    "each range is the way to the anchor and back, twice the distance": 2.0,
}
# Factors on the scale of the map that are tried, as with ranges in feet or of both ways.
_SCALE_FACTORS = np.geomspace(1 / 4, 4, 7)
# Directions of the three given coordinates, as _turned reads them. Each is a mirror image, and a turn of the others:
# where nothing but ranges ties the map to the site, nothing tells them apart, so that the words name the likely ones.
_AXES_OF_ANCHORS = {
    "x and y (east and north) are swapped, or heights are depths": "y x z",
    "y and z are swapped": "x z y",
    "x has the wrong sign": "-x y z",
    "heights have the wrong sign (they are depths), or x and y (east and north) are swapped": "x y -z",
}
_AXES_OF_LEVER_ARM = {
    "has the wrong sign (from the tag to the camera, not from the camera to the tag)": "left up back",
    "is given along x forward, y left, z up, not x right, y down, z forward": "forward left up",
    "is given along x right, y up, z back, not x right, y down, z forward": "right up back",
    "is given along x right, y forward, z up, not x right, y down, z forward": "right forward up",
    "is given along x forward, y right, z down, not x right, y down, z forward": "forward right down",
}
# Directions along the axes that are meant, and against them: of the site, and of a camera.
_IN_SITE = "x y z", "-x -y -z"
_IN_CAMERA = "right down forward", "left up back"


def alternatives(on_map: RangesOnMap) -> Iterator[Mistake]:
    """Yield all mistakes without a size that a map can have."""
    given_m, heard = on_map.problem.anchor_mean_m, np.unique(on_map.problem.anchor_index)
    given = {on_map.anchor_ids[k]: given_m[k] for k in heard if np.isfinite(given_m[k]).all()}
    yield from _of_labels([each.anchor_id for each in on_map.posed.given.anchors if each.anchor_id in given], given)
    yield from _of_coordinates(given)
    yield from _of_places(on_map, given)
    if on_map.posed.velocity is not None:  # as where the photos' order was taken from names that count down
        times = on_map.time_s
        yield Mistake.without_size(
            "photos reversed",
            "",
            "the photos' times run backwards: the last photo has the time of the first",
            "check the photos' times, or the order that they were given in",
            Correction(time_shift_s=times.min() + times.max() - 2 * times),
        )
    yield from lever_arms_in_other_axes(on_map)


def lever_arms_in_other_axes(on_map: RangesOnMap) -> Iterator[Mistake]:
    """Yield other readings of the lever arms: with the wrong sign, or along other axes."""
    in_cam_m = np.einsum("nji,nj->ni", on_map.posed.model_from_cam, on_map.problem.tag_from_center)
    tag_index = on_map.tag_index
    arms = {on_map.tag_ids[k]: np.median(in_cam_m[tag_index == k], axis=0) for k in np.unique(tag_index)}
    for words, given in _AXES_OF_LEVER_ARM.items():
        axes = _turned(given, *_IN_CAMERA)
        moves = {tag: axes @ arm - arm for tag, arm in arms.items()}
        if max(np.linalg.norm(move) for move in moves.values()) > 1e-3:
            remedy = "give the tag's place in the camera, x to the right, y down, z forward (--tag_in_cam)"
            yield Mistake.without_size(
                "lever arm's axes", "", f"the lever arm {words}", remedy, Correction(tag_moves_m=moves)
            )


def _of_labels(names: Sequence[str], given: Mapping[str, Array]) -> Iterator[Mistake]:
    """Yield swapped pairs of anchors' labels (or of lines in their file), and coordinates shifted by one line."""
    remedy = "compare the labels on the devices with the anchors' file"
    for one, other in combinations(given, 2):
        words = f"the labels of anchors {one} and {other} are swapped"
        swapped = Correction({one: given[other], other: given[one]})
        yield Mistake.without_size("labels swapped", f"{one}, {other}", words, remedy, swapped)
    at = [given[name] for name in names]
    for by, whose in ((1, "before"), (-1, "after")) if len(names) > 2 else ():
        words = f"each anchor has the coordinates of the one in the line {whose} it in the anchors' file"
        shifted = Correction(dict(zip(names, at[by:] + at[:by], strict=True)))
        yield Mistake.without_size("lines shifted", "", words, remedy, shifted)


def _of_coordinates(given: Mapping[str, Array]) -> Iterator[Mistake]:
    """Yield other axes of the anchors' coordinates, coordinates in feet, and ranges of the way there and back."""
    remedy = "compare the anchors' file with a sketch of the site"
    for axes_words, directions in _AXES_OF_ANCHORS.items() if len(given) > 2 else ():
        words, axes = f"in the anchors' coordinates {axes_words}", _turned(directions, *_IN_SITE)
        turned = Correction({name: axes @ at for name, at in given.items()})
        yield Mistake.without_size("anchors' axes", "", words, remedy, turned)
    if len(given) < 2:
        return
    middle = np.mean(list(given.values()), axis=0)
    remedy = "check the unit of ranges and anchors' file against a taped distance between two of them"
    for words, metres in _UNITS_M.items():
        grown = Correction({name: middle + metres * (at - middle) for name, at in given.items()})
        yield Mistake.without_size("anchors' unit", "", words, remedy, grown)


def _turned(given: str, along: str, against: str) -> Array:
    """Return the rotation or reflection (3, 3) of coordinates in given directions into those that are meant.

    Args:
        given: directions in which the three coordinates were given.
        along, against: directions of the three axes that are meant, and the opposite ones.
    """
    axes = dict(zip((*along.split(), *against.split()), np.vstack([np.eye(3), -np.eye(3)]), strict=True))
    return np.column_stack([axes[direction] for direction in given.split()])


def _of_places(on_map: RangesOnMap, given: Mapping[str, Array]) -> Iterator[Mistake]:
    """Yield for each anchor that hardly any range fits: it is far from its coordinates, as without a sign or a point.

    A linear test does not see this, as the ranges have no weight.
    """
    for name, at in given.items():
        k = on_map.anchor_ids.index(name)
        if np.mean(on_map.weights[on_map.problem.anchor_index == k] >= OUTLIER_BELOW) < LEAST_USED:
            off_m = where_ranges_meet(on_map, k) - at
            words = (
                f"anchor {name} is about {np.linalg.norm(off_m):.2f} m from where its coordinates say "
                f"(by {in_axes(off_m)} in x, y, z)"
            )
            yield Mistake.without_size("anchor place", name, words, MEASURE_AGAIN, Correction({name: None}))


def best_refits(
    on_map: RangesOnMap, scatter_m: float, tried: Sequence[Mistake], num_fitted: int
) -> list[tuple[Mistake, RangesOnMap]]:
    """Return mistakes with the map corrected for each and fitted to a few ranges of each anchor, the best fit first.

    Each fit starts from where the map itself sees the anchors.

    Args:
        scatter_m: standard deviation of a range.
        tried: mistakes without a size. num_fitted: number of them, the likeliest before a fit, that are fitted.
    """
    rows, nothing = spread_rows(on_map.problem, _NUM_PER_ANCHOR), np.zeros(0)

    def thinned(on_map: RangesOnMap) -> RangeProblem:
        thin = on_map.problem.subset(rows)
        return replace(thin, stddev_m=np.full(len(rows), scatter_m), share=np.ones(len(rows)))

    usually_seen, starts = _anchors_by_map(thinned(on_map)), []
    for each in tried:
        correction = each.correction(nothing)
        right = corrected(on_map, correction)
        thin = thinned(right)
        seen = _anchors_by_map(thin) if np.any(correction.time_shift_s) else usually_seen
        of_each = [(_cost(thin, state), state) for state in _starts(thin, right.state, on_map.state, *seen)]
        cost, state = min(of_each, key=lambda start: start[0])
        starts.append((cost, each, replace(right, state=state)))
    fits = []
    for _, each, right in sorted(starts, key=lambda start: start[0])[:num_fitted]:
        fit = _roughly_solved(thinned(right), right.state)
        fits.append((fit.cost, each, replace(right, state=fit.state)))
    return [(each, right) for _, each, right in sorted(fits, key=lambda fit: fit[0])]


def _starts(
    problem: RangeProblem, corrected: RangeState, state: RangeState, placed: Similarity, seen_m: Array
) -> Iterator[RangeState]:
    """Yield starting states: the map as it is, and moved to where it sees the anchors (``seen_m``, (m, 3)).

    Args:
        corrected: has the places of the anchors whose positions are not given. state: before the correction.
    """
    known = np.asarray(np.isfinite(problem.anchor_mean_m).all(axis=1))
    anchors_m = np.where(known[:, None], problem.anchor_mean_m, corrected.anchors_m)
    yield replace(state, anchors_m=anchors_m)
    is_seen = np.asarray(np.isfinite(seen_m).all(axis=1))
    if not problem.frame_is_free and not known.any():
        yield RangeState(placed, np.where(is_seen[:, None], seen_m, anchors_m), state.bias_m)
    usable = known & is_seen
    if problem.frame_is_free and usable.sum() >= 3:
        yield RangeState(align_points(seen_m[usable], anchors_m[usable]) @ placed, anchors_m, state.bias_m)


def _cost(problem: RangeProblem, state: RangeState) -> float:
    off = (predicted_ranges(problem, state) - problem.range_m) / problem.stddev_m
    return float(CAUCHY.rho(off**2)[0].sum())


def _roughly_solved(problem: RangeProblem, start: RangeState) -> RangeFit:
    return solve(problem, start, loss=CAUCHY, tolerance=1e-4)


def _anchors_by_map(problem: RangeProblem) -> tuple[Similarity, Array]:
    """Estimate how the map lies and where it sees the anchors (m, 3) if nothing is known of them beforehand."""
    unknown = replace(
        problem,
        anchor_mean_m=np.full_like(problem.anchor_mean_m, np.nan),
        anchor_stddev_m=np.where(np.isin(np.arange(problem.num_anchors), problem.anchor_index), np.inf, 0.0),
        frame_is_free=False,
        gravity=None,
    )
    anchors_m, (_, costs) = multilaterate_all(unknown, _SCALE_FACTORS)
    best = int(np.argmin(costs))
    heard = np.where(np.isinf(unknown.anchor_stddev_m)[:, None], anchors_m[best], np.nan)
    start = RangeState(replace(IDENTITY, scale=float(_SCALE_FACTORS[best])), heard, unknown.bias_mean_m)
    state = _roughly_solved(unknown, start).state
    return state.metric_from_model, state.anchors_m
