"""The factor by nested dissection, against dense algebra."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import block_diag, csr_array

from rangesfm.ceres import nested_dissection
from rangesfm.ceres.nested_dissection import Front, NestedFactor, SingularError, cost_of_factor, fronts_of

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def field(side: int, num_shared: int = 0) -> csr_array:
    """Return which of side x side photos are tied to their neighbours, and each to one of some shared blocks."""
    place = np.array([(x, y) for x in range(side) for y in range(side)])
    near = np.abs(place[:, None] - place).max(axis=2) <= 1
    shared = np.arange(len(place))[:, None] % max(num_shared, 1) == np.arange(num_shared)
    return csr_array(np.block([[near, shared], [shared.T, np.eye(num_shared, dtype=bool)]]))


def problem(tied: csr_array, sizes: Indices, seed: int = 0) -> tuple[Array, Indices]:
    """Return a positive definite matrix with these ties between blocks, and the first columns of the blocks."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    block_of = np.repeat(np.arange(len(sizes)), sizes)
    values = rng.normal(size=(starts[-1],) * 2) * tied.toarray()[block_of][:, block_of]
    values = values + values.T
    return values + np.diag(1.0 + np.abs(values).sum(axis=1)), starts


@pytest.fixture(autouse=True)
def small_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rangesfm.ceres.nested_dissection._MAX_LEAF", 4)


CASES = {
    "a field": (field(9), 0),
    "a field with shared blocks": (field(9, 3), 3),
    "two separate fields": (csr_array(block_diag([field(5).toarray(), field(4).toarray()])), 0),
    "all tied to all": (csr_array(np.ones((20, 20))), 0),
    "one block": (csr_array(np.ones((1, 1))), 0),
    "only blocks that come last": (field(2), 4),
}


@pytest.mark.parametrize("name", CASES)
def test_it_solves_and_inverts_like_dense_algebra(name: str) -> None:
    tied, num_last = CASES[name]
    num = tied.shape[0]
    matrix, starts = problem(tied, np.random.default_rng(1).integers(1, 7, num))
    between = csr_array(0.3 * problem(tied, np.diff(starts), seed=2)[0])
    factor = NestedFactor(csr_array(matrix), starts, np.arange(num) >= num - num_last)
    right = np.random.default_rng(3).normal(size=(len(matrix), 2))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), atol=1e-13)
    np.testing.assert_allclose(factor.solve(right[:, 0]), np.linalg.solve(matrix, right[:, 0]), atol=1e-13)
    assert np.log(factor.pivots).sum() == pytest.approx(np.linalg.slogdet(matrix)[1])
    inverse = np.linalg.inv(matrix)
    expected = inverse @ between.toarray() @ inverse
    for block, first, end in zip(factor.blocks_of_sandwich(between), starts[:-1], starts[1:], strict=True):
        np.testing.assert_allclose(block, expected[first:end, first:end], atol=1e-13)


def test_a_dense_matrix_is_one_front() -> None:
    matrix, starts = problem(field(4), np.full(16, 3))
    right = np.ones(len(matrix))
    factor = NestedFactor(matrix.copy(), starts, np.zeros(16, dtype=bool))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), atol=1e-13)


def test_every_block_is_eliminated_once_and_its_ties_are_in_its_front_or_before() -> None:
    tied = field(12, 2)
    fronts = fronts_of(tied, np.arange(146) >= 144)
    assert len(fronts) > 20
    assert sorted(np.concatenate([front.own for front in fronts])) == list(range(146))
    done: set[int] = set()
    for front in fronts:
        neighbours = set(csr_array(tied[front.own]).indices.tolist())
        assert neighbours <= done | set(front.own.tolist()) | set(front.boundary.tolist())
        for child in front.children:
            assert set(fronts[child].boundary.tolist()) <= {*front.own.tolist(), *front.boundary.tolist()}
        done |= set(front.own.tolist())
    assert set(fronts[-1].own.tolist()) == {144, 145}


def test_two_unequal_fields_fall_apart_at_the_narrowest_place_between_them() -> None:
    tied = block_diag([field(6).toarray(), np.eye(1), field(8).toarray()]).toarray()
    tied[36, 30:45] = tied[30:45, 36] = True  # one block is tied to an edge of either field
    assert fronts_of(csr_array(tied), np.zeros(101, dtype=bool))[-1].own.tolist() == [36]


def test_the_cost_of_a_field_grows_far_slower_than_that_of_a_dense_matrix() -> None:
    small, large = (cost_of_factor(field(side)) for side in (12, 24))
    assert large / small < 4**2  # the factor of a dense one is 64


def test_a_singular_matrix_names_a_column_of_the_dependent_block() -> None:
    matrix, starts = problem(field(6), np.full(36, 2))
    matrix[40] = matrix[:, 40] = 0.0
    with pytest.raises(SingularError) as raised:
        NestedFactor(csr_array(matrix), starts, np.zeros(36, dtype=bool))
    assert raised.value.column == 40
    assert str(raised.value) == "column 40 depends on others"


def path(num: int, seed: int | None = None) -> csr_array:
    """Return blocks each of which is tied to the next one; with a seed, they are numbered in random order."""
    name = np.arange(num) if seed is None else np.random.default_rng(seed).permutation(num)
    tied = np.eye(num)
    tied[name[1:], name[:-1]] = tied[name[:-1], name[1:]] = 1.0
    return csr_array(tied)


