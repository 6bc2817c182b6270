"""RangesOnMap, the ranges of a survey on its scaled map, and Linearized: what every test of a mistake looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.errors.bending import BendingOfCells, MapBending, by_poses
from rangesfm.ranging.errors.cells import Cells, cells, noisiness
from rangesfm.ranging.errors.components import PLACES
from rangesfm.ranging.errors.learned import ExpectedErrors, LearnedErrors
from rangesfm.ranging.errors.noise import MIN_STDDEV_M, robust_stddev
from rangesfm.ranging.range_gradient import RangeGradient
from rangesfm.ranging.range_observations import OnPath, RangeObservations
from rangesfm.scale.initialize import camera_velocities, model_from_cam
from rangesfm.scale.problem import ScaleProblem
from rangesfm.scale.range_equation import (
    Columns,
    RangeProblem,
    RangeState,
    columns_of,
    prior_jacobian,
    prior_residuals,
    range_jacobian,
    tag_positions,
)
from rangesfm.scale.solution import Solution
from rangesfm.scale.uncertainty import ruled_out, times_of_ranges

# The tests learn the errors many times over: fewer cells than an interval has.
_MAX_NUM_CELLS = 160
_NUM_NEIGHBOURS = 8
# In stddevs from the median of its neighbours, of which the noise is at least this: what is further off is an outlier
# among them. A radio may repeat itself to a centimetre and err by ten from one place to the next.
_OUTLYING = 3.0
_LEAST_SCATTER_M = 0.08
_NO_WEIGHT = 1e-6
# What the ranges to each anchor, and those to all, drift by in a minute, as hands and bodies move, however little a
# survey shows of the radio's own drift (a component that is learnt, to nothing where steps are allowed to explain it):
# too slow to be told from a step that is looked for.
_WANDERING_M, _WANDERING_S = 0.025, 60.0
# In spreads over radios: what errs by more than that is no radio but a mistake, which shall not pass for noise.
_MOST_UNUSUAL = 3.0


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
        placing_m: (n,) stddev of each coordinate of the antenna's place. gap: (n,) the gap that each range is from.
        curve_stddev_m: (n,) of a learnt error curve that has been taken off; None if none has.
        on_path: where they were taken. bending: of the map; None: it is not bent.
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
    placing_m: Array
    gap: Indices
    curve_stddev_m: Array | None
    on_path: OnPath
    bending: MapBending | None

    @property
    def world_from_cam(self) -> Array:
        """(n, 3, 3) in the metric world."""
        turned: Array = np.einsum("ij,njk->nik", self.state.metric_from_model.rotation, self.model_from_cam)
        return turned

    @property
    def residual_m(self) -> Array:
        """(n,) predicted minus measured, with biases as they are known beforehand."""
        biases_m = self.problem.bias_mean_m[self.problem.anchor_index]
        return np.asarray(np.linalg.norm(self.from_anchor_m, axis=1) + biases_m - self.problem.range_m)

    @property
    def from_anchor_m(self) -> Array:
        """(n, 3) from each range's anchor to its tag, in the metric world."""
        tags_m = tag_positions(self.problem, self.state.metric_from_model)
        return np.asarray(tags_m - self.state.anchors_m[self.problem.anchor_index])


def ranges_on_map(
    posed: ScaleProblem,
    solution: Solution,
    observations: RangeObservations,
    trajectory: Trajectory,
    bending: MapBending | None,
) -> RangesOnMap:
    """At a solution, on the path as its problem has it."""
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
        placing_m=posed.placing_stddev_m(solution.fit.state.metric_from_model.scale),
        gap=observations.before[rows],
        curve_stddev_m=None if log.shared_stddev_m is None else log.shared_stddev_m[rows],
        on_path=observations.on_path(rows),
        bending=bending,
    )


