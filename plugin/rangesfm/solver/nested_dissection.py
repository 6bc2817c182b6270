"""Cholesky factor of normal equations by nested dissection, and the diagonal blocks of their inverse.

A separator is a set of photos without which the others fall into two parts that share no point. The parts are divided
in the same way, and each separator is eliminated after its parts (George, "Nested dissection of a regular finite
element mesh", 1973). What is eliminated at once, with all that it is tied to, is a dense matrix, a front (Duff and
Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", 1983). From the last front back to
the first, the entries of the inverse within each front follow from those within the next one that it is tied to
(Erisman and Tinney, "On computing certain elements of the inverse of a sparse matrix", 1975), in about the time of the
factor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, pairwise, product
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow, reverse_cuthill_mckee

from rangesfm.arrays import Array, Indices, Mask

# Largest number of blocks that are not divided any further.
_MAX_LEAF = 50
# Share of the blocks at either end of their order that a separator leaves on that side. For 5000 keyframes over a
# field (the study of growth), 0.25 costs 2 % more, 0.35 12 %.
_END_SHARE = 0.3
# Number of averages with the neighbours for the order of the blocks; 200 of them save 1 % more of the same cost.
_NUM_SWEEPS = 60


class SingularError(Exception):
    """A matrix is singular: a column depends on others.

    Attributes:
        column: the one at which this shows.
    """

    def __init__(self, column: int) -> None:
        super().__init__(f"column {column} depends on others")
        self.column = column


@dataclass(frozen=True)
class Front:
    """What is eliminated at once: blocks, or columns by their places in the order of elimination.

    Attributes:
        own: (m,) blocks or columns, these ascending.
        boundary: (b,) those that are eliminated later and that these are tied to, in that order.
        children: numbers of the fronts before whose boundary begins here.
    """

    own: Indices
    boundary: Indices
    children: tuple[int, ...]

    @property
    def all(self) -> Indices:
        """(m + b,) own and boundary."""
        return np.concatenate([self.own, self.boundary])

    @property
    def span(self) -> slice:
        """Its own columns."""
        return slice(int(self.own[0]), int(self.own[-1]) + 1)

    def runs_of(self, child: Front) -> list[tuple[slice, slice]]:
        """Return the boundary of a child as runs of these columns: the places of each run here, and in the boundary."""
        at = np.searchsorted(self.all, child.boundary)
        ends = [0, *(np.flatnonzero(np.diff(at) > 1) + 1).tolist(), len(at)]
        return [(slice(at[first], at[last - 1] + 1), slice(first, last)) for first, last in pairwise(ends)]


def fronts_of(tied: csr_array, may_be_last: Mask) -> list[Front]:
    """Return the fronts in the order of their elimination, each after its children.

    Args:
        tied: (n, n) symmetric; nonzero where two blocks are tied to each other.
        may_be_last: (n,) blocks to be eliminated after all others if more are tied to them than are in a part.
    """
    is_last = may_be_last & (np.diff(tied.indptr) > _MAX_LEAF)
    first = np.flatnonzero(~is_last)
    parts = list(_dissected(csr_array(tied[first][:, first]), first))
    if is_last.any():
        parts.append(np.flatnonzero(is_last))
    block_at = np.concatenate(parts)
    place = np.argsort(block_at)
    part_at = np.repeat(np.arange(len(parts)), [len(own) for own in parts])
    below: list[list[int]] = [[] for _ in parts]
    fronts: list[Front] = []
    for number, own in enumerate(parts):
        ties = [csr_array(tied[own]).indices, *(fronts[child].boundary for child in below[number])]
        places = np.unique(place[np.concatenate(ties)])
        later = places[places > place[own].max()]
        fronts.append(Front(own, block_at[later], tuple(below[number])))
        if len(later):
            below[part_at[later[0]]].append(number)
    return fronts


def _dissected(tied: csr_array, blocks: Indices) -> Iterator[Indices]:
    """Yield the blocks in parts, each separator after the parts that it separates."""
    if len(blocks) > _MAX_LEAF:
        is_between, is_first = _separator(tied)
        halves = [np.flatnonzero(half & ~is_between) for half in (is_first, ~is_first)]
        if all(map(len, halves)):
            for rows in halves:
                yield from _dissected(csr_array(tied[rows][:, rows]), blocks[rows])
            blocks = blocks[is_between]
    if len(blocks):
        yield blocks


def _separator(tied: csr_array) -> tuple[Mask, Mask]:
    """Return the fewest blocks without which both ends of the blocks' order fall apart, and a mask of the first side.

    They are the smallest cut between the ends by maximum flow (Schild and Sommer, "On balanced separators in road
    networks", 2015, where the order is that of coordinates).
    """
    order = _order_along(tied)
    num_of_end = int(_END_SHARE * len(order))
    is_first, is_last = np.zeros((2, len(order)), dtype=bool)
    is_first[order[:num_of_end]] = is_last[order[-num_of_end:]] = True
    is_last &= ~(tied @ is_first > 0)  # a block that is tied to the other end itself may be part of the cut
    middle = np.flatnonzero(~is_first & ~is_last)
    ties, num = csr_array(tied[middle][:, middle]).tocoo(), len(middle)
    after_first, before_last = (np.flatnonzero(tied[middle] @ end > 0) for end in (is_first, is_last))
    # Each block is an edge of capacity 1 from its entry to its exit; all other edges are never the bottleneck.
    entry, leave, source, sink = np.arange(num), num + np.arange(num), 2 * num, 2 * num + 1
    starts = np.concatenate([entry, leave[ties.row], np.full(len(after_first), source), leave[before_last]])
    ends = np.concatenate([leave, entry[ties.col], entry[after_first], np.full(len(before_last), sink)])
    capacity = np.where(np.arange(len(starts)) < num, 1, num).astype(np.int32)
    network = csr_array((capacity, (starts, ends)), shape=(2 * num + 2,) * 2)
    rest = csr_array(network - maximum_flow(network, source, sink).flow)
    rest.eliminate_zeros()
    is_reached = np.zeros(2 * num + 2, dtype=bool)
    is_reached[breadth_first_order(rest, source, return_predecessors=False)] = True
    is_between = np.zeros(len(order), dtype=bool)
    is_between[middle] = is_reached[entry] & ~is_reached[leave]
    is_first[middle] = is_reached[leave]
    return is_between, is_first


def _order_along(tied: csr_array) -> Indices:
    """Return the blocks in an order along their longest extent: that of the Fiedler vector, roughly."""
    adjacency = csr_array((np.ones(tied.nnz), tied.indices, tied.indptr), shape=tied.shape)
    degree = np.maximum(adjacency.sum(axis=1), 1.0)
    place = np.empty(len(degree))
    place[reverse_cuthill_mckee(tied, symmetric_mode=True)] = np.linspace(-1.0, 1.0, len(degree))
    for _ in range(_NUM_SWEEPS):
        place = (place + adjacency @ place / degree) / 2
    # Rounded, so that the last digits, which differ between processors, do not change the order.
    return np.argsort(place.round(9), kind="stable")


def cost_of_factor(tied: csr_array) -> float:
    """Return the number of multiplications of a factor, up to a constant factor, with blocks of one column.

    Args:
        tied: (n, n) as for ``fronts_of``.
    """
    fronts = fronts_of(tied, np.zeros(tied.shape[0], dtype=bool))
    own = np.array([len(front.own) for front in fronts], dtype=np.float64)
    rest = np.array([len(front.boundary) for front in fronts], dtype=np.float64)
    return float(np.sum(own**3 / 3 + own**2 * rest + own * rest**2))


class _Eliminated(NamedTuple):
    """The eliminated part of a front.

    Attributes:
        lower: (m, m) Cholesky factor of its own part. tie: (m, b) ``lower``'s inverse times the tie to the boundary.
    """

    lower: Array
    tie: Array

    def solved(self, right: Array, *, transposed: bool = False) -> Array:
        """Return the inverse of ``lower``, or of its transpose, times (m, k)."""
        if not right.size:
            return right
        # LAPACK's dtrtrs, SciPy's solve_triangular, differs by some digits more between the kernels of processors.
        return np.asarray(linalg.blas.dtrsm(1.0, self.lower, right, lower=True, trans_a=int(transposed)))

    def inverse(self) -> Array:
        """Return the (m, m) inverse of the front's own part."""
        lower = np.tril(linalg.lapack.dpotri(self.lower, lower=True)[0])
        return np.asarray(lower + np.tril(lower, -1).T)


class NestedFactor:
    """A Cholesky factor of a symmetric positive definite matrix.

    Attributes:
        pivots: (size,) of the columns.
    """

    pivots: Array

    def __init__(self, matrix: Array | csr_array, starts: Indices, may_be_last: Mask) -> None:
        """Factor a matrix; a dense one is one front, and is overwritten.

        Args:
            matrix: (size, size). starts: (n + 1,) first column of each of n blocks, and the size.
            may_be_last: (n,) as for ``fronts_of``.

        Raises:
            SingularError: the matrix is singular, by rounding or exactly.
        """
        if isinstance(matrix, np.ndarray):
            fronts = [Front(np.arange(len(may_be_last)), np.zeros(0, dtype=np.int64), ())] if len(matrix) else []
        else:
            fronts = fronts_of(_tied_blocks(matrix, starts), may_be_last)
        self._order = _columns_of([front.own for front in fronts], starts)
        place = np.argsort(self._order)
        self._fronts = [
            Front(place[_columns_of([f.own], starts)], place[_columns_of([f.boundary], starts)], f.children)
            for f in fronts
        ]
        self._starts, self._place, self._eliminated = starts, place, list[_Eliminated]()
        rests = dict[int, Array]()
        for number, front in enumerate(self._fronts):
            full = matrix if isinstance(matrix, np.ndarray) else self._rows_of_front(matrix, front)
            for child in front.children:
                rest = rests.pop(child)
                runs = front.runs_of(self._fronts[child])
                for (rows, of_rows), (columns, of_columns) in combinations_with_replacement(runs, 2):
                    full[rows, columns] += rest[of_rows, of_columns]
            rests[number] = self._eliminate(front, full)
        squares = [np.square(np.diag(part.lower)) for part in self._eliminated]
        self.pivots = np.concatenate([np.zeros(0), *squares])[place]

    def _rows_of_front(self, matrix: csr_array, front: Front) -> Array:
        """Return a front with the rows of a matrix that are eliminated in it, (size, size), of which the rest is 0."""
        columns = front.all
        full = np.zeros((len(columns),) * 2)
        rows = matrix[self._order[front.span]].tocoo()
        column = self._place[rows.col]
        is_later = column >= front.span.start
        full[rows.row[is_later], np.searchsorted(columns, column[is_later])] = rows.data[is_later]
        return full

    def _eliminate(self, front: Front, full: Array) -> Array:
        """Eliminate a front, and return what it adds to the next one, on its boundary; the upper triangle counts."""
        num = len(front.own)
        own = slice(num)
        # The matrix is symmetric, so its transpose has the memory order of LAPACK. SciPy's own function reports the
        # failing column only in a text that differs between versions.
        lower, info = linalg.lapack.dpotrf(full[own, own].T, lower=True, overwrite_a=True, clean=True)
        if info > 0:
            raise SingularError(int(self._order[front.span.start + info - 1]))
        part = _Eliminated(lower, np.zeros((num, 0)))
        part = part._replace(tie=part.solved(full[own, num:]))
        self._eliminated.append(part)
        rest = full[num:, num:]
        return np.asarray(linalg.blas.dsyrk(-1.0, part.tie, 1.0, rest.T, trans=1, lower=1).T) if rest.size else rest

    def solve(self, right: Array) -> Array:
        """Solve for a right side of shape (size, k) or (size,)."""
        found = right.reshape(len(right), -1)[self._order]
        for front, part in zip(self._fronts, self._eliminated, strict=True):
            found[front.span] = part.solved(found[front.span])
            found[front.boundary] -= part.tie.T @ found[front.span]
        for front, part in zip(reversed(self._fronts), reversed(self._eliminated), strict=True):
            found[front.span] = part.solved(found[front.span] - part.tie @ found[front.boundary], transposed=True)
        return found[self._place].reshape(right.shape)

    def blocks_of_inverse(self) -> list[Array]:
        """Return the diagonal blocks of the inverse."""
        blocks: list[Array] = [np.zeros((0, 0))] * (len(self._starts) - 1)
        parent_of = {child: number for number, front in enumerate(self._fronts) for child in front.children}
        of_fronts = dict[int, Array]()
        for number in reversed(range(len(self._fronts))):
            front, num = self._fronts[number], len(self._fronts[number].own)
            whole = np.empty((num + len(front.boundary),) * 2)
            if (parent := parent_of.get(number)) is not None:
                of_rest = whole[num:, num:]
                for (rows, of_rows), (columns, of_columns) in product(self._fronts[parent].runs_of(front), repeat=2):
                    of_rest[of_rows, of_columns] = of_fronts[parent][rows, columns]
                if number == self._fronts[parent].children[0]:  # the last one that needs it
                    del of_fronts[parent]
            _upwards(self._eliminated[number], whole)
            for block in np.unique(np.searchsorted(self._starts, self._order[front.span], side="right") - 1).tolist():
                places = self._place[self._starts[block] : self._starts[block + 1]] - front.span.start
                blocks[block] = whole[np.ix_(places, places)]
            if front.children:
                of_fronts[number] = whole
        return blocks


def _upwards(part: _Eliminated, whole: Array) -> None:
    """Complete the inverse (size, size) of a whole front, of which the part of the boundary is known."""
    own, rest = slice(len(part.lower)), slice(len(part.lower), None)
    by_rest = part.solved(part.tie, transposed=True)
    whole[own, rest] = -by_rest @ whole[rest, rest]
    whole[rest, own] = whole[own, rest].T
    whole[own, own] = part.inverse() - whole[own, rest] @ by_rest.T


def _tied_blocks(matrix: csr_array, starts: Indices) -> csr_array:
    """Return the (n, n) matrix of blocks, nonzero where a block of a matrix has entries."""
    num = len(starts) - 1
    block_of = np.repeat(np.arange(num), np.diff(starts))
    # Row by row of blocks, because copies of the entries of all columns would take several times the matrix's memory.
    tied = [np.unique(block_of[matrix.indices[first:last]]) for first, last in pairwise(matrix.indptr[starts].tolist())]
    ends = np.cumsum([0, *map(len, tied)])
    return csr_array((np.ones(ends[-1]), np.concatenate(tied), ends), shape=(num, num))


def _columns_of(blocks: Sequence[Indices], starts: Indices) -> Indices:
    """Return the columns of some blocks, block by block."""
    first = np.concatenate([np.zeros(0, dtype=np.int64), *blocks])
    sizes = starts[first + 1] - starts[first]
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.asarray(np.repeat(starts[first], sizes) + within)
