"""Search for the place of an anchor by its ranges at known positions of the tag, without a first guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.errors.noise import inlier_noise
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState, predicted_ranges, solve
from rangesfm.util.geometry.robust_statistics import robust_stddevs
from rangesfm.util.geometry.similarity import IDENTITY, path_shape

# Added to the diagonal of normal equations, whose columns have length 1 before weighting. It keeps them regular where
# outliers have lost all their weight.
_RIDGE = 1e-16
ENOUGH_TO_SEARCH = 300
"""Ranges, spread over all of them, with which the place of a point is searched as well as with more."""
ENOUGH_TO_JUDGE = 2000
"""Ranges of a point, spread over all of them, that tell places apart and show errors as well as more would."""
# The search for a start uses this many directions of starting points around the tag, and losses of these widths (in
# units of the noise).
_NUM_DIRECTIONS = 8
_WIDTHS = np.geomspace(30.0, 0.3, 5)


def multilaterate(positions: Array, ranges: Array, num_rounds: int = 12) -> tuple[Array, Array]:
    """Locate a point by its distances to known positions, by a robust linear method that needs no start.

    rho^2 = |p|^2 - 2 a.p + |a|^2 is linear in (a, |a|^2). Where the positions lie in a plane, the height above it
    follows from |a|^2, with an arbitrary sign.

    Args:
        positions: (..., n, 3) known positions, metres, for one point or for many at once.
        ranges: (n,) or (..., n) distances, metres.
        num_rounds: of reweighting.

    Returns:
        The point (..., 3), and the residuals (..., n) of the linear model, metres.
    """
    shape = path_shape(positions)
    local = (positions - shape.centroid[..., None, :]) @ shape.axes
    # In directions of smaller extent than this, ranges with noise of about a decimetre carry no information.
    seen = shape.stddevs > np.maximum(0.02 * shape.stddevs[..., :1], 1e-9)
    squared = ranges**2 - np.sum(local**2, axis=-1)
    design = np.concatenate([-2 * local * seen[..., None, :], np.ones_like(local[..., :1])], axis=-1)
    sizes = np.linalg.norm(design, axis=-2, keepdims=True)
    sizes = np.where(sizes > 0, sizes, 1.0)
    design, nothing = design / sizes, np.concatenate([~seen, np.zeros_like(seen[..., :1])], axis=-1)
    rest = (nothing + _RIDGE)[..., None] * np.eye(4)
    weights = 1 / np.maximum(2 * ranges, 1e-3)
    robust = np.ones_like(squared)
    for _ in range(num_rounds):
        weighted = (design * (weights**2 * robust)[..., None]).swapaxes(-1, -2)
        solution = np.linalg.solve(weighted @ design + rest, weighted @ squared[..., None])
        residuals = weights * ((design @ solution)[..., 0] - squared)
        robust = 1 / (1 + (residuals / (2 * robust_stddevs(residuals))) ** 2)
    point, height = np.split(solution[..., 0] / sizes[..., 0, :], [3], axis=-1)
    above = np.sqrt(np.maximum(height - np.sum(point**2, axis=-1, keepdims=True), 0.0))
    point = np.where(~seen & (np.arange(3) == 2), above, point)
    anchor: Array = shape.centroid + (shape.axes @ point[..., None])[..., 0]
    return anchor, residuals


def likeliest_state(problem: RangeProblem, noise_m: Array, shared_m: Array) -> RangeState:
    """Return the likeliest state of one anchor beside a path in metres, in spite of outliers and without a first guess.

    Starting points all around the tag, and the linear solution, follow the minima of a Cauchy loss while it narrows
    from metres to centimetres. Of all minima on the way, the most likely one is chosen.

    Args:
        noise_m: (n,) of the ranges, up to a common factor. shared_m: (n,) standard deviation of the error that ranges
            of similar length share.
    """
    rows = np.linspace(0, len(noise_m) - 1, min(len(noise_m), ENOUGH_TO_SEARCH)).astype(np.int64)
    part, noise_m, shared_m = problem.subset(rows), noise_m[rows], shared_m[rows]
    now, passed = _starts(part), list[RangeState]()
    for width in _WIDTHS:
        narrowed = replace(part, stddev_m=np.hypot(width * noise_m, shared_m))
        fits = [solve(narrowed, state, tolerance=1e-3) for state in now]
        now = _distinct([fit.state for fit in fits], float(noise_m.min()))
        passed += now
    off_m = [predicted_ranges(part, state) - part.range_m for state in passed]
    likelihoods = [inlier_noise(each / np.hypot(noise_m, shared_m)).log_likelihood for each in off_m]
    return passed[int(np.argmax(likelihoods))]


def _distinct(states: list[RangeState], noise_m: float) -> list[RangeState]:
    """Return the first of each group of states that ranges with this noise do not tell apart."""
    kept: list[RangeState] = []
    for each in states:
        off_m = [np.append(each.anchors_m - other.anchors_m, each.bias_m - other.bias_m) for other in kept]
        if all(np.linalg.norm(of) > noise_m for of in off_m):
            kept.append(each)
    return kept


def _starts(problem: RangeProblem) -> list[RangeState]:
    """Return starting points around the mean of the tag's positions, and the linear solution with its mirror image."""
    tags_m, known_m = problem.tag_from_center, problem.anchor_mean_m
    ranges = problem.range_m - problem.bias_mean_m[0]
    shape = path_shape(tags_m)
    linear, _ = multilaterate(tags_m, ranges)
    normal = shape.axes[:, 2]
    mirrored = linear - 2 * ((linear - shape.centroid) @ normal) * normal
    places_m = np.vstack([shape.centroid + np.median(ranges) * _directions(), linear, mirrored])
    places_m = np.where(np.isnan(known_m), places_m, known_m)
    return [RangeState(IDENTITY, place_m[None], problem.bias_mean_m) for place_m in places_m]


def _directions() -> Array:
    """Return unit vectors (m, 3), evenly spread along a spiral from pole to pole."""
    step = np.arange(_NUM_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * step / _NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * step
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