@dataclass(frozen=True)
class Linearized:
    """c cells of ranges and r priors, by p parameters. What ranges are off by for each anchor's sake is random.

    Attributes:
        residual_m: (c,) predicted minus measured, where the photos alone would have the map.
        design: (c, p) its derivative.
        prior_residual, prior_design: (r,) and (r, p), in stddevs; first those of the anchors' places.
        columns: which of the p parameters is what; the first is the logarithm of the scale.
        place: (c, 3, p) derivative of the camera's place in each cell.
        cells: how ranges form them. time_s: (c,) as of the ranges.
        gradient: of the c distances.
        by_lever_arm: (c, 3) derivative of the residual by the tag's place in the camera.
        by_time: (c,) by the clocks' offset; None without clocks.
        on_map: the ranges. scatter_m: stddev of one among its neighbours.
        expected: of the errors, before anything is measured. errors: what is assumed random.
    """

    residual_m: Array
    design: Array
    prior_residual: Array
    prior_design: Array
    columns: Columns
    place: Array
    cells: Cells
    time_s: Array
    gradient: RangeGradient
    by_lever_arm: Array
    by_time: Array | None
    on_map: RangesOnMap
    scatter_m: float
    expected: ExpectedErrors
    errors: LearnedErrors

    @property
    def num_priors(self) -> int:
        return len(self.prior_residual)

    @property
    def heard(self) -> list[int]:
        """The anchors that there are ranges to."""
        anchors: list[int] = np.unique(self.cells.anchor_index).tolist()
        return anchors

    def with_learnt_errors(self, columns: Array, priors: Array) -> Linearized:
        """With what is left random when (c, k) columns and (r, k) priors explain what they can."""
        # At the place where nothing speaks against what is known beforehand, of the map as it is.
        back = np.linalg.lstsq(self.prior_design, self.prior_residual, rcond=1e-12)[0]
        learnt = self.expected.learnt(
            off_m=self.design @ back - self.residual_m + self.expected.shift_m,
            design=np.hstack([self.design, columns]),
            prior_design=np.hstack([self.prior_design, priors]),
            noise_m=self.scatter_m,
            most_unusual=_MOST_UNUSUAL,
        )
        return replace(self, errors=learnt)

    def with_usual_errors(self) -> Linearized:
        """As radios and maps have them that scatter like this."""
        return replace(self, errors=self.expected.usual({"white": self.scatter_m}))


def linearized(on_map: RangesOnMap, cells_of_ranges: Cells | None = None) -> Linearized:
    """At the map's own state, with the errors that are usual.

    Args:
        cells_of_ranges: of ranges that do not scatter; None: they are found by the residuals, of whatever is not far
            from its neighbours, however far from the map.
    """
    found, scatter_m = _cells(on_map) if cells_of_ranges is None else (cells_of_ranges, 0.0)
    towards = RangeGradient.of(on_map.from_anchor_m).by_tag
    others_m2 = _wandering(found) | {PLACES: found.shared_by_places(towards, on_map.placing_m, on_map.gap)}
    expected = ExpectedErrors.of(
        found, on_map.curve_stddev_m, ruled_out(on_map.problem), others_m2, _bending(on_map, found)
    )
    return _linearized(on_map, expected, scatter_m, expected.usual({"white": scatter_m}))


def at_state(problem: Linearized, on_map: RangesOnMap) -> Linearized:
    """The same cells and the same errors, linearised elsewhere, or of corrected ranges."""
    return _linearized(on_map, problem.expected, problem.scatter_m, problem.errors)


