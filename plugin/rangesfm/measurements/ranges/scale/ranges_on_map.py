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
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    RangeState,
    antenna_positions,
    columns_of,
    prior_jacobian,
    prior_residuals,
    range_jacobian,
)
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.solution import Solution
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import LinearMap
from rangesfm.solver.noise import Component
from rangesfm.util.geometry.trajectory import OnPath


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
        bending: of the map.
    """

    posed: ScaleProblem
    problem: RangeProblem
    state: RangeState
    model_from_cam: Array
    velocity: Array | None
    time_s: Array
    weights: Array
    bending: MapBending

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
        turned: Array = self.state.metric_from_model.rotation @ self.model_from_cam
        return turned

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
        if self.velocity is None:
            return np.zeros(len(self.time_s))
        placed = self.state.metric_from_model
        return self.gradient.by_log_scale(placed.scale * self.velocity @ placed.rotation.T)

    @property
    def by_poses(self) -> csr_array:
        """(n, 6 k) derivatives by the path's k poses: turns in their own frames, shifts in the model's world."""
        placed, arms_m = self.state.metric_from_model, self.problem.tag_from_center
        return by_poses(self.gradient, placed, self.model_from_cam, arms_m, self.on_path)

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
        problem = replace(self.problem, bias_stddev_m=np.zeros(self.problem.num_anchors))
        columns, state = columns_of([problem])[0], self.state
        return LinearMap(
            residual_m=bins.mean(self.residual_m),
            design=bins.mean(range_jacobian(problem, columns, state, state)),
            prior_residual=prior_residuals(problem, columns, state),
            prior_design=prior_jacobian(problem, columns, state, state),
            columns=columns,
        )

    def errors_of(self, bins: RangeBins, others_m2: Mapping[OtherError, Array]) -> tuple[Component, ...]:
        """Return the components of the errors of bins, without those of the map.

        Args:
            others_m2: (c, c) covariances of errors that are not learnt, besides those of the antenna's places.
        """
        placing_m, known_m2 = self.posed.placing_stddev_m(self.state.metric_from_model.scale), dict[OtherError, Array]()
        if np.any(placing_m > 0):
            known_m2[PLACES] = bins.shared_by_places(self.gradient.by_tag, placing_m, self.on_path.before)
        stddevs = {"bias": float(self.problem.bias_stddev_m.max()), "common_bias": self.problem.common_bias_stddev_m}
        ruled_out = [name for name, stddev in stddevs.items() if stddev == 0]
        return radio_components(bins, self.posed.curve_stddev_m, ruled_out, known_m2 | {**others_m2})


def ranges_on_map(posed: ScaleProblem, solution: Solution, bending: MapBending) -> RangesOnMap:
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
