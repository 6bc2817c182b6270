"""Trilateration: where anchors stand, from ranges taken at known positions of the tag.

The first step of Lee, Zhu, Giorgi and Günther (2018), made robust and honest about its error: every anchor is found on
its own, and what ranges get wrong is learnt from those of all anchors together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import PathShape, oriented, path_shape
from rangesfm.processes.threads import with_one_blas_thread
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.point_fit import (
    FitErrors,
    PointFit,
    PointProblem,
    errors_of_fits,
    fit_with_own_noise,
    improve,
)
from rangesfm.ranging.errors.noise import short_range_stddev
from rangesfm.ranging.errors.robust_loss import GEMAN_MCCLURE, SAME_COST
from rangesfm.ranging.log import RangeLog

# Three numbers, and one range more to see that they fit.
MIN_NUM_RANGES = 4
# Half of 3 stddevs squared: a rival this close in cost is not ruled out.
_MIN_COST_GAP = 4.5
# Formal stddevs beyond this share of the distance are checked against the cost itself.
_NONLINEAR = 0.05
_PROFILE_STEPS_M = np.geomspace(0.01, 100.0, 41)
_HOLD = 100.0
_MAX_RANGES_OF_PROFILE = 2000
_NEARLY_STRAIGHT = 0.1
_ACROSS = 0.9
# Sine of the angle between a plane and a direction that is along it, but for rounding.
_ALONG_PLANE = 1e-6
# Of a height that is known.
_HEIGHT_STDDEV_M = 0.01
# A bias that is known is held by a prior far stronger than any ranges.
_KNOWN_BIAS_STDDEV_M = 1e-6


@dataclass(frozen=True)
class TrilaterationOptions:
    """How an anchor is found.

    Attributes:
        range_stddev_m: noise of the ranges that do not say theirs; None: estimated from the residuals.
        range_bias_m: prior mean of what the ranges read too long.
        range_bias_stddev_m: stddev of that prior, by default over the radios of ``components.py``; 0: exactly known.
        max_position_stddev_m: an anchor less certain than this in any direction is refused.
    """

    range_stddev_m: float | None = None
    range_bias_m: float = 0.0
    range_bias_stddev_m: float = 0.25
    max_position_stddev_m: float = 1.0


@dataclass(frozen=True)
class Trilateration:
    """An anchor's place, found from n ranges.

    Attributes:
        position_m: (3,) in the frame of the tag's positions.
        covariance_m2: (3, 3) of the position.
        mirror_position_m: (3,) the place on the other side of the tag's positions that fits as well; or None.
        range_bias_m, range_bias_stddev_m: what the ranges read too long.
        noise_stddev_m: of a range away from all special cases.
        residuals_m: (n,) predicted minus measured.
        weights: (n,) of the robust loss, 1 for a range that fits.
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
        """Of each coordinate: root of their mean variance."""
        return float(np.sqrt(np.trace(self.covariance_m2) / 3))


@dataclass(frozen=True)
class AnchorRanges:
    """n ranges of one anchor to known positions of the tag.

    Attributes:
        tag_positions_m: (n, 3) positions of the tag's antenna.
        range_m: (n,) measured distances.
        range_stddev_m: (n,) noise of each, NaN where unknown; or None.
        shared_stddev_m: (n,) what ranges of about this length may be off together, by the radio's error curve;
            None: without one, short ranges weigh less.
        timestamp_s: (n,) when they were taken; None: in their order.
        tag_index: (n,) by which tag; None: all by the same.
        toward: (3,) direction in which the anchor lies, seen from its mirror image; or None.
        height_m: its z, if that is known.
    """

    tag_positions_m: Array
    range_m: Array
    range_stddev_m: Array | None = None
    shared_stddev_m: Array | None = None
    timestamp_s: Array | None = None
    tag_index: Indices | None = None
    toward: Array | None = None
    height_m: float | None = None

    @property
    def times_s(self) -> Array:
        """(n,); where there are none, of a tag that moves at a walking pace of 1 m/s."""
        if self.timestamp_s is not None:
            return self.timestamp_s
        steps_m = np.linalg.norm(np.diff(self.tag_positions_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps_m)])

    @property
    def tags(self) -> Indices:
        """(n,)"""
        return np.zeros(len(self.range_m), dtype=np.int64) if self.tag_index is None else self.tag_index

    @property
    def shape(self) -> PathShape:
        """Of the tag's positions about their mean; of a level one where the height is known: only that counts."""
        centred = self.tag_positions_m - self.tag_positions_m.mean(axis=0)
        return path_shape(centred if self.height_m is None else centred * [1.0, 1.0, 0.0])

    def fit(self, options: TrilaterationOptions) -> PointFit:
        """The most likely place, as if the ranges erred independently."""
        num = len(self.range_m)
        middle = self.tag_positions_m.mean(axis=0)
        mean = np.array([0.0, 0.0, 0.0, options.range_bias_m])
        prior = np.array([[0.0, 0.0, 0.0, 1 / max(options.range_bias_stddev_m, _KNOWN_BIAS_STDDEV_M)]])
        if self.height_m is not None:
            mean[2] = self.height_m - middle[2]
            prior = np.vstack([prior, [0.0, 0.0, 1 / _HEIGHT_STDDEV_M, 0.0]])
        shared = short_range_stddev(self.range_m) if self.shared_stddev_m is None else self.shared_stddev_m
        problem = PointProblem(self.tag_positions_m - middle, self.range_m, np.ones(num), shared, mean, prior)
        given = np.full(num, np.nan) if self.range_stddev_m is None else self.range_stddev_m
        return fit_with_own_noise(problem, np.where(np.isfinite(given), given, options.range_stddev_m or np.nan))


