"""Normal equations, factored dense or sparse, whichever is faster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.sparse import csc_array, csc_matrix
from scipy.sparse.linalg import splu

from rangesfm.arrays import Array

# From this share of nonzeros on, a dense factor is faster than a sparse one.
_DENSE_FROM = 0.15


class SingularError(Exception):
    """A column depends on others.

    Attributes:
        column: which one, as far as it shows.
    """

    def __init__(self, column: int) -> None:
        super().__init__(f"column {column} depends on others")
        self.column = column


@dataclass(frozen=True)
class Factored:
    """A factor of a symmetric positive definite matrix.

    Attributes:
        solve: gives (size, k) for a right side of (size, k), or (size,) for (size,).
        pivots: (size,) by column.
    """

    solve: Callable[[Array], Array]
    pivots: Array


def factor(normal: csc_matrix | csc_array) -> Factored:
    """Factor normal equations.

    Raises:
        SingularError: they are singular, by rounding or exactly.
    """
    return _dense(normal) if normal.nnz > _DENSE_FROM * normal.shape[0] ** 2 else _sparse(normal)


def _dense(normal: csc_matrix | csc_array) -> Factored:
    try:
        lower = linalg.cho_factor(normal.toarray(), lower=True, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError as error:
        raise SingularError(int(str(error).split("-th")[0]) - 1) from error
    return Factored(
        lambda right: np.asarray(linalg.cho_solve(lower, right, check_finite=False)), np.square(np.diag(lower[0]))
    )


def _sparse(normal: csc_matrix | csc_array) -> Factored:
    try:
        lu = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:  # exactly singular
        raise SingularError(int(np.argmin(normal.diagonal()))) from error
    return Factored(lambda right: np.asarray(lu.solve(right)), np.abs(lu.U.diagonal())[lu.perm_c])
