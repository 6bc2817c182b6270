"""RangesOnMap, the ranges of a survey on its scaled map, and Linearized, the linear problem that all tests use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.ranges.errors.components import DRIFT_S, PLACES, WANDERING, OtherError
from rangesfm.measurements.ranges.errors.learned import LearnedErrors, learn_errors, radio_components
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, by_poses, noisiness, range_bins
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.measurements.ranges.range_observations import OnPath
from rangesfm.measurements.ranges.scale.binned_ranges import ruled_out
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    RangeState,
    antenna_positions,
    columns_of,
    prior_jacobian,
    prior_residuals,
    range_jacobian,
    state_after,
)
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.solution import Solution
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import LinearMap
from rangesfm.solver.noise import Component, noise_of_sizes, usual_sizes
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import MIN_STDDEV_M, robust_stddev
from rangesfm.util.geometry.similarity import similarity_motions

# Fewer bins than for an interval, because the tests learn the errors many times.
_MAX_NUM_BINS = 160
# Number of consecutive ranges of an anchor whose median they are compared with, and how many of them agree with it.
_NUM_NEIGHBOURS, _NUM_AGREEING = 8, 3
# Least noise that counts where a range is compared with the median of its neighbours, to see whether it is an outlier
# among them: a radio may repeat itself to a centimetre and still err by ten from one place to the next.
_LEAST_SCATTER_M = 0.08
# Largest difference of two errors of an anchor's ranges, as a share of the path's extent and distance: more than where
# the ranges are in feet, of both ways, or of an anchor that was moved across the site.
_MOST_MISREAD = 4.0
# Standard deviation of a slow wandering of the ranges, metres, for each anchor and for all, as hands and bodies move.
# It is always assumed, in addition to the learnt drift of the radio, which is learnt as nothing where steps may explain
# it. It is too slow to be confused with a step. Without it, a mistake that nobody made is named in 7 of 72 real logs,
# with it in 4 (``tests.studies.real_logs``).
_WANDERING_M = 0.025


@dataclass(frozen=True)
class RangesOnMap:
    """n ranges that took part in an estimate, and its state.

    Attributes:
        posed: their scale problem.
        problem: its ranges, corrected where a mistake is undone, with standard deviations of 1: its residuals and
            Jacobians are in metres.
        state: the estimate.
        model_from_cam: (n, 3, 3) rotations into the model's world.
        velocity: (n, 3) camera velocities, model units per second; None where ranges have no times.
        time_s: (n,) as ``ScaleProblem.times_s``.
        weights: (n,) robust weights in the estimate.
        bending: of the map; None: the map is not bent.
    """

    posed: ScaleProblem
    problem: RangeProblem
    state: RangeState
    model_from_cam: Array
    velocity: Array | None
    time_s: Array
    weights: Array
    bending: MapBending | None

    @property
    def anchor_ids(self) -> tuple[str, ...]:
        return self.posed.observations.log.anchor_ids

    @property
    def tag_ids(self) -> tuple[str, ...]:
        return self.posed.observations.log.tag_ids

    @property
    def tag_index(self) -> Indices:
        return self.posed.observations.log.tag_index[self.posed.rows]

    @property
    def on_path(self) -> OnPath:
        """Places of the ranges between keyframes."""
        return self.posed.observations.on_path(self.posed.rows)

    @property
    def world_from_cam(self) -> Array:
        """(n, 3, 3) rotations of the cameras into the metric world."""
        turned: Array = np.einsum("ij,njk->nik", self.state.metric_from_model.rotation, self.model_from_cam)
        return turned

    @property
    def residual_m(self) -> Array:
        """(n,) predicted minus measured range, metres, with the prior means of the biases."""
        biases_m = self.problem.bias_mean_m[self.problem.anchor_index]
        return np.asarray(np.linalg.norm(self.from_anchor_m, axis=1) + biases_m - self.problem.range_m)

    @property
    def from_anchor_m(self) -> Array:
        """(n, 3) vectors from each range's anchor to its tag, in the metric world."""
        tags_m = antenna_positions(self.problem, self.state.metric_from_model)
        return np.asarray(tags_m - self.state.anchors_m[self.problem.anchor_index])


