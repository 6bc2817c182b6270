"""The problem of ranges on a map, linearised at its solution: what every test of a mistake looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.ranging.range_gradient import RangeGradient
from rangesfm.scale.range_equation import (
    Columns,
    columns_of,
    predicted_ranges,
    prior_jacobian,
    prior_residuals,
    range_gradient,
    range_jacobian,
    tag_positions,
)
from rangesfm.trust.cells import Cells
from rangesfm.trust.random_errors import RandomErrors
from rangesfm.trust.ranges_on_map import RangesOnMap


@dataclass(frozen=True)
class Linearized:
    """c cells of ranges and r priors, by p parameters.

    Attributes:
        residual_m: (c,) predicted minus measured. design: (c, p) its derivative.
        prior_residual, prior_design: (r,) and (r, p), in stddevs.
        is_anchor_prior, is_bias_prior: (r,) of which of them.
        covariance_m2: (c, c) of all that is random in the cells.
        columns: which of the p parameters is what; the first is the logarithm of the scale.
        place: (c, 3, p) derivative of the camera's place in each cell.
        cells: how ranges form them.
        anchor_index, tag_index, time_s: (c,).
        gradient: of the c distances.
        by_lever_arm: (c, 3) derivative of the residual by the tag's place in the camera.
        by_time: (c,) by the clocks' offset; None without clocks.
        by_log_scale: (c,) by the scale of the path about its middle.
        on_map: the ranges.
        noise: what is assumed random.
    """

    residual_m: Array
    design: Array
    prior_residual: Array
    prior_design: Array
    is_anchor_prior: npt.NDArray[np.bool_]
    is_bias_prior: npt.NDArray[np.bool_]
    covariance_m2: Array
    columns: Columns
    place: Array
    cells: Cells
    anchor_index: npt.NDArray[np.int64]
    tag_index: npt.NDArray[np.int64]
    time_s: Array
    gradient: RangeGradient
    by_lever_arm: Array
    by_time: Array | None
    by_log_scale: Array
    on_map: RangesOnMap
    noise: RandomErrors | None = None

    @property
    def num_priors(self) -> int:
        return len(self.prior_residual)

    def with_noise(self, noise: RandomErrors) -> Linearized:
        return replace(self, covariance_m2=noise.covariance_m2, noise=noise)


def linearized(on_map: RangesOnMap, cells: Cells | None = None) -> Linearized:
    """At the map's own state, with white noise alone until something is known of the rest.

    Args:
        cells: None: formed by the residuals.
    """
    problem, state = on_map.problem, on_map.state
    columns = columns_of([problem])[0]
    residual_m = predicted_ranges(problem, state) - problem.range_m
    if cells is None:
        cells = Cells.of(residual_m, problem.anchor_index, on_map.time_s)
    gradient = range_gradient(problem, state)
    first = np.zeros(cells.num, dtype=np.int64)
    first[cells.cell_of_range[::-1]] = np.arange(len(residual_m))[::-1]
    arms = tag_positions(problem, state.metric_from_model) - state.metric_from_model.translation
    middle = problem.centers.mean(axis=0)
    by_time = None
    if on_map.velocity_m_per_s is not None:
        by_time = cells.mean(np.sum(gradient.by_tag * on_map.velocity_m_per_s, axis=1))
    num_anchor_rows, num_bias_rows = _num_prior_rows(on_map, columns)
    kind = np.arange(len(prior_residuals(problem, columns, state)))
    return Linearized(
        residual_m=cells.mean(residual_m),
        design=cells.mean(range_jacobian(problem, columns, state, state)),
        prior_residual=prior_residuals(problem, columns, state),
        prior_design=prior_jacobian(problem, columns, state, state),
        is_anchor_prior=kind < num_anchor_rows,
        is_bias_prior=(kind >= num_anchor_rows) & (kind < num_anchor_rows + num_bias_rows),
        covariance_m2=np.diag(cells.scatter_m**2 / cells.num_ranges),
        columns=columns,
        place=_place(cells.mean(problem.centers), cells.mean(arms), columns),
        cells=cells,
        anchor_index=problem.anchor_index[first],
        tag_index=on_map.tag_index[first],
        time_s=cells.mean(on_map.time_s),
        gradient=RangeGradient(cells.mean(gradient.distance_m), cells.mean(gradient.by_tag)),
        by_lever_arm=cells.mean(gradient.by_tag_in_cam(on_map.world_from_cam)),
        by_time=by_time,
        by_log_scale=cells.mean(gradient.by_log_scale(problem.centers - middle)),
        on_map=on_map,
    )


def at_state(problem: Linearized, on_map: RangesOnMap) -> Linearized:
    """The same cells and the same noise, linearised elsewhere, or of corrected ranges."""
    return replace(linearized(on_map, problem.cells), covariance_m2=problem.covariance_m2, noise=problem.noise)


def _num_prior_rows(on_map: RangesOnMap, columns: Columns) -> tuple[int, int]:
    problem = on_map.problem
    anchors = np.count_nonzero((columns.anchor >= 0) & np.isfinite(problem.anchor_stddev_m))
    biases = np.count_nonzero((columns.bias >= 0) & np.isfinite(problem.bias_stddev_m))
    return 3 * int(anchors), int(biases)


def _place(centers_m: Array, arms_m: Array, columns: Columns) -> Array:
    """(c, 3, p) of the places of cameras at (c, 3) from the origin that the scale stretches them about."""
    place = np.zeros((len(centers_m), 3, columns.num))
    place[:, :, columns.scale] = centers_m
    if columns.frame >= 0:
        x, y, z = arms_m.T
        nothing = np.zeros_like(x)
        turn = np.array([[nothing, z, -y], [-z, nothing, x], [y, -x, nothing]])
        place[:, :, columns.frame : columns.frame + 3] = np.moveaxis(turn, 2, 0)
        place[:, :, columns.frame + 3 : columns.frame + 6] = np.eye(3)
    return place
