"""Errors of the parts of a map in few shared modes, from a covariance that is known only by its products."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def map_errors(
    parts: Sequence[PartSteps],
    num_columns: int,
    product: Callable[[Array], Array],
    block: Callable[[int], Array],
    of_scale: Array,
    scale_stddev: float,
) -> MapErrors:
    """Return how the parts of a map err together.

    Args:
        parts: all parts, those of one kind with the same number of numbers.
        num_columns: of the normal equations.
        product: covariance of all columns times (num_columns, k).
        block: covariance of the columns of one part, by the first of them.
        of_scale: (num_columns,) derivative of the logarithm of the map's scale.
        scale_stddev: its standard deviation.
    """
    steps = _all_steps(parts, num_columns)
    unit = np.concatenate([np.zeros(0), *(part.unit for part in parts)])
    in_metres = diags_array(unit)
    modes = _largest_modes(lambda right: in_metres @ (steps.T @ product(steps @ (in_metres @ right))), len(unit))
    modes /= unit[:, None]
    by_scale = np.zeros(len(unit))
    if scale_stddev > 0:
        by_scale = steps.T @ product(of_scale[:, None])[:, 0] / scale_stddev**2
    ends = np.cumsum([0, *(len(part.unit) for part in parts)])
    rests = [
        _rest(part, block, modes[first:last]) for part, first, last in zip(parts, ends[:-1], ends[1:], strict=True)
    ]
    kinds: dict[Kind, list[int]] = {}
    for k, part in enumerate(parts):
        kinds.setdefault(part.kind, []).append(k)
    return MapErrors(
        {
            kind: PartErrors(
                tuple(parts[k].id_ for k in members),  # type: ignore[arg-type]
                np.array([modes[ends[k] : ends[k + 1]] for k in members]),
                np.array([rests[k] for k in members]),
                np.array([by_scale[ends[k] : ends[k + 1]] for k in members]),
            )
            for kind, members in kinds.items()
        },
        scale_stddev,
    )


def _all_steps(parts: Sequence[PartSteps], num_columns: int) -> csc_array:
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


def _rest(part: PartSteps, block: Callable[[int], Array], modes: Array) -> Array:
    """Return the covariance of a part that the modes leave, without negative variances by rounding."""
    if part.start is None:
        return np.zeros((len(part.unit), len(part.unit)))
    rest = part.by_step @ block(part.start) @ part.by_step.T - modes @ modes.T
    values, vectors = np.linalg.eigh((rest + rest.T) / 2)
    left: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return left