def ranges_on_map(posed: ScaleProblem, solution: Solution, bending: MapBending | None) -> RangesOnMap:
    """Collect the ranges of a problem at its solution."""
    return RangesOnMap(
        posed=posed,
        problem=replace(posed.ranges, stddev_m=np.ones(len(posed.rows)), share=np.ones(len(posed.rows))),
        state=solution.fit.state,
        model_from_cam=posed.model_from_cam,
        velocity=posed.velocity,
        time_s=posed.times_s(solution.fit.state.metric_from_model.scale),
        weights=solution.fit.weights,
        bending=bending,
    )


@dataclass(frozen=True)
class Linearized(LinearMap):
    """The linear problem of c bins of ranges and r priors; the anchors' biases are random errors.

    Its residuals are those of the map as the photos alone would have it. Priors are first those of the anchors' places.

    Attributes:
        place: (c, 3, p) derivative of the tag's position in each bin.
        bins: how ranges are averaged. time_s: (c,) mean times.
        gradient: of the c distances.
        by_lever_arm: (c, 3) derivative of the residual by the lever arm in the camera's frame.
        by_time: (c,) derivative by the clocks' offset; None without times.
        on_map: the ranges. scatter_m: standard deviation of a range among its neighbours.
        shift_m: (c,) change of the residuals from the map as it is to the map as the photos alone would have it.
        components: of the errors. errors: the errors assumed random.
    """

    place: Array
    bins: RangeBins
    time_s: Array
    gradient: RangeGradient
    by_lever_arm: Array
    by_time: Array | None
    on_map: RangesOnMap
    scatter_m: float
    shift_m: Array
    components: tuple[Component, ...]
    errors: LearnedErrors

    @property
    def num_priors(self) -> int:
        return len(self.prior_residual)

    @property
    def heard(self) -> list[int]:
        """Indices of the anchors that have ranges."""
        anchors: list[int] = np.unique(self.bins.anchor_index).tolist()
        return anchors

    def with_learnt_errors(
        self, columns: Array | None = None, priors: Array | None = None, near: LearnedErrors | None = None
    ) -> Linearized:
        """Return the problem with the errors learnt while given mistakes explain what they can.

        Args:
            columns, priors: (c, k) and (r, k) effects of the mistakes; None: no mistake was made.
            near: errors of nearly the same problem, to start from, which takes half the time.
        """
        columns = self.design[:, :0] if columns is None else columns
        priors = self.prior_design[:, :0] if priors is None else priors
        # Residuals are taken where the priors' residuals are smallest, with the map as it is.
        back = np.linalg.lstsq(self.prior_design, self.prior_residual, rcond=1e-12)[0]
        learnt = learn_errors(
            self.components,
            self.bins,
            off_m=self.design @ back - self.residual_m,
            design=np.hstack([self.design, columns]),
            prior_design=np.hstack([self.prior_design, priors]),
            noise_m=self.scatter_m,
            # A radio that errs by significantly more than others was mistaken, which must not pass for noise.
            most_unusual=SIGNIFICANT_STDDEVS,
            near=near,
        )
        return replace(self, errors=learnt)

    def with_usual_errors(self) -> Linearized:
        """Return the problem with the errors usual for radios and maps with this scatter."""
        return replace(self, errors=_usual_errors(self.components, self.bins, self.scatter_m))


def linearized(on_map: RangesOnMap, bins_of_ranges: RangeBins | None = None) -> Linearized:
    """Linearise at the map's own state, with the usual errors.

    Args:
        bins_of_ranges: for ranges without noise; None: bins are formed from the ranges that agree with their
            neighbours, however far they are from the map.
    """
    return _with_usual_errors(on_map, *(_bins(on_map) if bins_of_ranges is None else (bins_of_ranges, 0.0)))


def at_other_map(problem: Linearized, on_map: RangesOnMap) -> Linearized:
    """Linearise the same ranges on another map, in the same bins, with the usual errors."""
    return _with_usual_errors(on_map, problem.bins, problem.scatter_m)


