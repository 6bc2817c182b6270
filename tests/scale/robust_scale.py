"""The scale estimate by the robust weights alone, from which it is moved half-way to that by the best weights."""

from __future__ import annotations

from rangesfm.geometry.similarity import Similarity
from rangesfm.scale.scale_estimate import ScaleEstimate


def metric_from_sfm_by_robust_weights(estimate: ScaleEstimate) -> Similarity:
    problem, solution = estimate.problem, estimate.solution
    assert problem is not None
    assert solution is not None
    return solution.fit.state.metric_from_model @ problem.first_camera_from_sfm
