"""Factorisation of normal equations, dense or sparse, and the cost of solving for all photos at once.

The cost is low if each photo shares points with few others.
"""

from __future__ import annotations

import functools
import itertools
import operator

import numpy as np
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.solver.nested_dissection import NestedFactor, cost_of_factor
from rangesfm.util.processes.threads import side_by_side

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
    photos. A bound of its cost is compared with the cost of ``limit`` photos that all share points.

    Args:
        overlaps: (n, n), symmetric; nonzero where two photos share a point.
        limit: COLMAP's ``max_num_images_direct_sparse_cpu_solver``.
    """
    num, _ = overlaps.shape
    return num if num > limit and _cost(overlaps) <= _cost_of_all(limit) else limit


def dense_is_faster(overlaps: csr_array) -> bool:
    """Return True if so many photos share points that a dense factor is faster than a sparse one.

    Args:
        overlaps: as for ``max_num_images_direct``.
    """
    num, _ = overlaps.shape
    return _cost_of_all(num) < _BLOCKWISE_SLOWDOWN * _cost(overlaps)


def inverse_is_affordable(overlaps: csr_array, limit: int) -> bool:
    """Return True if factor and inverse take no longer for each photo than those of ``limit`` photos that all overlap.

    Args:
        overlaps: as for ``max_num_images_direct``.
    """
    num, _ = overlaps.shape
    return bool(num <= limit) or cost_of_factor(overlaps) <= _cost_of_all(limit) * num / limit


def _cost(overlaps: csr_array) -> float:
    """Return an upper bound on the multiplications of a Cholesky factorisation, up to a constant factor.

    It is that of the envelope, because a row of the factor begins no further left than that of its matrix (George and
    Liu, "Computer Solution of Large Sparse Positive Definite Systems", 1981), or that of nested dissection.
    """
    order = reverse_cuthill_mckee(overlaps, symmetric_mode=True)
    ordered = csr_array(overlaps[order][:, order]).tocoo()
    leftmost = np.arange(overlaps.shape[0])
    np.minimum.at(leftmost, ordered.row, ordered.col)
    widths = np.arange(overlaps.shape[0]) - leftmost
    return min(float(np.sum(widths.astype(np.float64) ** 2)), cost_of_factor(overlaps))


def _cost_of_all(num: int) -> float:
    """Return the same for photos that all overlap."""
    return float(np.sum(np.arange(num, dtype=np.float64) ** 2))


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


def _is_full(normal: bsr_array | csr_array) -> bool:
    return bool(normal.nnz > _DENSE_FROM * normal.shape[0] ** 2)


def _strip(rows: bsr_array, first: int, last: int) -> bsr_array:
    """Return the rows of blocks from ``first`` up to ``last``."""
    starts = rows.indptr[first : last + 1]
    entries = slice(starts[0], starts[-1])
    shape = (rows.blocksize[0] * (last - first), rows.shape[1])
    return bsr_array((rows.data[entries], rows.indices[entries], starts - starts[0]), shape=shape)


def factor(normal: Array | csr_array, starts: Indices, may_be_last: Mask) -> NestedFactor:
    """Factor normal equations; dense ones are overwritten, and sparse ones that are full enough are made dense.

    Args:
        starts, may_be_last: as for ``NestedFactor``.

    Raises:
        SingularError: they are singular, by rounding or exactly.
    """
    if not isinstance(normal, np.ndarray) and _is_full(normal):
        normal = normal.toarray()
    return NestedFactor(normal, starts, may_be_last)
