"""A long path is refined directly."""

from __future__ import annotations

import numpy as np
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, sequence_path

from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import bundle_adjustment
from rangesfm.util.geometry.similarity import IDENTITY


def test_the_refinement_of_a_long_path_is_direct() -> None:
    times, path = np.arange(1010.0), sequence_path(1010.0, seed=1)
    photos = along(path, times)
    model = synthetic_model(*photos, num_observations=6, max_track_length=3, metric_from_sfm=IDENTITY).reconstruction
    problem = bundle_adjustment(model, CameraOptions(), RefineOptions(max_num_iterations=1), num_threads=1)
    assert problem.adjuster.options.ceres.max_num_images_direct_sparse_cpu_solver == len(times)
