"""Sensitivity of the scale to errors of the range model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.errors.range_bins import RangeBins
from rangesfm.measurements.ranges.scale.range_equation import predicted_ranges, range_gradient
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.solution import Solution
from rangesfm.util.geometry.numerics import ROUNDING


@dataclass(frozen=True)
class ScaleSensitivity:
    """Change of the scale, in percent, per error of the range model; estimated biases absorb their part of it.

    Attributes:
        common_bias_per_cm: if all ranges were a centimetre longer.
        short_range_per_cm: if the shorter half of the ranges were a centimetre longer.
        anchor_bias_per_cm: by anchor id, if the ranges to that anchor were a centimetre longer.
        range_slope_per_percent: if all ranges were one percent longer.
        lever_arm_per_cm: if the tag sat a centimetre further along x, y, z of the camera.
    """

    common_bias_per_cm: float
    short_range_per_cm: float
    anchor_bias_per_cm: dict[str, float]
    range_slope_per_percent: float
    lever_arm_per_cm: tuple[float, float, float]


NOT_KNOWN = ScaleSensitivity(0.0, 0.0, {}, 0.0, (0.0, 0.0, 0.0))


def scale_sensitivity(solution: Solution, posed: ScaleProblem, by_bins: Array, bins: RangeBins) -> ScaleSensitivity:
    """Return the changes of the scale in percent, to first order.

    Args:
        by_bins: (c,) change of the scale's logarithm per metre that each bin is longer.
        bins: of the problem's ranges.
    """
    problem, state = solution.problem, solution.fit.state

    def percent(range_error_m: Array) -> float:
        return 100 * float(by_bins @ bins.mean(range_error_m))

    distance, centimetre = predicted_ranges(problem, state), 0.01
    world_from_cam = state.metric_from_model.rotation @ posed.model_from_cam
    along_x, along_y, along_z = range_gradient(problem, state).by_tag_in_cam(world_from_cam).T
    return ScaleSensitivity(
        common_bias_per_cm=percent(np.full(len(distance), centimetre)),
        # Rounding spreads ranges of one length, of which none is a shorter one.
        short_range_per_cm=percent(np.where(distance < (1 - ROUNDING) * np.median(distance), centimetre, 0.0)),
        anchor_bias_per_cm={
            anchor_id: percent(np.where(problem.anchor_index == k, centimetre, 0.0))
            for k, anchor_id in enumerate(posed.observations.log.anchor_ids)
        },
        range_slope_per_percent=percent(0.01 * distance),
        # A tag further out than assumed lengthens the measured ranges, which then stretch the map.
        lever_arm_per_cm=(percent(centimetre * along_x), percent(centimetre * along_y), percent(centimetre * along_z)),
    )
