"""Trilateration: positions of anchors from ranges at known positions of the tag.

This is the first step of Lee, Zhu, Giorgi and Günther (2018), with robust estimation and a realistic uncertainty. Every
anchor is located on its own. The errors of the ranges are learnt from those of all anchors together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.point_fit import (
    ENOUGH_TO_JUDGE,
    JudgedFit,
    PointFit,
    fit_with_own_noise,
    judged_fits,
    known_directions,
)
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, cost_at, solve
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import UNDETERMINED
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE, MIN_COST_GAP, SAME_COST
from rangesfm.util.geometry.similarity import NEARLY_STRAIGHT, PathShape, oriented, path_shape
from rangesfm.util.processes.threads import with_one_blas_thread

# Three ranges determine a position, and a fourth one checks it.
MIN_NUM_RANGES = 4
# Standard deviations above this fraction of the distance are computed from the cost itself, not from its curvature.
_NONLINEAR = 0.05
# Distances at which the cost is then evaluated, metres.
_PROFILE_STEPS_M = np.geomspace(0.01, 100.0, 41)
# Id of an anchor without one.
_ONE = "anchor"


@dataclass(frozen=True)
class TrilaterationOptions:
    """Options of trilateration.

    Attributes:
        range_stddev_m: noise of ranges for which the log gives none; None: estimated from the residuals.
        range_bias_m: prior mean of the bias of the ranges, positive if they are too long.
        range_bias_stddev_m: standard deviation of that prior, by default over the radios of ``components.py``; 0: the
            bias is exactly known.
        max_position_stddev_m: an anchor with a larger standard deviation in any direction is refused.
    """

    range_stddev_m: float | None = None
    range_bias_m: float = 0.0
    range_bias_stddev_m: float = 0.25
    max_position_stddev_m: float = 1.0


@dataclass(frozen=True)
class Trilateration:
    """Position of an anchor, found from n ranges.

    Attributes:
        position_m: (3,) position in the frame of the tag's positions.
        covariance_m2: (3, 3) covariance of the position.
        mirror_position_m: (3,) mirror image in the tag's positions, if it fits as well; or None.
        range_bias_m, range_bias_stddev_m: bias of the ranges, positive if they are too long, and its standard
            deviation.
        noise_stddev_m: median noise of a range.
        residuals_m: (n,) predicted minus measured ranges.
        weights: (n,) weights of the robust loss, 1 for a range that fits.
    """

    position_m: Array
    covariance_m2: Array
    mirror_position_m: Array | None
    range_bias_m: float
    range_bias_stddev_m: float
    noise_stddev_m: float
    residuals_m: Array
    weights: Array

    @property
    def position_stddev_m(self) -> float:
        """Root of the mean variance of the three coordinates, metres."""
        return float(np.sqrt(np.trace(self.covariance_m2) / 3))


def walking_times_s(places_m: Array) -> Array:
    """Return (n,) times, seconds, at which somebody who walks a metre a second is at (n, 3) places, from 0."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places_m, axis=0), axis=1)))


@with_one_blas_thread
def trilaterate(
    tag_positions_m: npt.ArrayLike,
    range_m: npt.ArrayLike,
    *,
    options: TrilaterationOptions = TrilaterationOptions(),
    height_m: float | None = None,
    **known: npt.ArrayLike | None,
) -> Trilateration:
    """Find an anchor from its ranges to known positions of the tag.

    Up to about half of the ranges may be wrong by any amount. If the tag's positions lie in a plane, the anchor's
    mirror image in that plane fits as well. Then both are returned, unless ``toward`` selects one. If both fit equally,
    the upper one comes first. With a known height, the same applies to positions that lie on a line seen from above.

    Args:
        tag_positions_m: (n, 3) positions of the tag's antenna. range_m: (n,) ranges.
        height_m: z of the anchor, if it is known.
        known: ``timestamp_s`` (n,), without which ranges are in the order of time; ``range_stddev_m`` (n,), the noise
            of each range, NaN where unknown; ``shared_stddev_m`` (n,), of the radio's error curve at each range,
            without which short ranges get a larger standard deviation; ``toward`` (3,), direction from the anchor's
            mirror image to the anchor.

    Raises:
        GeometryError: there are too few ranges, the positions lie on a line or close together, or the anchor's standard
            deviation exceeds ``options.max_position_stddev_m``.
    """
    positions = np.asarray(tag_positions_m, dtype=np.float64)
    given = {name: np.asarray(values, np.float64) for name, values in known.items() if values is not None}
    log = RangeLog.from_arrays(
        [_ONE] * len(positions),
        range_m,
        timestamp_s=given.get("timestamp_s", walking_times_s(positions)),
        range_stddev_m=given.get("range_stddev_m"),
    )
    (placement,) = trilaterate_anchors(
        replace(log, shared_stddev_m=given.get("shared_stddev_m", log.shared_stddev_m)),
        positions,
        toward={_ONE: given["toward"]} if "toward" in given else {},
        height_m={} if height_m is None else {_ONE: height_m},
        options=options,
    )
    if placement.found is None:
        raise GeometryError(placement.why_not)
    return placement.found