@dataclass(frozen=True)
class _Found:
    """A fit and how wrong it may be.

    Attributes:
        fit: its prior holds by as much more as errors that go together take from the ranges.
        errors: of its ranges.
        inflation: of the bias, by errors that go together.
    """

    fit: PointFit
    errors: FitErrors
    inflation: float

    @classmethod
    def of(cls, fit: PointFit, errors: FitErrors) -> _Found:
        inflation = errors.inflation_of_bias(fit)
        problem = replace(fit.problem, prior=fit.problem.prior * inflation)
        return cls(replace(fit, problem=problem, x=improve(problem, fit.x)), errors, inflation)

    def judged_by(self, inflation: float) -> PointProblem:
        """The problem with costs in which errors that go together count for what they are."""
        problem = self.fit.problem
        return replace(problem, stddev_m=inflation * problem.stddev_m, prior=problem.prior / self.inflation)


@with_one_blas_thread
def trilaterate(
    tag_positions_m: npt.ArrayLike,
    range_m: npt.ArrayLike,
    *,
    options: TrilaterationOptions | None = None,
    height_m: float | None = None,
    **known: npt.ArrayLike | None,
) -> Trilateration:
    """Find an anchor from its ranges to known positions of the tag.

    Up to about half of the ranges may be wrong by any amount. If the positions lie in a plane, the anchor's
    mirror image in it fits as well: then both are returned, unless ``toward`` says which it is; the upper one first if
    no range tells. Where the height is known, the same goes for positions that lie on a line, seen from above.

    Args:
        tag_positions_m, range_m, height_m: as in ``AnchorRanges``.
        known: others of its attributes: ``range_stddev_m``, ``shared_stddev_m``, ``timestamp_s``, ``toward``.

    Raises:
        GeometryError: too few ranges, positions on a line or all close together, or else an anchor less
            certain than ``options.max_position_stddev_m``.
    """
    positions, ranges = (np.asarray(values, dtype=np.float64) for values in (tag_positions_m, range_m))
    arrays: dict[str, Any] = {
        name: None if values is None else np.asarray(values, dtype=np.float64) for name, values in known.items()
    }
    anchor = AnchorRanges(positions, ranges, height_m=height_m, **arrays)
    (placement,) = _trilaterate_together({"": anchor}, options or TrilaterationOptions())
    if placement.found is None:
        raise GeometryError(str(placement.why_not))
    return placement.found


@dataclass(frozen=True)
class AnchorPlacement:
    """What trilateration says of one anchor.

    Attributes:
        num_ranges: its ranges at known positions of the tag.
        found: where it stands; None if that is not determined, for the reason ``why_not``.
    """

    anchor_id: str
    num_ranges: int
    found: Trilateration | None
    why_not: str | None

    @property
    def anchor(self) -> Anchor:
        """For an anchors' file: without a position if there is none, or if there are two."""
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
    toward: Mapping[str, Sequence[float]] | None = None,
    height_m: Mapping[str, float] | None = None,
    options: TrilaterationOptions | None = None,
) -> tuple[AnchorPlacement, ...]:
    """Place every anchor of a log; what the ranges get wrong is learnt from all of them together.

    Args:
        log: n ranges.
        tag_positions_m: (n, 3) where the tag was at each; NaN where unknown (see ``tag_positions``).
        toward: by anchor, the direction in which it lies of two places that fit alike (see ``trilaterate``).
        height_m: by anchor, its z where that is known.

    Returns:
        one placement for each anchor, in the order of the log.
    """
    known = np.isfinite(tag_positions_m).all(axis=1)
    rows = [np.flatnonzero(known & (log.anchor_index == k)) for k in range(len(log.anchor_ids))]
    anchors = {
        anchor_id: AnchorRanges(
            tag_positions_m[own],
            log.range_m[own],
            range_stddev_m=log.range_stddev_m[own],
            shared_stddev_m=None if log.shared_stddev_m is None else log.shared_stddev_m[own],
            timestamp_s=None if log.timestamp_s is None else log.timestamp_s[own],
            tag_index=log.tag_index[own],
            toward=None if toward is None or anchor_id not in toward else np.asarray(toward[anchor_id], np.float64),
            height_m=None if height_m is None else height_m.get(anchor_id),
        )
        for anchor_id, own in zip(log.anchor_ids, rows, strict=True)
    }
    return _trilaterate_together(anchors, options or TrilaterationOptions())


