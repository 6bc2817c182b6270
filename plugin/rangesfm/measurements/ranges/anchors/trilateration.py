"""Trilateration: positions of anchors from ranges at known positions of the tag.

It is the estimate of a run with the path held: the same robust fit, errors and best weights (sections 4 to 7 of
``model.md``). The errors are learnt from the ranges to all anchors together, or to each that has many. Lee, Zhu, Giorgi
and Günther (2018) begin with it, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.linalg import null_space
from scipy.optimize import brentq

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.point_fit import likeliest_state
from rangesfm.measurements.ranges.errors.noise import MIN_NUM_OF_SCATTER, START_STDDEV_M
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus
from rangesfm.measurements.ranges.scale.binned_ranges import binned_ranges
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState, cost_at, solve, state_after
from rangesfm.measurements.ranges.scale.range_start import RangesOnPath
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.scale_problem import (
    MIN_NUM_RANGES,
    ScaleProblem,
    walking_times_s,
)
from rangesfm.measurements.ranges.scale.solution import solution_from
from rangesfm.options import RangeModelOptions
from rangesfm.solver.bending import WalkBending
from rangesfm.solver.linear_map import Solved
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import ScaleByKind
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, UNDETERMINED
from rangesfm.util.geometry.robust_statistics import MIN_COST_GAP, SAME_COST
from rangesfm.util.geometry.similarity import IDENTITY, NEARLY_STRAIGHT, PathShape, oriented, path_shape
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import with_one_blas_thread

# Standard deviations above this fraction of the distance are computed from the residuals themselves, not from their
# derivatives.
_NONLINEAR = 0.05
# Distances at which the residuals are then evaluated, metres.
_PROFILE_STEPS_M = tuple(0.01 * 2.0**n for n in range(14))
# Standard deviation of a height that is known, metres.
_KNOWN_STDDEV_M = 0.01
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
    is_known = np.isfinite(tag_positions_m).all(axis=1)
    counts = np.bincount(log.anchor_index[is_known], minlength=len(log.anchor_ids))
    rows = np.flatnonzero(is_known & (counts >= MIN_NUM_RANGES)[log.anchor_index])
    placements = [
        AnchorPlacement(name, num, None, f"{num} ranges at known positions of the tag, {MIN_NUM_RANGES} are needed")
        for name, num in zip(log.anchor_ids, counts.tolist(), strict=True)
    ]
    if not len(rows):
        return tuple(placements)
    # Near the origin, because large coordinates lose digits.
    middle, heights_m = tag_positions_m[rows].mean(axis=0), [height_m.get(each, np.nan) for each in log.anchor_ids]
    posed = _on_given_path(log, rows, tag_positions_m - middle, np.array(heights_m) - middle[2], options)
    for k, located, fitted in _located(posed):
        told = np.asarray(toward.get(log.anchor_ids[k], np.zeros(3)), np.float64)
        try:
            found, why_not = _concluded(located, fitted, k, middle, told, options), ""
        except GeometryError as error:
            found, why_not = None, str(error)
        placements[k] = replace(placements[k], found=found, why_not=why_not)
    return tuple(placements)


def _on_given_path(
    log: RangeLog, rows: Indices, tags_m: Array, heights_m: Array, options: TrilaterationOptions
) -> ScaleProblem:
    """Pose the problem of unknown anchors beside a path that is given.

    The path is a camera that stands still with the tag anywhere beside it: lever arms are in metres, and never scale.

    Args:
        rows: of the ranges that take part. tags_m: (n, 3). heights_m: (m,) of the anchors; NaN where unknown.
    """
    if isinstance(log.moments, ByPhoto):
        times_s = np.zeros(len(log))
        for k in np.unique(log.anchor_index[rows]):
            own = rows[log.anchor_index[rows] == k]
            times_s[own] = walking_times_s(tags_m[own])
        log = replace(log, moments=ByTime(times_s))
    index, num = log.anchor_index[rows], len(log.anchor_ids)
    nothing, origin, one_pose = np.zeros(len(log)), np.zeros((len(log), 3)), np.zeros(len(log), dtype=np.int64)
    status = np.full(len(log), RangeStatus.NO_KEYFRAME_NEAR, dtype=np.int8)
    status[rows] = RangeStatus.USED
    observations = RangeObservations(
        before=one_pose,
        after=one_pose,
        fraction=nothing,
        centers=origin,
        center_offsets=origin,
        tag_from_center=tags_m,
        center_stddev=nothing,
        arm_stddev_m=nothing,
        log=log,
        status=status,
    )
    still = Trajectory(np.zeros(1, dtype=np.int64), ("",), None, np.zeros((1, 3)), np.eye(3)[None])
    # So few residuals do not show the noise, as place and bias of each anchor follow them.
    is_shown = len(rows) - MIN_NUM_RANGES * len(np.unique(index)) >= MIN_NUM_OF_SCATTER
    model = RangeModelOptions(
        range_stddev_m=options.range_stddev_m or (None if is_shown else START_STDDEV_M),
        range_bias_stddev_m=options.range_bias_stddev_m,
        common_bias_stddev_m=0.0,
    )
    errors = RangeErrors.begin(observations, rows, model)
    ranges = RangeProblem(
        centers=origin[rows],
        tag_from_center=tags_m[rows],
        anchor_index=index,
        range_m=log.range_m[rows],
        stddev_m=errors.stddev_m,
        anchor_mean_m=np.column_stack([np.full((num, 2), np.nan), heights_m]),
        anchor_stddev_m=np.where(np.isnan(heights_m), np.inf, _KNOWN_STDDEV_M),
        bias_mean_m=np.full(num, options.range_bias_m),
        bias_stddev_m=np.full(num, options.range_bias_stddev_m),
        common_bias_stddev_m=0.0,
        frame_is_free=False,
        share=errors.share,
        # Nothing depends on the scale of a camera that stands still, and this keeps it as it is.
        scales=(ScaleByKind(1.0, 1.0),),
    )
    given = RangesOnPath(observations, WalkBending(still), (), "unknown", model)
    upright = np.tile(np.eye(3), (len(rows), 1, 1))
    return ScaleProblem(given, given.bending, ranges, IDENTITY, upright, None, rows, (), ())


def _located(posed: ScaleProblem) -> Iterator[tuple[int, Linearized, RangesOnMap]]:
    """Yield each anchor at its likeliest place, with the errors that all ranges show; and the robust fit of all."""
    problem, before = posed.ranges, posed.prior_errors
    state = RangeState(IDENTITY, np.zeros((problem.num_anchors, 3)), problem.bias_mean_m.copy())
    noise_m = np.where(before.is_estimated, START_STDDEV_M, before.given_m)
    for k in np.unique(problem.anchor_index):
        rows = problem.anchor_index == k
        found = likeliest_state(problem.of_anchor(k), noise_m[rows], before.shared_m[rows])
        state.anchors_m[k], state.bias_m[k] = found.anchors_m[0], found.bias_m[0]
    fitted, index = solution_from(posed, state), problem.anchor_index
    together = _in_bins(fitted).learnt()
    for k in np.unique(index).tolist():
        # As many bins for each anchor as for all: in those of all, what tells the places would be averaged away over a
        # long log. The others are held.
        is_own = np.arange(problem.num_anchors) == k
        alone = replace(problem, anchor_stddev_m=np.where(is_own, problem.anchor_stddev_m, 0.0))
        own = _in_bins(replace(fitted.with_problem(alone), weights=np.where(index == k, fitted.weights, 0.0)))
        # So would errors that last for seconds, which bins of its own show, if there are about as many of them.
        shows = 2 * len(own.bins) > len(together.bins)
        own = own.learnt(near=together.sizes) if shows else replace(own, sizes=together.sizes)
        yield k, own.settled(fitted.state), fitted


def _in_bins(on_map: RangesOnMap) -> Linearized:
    """Return the linear problem of ranges, whose biases have the prior that was given."""
    observed, bias_stddev_m = binned_ranges(on_map), float(on_map.problem.bias_stddev_m[0])
    index = observed.bins.anchor_index
    own_bias = Component("bias", (index[:, None] == index).astype(np.float64), bias_stddev_m)
    others = (each for each in observed.components if each.name not in ("bias", "common_bias"))
    return Linearized.by_ranges(replace(observed, components=(*others, own_bias)), on_map, on_map.noise_stddev_m)


def _concluded(
    located: Linearized, fitted: RangesOnMap, k: int, middle: Array, toward: Array, options: TrilaterationOptions
) -> Trilateration:
    """Return the position of an anchor with its mirror image, in a frame in which ``middle`` is the problem's origin.

    Raises:
        GeometryError: the position is less certain than wanted.
    """
    covariance, problem = _covariance(located, k), located.on_map.problem
    own = problem.anchor_index == k
    tags_m, height_is_known = problem.tag_from_center[own], bool(np.isfinite(problem.anchor_mean_m[k, 2]))
    shape = path_shape(tags_m * [1.0, 1.0, 0.0] if height_is_known else tags_m)
    _refuse_uncertain(covariance, shape, options)
    # With a known height, position and mirror image have the same height, and the plane between them is vertical.
    level = np.cross([0.0, 0.0, 1.0], shape.axes[:, 0])
    across = oriented(level[:, None])[:, 0] if height_is_known else shape.axes[:, 2]
    mirrored, gap = _mirror_image(fitted, k, shape.centroid, across)
    mirror = located.settled(mirrored) if gap < MIN_COST_GAP else located
    apart = _place_m(mirror, k) - _place_m(located, k)
    is_open = bool(apart @ apart > 2 * np.sqrt(apart @ covariance @ apart))
    tells = bool(abs(toward @ across) > UNDETERMINED * np.linalg.norm(toward))
    # If both fit equally well, the choice would depend on rounding, so the order is fixed.
    if is_open and (tells or abs(gap) < SAME_COST) and apart @ (toward if tells else across) > 0:
        located, mirror = mirror, located
        covariance = _covariance(located, k)
    bias_m, bias_stddev_m = _bias(located, k)
    noise_m = np.where(located.on_map.errors.is_estimated, located.scatter_m, located.on_map.errors.given_m)
    return Trilateration(
        position_m=middle + _place_m(located, k),
        covariance_m2=covariance,
        mirror_position_m=middle + _place_m(mirror, k) if is_open and not tells else None,
        range_bias_m=options.range_bias_m + bias_m,
        range_bias_stddev_m=bias_stddev_m,
        noise_stddev_m=float(np.median(noise_m[own])),
        residuals_m=located.on_map.residual_m[own] + bias_m,
        weights=located.on_map.weights[own],
    )


def _place_m(located: Linearized, k: int) -> Array:
    return np.asarray(located.on_map.state.anchors_m[k])


def _bias(located: Linearized, k: int) -> tuple[float, float]:
    """Return the bias of an anchor's ranges from its prior mean, and its standard deviation, metres."""
    solved = located.solution
    stddev_m = float(located.on_map.problem.bias_stddev_m[k])
    of_bins = stddev_m**2 * (located.bins.anchor_index == k)
    left = solved.left(solved.whitened(of_bins[:, None]))[:, 0]
    return -float(left @ solved.residual), float(np.sqrt(np.maximum(stddev_m**2 - left @ left, 0.0)))


