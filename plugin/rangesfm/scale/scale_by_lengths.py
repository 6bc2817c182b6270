"""Outliers among measured lengths, by all that is known of a map, and the scale by the lengths alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.distances.lengths_on_map import LENGTHS, lengths_on_map
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING, SIGNIFICANT_STDDEVS
from rangesfm.geometry.similarity import path_shape
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.inference.bending import MapBending
from rangesfm.inference.linear_map import FALSE_ALARM_RATE, NUM_SUSPECTS
from rangesfm.inference.posterior import JointProblem, Observations, Posterior, ScaleByKind, ScaleUncertainty, joined


@dataclass(frozen=True)
class KnownLengths:
    """Measured lengths between points that may take part in the scale.

    Attributes:
        lengths: the m lengths, in the model of ``path``. rows: (m,) of them among all distances.
        bending: of the map. metres_per_unit: as of ``lengths_on_map``.
    """

    lengths: LocatedDistances
    rows: Indices
    path: Trajectory
    bending: MapBending
    metres_per_unit: float = 1.0

    @classmethod
    def of(
        cls,
        distances: LocatedDistances | None,
        path: Trajectory,
        bending: MapBending,
        metres_per_unit: float = 1.0,
        rows: Indices | None = None,
    ) -> KnownLengths | None:
        """Return the lengths among measured distances; None where there is none between points.

        Args:
            rows: of the lengths; None: all that are no checks.

        Raises:
            GeometryError: both ends of a length are in one place of the map.
        """
        if distances is None:
            return None
        if rows is None:
            rows = np.flatnonzero(distances.is_between_points & ~distances.is_check)
        if not len(rows):
            return None
        extent = float(np.linalg.norm(path_shape(path.centers).stddevs))
        if not np.all(distances.model_length[rows] > 1e-9 * extent):
            raise GeometryError("a measured length has both its ends in one place of the map")
        lengths = distances.subset(np.isin(np.arange(len(distances)), rows))
        return cls(lengths, rows, path, bending, metres_per_unit)

    def observed(self, scale: float, is_kept: Mask) -> Observations:
        """Return the observations of the lengths about a scale."""
        return lengths_on_map(self.lengths, scale, self.path, is_kept, metres_per_unit=self.metres_per_unit)

    def alone(self, is_kept: Mask) -> tuple[float, Posterior, Array]:
        """Return the scale by some of the lengths alone, what is known of it, and its (m,) change by each length."""
        value = float(np.median((self.lengths.distance_m / self.lengths.model_length)[is_kept]))
        for _ in range(MAX_NUM_ROUNDS):  # the equations are linear in the scale, and not in its logarithm
            problem = joined([self.observed(value, is_kept)], self.bending).learnt()
            known = problem.posterior(is_fitted=False)
            value *= float(np.exp(known.step[0]))
            if abs(known.step[0]) <= ROUNDING:
                break
        return value, known, problem.of_kind(LENGTHS, known.gains)


@dataclass(frozen=True)
class LengthScale:
    """What m measured lengths say of the scale, and what all else says of them.

    Attributes:
        value: metres per SfM unit by the lengths alone. uncertainty: of this.
        rows: (m,) rows of the lengths among the distances.
        is_kept: (m,) True for lengths that agree with all else; the others are not used. Where none is kept, the scale
            is that of all of them, and takes no part.
        too_long_m, stddev_m: (m,) excess of each length over what all other kept measurements predict, and its standard
            deviation; inf where nothing predicts it.
        redundancy: (m,) how much of an error of each length the others check, 0 to 1 (Baarda's redundancy number).
        threshold: squared error of a length, in standard deviations, above which it is an outlier.
        by_metre: (m,) relative change of the scale by the lengths if the length was a metre longer.
    """

    value: float
    uncertainty: ScaleUncertainty
    rows: Indices
    is_kept: Mask
    too_long_m: Array
    stddev_m: Array
    redundancy: Array
    threshold: float
    by_metre: Array

    @property
    def alone(self) -> ScaleByKind:
        """The scale, with its standard deviation."""
        return self.uncertainty.about(self.value)

    @property
    def is_used(self) -> bool:
        """Return whether any of the lengths takes part."""
        return bool(self.is_kept.any())

    @property
    def statistic(self) -> Array:
        """(m,) squared excess of each length, in standard deviations."""
        return (self.too_long_m / self.stddev_m) ** 2

    def beside_ranges(self, distances: LocatedDistances, unit: float = 1.0) -> LocatedDistances:
        """Return the distances with one length that gives the same scale in place of all those between points, if used.

        With it the problem of the ranges is solved and tested.

        Args:
            unit: of the model to which the distances refer, in units of that of the lengths.
        """
        others = distances.subset(~distances.is_between_points)
        if not self.is_used:
            return others
        one, alone = np.array([1.0]), self.alone
        return LocatedDistances.of(unit * alone.value * one, unit * alone.stddev * one, model_length=one).joined(others)


def scale_by_lengths(
    lengths: KnownLengths | None,
    scale: float | None = None,
    others: Sequence[Observations] = (),
    priors: tuple[Array, Array] | None = None,
    is_kept: Mask | None = None,
) -> LengthScale | None:
    """Estimate the scale with outlying lengths left out; None without any.

    Args:
        scale: of the map at which the others are; None without any.
        others: observations of other kinds on the map. They tell which lengths are wrong.
        priors: residuals and derivatives of the priors, by the unknowns of the others; None without any.
        is_kept: (m,) lengths that are known to agree, which are only tested; None: they are found.
    """
    if lengths is None:
        return None
    num, measured = len(lengths.rows), lengths.lengths
    threshold = float(special.chdtri(1, FALSE_ALARM_RATE / num))
    at = float(np.median(measured.distance_m / measured.model_length)) if scale is None else scale

    def problem(kept: Mask) -> JointProblem:
        all_kinds = [*others, lengths.observed(at, kept)]
        # A map that bends by significantly more than others do was mistaken, which must not pass for noise.
        return joined(all_kinds, lengths.bending, *(priors or ())).learnt(most_unusual=SIGNIFICANT_STDDEVS)

    def effect(of: JointProblem, k: int) -> Array:
        columns = np.zeros((len(of.is_used), 1))
        columns[of.rows[LENGTHS].start + k] = 1.0
        return columns

    def excess(kept: Mask, k: int) -> float:
        without = problem(kept & (np.arange(num) != k))
        return without.mistake(effect(without, k)).statistic / threshold if without.is_used.any() else 0.0

    kept = np.ones(num, dtype=bool) if is_kept is None else is_kept.copy()
    while is_kept is None and kept.sum() + len(others) > 2 and (~kept).sum() + 1 < (num + len(others)) / 2:
        now, among = problem(kept), np.flatnonzero(kept)
        suspicious = np.array([now.mistake(effect(now, k)).statistic for k in among.tolist()])
        far = among[np.argsort(-suspicious, kind="stable")[:NUM_SUSPECTS]]
        found = {k: excess(kept, k) for k in far.tolist()}
        worst = max(found, key=found.__getitem__)
        # Where the others contradict each other, one of them is wrong.
        wrong_size = (now.mistake(now.size_of(each.kind)).statistic / threshold for each in others)
        if found[worst] <= max(1.0, *wrong_size, 0.0):
            break
        kept[worst] = False
    now = problem(kept)
    tests = [_test(now, effect(now, k)) for k in range(num)]
    used = kept if kept.any() else ~kept
    value, known, by_metre = lengths.alone(used)
    too_long_m, stddev_m, redundancy = np.array(tests).T
    return LengthScale(
        value, known.uncertainty, lengths.rows, kept, too_long_m, stddev_m, redundancy, threshold, by_metre
    )


def _test(problem: JointProblem, columns: Array) -> tuple[float, float, float]:
    """Return by how much a length is too long, the standard deviation of that, and the redundancy of the length."""
    found = problem.mistake(columns)
    if not found.is_seen or not np.isfinite(found.stddevs[0]):
        return 0.0, np.inf, 0.0
    used = problem.is_used | np.any(columns != 0, axis=1)
    at = np.flatnonzero(columns[used, 0])[0]
    precision = float(np.linalg.inv(problem.noise.of_rows(used).covariance_m2)[at, at])
    return float(found.sizes[0]), float(found.stddevs[0]), float(found.stddevs[0] ** -2 / precision)
