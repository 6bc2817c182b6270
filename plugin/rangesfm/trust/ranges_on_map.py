"""RangesOnMap: the ranges of a survey on its scaled map, with all that a mistake could have changed of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.observations import RangeObservations
from rangesfm.scale.initialize import camera_velocities, model_from_cam
from rangesfm.scale.problem import ScaleProblem
from rangesfm.scale.range_equation import RangeProblem, RangeState, tag_positions
from rangesfm.scale.solution import Solution
from rangesfm.scale.uncertainty import ruled_out, times_of_ranges


@dataclass(frozen=True)
class RangesOnMap:
    """n ranges that took part in an estimate, and its state.

    Attributes:
        problem: with stddevs of 1, so that its residuals and Jacobians are in metres.
        state: the estimate.
        model_from_cam: (n, 3, 3) into the model's world.
        velocity: (n, 3) of the camera there, model units per second; None where ranges have no times.
        time_s: (n,) on the radio's clock; where the log names photos, the way along the path in metres.
        tag_index: (n,). tag_ids, anchor_ids: by index. order_given: of the anchors in their file.
        rows: (n,) of the log.
        weights: (n,) robust weights by which the estimate took them.
        curve_stddev_m: (n,) of a learnt error curve that has been taken off; None if none has.
        ruled_out: components of the errors that the user knows not to be there.
    """

    problem: RangeProblem
    state: RangeState
    model_from_cam: Array
    velocity: Array | None
    time_s: Array
    tag_index: Indices
    tag_ids: tuple[str, ...]
    anchor_ids: tuple[str, ...]
    order_given: tuple[str, ...]
    rows: Indices
    weights: Array
    curve_stddev_m: Array | None
    ruled_out: tuple[str, ...]

    @property
    def world_from_cam(self) -> Array:
        """(n, 3, 3) in the metric world."""
        turned: Array = np.einsum("ij,njk->nik", self.state.metric_from_model.rotation, self.model_from_cam)
        return turned

    @property
    def residual_m(self) -> Array:
        """(n,) predicted minus measured, but for biases."""
        return np.asarray(np.linalg.norm(self.from_anchor_m, axis=1) - self.problem.range_m)

    @property
    def from_anchor_m(self) -> Array:
        """(n, 3) from each range's anchor to its tag, in the metric world."""
        tags_m = tag_positions(self.problem, self.state.metric_from_model)
        return np.asarray(tags_m - self.state.anchors_m[self.problem.anchor_index])


def ranges_on_map(
    posed: ScaleProblem, solution: Solution, observations: RangeObservations, trajectory: Trajectory
) -> RangesOnMap:
    """As the scale stage left them."""
    log, rows = observations.log, posed.rows
    return RangesOnMap(
        problem=replace(posed.ranges, stddev_m=np.ones(len(rows)), share=None),
        state=solution.fit.state,
        model_from_cam=model_from_cam(observations, trajectory, posed),
        velocity=camera_velocities(observations, trajectory, posed),
        time_s=times_of_ranges(posed, solution, observations),
        tag_index=log.tag_index[rows],
        tag_ids=log.tag_ids,
        anchor_ids=log.anchor_ids,
        order_given=posed.order_given,
        rows=rows,
        weights=solution.fit.weights,
        curve_stddev_m=None if log.shared_stddev_m is None else log.shared_stddev_m[rows],
        ruled_out=tuple(ruled_out(posed.ranges)),
    )
