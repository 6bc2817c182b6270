"""How far the scale moves for each centimetre or percent that the range model may have wrong."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.scale.estimate import ScaleSensitivity
from rangesfm.scale.range_equation import directions_to_tag, predicted_ranges
from rangesfm.scale.solution import Solution
from rangesfm.scale.uncertainty import scale_influence

Array = npt.NDArray[np.float64]

_CM = 0.01
# Of all ranges from one distance, which rounding spreads, none is shorter than the others.
_SHORTER = 1 - 1e-9


def scale_sensitivity(solution: Solution, model_from_cam: Array, anchor_ids: tuple[str, ...]) -> ScaleSensitivity:
    """Percents by which the scale changes, to first order.

    Args:
        model_from_cam: (n, 3, 3) rotation of the camera at each range, into the world of the problem.
    """
    problem, state = solution.problem, solution.fit.state

    influence = scale_influence(solution.fit, problem)

    def percent(range_error_m: Array) -> float:
        return 100 * float(influence @ range_error_m)

    distance = predicted_ranges(problem, state)
    in_model = directions_to_tag(problem, state) @ state.metric_from_model.rotation
    along_axes = np.einsum("ni,nij->nj", in_model, model_from_cam)
    return ScaleSensitivity(
        common_bias_per_cm=percent(np.full(len(distance), _CM)),
        short_range_per_cm=percent(np.where(distance < _SHORTER * np.median(distance), _CM, 0.0)),
        anchor_bias_per_cm={
            anchor_id: percent(np.where(problem.anchor_index == k, _CM, 0.0)) for k, anchor_id in enumerate(anchor_ids)
        },
        range_slope_per_percent=percent(0.01 * distance),
        lever_arm_per_cm=(
            # A tag further out lengthens the ranges; taken for nearer, they stretch the map.
            percent(_CM * along_axes[:, 0]),
            percent(_CM * along_axes[:, 1]),
            percent(_CM * along_axes[:, 2]),
        ),
    )