def _trilaterate_together(
    anchors: Mapping[str, AnchorRanges], options: TrilaterationOptions
) -> tuple[AnchorPlacement, ...]:
    """Find anchors of one radio, whose ranges err alike."""
    fits = {name: anchor.fit(options) for name, anchor in anchors.items() if len(anchor.range_m) >= MIN_NUM_RANGES}
    fitted = [anchors[name] for name in fits]
    times_s, tags = [anchor.times_s for anchor in fitted], [anchor.tags for anchor in fitted]
    is_calibrated = all(anchor.shared_stddev_m is not None for anchor in fitted)
    errors = errors_of_fits([*fits.values()], times_s, tags, is_calibrated=is_calibrated) if fits else []
    errors_of, placements = dict(zip(fits, errors, strict=True)), []
    for name, anchor in anchors.items():
        num, found = len(anchor.range_m), None
        why_not: str | None = f"{num} ranges at known positions of the tag, {MIN_NUM_RANGES} are needed"
        if name in fits:
            try:
                found, why_not = _conclude(anchor, _Found.of(fits[name], errors_of[name]), options), None
            except GeometryError as error:
                why_not = str(error)
        placements.append(AnchorPlacement(name, num, found, why_not))
    return tuple(placements)


def _conclude(anchor: AnchorRanges, found: _Found, options: TrilaterationOptions) -> Trilateration:
    covariance, shape = _covariance(found), anchor.shape
    _refuse_uncertain(covariance, shape, options)
    # Between two places of one height lies an upright plane.
    level = np.cross([0.0, 0.0, 1.0], shape.axes[:, 0])
    across = shape.axes[:, 2] if anchor.height_m is None else oriented(level[:, None])[:, 0]
    mirror = _mirror(found, covariance, shape.centroid, across)
    if mirror is not None:
        apart = (mirror - found.fit.x)[:3]
        told = None if anchor.toward is None else _unless_along_plane(anchor.toward, apart)
        # Where no range tells the two apart, rounding would choose.
        is_free = told is not None or abs(_gap(found, mirror)) < SAME_COST
        if is_free and apart @ (across if told is None else told) > 0:
            found, mirror = replace(found, fit=replace(found.fit, x=mirror)), found.fit.x
            covariance = _covariance(found)
        mirror = mirror if told is None else None
    middle = anchor.tag_positions_m.mean(axis=0)
    return Trilateration(
        position_m=middle + found.fit.x[:3],
        covariance_m2=covariance[:3, :3],
        mirror_position_m=None if mirror is None else middle + mirror[:3],
        range_bias_m=float(found.fit.x[3]),
        range_bias_stddev_m=float(np.sqrt(covariance[3, 3])) if options.range_bias_stddev_m > 0 else 0.0,
        noise_stddev_m=found.fit.noise_m,
        residuals_m=found.fit.residuals_m,
        weights=found.fit.weights,
    )


def _covariance(found: _Found) -> Array:
    """(4, 4) of position and bias: what the errors of the ranges do to the weighted least squares at the minimum.

    Huber and Ronchetti, "Robust Statistics" (2009), section 6.3: the sandwich of the covariance of the gradient between
    inverses of the information. The weakest direction by the cost itself.
    """
    problem, weights = found.fit.problem, found.fit.weights
    jacobian = problem.jacobian(found.fit.x)
    of_prior = problem.prior.T @ problem.prior
    inverse = _inverse((jacobian * weights[:, None]).T @ jacobian + of_prior)
    influence = inverse @ (jacobian * (weights / problem.stddev_m)[:, None]).T
    sandwich = found.errors.of_sums(influence) + found.inflation**2 * inverse @ of_prior @ inverse
    return _with_weak_direction(found, sandwich, inverse)


