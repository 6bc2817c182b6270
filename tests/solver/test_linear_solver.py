"""Normal equations of sparse and dense matrices, and a long path that is refined directly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import bsr_array, csr_array
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import sequence_path

from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import bundle_adjustment
from rangesfm.solver.linear_solver import (
    normal_matrix,
    resized,
)
from rangesfm.util.geometry.similarity import IDENTITY


def walk(num: int, num_observations: int) -> SyntheticModel:
    times = np.arange(float(num))
    path = sequence_path(float(num), seed=1)
    return synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=num_observations,
        max_track_length=3,
        metric_from_sfm=IDENTITY,
    )


@pytest.mark.parametrize("num_rows", [0, 1, 3, 50])
@pytest.mark.parametrize("has_information", [False, True])
def test_normal_equations_are_the_product(num_rows: int, *, has_information: bool) -> None:
    rng = np.random.default_rng(num_rows)
    dense = rng.normal(size=(2 * num_rows, 12)) * np.kron(rng.random((num_rows, 4)) < 0.4, np.ones((2, 3)))
    information = rng.normal(size=(2 * num_rows, 2 * num_rows)) if has_information else np.eye(2 * num_rows)
    given = (bsr_array(information, blocksize=(2, 2)),) if has_information else ()
    found = normal_matrix(bsr_array(dense, blocksize=(2, 3)), *given)
    np.testing.assert_allclose(found.toarray(), dense.T @ information @ dense, rtol=0, atol=1e-12)


@pytest.mark.parametrize("is_full", [False, True])
@pytest.mark.parametrize("size", [10, 12, 14])
def test_a_resized_matrix_is_cut_or_gets_empty_columns_full_or_not(size: int, *, is_full: bool) -> None:
    given = np.arange(1.0, 145.0).reshape(12, 12) if is_full else np.diag(np.arange(1.0, 13.0))
    found = resized(bsr_array(given, blocksize=(1, 1)), size)
    assert isinstance(found, csr_array) != is_full
    expected = np.zeros((14, 14))
    expected[:12, :12] = given
    np.testing.assert_array_equal(csr_array(found).toarray(), expected[:size, :size])


def test_the_refinement_of_a_long_path_is_direct() -> None:
    problem = bundle_adjustment(
        walk(1010, 6).reconstruction,
        CameraOptions(),
        RefineOptions(max_num_iterations=1),
        num_threads=1,
    )
    assert problem.adjuster.options.ceres.max_num_images_direct_sparse_cpu_solver == 1010
