"""Factorisation of normal equations, dense or sparse, and the cost of solving for all photos at once.

The cost is low if each photo shares points with few others.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.sparse import bsr_array, csc_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from rangesfm.arrays import Array, Indices
from rangesfm.processes.threads import side_by_side

# Time for an entry of a sparse factor, relative to an entry of a dense factor.
_SPARSE_SLOWDOWN = 8
# The same per multiplication, where whole blocks of photos are eliminated at once.
_BLOCKWISE_SLOWDOWN = 2
# From this share of nonzeros on, a dense factor is faster than a sparse one.
_DENSE_FROM = 0.15
# Number of strips in which normal equations are summed; it is fixed so that the sums are the same on all machines.
_NUM_STRIPS = 4


def max_num_images_direct(overlaps: csr_array, limit: int) -> int:
    """Return the largest number of photos for COLMAP's direct solver: ``limit``, or all if they cost no more than that.

    COLMAP uses an iterative solver beyond a number of photos, whatever they see. Along a path, where each photo shares
    points with few others, that converges slowly, while the time of the direct solver is proportional to the number of
    photos. The envelope gives an upper bound of its cost, because a row of the Cholesky factor begins no further left
    than that of its matrix (George and Liu, "Computer Solution of Large Sparse Positive Definite Systems", 1981). The
    bound is compared with the cost of ``limit`` photos that all share points.

    Args:
        overlaps: (n, n), symmetric; nonzero where two photos share a point.
        limit: COLMAP's ``max_num_images_direct_sparse_cpu_solver``.
    """
    num = overlaps.shape[0]
    return num if num > limit and _cost(_envelope_widths(overlaps)) <= _cost(np.arange(limit)) else limit


def dense_is_faster(overlaps: csr_array) -> bool:
    """Return True if so many photos share points that a dense factor is faster than a sparse one.

    Args:
        overlaps: as for ``max_num_images_direct``.
    """
    return _cost(np.arange(overlaps.shape[0])) < _BLOCKWISE_SLOWDOWN * _cost(_envelope_widths(overlaps))


def inverse_is_affordable(overlaps: csr_array, limit: int) -> bool:
    """Return True if the photos' columns of the inverse take no longer than those of ``limit`` photos that all overlap.

    The time for a column is proportional to the number of entries of the factor.

    Args:
        overlaps: as for ``max_num_images_direct``.
    """
    num = int(overlaps.shape[0])
    num_entries = _SPARSE_SLOWDOWN * int(np.sum(_envelope_widths(overlaps) + 1))
    return num <= limit or num * num_entries <= limit * limit * (limit + 1) // 2


def _envelope_widths(overlaps: csr_array) -> Indices:
    """Return (n,) distances from each row's first entry to the diagonal, in an order that keeps neighbours together."""
    order = reverse_cuthill_mckee(overlaps, symmetric_mode=True)
    ordered = overlaps[order][:, order].tocoo()
    leftmost = np.arange(overlaps.shape[0])
    np.minimum.at(leftmost, ordered.row, ordered.col)
    return np.arange(overlaps.shape[0]) - leftmost


def _cost(widths: Indices) -> float:
    """Return the number of multiplications of a Cholesky factorisation, up to a constant factor."""
    return float(np.sum(widths.astype(np.float64) ** 2))


def normal_matrix(rows: bsr_array, information: bsr_array | None = None) -> bsr_array:
    """Return ``rows.T @ information @ rows``, computed in parallel strips; information None: the identity."""

    def strip(ends: tuple[int, int]) -> bsr_array:
        part = _strip(rows, *ends)
        return part.T @ (part if information is None else _strip(information, *ends) @ rows)

    starts = (rows if information is None else information).indptr
    cuts = np.searchsorted(starts, np.linspace(0, starts[-1], _NUM_STRIPS + 1)[1:-1])
    strips = side_by_side(strip, itertools.pairwise([0, *cuts.tolist(), len(starts) - 1]))
    return functools.reduce(operator.add, strips)


def resized(normal: bsr_array, size: int) -> Array | csr_array:
    """Return the matrix with another size (empty new columns); dense if it is full enough for that to be faster."""
    if not _is_full(normal):
        rows = normal.tocsr()
        rows.resize(size, size)
        return rows
    dense, kept = np.zeros((size, size)), min(size, normal.shape[0])
    dense[:kept, :kept] = normal.toarray()[:kept, :kept]
    return dense


def _is_full(normal: bsr_array | csc_array | csr_array) -> bool:
    return bool(normal.nnz > _DENSE_FROM * normal.shape[0] ** 2)


def _strip(rows: bsr_array, first: int, last: int) -> bsr_array:
    """Return the rows of blocks from ``first`` up to ``last``."""
    starts = rows.indptr[first : last + 1]
    entries = slice(starts[0], starts[-1])
    shape = (rows.blocksize[0] * (last - first), rows.shape[1])
    return bsr_array((rows.data[entries], rows.indices[entries], starts - starts[0]), shape=shape)


class SingularError(Exception):
    """A matrix is singular: a column depends on others.

    Attributes:
        column: the one at which this shows.
    """

    def __init__(self, column: int) -> None:
        super().__init__(f"column {column} depends on others")
        self.column = column


@dataclass(frozen=True)
class Factored:
    """A factor of a symmetric positive definite matrix.

    Attributes:
        solve: solves for a right side of shape (size, k) or (size,).
        pivots: (size,) of the columns.
    """

    solve: Callable[[Array], Array]
    pivots: Array


def factor(normal: Array | csr_array) -> Factored:
    """Factor normal equations; dense ones are overwritten.

    Raises:
        SingularError: they are singular, by rounding or exactly.
    """
    if isinstance(normal, np.ndarray):
        return _dense(normal)
    return _dense(normal.toarray()) if _is_full(normal) else _sparse(normal.T)  # in columns; it is symmetric


def _dense(normal: Array) -> Factored:
    # The matrix is symmetric, so its transpose has the memory order of LAPACK and nothing is copied. SciPy's own
    # function reports the failing column only in a text that differs between versions.
    lower, info = linalg.lapack.dpotrf(normal.T, lower=True, overwrite_a=True, clean=False)
    if info > 0:
        raise SingularError(info - 1)
    return Factored(
        lambda right: np.asarray(linalg.cho_solve((lower, True), right, check_finite=False)), np.square(np.diag(lower))
    )


def _sparse(normal: csc_array) -> Factored:
    try:
        lu = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:  # exactly singular
        raise SingularError(int(np.argmin(normal.diagonal()))) from error
    return Factored(lambda right: np.asarray(lu.solve(right)), np.abs(lu.U.diagonal())[lu.perm_c])
