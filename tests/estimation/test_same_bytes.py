"""The same refinement, run twice, gives the same bytes."""

from __future__ import annotations

import numpy as np
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.colmap.transform import rescale
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import bundle_adjustment

COLMAPS_OWN_LIMIT = 50_000  # residuals; above this number COLMAP uses several threads


def test_more_residuals_than_colmap_gives_to_one_thread_are_added_up_by_one() -> None:
    path = loop_path(132.0, start_s=0.0, seed=3)
    times = np.arange(130, dtype=np.float64)
    made = synthetic_model(*along(path, times), num_observations=220, pixel_stddev=0.5, seed=1)
    bundle = bundle_adjustment(
        rescale(made.reconstruction, made.metric_from_sfm),
        CameraOptions(),
        RefineOptions(max_num_iterations=1),
        fixed_frame_ids=(1,),
        num_threads=2,
    )
    problem, adjuster = bundle.adjuster.problem, bundle.adjuster
    assert problem.num_residuals() > COLMAPS_OWN_LIMIT
    assert adjuster.options.ceres.create_solver_options(adjuster.config, problem).num_threads == 1
