"""The factor by nested dissection, against dense algebra."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import block_diag, csr_array

from rangesfm.solver.nested_dissection import NestedFactor, SingularError, cost_of_factor

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def field(side: int, num_shared: int = 0) -> csr_array:
    """Return which of side x side photos are tied to their neighbours, and each to one of some shared blocks."""
    place = np.array([(x, y) for x in range(side) for y in range(side)])
    near = np.abs(place[:, None] - place).max(axis=2) <= 1
    shared = np.arange(len(place))[:, None] % max(num_shared, 1) == np.arange(num_shared)
    return csr_array(np.block([[near, shared], [shared.T, np.eye(num_shared, dtype=bool)]]))


def problem(tied: csr_array, sizes: Indices) -> tuple[Array, Indices]:
    """Return a positive definite matrix with these ties between blocks, and the first columns of the blocks."""
    rng = np.random.default_rng(0)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    block_of = np.repeat(np.arange(len(sizes)), sizes)
    values = rng.normal(size=(starts[-1],) * 2) * tied.toarray()[block_of][:, block_of]
    values = values + values.T
    return values + np.diag(1.0 + np.abs(values).sum(axis=1)), starts


@pytest.fixture(autouse=True)
def small_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rangesfm.solver.nested_dissection._MAX_LEAF", 4)


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
    factor = NestedFactor(csr_array(matrix), starts, np.arange(num) >= num - num_last)
    right = np.random.default_rng(3).normal(size=(len(matrix), 2))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), atol=1e-13)
    np.testing.assert_allclose(factor.solve(right[:, 0]), np.linalg.solve(matrix, right[:, 0]), atol=1e-13)
    assert np.log(factor.pivots).sum() == pytest.approx(np.linalg.slogdet(matrix)[1])
    inverse = np.linalg.inv(matrix)
    for block, first, end in zip(factor.blocks_of_inverse(), starts[:-1], starts[1:], strict=True):
        np.testing.assert_allclose(block, inverse[first:end, first:end], atol=1e-13)


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
