"""Linear equations of known positions about a similarity: components of their errors, and the tests of mistakes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_diag, csr_array, kron
from scipy.spatial.distance import cdist

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.positions.known_positions import KnownPositions
from rangesfm.ranging.errors.bending import ErrorPart
from rangesfm.ranging.errors.components import FRAME
from rangesfm.ranging.errors.learned import ComponentLikelihood, ErrorParts, independent_unknowns
from rangesfm.ranging.errors.range_bins import MAX_NUM_BINS
from rangesfm.ranging.range_observations import OUTLIER_BELOW
from rangesfm.scale.linear_map import EstimatedMistake, LinearMap
from rangesfm.scale.scale_by_lengths import NUM_WITHIN

LASTING = "positions_"
"""Start of the names of errors of an antenna's positions that last for some time."""
WARP = f"{LASTING}warp"


@dataclass(frozen=True)
class PositionEquations:
    """Linear equations of g groups of positions about a similarity, three coordinates each.

    Attributes:
        linear: the equations, for the logarithm of the scale, a turn and a shift about the first camera.
        parts: components of the errors of all coordinates. errors: as learnt.
        is_used: (3 g,) coordinates that take part in the estimate.
        grouping: (3 g, 3 k) sparse weights of the positions in the groups.
    """

    linear: LinearMap
    parts: tuple[ErrorPart, ...]
    errors: ErrorParts
    is_used: Mask
    grouping: csr_array

    def with_mistake_learnt(self, columns: Array) -> PositionEquations:
        """Return the equations with errors learnt again, as if a mistake with (3 k, m) ``columns`` was made.

        Otherwise the errors that the mistake causes are taken for noise, in which it then hides.
        """
        design = np.hstack([self.linear.design, self.grouping @ columns])
        more = np.zeros((len(self.linear.prior_design), columns.shape[1]))
        linear = replace(self.linear, design=design, prior_design=np.hstack([self.linear.prior_design, more]))
        return replace(self, errors=errors_of_sizes(self.parts, learnt_sizes(self.parts, linear, self.is_used)))

    def of(self, rows: Mask) -> tuple[LinearMap, ErrorParts]:
        """Return the equations and errors of some coordinates (3 g,)."""
        linear, parts = self.linear, self.errors
        chosen = parts.covariances_m2[:, rows][:, :, rows]
        return replace(linear, residual_m=linear.residual_m[rows], design=linear.design[rows]), replace(
            parts, covariances_m2=chosen
        )

    def of_mistake(self, columns: Array) -> EstimatedMistake:
        """Estimate a mistake that changes the known positions by (3 k, m) ``columns`` times its m numbers.

        Positions that it changes are taken into the equations, whether they take part or not.
        """
        by_groups = self.grouping @ columns
        rows = self.is_used | np.any(by_groups != 0, axis=1)
        linear, parts = self.of(rows)
        return linear.solved(parts.covariance_m2).mistake(-by_groups[rows])


def at_point(known: KnownPositions, row: int) -> Array:
    """Return the (3 k, 3) effect of a known position that is too large by a metre in each coordinate."""
    columns = np.zeros((3 * len(known), 3))
    columns[3 * row : 3 * row + 3] = np.eye(3)
    return columns


