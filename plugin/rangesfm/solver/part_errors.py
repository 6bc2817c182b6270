"""Errors of the parts of a map in few shared modes, from a covariance that is known only by its products."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.sparse import csc_array, diags_array

from rangesfm.arrays import Array
from rangesfm.util.geometry.map_errors import Kind, MapErrors, PartErrors
from rangesfm.util.geometry.numerics import ROUNDING

# Largest number of modes, which take 7 kB for each keyframe. What they leave counts as independent from keyframe to
# keyframe. On a field of 500 keyframes (the study of growth), standard deviations between two of them are 0.95 to 1.34
# times those by the whole covariance, on one of 1000 keyframes 0.97 to 1.61 times, the most between neighbours.
MAX_NUM_MODES = 300
# Products by which the subspace of the largest modes is found.
_NUM_PRODUCTS = 2


class PartSteps(NamedTuple):
    """A part of the map, and how its numbers change with the columns of the normal equations.

    Attributes:
        kind, id_: of the part.
        start: first of its columns; None if it is held constant.
        by_step: (d, columns) derivatives of its d numbers.
        unit: (d,) metres by which one unit of each number moves the map, roughly; the largest modes are the largest
            in metres.
    """

    kind: Kind
    id_: int | str
    start: int | None
    by_step: Array
    unit: Array

    def covariance(self, of_columns: Callable[[int], Array]) -> Array:
        """Return the (d, d) covariance of its numbers, by that of its columns, given the first of these."""
        if self.start is None:
            return np.zeros((len(self.unit), len(self.unit)))
        return np.asarray(self.by_step @ of_columns(self.start) @ self.by_step.T)


def map_errors(
    parts: Sequence[PartSteps],
    product: Callable[[Array], Array],
    blocks: Iterable[Array],
    by_scale: Array,
    scale_stddev: float,
) -> MapErrors:
    """Return how the parts of a map err together.

    Args:
        parts: all parts, those of one kind with the same number of numbers.
        product: covariance of all numbers of all parts times (numbers, k).
        blocks: (d, d) covariance of the numbers of each part.
        by_scale: (numbers,) expected change where the logarithm of the map's scale changes by 1.
        scale_stddev: standard deviation of that logarithm.
    """
    unit = np.concatenate([np.zeros(0), *(part.unit for part in parts)])
    in_metres = diags_array(unit)
    modes = _largest_modes(lambda right: in_metres @ product(in_metres @ right), len(unit))
    modes /= unit[:, None]
    rows = rows_of(parts)
    rests = [_rest(block, modes[own]) for block, own in zip(blocks, rows, strict=True)]
    kinds: dict[Kind, list[int]] = {}
    for k, part in enumerate(parts):
        kinds.setdefault(part.kind, []).append(k)
    return MapErrors(
        {
            kind: PartErrors(
                tuple(parts[k].id_ for k in members),  # type: ignore[arg-type]
                np.array([modes[rows[k]] for k in members]),
                np.array([rests[k] for k in members]),
                np.array([by_scale[rows[k]] for k in members]),
            )
            for kind, members in kinds.items()
        },
        scale_stddev,
    )


def rows_of(parts: Sequence[PartSteps]) -> list[slice]:
    """Return the rows of each part in the numbers of all."""
    ends = np.cumsum([0, *(len(part.unit) for part in parts)]).tolist()
    return [slice(first, last) for first, last in itertools.pairwise(ends)]


def steps_of(parts: Sequence[PartSteps], num_columns: int) -> csc_array:
    """Return the derivatives of all numbers of all parts by the columns, (num_columns, numbers)."""
    rows, columns, values, first = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)], 0
    for part in parts:
        if part.start is not None:
            number, column = np.indices(part.by_step.shape)
            rows.append(part.start + column.ravel())
            columns.append(first + number.ravel())
            values.append(part.by_step.ravel())
        first += len(part.unit)
    return csc_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(num_columns, first)
    )


def _largest_modes(product: Callable[[Array], Array], size: int) -> Array:
    """Return (size, r) modes whose product with their transpose is near to a symmetric (size, size) covariance.

    They are those of the Nystrom method, for the subspace to which products take random vectors: Halko,
    Martinsson and Tropp, "Finding structure with randomness", SIAM Review 2011, section 5.4.
    """
    if size <= MAX_NUM_MODES:
        basis = np.eye(size)
    else:
        basis = np.random.default_rng(0).standard_normal((size, MAX_NUM_MODES))
        for _ in range(_NUM_PRODUCTS):
            basis = linalg.qr(product(basis), mode="economic", overwrite_a=True)[0]
    image = product(basis)
    small = basis.T @ image
    values, vectors = linalg.eigh((small + small.T) / 2)
    least = ROUNDING * values.max(initial=0.0) + 1e-300
    modes: Array = image @ (vectors / np.sqrt(np.maximum(values, least)))
    return modes


def _rest(block: Array, modes: Array) -> Array:
    """Return the covariance of a part that the modes leave, without negative variances by rounding."""
    rest = block - modes @ modes.T
    values, vectors = np.linalg.eigh((rest + rest.T) / 2)
    left: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return left