def _with_usual_errors(on_map: RangesOnMap, bins: RangeBins, scatter_m: float) -> Linearized:
    towards = RangeGradient.of(on_map.from_anchor_m).by_tag
    placing_m = on_map.posed.placing_stddev_m(on_map.state.metric_from_model.scale)
    by_places_m2 = bins.shared_by_places(towards, placing_m, on_map.on_path.before)
    others_m2: dict[OtherError, Array] = {WANDERING: _wandering_m2(bins), PLACES: by_places_m2}
    components = radio_components(bins, on_map.posed.curve_stddev_m, ruled_out(on_map.problem), others_m2)
    bending = on_map.bending
    if bending is None:
        shift_m = np.zeros(len(bins))
    else:
        by_pose = bins.by_pose(slopes_by_poses(on_map), len(bending.path))
        bent = bending.of_functions(by_pose, frame_is_free=on_map.problem.frame_is_free)
        components, shift_m = (*components, *bent.parts), bent.shift_m
    return _linearized(on_map, components, bins, shift_m, scatter_m, _usual_errors(components, bins, scatter_m))


def _usual_errors(components: Sequence[Component], bins: RangeBins, scatter_m: float) -> LearnedErrors:
    return LearnedErrors.from_noise(
        noise_of_sizes(components, usual_sizes(components) | {"white": scatter_m}, len(bins)), bins
    )


def at_state(problem: Linearized, on_map: RangesOnMap) -> Linearized:
    """Linearise the problem at another state or for corrected ranges, with the same bins and errors."""
    of = problem
    return _linearized(on_map, of.components, of.bins, of.shift_m, of.scatter_m, of.errors)


def is_nearly_at(now: RangesOnMap, before: RangesOnMap, scatter_m: float) -> bool:
    """Return whether a round of an iteration has moved the tags, as seen from the anchors, by hardly anything.

    Args:
        scatter_m: of single ranges, metres.
    """
    moved_m = now.from_anchor_m - before.from_anchor_m
    return bool(np.sqrt(np.mean(moved_m**2)) < NEGLIGIBLE_STDDEVS * scatter_m)


def after_step(problem: Linearized) -> Linearized:
    """Return the problem after a step to the likeliest state, or after a part of it.

    A whole step moves an anchor by kilometres in a direction of which ranges say next to nothing, as its height above
    a flat path. So a step that makes the state less likely is halved.
    """
    solved = problem.solved(problem.errors.covariance_m2)

    def cost(of: Linearized) -> float:
        return float(np.sum(solved.whitened(of.residual_m[:, None], of.prior_residual[:, None]) ** 2))

    step, before = solved.step, cost(problem)
    for share in 0.5 ** np.arange(MAX_NUM_ROUNDS):
        state = state_after((problem.columns,), problem.on_map.state, share * step)
        moved = at_state(problem, replace(problem.on_map, state=state))
        if cost(moved) <= before:
            return moved
    return problem


def _linearized(
    on_map: RangesOnMap,
    components: tuple[Component, ...],
    bins: RangeBins,
    shift_m: Array,
    scatter_m: float,
    errors: LearnedErrors,
) -> Linearized:
    # The anchors' biases are random errors here, not parameters.
    problem = replace(on_map.problem, bias_stddev_m=np.zeros(on_map.problem.num_anchors))
    state, placed = on_map.state, on_map.state.metric_from_model
    columns, gradient, mean = columns_of([problem])[0], RangeGradient.of(on_map.from_anchor_m), bins.mean
    by_time = None
    if on_map.velocity is not None:
        by_time = mean(gradient.by_log_scale(placed.scale * on_map.velocity @ placed.rotation.T))
    place = np.zeros((len(bins), 3, columns.num))
    place[:, :, columns.scale] = mean(placed.scale * problem.centers @ placed.rotation.T)
    if columns.frame >= 0:
        arms_m = mean(antenna_positions(problem, placed) - placed.translation)
        place[:, :, columns.frame : columns.frame + 6] = similarity_motions(arms_m)[:, :, 1:]
    return Linearized(
        residual_m=mean(on_map.residual_m) + shift_m,
        design=mean(range_jacobian(problem, columns, state, state)),
        prior_residual=prior_residuals(problem, columns, state),
        prior_design=prior_jacobian(problem, columns, state, state),
        columns=columns,
        place=place,
        bins=bins,
        time_s=mean(on_map.time_s),
        gradient=RangeGradient(mean(gradient.distance_m), mean(gradient.by_tag)),
        by_lever_arm=mean(gradient.by_tag_in_cam(on_map.world_from_cam)),
        by_time=by_time,
        on_map=on_map,
        scatter_m=scatter_m,
        shift_m=shift_m,
        components=components,
        errors=errors,
    )