def grouped_by_time(known: KnownPositions, weights: Array) -> csr_array:
    """Return the (3 g, 3 k) weights of positions in groups: marks alone, an antenna's averaged in the order of time.

    The groups of an antenna have no more coordinates than ranges have bins, whose errors are learnt in the same way.
    """
    marks = np.flatnonzero(known.is_mark)
    others = np.flatnonzero(~known.is_mark & (weights >= OUTLIER_BELOW))
    order = (
        others[np.argsort(known.time_s[others], kind="stable")] if np.isfinite(known.time_s[others]).all() else others
    )
    groups = [np.array([row]) for row in marks]
    groups += [part for part in np.array_split(order, min(len(order), MAX_NUM_BINS // 3) or 1) if len(part)]
    shares = [np.ones(1) if known.is_mark[rows[0]] else weights[rows] / weights[rows].sum() for rows in groups]
    lines = np.repeat(np.arange(len(groups)), [len(rows) for rows in groups])
    shape = (len(groups), len(known))
    alone = csr_array((np.concatenate(shares), (lines, np.concatenate(groups))), shape=shape)
    return kron(alone, np.eye(3), format="csr")


def covariance_of_groups(grouping: csr_array, covariances: Array, rows: Mask) -> Array:
    """Return the (3 g, 3 g) covariance of groups from independent (k, 3, 3) ones of the positions in ``rows``."""
    blocks = block_diag(list(np.where(rows[:, None, None], covariances, 0.0)), format="csr")
    return np.asarray((grouping @ blocks @ grouping.T).toarray())


def times_of_groups(grouping: csr_array, known: KnownPositions, size_m: Array, rows: Indices) -> tuple[Array, Array]:
    """Return (g,) mean standard deviations of the antenna's positions in each group (0: marks), and (g, t) times."""
    of_groups = grouping[::3, ::3]
    is_timed = np.zeros(len(known))
    is_timed[rows] = 1.0
    times = np.zeros((of_groups.shape[0], NUM_WITHIN))
    for group in range(of_groups.shape[0]):
        members = of_groups.indices[of_groups.indptr[group] : of_groups.indptr[group + 1]]
        if is_timed[members].all():
            times[group] = np.quantile(known.time_s[members], np.linspace(0, 1, NUM_WITHIN))
    return of_groups @ (is_timed * size_m), times


def errors_by_place(
    grouping: csr_array, position_m: Array, size_m: Array, median: float, spread: float, *, is_geodetic: bool
) -> Iterator[ErrorPart]:
    """Yield the components of the errors of an antenna's positions that are the same whenever it is at a place.

    Args:
        position_m: (k, 3) positions by the map. size_m: (g,) standard deviations of the groups; 0 for marks.
        median, spread: of the size of the warp, in those standard deviations.
        is_geodetic: whether the frame is one of the Earth, whose scale is right.
    """
    of_groups_m: Array = grouping[::3, ::3] @ position_m
    has_frame = (size_m > 0).astype(np.float64)
    from_middle = has_frame[:, None] * (of_groups_m - has_frame @ of_groups_m / has_frame.sum())
    extent_m = float(np.sqrt(np.sum(from_middle**2) / has_frame.sum()))
    if not extent_m > 0:
        return
    warp = np.exp(-cdist(of_groups_m, of_groups_m) / extent_m) * np.outer(size_m, size_m)
    yield ErrorPart(WARP, np.asarray(np.kron(warp, np.eye(3))), median, spread)
    stretch = (0.0 if is_geodetic else 1.0) / extent_m * from_middle.ravel()
    shift = np.kron(np.outer(has_frame, has_frame), np.eye(3))
    yield ErrorPart(FRAME, np.asarray(shift + np.outer(stretch, stretch)))


def expected_sizes(parts: Sequence[ErrorPart], linear: LinearMap) -> dict[str, float]:
    """Return the size of each component before anything is measured."""
    sizes = {part.name: part.median_m * float(np.exp(part.spread**2)) for part in parts}
    return _with_frame(parts, sizes, linear, np.ones(len(linear.residual_m), dtype=bool))


def _with_frame(
    parts: Sequence[ErrorPart], sizes: Mapping[str, float], linear: LinearMap, rows: Mask
) -> dict[str, float]:
    """Return the sizes with that of the place and the scale of the positions' frame.

    No survey shows it, as place and scale of the map are no other. A system is taken to shift and to stretch its frame
    (as a root mean square over the path) by as much as a coordinate errs for some time, or at some place: by what of
    these errors a similarity does not take up.
    """
    if FRAME not in sizes:
        return dict(sizes)
    similarity, _ = independent_unknowns(linear.design[rows], np.zeros((0, linear.design.shape[1])))
    left_m2 = 0.0
    for part in parts:
        if part.name.startswith(LASTING):
            alike = sizes[part.name] ** 2 * part.alike[np.ix_(rows, rows)]
            left_m2 += float(np.trace(alike) - np.sum(similarity * (alike @ similarity)))
    return {**sizes, FRAME: float(np.sqrt(max(left_m2, 0.0) / rows.sum()))}


def learnt_sizes(parts: Sequence[ErrorPart], linear: LinearMap, rows: Mask) -> dict[str, float]:
    """Return the size of each component, by restricted likelihood over some coordinates (3 g,)."""
    learnt = [part for part in parts if part.spread > 0]
    sizes = {part.name: 1.0 for part in parts}
    if not learnt:
        return sizes
    at = np.ix_(rows, rows)
    known_m2 = [part.alike[at] for part in parts if part.spread == 0 and part.name != FRAME]
    likelihood = ComponentLikelihood(
        np.array([part.alike[at] for part in learnt]),
        np.log([part.median_m for part in learnt]),
        np.array([part.spread for part in learnt]),
        np.sum([np.zeros((rows.sum(),) * 2), *known_m2], axis=0),
        -linear.residual_m[rows],
        # A mistake may have no effect of its own, such as an antenna too high above a camera that is always level.
        *independent_unknowns(linear.design[rows], linear.prior_design),
    )
    found = likelihood.mean_stddevs(likelihood.most_likely())
    sizes |= dict(zip((part.name for part in learnt), found.tolist(), strict=True))
    return _with_frame(parts, sizes, linear, rows)


def errors_of_sizes(parts: Sequence[ErrorPart], sizes: Mapping[str, float]) -> ErrorParts:
    """Return the errors with components of these sizes."""
    of_all = np.array([sizes[part.name] ** 2 * part.alike for part in parts])
    stddevs = np.sqrt(np.trace(of_all, axis1=1, axis2=2) / of_all.shape[1])
    return ErrorParts(tuple(part.name for part in parts), stddevs, of_all)
