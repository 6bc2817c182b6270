"""The choice between a direct and an iterative linear solver."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import bsr_array, csr_array
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import sequence_path

from rangesfm.ceres.linear_solver import (
    dense_is_faster,
    inverse_is_affordable,
    max_num_images_direct,
    normal_matrix,
    resized,
)
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.refine.bundle_adjustment import bundle_adjustment


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


def overlaps_of(pairs: npt.NDArray[np.int64], num: int) -> csr_array:
    """Return the (n, n) overlaps given by (k, 2) pairs of photos, each pair once."""
    ones = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num, num))
    return csr_array(ones + ones.T)


def each_with_the_next(num: int, num_next: int, seed: int | None = None) -> csr_array:
    """Return the overlaps along a path; with a seed, the photos are numbered in random order."""
    first = np.repeat(np.arange(num), num_next)
    second = first + np.tile(np.arange(1, num_next + 1), num)
    pairs = np.stack([first, second], axis=1)[second < num]
    names: npt.NDArray[np.int64] = np.arange(num) if seed is None else np.random.default_rng(seed).permutation(num)
    return overlaps_of(names[pairs], num)


def test_along_a_path_the_direct_solver_takes_any_number_of_photos() -> None:
    assert max_num_images_direct(each_with_the_next(3000, 20), 200) == 3000


def test_the_order_of_the_photos_does_not_matter() -> None:
    assert max_num_images_direct(each_with_the_next(3000, 20, seed=1), 200) == 3000


def test_photos_that_all_see_the_same_keep_colmaps_limit() -> None:
    assert max_num_images_direct(csr_array(np.ones((101, 101))), 100) == 100


def test_photos_that_see_others_here_and_there_keep_colmaps_limit() -> None:
    pairs = np.random.default_rng(1).integers(0, 1000, (10_000, 2))
    assert max_num_images_direct(overlaps_of(pairs[pairs[:, 0] != pairs[:, 1]], 1000), 200) == 200


def test_below_the_limit_nothing_changes() -> None:
    assert max_num_images_direct(each_with_the_next(50, 3), 100) == 100


def test_photos_that_all_see_the_same_are_solved_densely_and_those_along_a_path_are_not() -> None:
    assert dense_is_faster(csr_array(np.ones((100, 100))))
    assert not dense_is_faster(each_with_the_next(100, 30))


def test_the_inverse_is_affordable_along_a_path_but_not_of_photos_that_all_see_the_same() -> None:
    assert inverse_is_affordable(each_with_the_next(1000, 5), 500)
    assert inverse_is_affordable(csr_array(np.ones((100, 100))), 100)
    assert not inverse_is_affordable(csr_array(np.ones((101, 101))), 100)


def test_the_inverse_of_many_photos_is_affordable_if_each_takes_no_longer_than_one_of_the_limit() -> None:
    assert inverse_is_affordable(each_with_the_next(3000, 15), 100)
    assert not inverse_is_affordable(each_with_the_next(3000, 60), 100)


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
        fixed_frame_id=None,
        num_threads=1,
    )
    assert problem.adjuster.options.ceres.max_num_images_direct_sparse_cpu_solver == 1010