@dataclass(frozen=True)
class AnchorPlacement:
    """Result of trilateration for one anchor.

    Attributes:
        anchor_id: id in the log.
        num_ranges: number of its ranges at known positions of the tag.
        found: its position; None if it is not determined.
        why_not: why it is not determined; empty if it is.
    """

    anchor_id: str
    num_ranges: int
    found: Trilateration | None
    why_not: str

    @property
    def anchor(self) -> Anchor:
        """Anchor for an anchor file, without a position if none was found, or if a mirror image fits as well."""
        if self.found is None:
            return Anchor(self.anchor_id)
        bias = (self.found.range_bias_m, self.found.range_bias_stddev_m)
        if self.found.mirror_position_m is not None:
            return Anchor(self.anchor_id, None, 0.0, *bias)
        return Anchor(self.anchor_id, self.found.position_m, self.found.position_stddev_m, *bias)


@with_one_blas_thread
def trilaterate_anchors(
    log: RangeLog,
    tag_positions_m: Array,
    *,
    toward: Mapping[str, npt.ArrayLike] = MappingProxyType({}),
    height_m: Mapping[str, float] = MappingProxyType({}),
    options: TrilaterationOptions = TrilaterationOptions(),
) -> tuple[AnchorPlacement, ...]:
    """Locate every anchor of a log; the errors of the ranges are learnt from all anchors together.

    Args:
        log: n ranges.
        tag_positions_m: (n, 3) position of the tag at each range; NaN where unknown (see ``tag_positions``).
        toward: by anchor, the direction from its mirror image to it, where both fit alike (see ``trilaterate``).
        height_m: by anchor, its z if that is known.

    Returns:
        One placement for each anchor, in the order of the log.
    """
    num = len(log.anchor_ids)
    rows = np.flatnonzero(np.isfinite(tag_positions_m).all(axis=1))
    counts = np.bincount(log.anchor_index[rows], minlength=num)
    rows = rows[np.argsort(log.anchor_index[rows], kind="stable")]
    rows = rows[counts[log.anchor_index[rows]] >= MIN_NUM_RANGES]
    index, given_m = log.anchor_index[rows], log.range_stddev_m[rows]
    tags_m, found = tag_positions_m[rows], dict[int, JudgedFit]()
    middle = tags_m.mean(axis=0) if len(rows) else np.zeros(3)
    heights_m = np.array([height_m.get(anchor_id, np.nan) for anchor_id in log.anchor_ids])
    problem = RangeProblem(
        centers=np.zeros((len(rows), 3)),
        tag_from_center=tags_m - middle,
        anchor_index=index,
        range_m=log.range_m[rows],
        stddev_m=np.ones(len(rows)),
        anchor_mean_m=np.column_stack([np.full((num, 2), np.nan), heights_m - middle[2]]),
        anchor_stddev_m=np.full(num, np.inf),
        bias_mean_m=np.full(num, options.range_bias_m),
        bias_stddev_m=np.full(num, options.range_bias_stddev_m),
        common_bias_stddev_m=0.0,
        frame_is_free=False,
        share=np.ones(len(rows)),
    )
    if len(rows):
        given_m = np.where(np.isfinite(given_m), given_m, options.range_stddev_m or np.nan)
        curve_m = log.shared_stddev_m[rows]
        heard = np.unique(index)
        fits = [fit_with_own_noise(problem.of_anchor(k), curve_m[index == k], given_m[index == k]) for k in heard]
        by_walk = [walking_times_s(tags_m[index == k]) for k in heard] if isinstance(log.moments, ByPhoto) else []
        times_s = np.concatenate(by_walk) if by_walk else log.timestamp_s[rows]
        found = dict(zip(heard.tolist(), judged_fits(fits, times_s, log.tag_index[rows], curve_m), strict=True))
    placements = []
    for k, anchor_id in enumerate(log.anchor_ids):
        placed, why_not = None, f"{counts[k]} ranges at known positions of the tag, {MIN_NUM_RANGES} are needed"
        if k in found:
            try:
                told = np.asarray(toward.get(anchor_id, np.zeros(3)), np.float64)
                placed, why_not = _conclude(found[k].balanced(), middle, told, options), ""
            except GeometryError as error:
                why_not = str(error)
        placements.append(AnchorPlacement(anchor_id, int(counts[k]), placed, why_not))
    return tuple(placements)