@pytest.mark.parametrize(("max_leaf", "is_own"), [(4, False), (50, True)])
def test_only_more_blocks_than_a_leaf_has_are_divided(
    max_leaf: int, is_own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if is_own:
        monkeypatch.undo()  # the module's own number, which the other tests make smaller
    (whole,) = fronts_of(path(max_leaf), np.zeros(max_leaf, dtype=bool))
    assert sorted(whole.own.tolist()) == list(range(max_leaf))
    assert len(whole.boundary) == 0
    parts = fronts_of(path(max_leaf + 1), np.zeros(max_leaf + 1, dtype=bool))
    assert sorted(len(front.boundary) for front in parts) == [0, 1, 1]
    assert len(parts[-1].own) == 1  # one block of a path separates its ends


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_the_order_of_a_path_is_along_it(seed: int | None) -> None:
    name = np.arange(20) if seed is None else np.random.default_rng(seed).permutation(20)
    order = nested_dissection._order_along(path(20, seed)).tolist()
    assert order in (name.tolist(), name[::-1].tolist())


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_separator_leaves_30_percent_at_either_end(seed: int | None) -> None:
    """It is one block of a path, and the smallest row of a field with more columns than rows."""
    for tied, num_between in ((path(21, seed), 1), (strip_of(7, 3), 3)):
        num = tied.shape[0]
        is_between, is_first = nested_dissection._separator(tied)
        assert is_between.sum() == num_between
        halves = [np.flatnonzero(half & ~is_between) for half in (is_first, ~is_first)]
        assert min(map(len, halves)) >= 6  # 30 % of 21, rounded down
        assert sum(map(len, halves)) == num - num_between
        assert not tied.toarray()[np.ix_(*halves)].any()


def strip_of(num_columns: int, num_rows: int) -> csr_array:
    """Return blocks in columns and rows that are tied to their neighbours."""
    place = np.array([(x, y) for x in range(num_columns) for y in range(num_rows)])
    return csr_array((np.abs(place[:, None] - place).max(axis=2) <= 1).astype(float))


def test_blocks_that_all_overlap_are_not_divided() -> None:
    (front,) = fronts_of(csr_array(np.ones((9, 9))), np.zeros(9, dtype=bool))
    assert sorted(front.own.tolist()) == list(range(9))
    assert cost_of_factor(csr_array(np.ones((9, 9)))) == pytest.approx(9**3 / 3)


def test_the_cost_is_that_of_the_fronts(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, third = np.arange(2), np.arange(2, 3), np.arange(3, 8)
    fronts = [Front(first, third[:3], ()), Front(second, third[:1], ()), Front(third, third[:0], (0, 1))]
    monkeypatch.setattr(nested_dissection, "fronts_of", lambda tied, is_last: fronts)
    # The factor of a front's own part, its inverse times the tie, and the square of this.
    expected = (8 / 3 + 4 * 3 + 2 * 9) + (1 / 3 + 1 * 1 + 1 * 1) + 125 / 3
    assert cost_of_factor(csr_array((8, 8))) == pytest.approx(expected)


def test_blocks_are_tied_where_a_matrix_has_entries() -> None:
    starts = np.array([0, 2, 3, 6])
    matrix = np.zeros((6, 6))
    matrix[1, 4] = matrix[4, 1] = 3.0
    matrix[2, 2] = 1.0
    expected = [[False, False, True], [False, True, False], [True, False, False]]
    assert (nested_dissection._tied_blocks(csr_array(matrix), starts).toarray() > 0).tolist() == expected


def test_columns_of_blocks_are_block_by_block() -> None:
    starts = np.array([0, 2, 3, 6])
    blocks = [np.array([2]), np.array([0, 1])]
    assert nested_dissection._columns_of(blocks, starts).tolist() == [3, 4, 5, 0, 1, 2]
    assert nested_dissection._columns_of([], starts).tolist() == []


def test_the_rest_of_a_child_is_found_in_runs() -> None:
    child = nested_dissection._Shape(np.array([3, 4, 7, 8, 10, 12, 13]), 2, ())
    parent = nested_dissection._Shape(np.array([7, 8, 9, 10, 11, 12, 13]), 3, (0,))
    assert child.own == slice(3, 5)
    assert child.rest.tolist() == [7, 8, 10, 12, 13]
    assert parent.runs_of(child) == [
        (slice(0, 2), slice(0, 2)),
        (slice(3, 4), slice(2, 3)),
        (slice(5, 7), slice(3, 5)),
    ]


def test_an_eliminated_part_is_solved_and_inverted_by_its_factor() -> None:
    lower = np.array([[2.0, 0, 0], [1.0, 3.0, 0], [-1.0, 0.5, 4.0]])
    part = nested_dissection._Eliminated(np.asfortranarray(lower), np.zeros((3, 0)))
    right = np.arange(6.0).reshape(3, 2)
    np.testing.assert_allclose(part.solved(right), np.linalg.solve(lower, right))
    np.testing.assert_allclose(part.solved(right, transposed=True), np.linalg.solve(lower.T, right))
    np.testing.assert_allclose(part.inverse(), np.linalg.inv(lower @ lower.T))
    assert part.solved(right[:, :0]).shape == (3, 0)


def test_a_matrix_of_no_blocks_has_no_pivots() -> None:
    factor = NestedFactor(np.zeros((0, 0)), np.array([0]), np.zeros(0, dtype=bool))
    assert factor.pivots.shape == (0,)
    assert factor.blocks_of_sandwich(np.zeros((0, 0))) == []


def test_the_pivots_are_in_the_order_of_the_columns() -> None:
    diagonal = np.random.default_rng(0).uniform(1.0, 2.0, 24)
    factor = NestedFactor(csr_array(np.diag(diagonal)), np.arange(0, 25, 2), np.zeros(12, dtype=bool))
    np.testing.assert_allclose(factor.pivots, diagonal)
