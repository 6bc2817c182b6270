"""Which mistakes a planned survey would find, and what those just too small to be found would do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.planning.expected import Expected
from rangesfm.scale.anchor_by_anchor import anchor_estimates
from rangesfm.trust.catalogue import STANDING
from rangesfm.trust.cells import Cells
from rangesfm.trust.linearized import linearized
from rangesfm.trust.noise_model import usual_noise
from rangesfm.trust.ranges_on_map import RangesOnMap, ranges_on_map
from rangesfm.trust.table import MistakeTest
from rangesfm.trust.testing import Factorization
from rangesfm.trust.verdict import row_of


def detectable_mistakes(expected: Expected) -> tuple[MistakeTest, ...]:
    """Of every mistake that lasts for the whole survey; that it was made is not tested, as nothing was measured."""
    on_map = _on_map(expected)
    num_alike = float(expected.planned.num_alike)
    residuals_m = np.zeros(len(on_map.time_s))
    cells = Cells.of(residuals_m, on_map.problem.anchor_index, on_map.time_s)
    white_m = float(expected.learned.stddevs[expected.learned.names.index("white")])
    problem = linearized(on_map, replace(cells, weights=num_alike * cells.weights, scatter_m=white_m))
    problem = problem.with_noise(usual_noise(problem))
    hypotheses = [hypothesis for of_kind in STANDING for hypothesis in of_kind(problem)]
    return tuple(row_of(test) for test in Factorization(problem).test(hypotheses, seed=0))


def _on_map(expected: Expected) -> RangesOnMap:
    solution, posed, observations = expected.solution, expected.posed, expected.observations
    num = len(observations.log)
    return ranges_on_map(
        observations,
        expected.planned.trajectory,
        solution.fit.state.metric_from_model @ posed.first_camera_from_sfm,
        anchor_estimates(solution, observations.log.anchor_ids, expected.covariance),
        solution.errors.spread(posed.rows, num),
        np.ones(num),
        frame_is_free=posed.frame == "site",
    )