def _conclude(found: JudgedFit, middle: Array, toward: Array, options: TrilaterationOptions) -> Trilateration:
    """Return the position with its mirror image, in a frame in which ``middle`` is the problem's origin.

    Raises:
        GeometryError: the position is less certain than wanted.
    """
    covariance, tags_m = _covariance(found), found.point.problem.tag_from_center
    height_is_known = bool(np.isfinite(found.point.problem.anchor_mean_m[0, 2]))
    shape = path_shape(tags_m * [1.0, 1.0, 0.0] if height_is_known else tags_m)
    _refuse_uncertain(covariance, shape, options)
    # With a known height, position and mirror image have the same height, and the plane between them is vertical.
    level = np.cross([0.0, 0.0, 1.0], shape.axes[:, 0])
    across = oriented(level[:, None])[:, 0] if height_is_known else shape.axes[:, 2]
    mirror = _mirror(found, covariance, shape.centroid, across)
    if mirror is not None:
        apart = mirror.at_m - found.point.at_m
        # A plane between two positions that are each as exact as a solver is has a normal with as many digits.
        least = UNDETERMINED * float(np.linalg.norm(toward) * np.linalg.norm(apart))
        told = toward if abs(toward @ apart) > least else None
        # If both have the same cost, the choice would depend on rounding, so the order is fixed.
        is_free = told is not None or abs(_gap(found, mirror)) < SAME_COST
        if is_free and apart @ (across if told is None else told) > 0:
            found, mirror = replace(found, point=mirror), found.point
            covariance = _covariance(found)
        mirror = mirror if told is None else None
    return Trilateration(
        position_m=middle + found.point.at_m,
        covariance_m2=covariance[:3, :3],
        mirror_position_m=None if mirror is None else middle + mirror.at_m,
        range_bias_m=found.point.bias_m,
        range_bias_stddev_m=float(np.sqrt(np.diag(covariance)[3:].sum())),  # none if the bias is known
        noise_stddev_m=found.point.noise_m,
        residuals_m=found.point.fit.residuals_m,
        weights=found.point.fit.weights,
    )


def _covariance(found: JudgedFit) -> Array:
    """Return the covariance (q, q) of the position and, unless it is known, the bias, given the errors of the ranges.

    It is the sandwich covariance of a robust estimate: the covariance of the gradient between two inverses of the
    information (Huber and Ronchetti, "Robust Statistics", 2009, section 6.3). The weakest direction may instead be
    evaluated by the cost itself.
    """
    point, weights, stddev_m = found.point, found.point.fit.weights, found.point.problem.stddev_m
    jacobian, prior = point.slopes / stddev_m[:, None], point.prior(found.inflation_of_prior)
    of_prior = prior.T @ prior
    inverse = _inverse((jacobian * weights[:, None]).T @ jacobian + of_prior)
    influence = inverse @ (jacobian * (weights / stddev_m)[:, None]).T
    sandwich = found.of_sums(influence) + found.inflation_of_prior**2 * inverse @ of_prior @ inverse
    return _with_weak_direction(found, sandwich, inverse)


def _inverse(information: Array) -> Array:
    # Position and bias are scaled to units of their own. In metres, the large information of a bias that is known well
    # would hide that of the position.
    strongest = np.diag(information)
    unit = 1 / np.sqrt(np.append(np.full(3, strongest[:3].max()), strongest[3:]))
    values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
    inverse: Array = unit[:, None] * ((vectors / np.maximum(values, 1e-12)) @ vectors.T) * unit
    return inverse