def _inverse(information: Array) -> Array:
    # Position and bias each in a unit of its own: beside a bias that is known, in metres, no place counts at all.
    strongest = np.diag(information)
    unit = 1 / np.sqrt(np.append(np.full(3, strongest[:3].max()), strongest[3]))
    values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
    inverse: Array = unit[:, None] * ((vectors / np.maximum(values, 1e-12)) @ vectors.T) * unit
    return inverse


def _with_weak_direction(found: _Found, sandwich: Array, formal: Array) -> Array:
    """Near the plane of the tag's positions the curvature across it vanishes, but the cost rises further off."""
    variances, axes = np.linalg.eigh(formal[:3, :3])
    along = np.append(axes[:, 2], 0.0)
    # The other numbers follow along as they do where the curvature holds.
    tied = formal @ along / variances[2]
    inflation = found.errors.inflation(found.fit, found.fit.problem.slopes(found.fit.x) @ tied)
    if inflation * np.sqrt(variances[2]) < _NONLINEAR * float(np.median(found.fit.problem.range_m)):
        return sandwich
    rest = np.eye(4) - np.outer(tied, along)
    changed: Array = rest @ sandwich @ rest.T + _profile_stddev(found, along, inflation) ** 2 * np.outer(tied, tied)
    return changed


def _profile_stddev(found: _Found, along: Array, inflation: float) -> float:
    """How far the point moves ``along`` (4,) until the cost, all else adapted, has risen by that of one stddev."""
    num = len(found.fit.problem.range_m)
    rows = np.linspace(0, num - 1, min(num, _MAX_RANGES_OF_PROFILE)).astype(np.int64)
    part = found.judged_by(inflation).subset(rows)
    hold = np.vstack([part.prior, _HOLD * np.sqrt(np.sum(part.stddev_m**-2)) * along])
    best = improve(part, found.fit.x)
    allowed = part.cost(best) + 0.5 * len(rows) / num

    def is_far(step: float) -> bool:
        moved = best + step * along
        held = replace(part, prior_mean=np.append(moved[:3], part.prior_mean[3]), prior=hold)
        return held.cost(improve(held, moved)) > allowed

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
    elif width < _NEARLY_STRAIGHT * length:
        why = "the tag's positions lie on a line, about which the anchor may stand anywhere"
    elif abs(axes[:, 2] @ shape.axes[:, 2]) > _ACROSS:
        why = "the anchor stands near the plane in which the tag's positions lie, and how far off it is not seen"
    else:
        why = f"the tag's positions extend over {length:.3g} by {width:.3g} m, too little or too far away"
    # No minus sign by rounding, neither of all three nor of a zero.
    direction = ", ".join(f"{component:.2f}" for component in np.round(oriented(axes)[:, 2], 2) + 0.0)
    raise GeometryError(
        f"the position is not determined: {why} (stddev {min(stddev, _PROFILE_STEPS_M[-1]):.2g} m along {direction})"
    )


def _mirror(found: _Found, covariance: Array, centroid: Array, across: Array) -> Array | None:
    """(4,) the place on the other side of the tag's positions, if it is another one and fits as well."""
    height = float((found.fit.x[:3] - centroid) @ across)
    other = improve(found.fit.problem, found.fit.x - 2 * height * np.append(across, 0.0))
    apart = (other - found.fit.x)[:3]
    distance = float(np.linalg.norm(apart))
    stddev = float(np.sqrt(apart @ covariance[:3, :3] @ apart)) / max(distance, 1e-12)
    return other if distance > 2 * stddev and _gap(found, other) < _MIN_COST_GAP else None


def _gap(found: _Found, mirror: Array) -> float:
    """How much worse the mirror image fits, beside what errors that go together do to the difference.

    By a bounded loss: outliers cost the same wherever the point is.
    """
    problem = found.fit.problem
    inflation = found.errors.inflation(found.fit, problem.residuals_m(mirror) - found.fit.residuals_m)
    judged = found.judged_by(inflation)
    return judged.cost(mirror, GEMAN_MCCLURE) - judged.cost(found.fit.x, GEMAN_MCCLURE)


def _unless_along_plane(direction: Array, across: Array) -> Array | None:
    """A direction that tells two places apart; of one along the plane between them, rounding would choose the sign."""
    least = _ALONG_PLANE * float(np.linalg.norm(direction) * np.linalg.norm(across))
    return direction if abs(direction @ across) > least else None
