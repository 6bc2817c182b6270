"""RangesOnMap, the ranges of a survey on its map, and their linear equations (sections 2 and 4 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.errors.components import PLACES, OtherError
from rangesfm.measurements.ranges.errors.learned import radio_components
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, by_poses, range_bins
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    RangeState,
    antenna_positions,
    columns_of,
    fit_at,
    predicted_ranges,
    prior_jacobian,
    prior_residuals,
    range_jacobian,
    solve,
)
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.solver.linear_map import LinearMap
from rangesfm.solver.noise import Component
from rangesfm.util.geometry.similarity import Similarity


@dataclass(frozen=True)
class RangesOnMap:
    """n ranges at a state of a map.

    Attributes:
        posed: their scale problem; corrected where a mistake is undone, and carried along where the map is bent.
        state: of the map and the anchors.
        weights: (n,) robust weights in the solution; larger than 1 for a range that stands for several.
        errors: of the ranges, as weighted in the solution, whose formal standard deviations their inflation multiplies.
        noise_stddev_m: standard deviation of an ordinary range, estimated from the solution.
        rivals: states of other maps that fit worse, the likeliest first.
        why_open: why the map also fits in another place of the site, with the same scale; empty if it does not.
    """

    posed: ScaleProblem
    state: RangeState
    weights: Array
    errors: RangeErrors
    noise_stddev_m: float
    rivals: tuple[RangeState, ...] = ()
    why_open: str = ""

    @property
    def problem(self) -> RangeProblem:
        """Of ``posed``, whose standard deviations are from before anything was estimated."""
        return self.posed.ranges

    @property
    def weighted(self) -> RangeProblem:
        """The problem with the errors as its weights; its priors are scaled for ranges with independent errors."""
        return self.posed.weighted(self.errors)

    @property
    def log_scale_stddev(self) -> float:
        """Formal standard deviation of the logarithm of the scale."""
        return fit_at(self.weighted, self.state, self.weights).log_scale_stddev

    @cached_property
    def time_s(self) -> Array:
        """(n,) times of the ranges, as ``ScaleProblem.times_s``."""
        return self.posed.times_s(self.state.metric_from_model.scale)

    def with_problem(self, problem: RangeProblem) -> RangesOnMap:
        """Return the ranges with another problem of them, at the same state."""
        return replace(self, posed=replace(self.posed, ranges=problem))

    def solved(self, problem: RangeProblem) -> RangesOnMap:
        """Return the ranges at the solution of another problem of them, near their state, with the same errors."""
        changed = self.with_problem(problem)
        fit = solve(changed.weighted, self.state, loss=self.errors.loss)
        return replace(changed, state=fit.state, weights=fit.weights)

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
    def metric_from_path(self) -> Similarity:
        """From the world of the map's path to the metric world."""
        return self.state.metric_from_model @ self.posed.model_from_path

    @property
    def world_from_cam(self) -> Array:
        """(n, 3, 3) rotations of the cameras into the metric world."""
        turned: Array = self.state.metric_from_model.rotation @ self.posed.model_from_cam
        return turned

    @property
    def fit_residual_m(self) -> Array:
        """(n,) predicted minus measured range, metres, with the estimated biases."""
        return predicted_ranges(self.problem, self.state) - self.problem.range_m

    @property
    def residual_m(self) -> Array:
        """(n,) predicted minus measured range, metres, with the prior means of the biases."""
        biases_m = self.problem.bias_mean_m[self.problem.anchor_index]
        return np.asarray(self.gradient.distance_m + biases_m - self.problem.range_m)

    @property
    def from_anchor_m(self) -> Array:
        """(n, 3) vectors from each range's anchor to its tag, in the metric world."""
        tags_m = antenna_positions(self.problem, self.state.metric_from_model)
        return np.asarray(tags_m - self.state.anchors_m[self.problem.anchor_index])

    @cached_property
    def gradient(self) -> RangeGradient:
        """Of the n distances."""
        return RangeGradient.of(self.from_anchor_m)

    @property
    def by_time(self) -> Array:
        """(n,) derivatives by the clocks' offset, metres per second; 0 where ranges have no times."""
        if self.posed.velocity is None:
            return np.zeros(len(self.time_s))
        placed = self.state.metric_from_model
        return self.gradient.by_log_scale(placed.scale * self.posed.velocity @ placed.rotation.T)

    @property
    def by_poses(self) -> csr_array:
        """(n, 6 k) derivatives by the path's k poses: turns in their own frames, shifts in the path's world."""
        arms_m = self.problem.tag_from_center @ self.state.metric_from_model.rotation.T
        return by_poses(self.gradient, self.metric_from_path, self.world_from_cam, arms_m, self.posed.on_path)

    def bins(self, weights: Array, noise_of_anchor: Array, max_num: int) -> RangeBins:
        """Average the ranges, as ``range_bins``."""
        return range_bins(
            self.problem.anchor_index,
            self.tag_index,
            self.time_s,
            self.gradient.distance_m[:, None] * self.gradient.by_tag,
            np.swapaxes(self.world_from_cam, 1, 2),
            weights,
            noise_of_anchor,
            max_num,
        )

    def linearized(self, bins: RangeBins) -> LinearMap:
        """Linearise about the state: the biases of anchors are errors of the bins here, and no unknowns."""
        in_metres, no_biases = np.ones(len(self.time_s)), np.zeros(self.problem.num_anchors)
        problem = replace(self.problem, stddev_m=in_metres, bias_stddev_m=no_biases)
        columns, state = columns_of([problem])[0], self.state
        return LinearMap(
            residual_m=bins.mean(self.residual_m),
            design=bins.mean(range_jacobian(problem, columns, state)),
            prior_residual=prior_residuals(problem, columns, state),
            prior_design=prior_jacobian(problem, columns, state),
            columns=columns,
        )

    def errors_of(self, bins: RangeBins, others_m2: Mapping[OtherError, Array]) -> tuple[Component, ...]:
        """Return the components of the errors of bins, without those of the map.

        Args:
            others_m2: (c, c) covariances of errors that are not learnt, besides those of the antenna's places.
        """
        placing_m, known_m2 = self.posed.placing_stddev_m(self.state.metric_from_model.scale), dict[OtherError, Array]()
        if np.any(placing_m > 0):
            # Ranges in one gap between keyframes share the error of a place; errors of different gaps are independent.
            num, column = len(placing_m), 3 * self.posed.on_path.before[:, None] + np.arange(3)
            towards = placing_m[:, None] * self.gradient.by_tag
            of_bins = bins.averages @ csr_array((towards.ravel(), column.ravel(), 3 * np.arange(num + 1)))
            known_m2[PLACES] = (of_bins @ of_bins.T).toarray()
        stddevs = {"bias": float(self.problem.bias_stddev_m.max()), "common_bias": self.problem.common_bias_stddev_m}
        ruled_out = [name for name, stddev in stddevs.items() if stddev == 0]
        return radio_components(bins, self.posed.curve_stddev_m, ruled_out, known_m2 | {**others_m2})