def _covariance(located: Linearized, k: int) -> Array:
    """Return the covariance (3, 3) of an anchor's position.

    Near the plane of the tag's positions the derivatives of the ranges by the distance from the plane vanish, but the
    residuals rise farther off. So the standard deviation in the weakest direction may be the distance at which the
    misfit is higher by that of one standard deviation.
    """
    noise_m2, own = located.noise.covariance_m2, located.columns.anchor[k] + np.arange(3)
    whole = located.solution.covariance
    covariance: Array = whole[np.ix_(own, own)]
    variances, axes = np.linalg.eigh(covariance)
    along, problem = axes[:, 2], located.on_map.problem
    if np.sqrt(variances[2]) < _NONLINEAR * float(np.median(problem.range_m[problem.anchor_index == k])):
        return covariance
    # How all else changes with this direction, to first order, and the directions in which it is free.
    tied, held = whole[:, own] @ along / variances[2], np.zeros((1, len(whole)))
    held[0, own] = along
    free = null_space(held)

    def solved(at: Linearized) -> Solved:
        return Solved(noise_m2, at.jacobian @ free, at.residual)

    def misfit(distance_m: float) -> float:
        """Return the misfit at a distance along the direction, with all else adapted."""
        moved, step, found = located, distance_m * tied, np.inf
        for _ in range(MAX_NUM_ROUNDS):
            state = state_after((located.columns,), moved.on_map.state, step)
            moved, before = located.at_state(replace(located.on_map, state=state)), found
            best = solved(moved)
            found, step = best.misfit, np.zeros(len(tied))
            if abs(before - found) < NEGLIGIBLE_STDDEVS:
                break
            step[own] = free[own] @ best.step
        return found

    most = misfit(0.0) + 1.0

    def reached(side: float) -> float:
        near = 0.0
        for far in _PROFILE_STEPS_M:
            if misfit(side * far) > most:
                return float(brentq(lambda at: misfit(side * at) - most, near, far, rtol=_NONLINEAR))
            near = far
        return near

    of_free = free[own] @ solved(located).covariance @ free[own].T
    return np.asarray(of_free + max(reached(1.0), reached(-1.0)) ** 2 * np.outer(along, along))


def _refuse_uncertain(covariance: Array, shape: PathShape, options: TrilaterationOptions) -> None:
    variances, axes = np.linalg.eigh(covariance)
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


def _mirror_image(fitted: RangesOnMap, k: int, centroid: Array, across: Array) -> tuple[RangeState, float]:
    """Return the state of a fit with an anchor mirrored in the tag's positions, and how much higher its cost is.

    The loss is bounded, so that outliers cost the same for both.
    """
    state, alone, loss = fitted.state, fitted.weighted.of_anchor(k), fitted.errors.loss
    here = RangeState(IDENTITY, state.anchors_m[k : k + 1], state.bias_m[k : k + 1])
    off_m = (here.anchors_m - centroid) @ across
    fit = solve(alone, replace(here, anchors_m=here.anchors_m - 2 * off_m[:, None] * across), loss=loss)
    anchors_m = state.anchors_m.copy()
    anchors_m[k] = fit.state.anchors_m[0]
    gap = (fit.cost - cost_at(alone, here, loss)) / fitted.errors.inflation**2
    return replace(state, anchors_m=anchors_m), gap