def _linearized(on_map: RangesOnMap, expected: ExpectedErrors, scatter_m: float, errors: LearnedErrors) -> Linearized:
    # What ranges are off by for each anchor's sake is random.
    problem = replace(on_map.problem, bias_stddev_m=np.zeros(on_map.problem.num_anchors))
    state, placed = on_map.state, on_map.state.metric_from_model
    columns, gradient, mean = columns_of([problem])[0], RangeGradient.of(on_map.from_anchor_m), expected.cells.mean
    by_time = None
    if on_map.velocity is not None:
        by_time = mean(gradient.by_log_scale(placed.scale * on_map.velocity @ placed.rotation.T))
    place = np.zeros((len(expected.cells), 3, columns.num))
    place[:, :, columns.scale] = mean(placed.scale * problem.centers @ placed.rotation.T)
    if columns.frame >= 0:
        arms_m = mean(tag_positions(problem, placed) - placed.translation)
        place[:, :, columns.frame : columns.frame + 6] = similarity_motions(arms_m)[:, :, 1:]
    return Linearized(
        residual_m=mean(on_map.residual_m) + expected.shift_m,
        design=mean(range_jacobian(problem, columns, state, state)),
        prior_residual=prior_residuals(problem, columns, state),
        prior_design=prior_jacobian(problem, columns, state, state),
        columns=columns,
        place=place,
        cells=expected.cells,
        time_s=mean(on_map.time_s),
        gradient=RangeGradient(mean(gradient.distance_m), mean(gradient.by_tag)),
        by_lever_arm=mean(gradient.by_tag_in_cam(on_map.world_from_cam)),
        by_time=by_time,
        on_map=on_map,
        scatter_m=scatter_m,
        expected=expected,
        errors=errors,
    )


def _bending(on_map: RangesOnMap, cells_of_ranges: Cells) -> BendingOfCells | None:
    if on_map.bending is None:
        return None
    return on_map.bending.of_cells(cells_of_ranges, slopes_by_poses(on_map), frame_is_free=on_map.problem.frame_is_free)


def slopes_by_poses(on_map: RangesOnMap) -> csr_array:
    """(n, 6 k) of the distances, by the path's poses."""
    gradient, placed = RangeGradient.of(on_map.from_anchor_m), on_map.state.metric_from_model
    return by_poses(gradient, placed, on_map.model_from_cam, on_map.problem.tag_from_center, on_map.on_path)


def _wandering(cells_of_ranges: Cells) -> dict[str, Array]:
    index, time_s = cells_of_ranges.anchor_index, cells_of_ranges.time_s
    together = np.exp(-np.abs(time_s[:, None] - time_s) / _WANDERING_S)
    return {"wandering": _WANDERING_M**2 * (1.0 + (index[:, None] == index)) * together}


def _cells(on_map: RangesOnMap) -> tuple[Cells, float]:
    index = on_map.problem.anchor_index
    order = np.lexsort((on_map.time_s, on_map.tag_index, index))
    off_m, scatter_m = _off_neighbours(on_map.residual_m[order], index[order])
    is_near = np.empty(len(order), dtype=bool)
    is_near[order] = np.abs(off_m) <= near_m(scatter_m)
    of_ranges = cells(
        index,
        on_map.tag_index,
        on_map.time_s,
        on_map.from_anchor_m,
        np.swapaxes(on_map.world_from_cam, 1, 2),
        np.where(is_near, 1.0, _NO_WEIGHT),
        noisiness(index[order], off_m, on_map.problem.num_anchors),
        _MAX_NUM_CELLS,
    )
    return of_ranges, scatter_m


def near_m(scatter_m: float) -> float:
    """How far from its neighbours a range may be that scatters like this."""
    return _OUTLYING * max(scatter_m, _LEAST_SCATTER_M)


def _off_neighbours(values: Array, anchor_index: Indices) -> tuple[Array, float]:
    """(n,) from the lower median of a few that follow each other, and the stddev of a value; all in order."""
    begins: Mask = np.diff(anchor_index, prepend=-1) != 0
    since = np.arange(len(values)) - np.maximum.accumulate(np.where(begins, np.arange(len(values)), 0))
    labels = np.cumsum(begins | (since % _NUM_NEIGHBOURS == 0)) - 1
    counts = np.bincount(labels)
    by_value = np.lexsort((values, labels))
    middles = values[by_value][np.cumsum(counts) - counts + (counts - 1) // 2]
    steps = np.diff(values)[~begins[1:]]
    return values - middles[labels], max(robust_stddev(steps) / np.sqrt(2), MIN_STDDEV_M)
