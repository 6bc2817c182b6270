"""Linearized, the linear problem of a map's ranges in which all mistakes are tested (section 8 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.ranges.errors.components import DRIFT_S, WANDERING
from rangesfm.measurements.ranges.errors.learned import is_widened, widening
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, noisiness
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.measurements.ranges.scale.binned_ranges import BinnedRanges, in_bins
from rangesfm.measurements.ranges.scale.range_equation import RangeState, antenna_positions, state_after
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.solver.posterior import JointProblem, joined
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, ROUNDING, SIGNIFICANT_STDDEVS
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


@dataclass(frozen=True, kw_only=True)
class Linearized(JointProblem):
    """The linear problem of ranges in c bins alone, and of r priors; the anchors' biases are random errors.

    Priors are first those of the anchors' places.

    Attributes:
        on_map: the ranges. bins: how they are averaged.
        scatter_m: standard deviation of a range among its neighbours.
    """

    on_map: RangesOnMap
    bins: RangeBins
    scatter_m: float

    @classmethod
    def by_ranges(cls, observed: BinnedRanges, on_map: RangesOnMap, scatter_m: float) -> Linearized:
        """Return the problem of ranges that were averaged on a map, with the usual sizes of their errors."""
        problem = joined([observed], on_map.posed.bending)
        return cls(**vars(problem), on_map=on_map, bins=observed.bins, scatter_m=scatter_m)

    @cached_property
    def time_s(self) -> Array:
        """(c,) mean times."""
        return self.bins.mean(self.on_map.time_s)

    @cached_property
    def gradient(self) -> RangeGradient:
        """Of the c distances."""
        of_ranges = self.on_map.gradient
        return RangeGradient(self.bins.mean(of_ranges.distance_m), self.bins.mean(of_ranges.by_tag))

    @property
    def by_lever_arm(self) -> Array:
        """(c, 3) derivatives of the residuals by the lever arm in the camera's frame."""
        return self.bins.mean(self.on_map.gradient.by_tag_in_cam(self.on_map.world_from_cam))

    @property
    def place(self) -> Array:
        """(c, 3, p) derivatives of the tag's position in each bin."""
        problem, placed = self.on_map.problem, self.on_map.state.metric_from_model
        place = np.zeros((len(self.bins), 3, self.columns.num))
        place[:, :, self.columns.scale] = self.bins.mean(placed.scale * problem.centers @ placed.rotation.T)
        if self.columns.frame >= 0:
            arms_m = self.bins.mean(antenna_positions(problem, placed) - placed.translation)
            place[:, :, self.columns.frame : self.columns.frame + 6] = similarity_motions(arms_m)[:, :, 1:]
        return place

    @property
    def heard(self) -> list[int]:
        """Indices of the anchors that have ranges."""
        anchors: list[int] = np.unique(self.bins.anchor_index).tolist()
        return anchors

    def with_learnt_errors(
        self, mistakes: Sequence[Array] = (), near: Mapping[str, float] = MappingProxyType({})
    ) -> Linearized:
        """Return the problem with the errors learnt while mistakes explain what they can; arguments as of ``learnt``.

        A radio that errs by significantly more than others was mistaken, which must not pass for noise. A map may bend
        by any amount. Residuals are taken where those of the priors are smallest, with the map as it is.
        """
        back = np.linalg.lstsq(self.prior_design, self.prior_residual, rcond=ROUNDING)[0]
        there = replace(self, residual_m=self.residual_m - self.design @ back)
        return replace(self, sizes=there.learnt(*mistakes, most_unusual=SIGNIFICANT_STDDEVS, near=near).sizes)

    def with_usual_errors(self) -> Linearized:
        """Return the problem with this scatter, and all other errors as usual for radios and maps.

        Only where errors are learnt does a noisier radio have more of all kinds.
        """
        larger = widening(self.scatter_m)
        sizes = {each.name: each.usual / (larger if is_widened(each) else 1.0) for each in self.components}
        return replace(self, sizes=sizes | {"white": self.scatter_m})

    def at_state(self, on_map: RangesOnMap) -> Linearized:
        """Linearise at another state or for corrected ranges, with the same bins and errors."""
        linear = on_map.linearized(self.bins)
        linear = replace(linear, residual_m=linear.residual_m + self.bending.shift_m)
        return replace(self, **vars(linear), on_map=on_map)

    def at_other_map(self, on_map: RangesOnMap) -> Linearized:
        """Linearise the same ranges on another map, in the same bins, with the usual errors."""
        return _with_usual_errors(on_map, self.bins, self.scatter_m)

    def after_step(self) -> Linearized:
        """Return the problem after a step to the likeliest state, or after a part of it.

        A whole step moves an anchor by kilometres in a direction of which ranges say next to nothing, as its height
        above a flat path. So a step that makes the state less likely is halved.
        """
        solved = self.solution

        def cost(of: Linearized) -> float:
            return float(np.sum(solved.whitened(of.residual[:, None]) ** 2))

        step, before = solved.step, cost(self)
        for share in 0.5 ** np.arange(MAX_NUM_ROUNDS):
            state = state_after((self.columns,), self.on_map.state, share * step)
            moved = self.at_state(replace(self.on_map, state=state))
            if cost(moved) <= before:
                return moved
        return self

    def settled(self, state: RangeState) -> Linearized:
        """Return the problem at the likeliest state near another one."""
        problem = self.at_state(replace(self.on_map, state=state))
        for _ in range(MAX_NUM_ROUNDS):
            before, problem = problem, problem.after_step()
            if is_nearly_at(problem.on_map, before.on_map, problem.scatter_m):
                break
        return problem


def linearized(on_map: RangesOnMap) -> Linearized:
    """Linearise at the map's own state, with the usual errors.

    Bins are formed from the ranges that agree with their neighbours, however far they are from the map.
    """
    index = on_map.problem.anchor_index
    order = np.lexsort((on_map.time_s, on_map.tag_index, index))
    off_m, scatter_m = _off_neighbours(on_map.residual_m[order], index[order])
    agrees = np.empty(len(order), dtype=bool)
    agrees[order] = _agree(np.abs(off_m) <= near_m(scatter_m), index[order])
    weights = (agrees & _can_be(on_map)).astype(np.float64)
    noise_of_anchor = noisiness(index[order], off_m, on_map.problem.num_anchors)
    return _with_usual_errors(on_map, on_map.bins(weights, noise_of_anchor, _MAX_NUM_BINS), scatter_m)


def _with_usual_errors(on_map: RangesOnMap, bins: RangeBins, scatter_m: float) -> Linearized:
    alone_m2 = scatter_m**2 / np.maximum(bins.worth, 1e-12)
    together = np.exp(-np.abs(bins.time_s[:, None] - bins.time_s) / DRIFT_S)
    wandering_m2 = _WANDERING_M**2 * (1.0 + (bins.anchor_index[:, None] == bins.anchor_index)) * together
    observed = in_bins(on_map, bins, scatter_m, {WANDERING: wandering_m2}, alone_m2)
    return Linearized.by_ranges(observed, on_map, scatter_m).with_usual_errors()


def is_nearly_at(now: RangesOnMap, before: RangesOnMap, scatter_m: float) -> bool:
    """Return whether a round of an iteration has moved the tags, as seen from the anchors, by hardly anything.

    Args:
        scatter_m: of single ranges, metres.
    """
    moved_m = now.from_anchor_m - before.from_anchor_m
    return bool(np.sqrt(np.mean(moved_m**2)) < NEGLIGIBLE_STDDEVS * scatter_m)


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