def _with_weak_direction(found: JudgedFit, sandwich: Array, formal: Array) -> Array:
    """Return the covariance with the variance of the weakest direction from the cost itself, where that is needed.

    Near the plane of the tag's positions, the curvature of the cost across the plane vanishes, but the cost rises
    farther off.
    """
    variances, axes = np.linalg.eigh(formal[:3, :3])
    along = np.append(axes[:, 2], np.zeros(len(formal) - 3))
    # The other unknowns are assumed to change with this direction as the curvature says.
    tied = formal @ along / variances[2]
    inflation = found.inflation(found.point.slopes @ tied)
    if inflation * np.sqrt(variances[2]) < _NONLINEAR * float(np.median(found.point.problem.range_m)):
        return sandwich
    rest = np.eye(len(formal)) - np.outer(tied, along)
    changed: Array = rest @ sandwich @ rest.T + _profile_stddev(found, along, inflation) ** 2 * np.outer(tied, tied)
    return changed


def _profile_stddev(found: JudgedFit, along: Array, inflation: float) -> float:
    """Return the distance along a direction (q,) at which the cost has risen by that of one standard deviation, metres.

    The other unknowns are estimated anew at each distance.
    """
    num = len(found.point.problem.range_m)
    rows = np.linspace(0, num - 1, min(num, ENOUGH_TO_JUDGE)).astype(np.int64)
    part = found.judged_by(inflation).subset(rows)
    held = known_directions(part)
    best = solve(part, found.point.fit.state, held=held)
    allowed = best.cost + 0.5 * len(rows) / num

    def is_far(step: float) -> bool:
        moved = replace(best.state, anchors_m=best.state.anchors_m + step * along[:3])
        return solve(part, moved, held=(*held, np.append(0.0, along))).cost > allowed

    last = _PROFILE_STEPS_M[-1]
    return float(max(next((step for step in _PROFILE_STEPS_M if is_far(sign * step)), last) for sign in (1, -1)))


def _refuse_uncertain(covariance: Array, shape: PathShape, options: TrilaterationOptions) -> None:
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    stddev = float(np.sqrt(variances[2]))
    if stddev <= options.max_position_stddev_m:
        return
    length, width = shape.stddevs[:2]
    if length <= options.max_position_stddev_m / 10:
        why = f"the tag's positions lie within {length:.3g} m of each other"
    elif width < NEARLY_STRAIGHT * length:
        why = "the tag's positions lie on a line, and the anchor may be anywhere on a circle around that line"
    elif np.argmax(np.abs(axes[:, 2] @ shape.axes)) == 2:  # the plane's normal is the nearest of the axes
        why = "the anchor is near the plane of the tag's positions, and its distance from the plane is not determined"
    else:
        why = f"the tag's positions extend over {length:.3g} by {width:.3g} m only, or are too far away"
    # Signs are normalized, so that rounding cannot change them, neither of the whole vector nor of a zero.
    direction = ", ".join(f"{component:.2f}" for component in np.round(oriented(axes)[:, 2], 2) + 0.0)
    raise GeometryError(
        f"the position is not determined: {why} (stddev {min(stddev, _PROFILE_STEPS_M[-1]):.2g} m along {direction})"
    )


def _mirror(found: JudgedFit, covariance: Array, centroid: Array, across: Array) -> PointFit | None:
    """Return the fit of the mirror image in the tag's positions, if it is a different one and fits."""
    at_m = found.point.at_m
    other = found.point.near(at_m - 2 * float((at_m - centroid) @ across) * across)
    apart = other.at_m - at_m
    distance = float(np.linalg.norm(apart))
    stddev = float(np.sqrt(apart @ covariance[:3, :3] @ apart)) / max(distance, 1e-12)
    return other if distance > 2 * stddev and _gap(found, other) < MIN_COST_GAP else None


def _gap(found: JudgedFit, mirror: PointFit) -> float:
    """Return the cost of the mirror image minus that of the fit, with common errors of the ranges accounted for.

    The loss is bounded, so that outliers cost the same for both.
    """
    fit, other = found.point.fit, mirror.fit
    judged = found.judged_by(found.inflation(other.residuals_m - fit.residuals_m))
    return cost_at(judged, other.state, GEMAN_MCCLURE) - cost_at(judged, fit.state, GEMAN_MCCLURE)