def slopes_by_poses(on_map: RangesOnMap) -> csr_array:
    """Return the (n, 6 k) derivatives of the distances by the path's k poses."""
    gradient, placed = RangeGradient.of(on_map.from_anchor_m), on_map.state.metric_from_model
    return by_poses(gradient, placed, on_map.model_from_cam, on_map.problem.tag_from_center, on_map.on_path)


def _wandering_m2(bins_of_ranges: RangeBins) -> Array:
    index, time_s = bins_of_ranges.anchor_index, bins_of_ranges.time_s
    together = np.exp(-np.abs(time_s[:, None] - time_s) / DRIFT_S)
    return np.asarray(_WANDERING_M**2 * (1.0 + (index[:, None] == index)) * together)


def _bins(on_map: RangesOnMap) -> tuple[RangeBins, float]:
    index = on_map.problem.anchor_index
    order = np.lexsort((on_map.time_s, on_map.tag_index, index))
    off_m, scatter_m = _off_neighbours(on_map.residual_m[order], index[order])
    agrees = np.empty(len(order), dtype=bool)
    agrees[order] = _agree(np.abs(off_m) <= near_m(scatter_m), index[order])
    of_ranges = range_bins(
        index,
        on_map.tag_index,
        on_map.time_s,
        on_map.from_anchor_m,
        np.swapaxes(on_map.world_from_cam, 1, 2),
        (agrees & _can_be(on_map)).astype(np.float64),
        noisiness(index[order], off_m, on_map.problem.num_anchors),
        _MAX_NUM_BINS,
    )
    return of_ranges, scatter_m


def _can_be(on_map: RangesOnMap) -> Mask:
    """Return (n,) whether a range can be one of its anchor, by the extent of the path.

    By the triangle inequality, the distances to an anchor from two places differ by no more than these are apart,
    wherever the anchor stands. Garbage that repeats itself agrees with its neighbours, and is farther off.
    """
    index, from_anchor_m, residual_m = on_map.problem.anchor_index, on_map.from_anchor_m, on_map.residual_m
    can_be = np.ones(len(index), dtype=bool)
    for anchor in np.unique(index):
        is_of = index == anchor
        distance_m = np.linalg.norm(from_anchor_m[is_of], axis=1)
        apart_m = np.linalg.norm(np.ptp(from_anchor_m[is_of], axis=0))
        off_m = np.abs(residual_m[is_of] - np.median(residual_m[is_of]))
        can_be[is_of] = off_m <= _MOST_MISREAD * (apart_m + np.median(distance_m))
    return can_be


def near_m(scatter_m: float) -> float:
    """Return how far from its neighbours a range with this scatter may be, in metres."""
    return SIGNIFICANT_STDDEVS * max(scatter_m, _LEAST_SCATTER_M)


def _agree(are_near: Mask, anchor_index: Indices) -> Mask:
    """Return (n,) which values are near the median of a few consecutive ones, unless too few of these are.

    Where most of them are garbage, so is their median, but hardly another one agrees with it.
    """
    labels = _neighbours(anchor_index)
    enough = np.minimum((np.bincount(labels) + 1) // 2, _NUM_AGREEING)
    return np.asarray(are_near & (np.bincount(labels, are_near) >= enough)[labels])


def _neighbours(anchor_index: Indices) -> Indices:
    """Return (n,) labels of a few consecutive values of one anchor, given equal indices together."""
    rows, begins = np.arange(len(anchor_index)), np.diff(anchor_index, prepend=-1) != 0
    since = rows - np.maximum.accumulate(np.where(begins, rows, 0))
    return np.asarray(np.cumsum(begins | (since % _NUM_NEIGHBOURS == 0)) - 1)


def _off_neighbours(values: Array, anchor_index: Indices) -> tuple[Array, float]:
    """Return (n,) differences from the lower median of a few consecutive values, and the stddev of a value.

    Args:
        values: in order of time within each anchor. anchor_index: (n,), equal values together.
    """
    labels = _neighbours(anchor_index)
    counts = np.bincount(labels)
    by_value = np.lexsort((values, labels))
    middles = values[by_value][np.cumsum(counts) - counts + (counts - 1) // 2]
    steps = np.diff(values)[np.diff(anchor_index) == 0]
    return values - middles[labels], max(robust_stddev(steps) / np.sqrt(2), MIN_STDDEV_M)
