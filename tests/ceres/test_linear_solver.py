"""The choice between a direct and an iterative linear solver."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import bsr_array, csr_array
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import sequence_path

from rangesfm.ceres import linear_solver
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


def costing(monkeypatch: pytest.MonkeyPatch, name: str, cost: float) -> None:
    """Make the solution of any photos cost this, by one of the two estimates."""
    monkeypatch.setattr(linear_solver, name, lambda overlaps: cost)


def test_photos_that_all_overlap_cost_the_sum_of_the_squares_of_those_before_each() -> None:
    assert [linear_solver._cost_of_all(num) for num in (0, 1, 2, 3, 5)] == [0, 0, 1, 5, 30]


@pytest.mark.parametrize(
    ("num", "cost", "expected"), [(7, 30.0, 7), (7, 30.1, 5), (6, 30.0, 6), (6, 30.1, 5), (5, 0.0, 5), (4, 0.0, 5)]
)
def test_the_direct_solver_takes_more_than_colmaps_limit_if_they_cost_no_more_than_it(
    num: int, cost: float, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    costing(monkeypatch, "_cost", cost)
    assert max_num_images_direct(csr_array((num, num)), 5) == expected


@pytest.mark.parametrize(("cost", "is_faster"), [(14.9, False), (15.1, True)])
def test_a_dense_factor_is_faster_from_half_of_its_cost_on(
    cost: float, is_faster: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    costing(monkeypatch, "_cost", cost)
    assert dense_is_faster(csr_array((5, 5))) == is_faster


@pytest.mark.parametrize(
    ("num", "cost", "is_affordable"), [(10, 60.0, True), (10, 60.1, False), (6, 36.0, True), (6, 36.1, False)]
)
def test_the_inverse_is_affordable_up_to_the_cost_of_the_limit_for_each_photo(
    num: int, cost: float, is_affordable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    costing(monkeypatch, "cost_of_factor", cost)  # 5 photos that all overlap cost 30, which is 6 for each
    assert inverse_is_affordable(csr_array((num, num)), 5) == is_affordable


@pytest.mark.parametrize("num", [4, 5])
def test_the_inverse_of_no_more_photos_than_the_limit_is_affordable_at_any_cost(
    num: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    costing(monkeypatch, "cost_of_factor", np.inf)
    assert inverse_is_affordable(csr_array((num, num)), 5)


def test_the_cost_of_photos_is_that_of_their_envelope() -> None:
    """Along a path, each photo is eliminated with the few before it, whatever their order is."""
    all_tied = csr_array(np.ones((4, 4)))
    assert linear_solver._cost(all_tied) == 0 + 1 + 4 + 9
    for seed in (None, 0, 1):
        assert linear_solver._cost(each_with_the_next(30, 1, seed)) == 29
    assert linear_solver._cost(each_with_the_next(30, 2)) == 1 + 28 * 4
    # A path of 5 beside one photo that no other overlaps.
    assert linear_solver._cost(overlaps_of(np.array([[0, 1], [1, 3], [3, 4], [4, 5]]), 6)) == 4


def test_the_cost_of_photos_is_that_of_nested_dissection_if_that_is_lower(monkeypatch: pytest.MonkeyPatch) -> None:
    for cost, expected in ((28.0, 28.0), (30.0, 29.0)):
        costing(monkeypatch, "cost_of_factor", cost)
        assert linear_solver._cost(each_with_the_next(30, 1)) == expected


@pytest.mark.parametrize(("num_entries", "is_full"), [(60, False), (61, True)])
def test_a_matrix_is_full_from_15_percent_of_entries_on(num_entries: int, is_full: bool) -> None:
    entries = np.arange(400)[:num_entries]
    matrix = csr_array((np.ones(num_entries), (entries // 20, entries % 20)), shape=(20, 20))
    assert linear_solver._is_full(matrix) == is_full
    assert isinstance(resized(bsr_array(matrix, blocksize=(1, 1)), 20), np.ndarray) == is_full


def test_a_strip_of_rows_has_their_blocks_only() -> None:
    dense = np.kron(np.array([[1, 0, 2], [0, 3, 0], [0, 0, 0], [4, 5, 6]]), np.ones((2, 3)))
    rows = bsr_array(dense, blocksize=(2, 3))
    for first, last in ((0, 4), (0, 1), (1, 3), (2, 3), (3, 4), (2, 2)):
        strip = linear_solver._strip(rows, first, last)
        np.testing.assert_array_equal(strip.toarray(), dense[2 * first : 2 * last])


@pytest.mark.parametrize(("num_entries", "is_dense"), [(60, False), (61, True)])
def test_sparse_normal_equations_that_are_full_are_factored_densely(
    num_entries: int, is_dense: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[object] = []
    monkeypatch.setattr(linear_solver, "NestedFactor", lambda normal, *rest: given.extend([normal, *rest]))
    entries, starts, is_last = np.arange(num_entries), np.array([0, 20]), np.zeros(1, dtype=bool)
    normal = csr_array((np.ones(num_entries), (entries // 20, entries % 20)), shape=(20, 20))
    linear_solver.factor(normal, starts, is_last)
    assert isinstance(given[0], np.ndarray) == is_dense
    np.testing.assert_array_equal(csr_array(given[0]).toarray(), normal.toarray())
    assert (given[1] is starts, given[2] is is_last) == (True, True)


def test_dense_normal_equations_are_factored_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []
    monkeypatch.setattr(linear_solver, "NestedFactor", lambda normal, *_: given.append(normal))
    for normal in (np.eye(20), np.ones((20, 20))):
        linear_solver.factor(normal, np.array([0, 20]), np.zeros(1, dtype=bool))
        assert given[-1] is normal


def test_normal_equations_are_summed_in_four_strips_of_as_many_entries_on_all_machines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    summed: list[tuple[int, int]] = []

    def one_by_one(strip: Callable[[tuple[int, int]], bsr_array], ends: Iterable[tuple[int, int]]) -> list[bsr_array]:
        summed.extend(given := list(ends))
        return [strip(of_strip) for of_strip in given]

    monkeypatch.setattr(linear_solver, "side_by_side", one_by_one)
    # The first row has two blocks, as many as any two of the others together.
    present = np.vstack([np.ones((1, 2)), np.tile(np.eye(2), (3, 1))])
    dense = np.kron(present, np.arange(1.0, 7.0).reshape(2, 3))
    found = normal_matrix(bsr_array(dense, blocksize=(2, 3)))
    assert summed == [(0, 1), (1, 3), (3, 5), (5, 7)]
    np.testing.assert_allclose(found.toarray(), dense.T @ dense)
