"""The scale from measured lengths alone, and outliers among them.

A measured length d between two points of a model has three errors: of its measurement, of the marks of its ends, and
of the map's bending. Bending means that the scale of a map varies smoothly from place to place; a length sees the mean
along its way. The size of this variation is estimated from how the lengths disagree, with a prior from other maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.linalg import block_diag
from scipy.optimize import brentq

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.geometry.similarity import path_shape
from rangesfm.scale.linear_map import FALSE_ALARM_RATE, NUM_SUSPECTS

# BENDING: relative variation of the scale within a map (stddev). _BENDING_SPREAD: stddev of its logarithm from map to
# map. _ALIKE_WITHIN: correlation length of the variation, as a share of the path's extent. Source: lengths of 0.5 to
# 5 m against the truth in a room mapped with a hand-held camera.
BENDING = 0.008
_BENDING_SPREAD, _ALIKE_WITHIN = 0.6, 0.25
# Number of sizes of the bending that are tried.
_NUM_TRIED = 21
NUM_WITHIN = 8
"""Number of places along a length, or of times of a group, over which its correlation with others is averaged."""


@dataclass(frozen=True)
class ScaleByKind:
    """The scale by ranges, measured lengths or known positions alone, in metres per SfM unit.

    Attributes:
        value: middle of its interval. stddev: with all error components; inf where the scale is not determined.
    """

    value: float
    stddev: float


@dataclass(frozen=True)
class LengthScale:
    """The scale from m lengths between points.

    Attributes:
        value: metres per SfM unit.
        components: relative standard deviations of the scale, by cause.
        rows: (m,) rows of the lengths among the distances.
        is_kept: (m,) True for lengths that agree with all else; the others are not used. Where none is kept, the scale
            is that of all of them, and takes no part.
        too_long_m, stddev_m: (m,) excess of each length over what all other kept measurements predict, and its standard
            deviation; inf where nothing predicts it.
        redundancy: (m,) how much of an error of each length the others check, 0 to 1 (Baarda's redundancy number).
        threshold: (m,) squared error of each length, in standard deviations, above which it is an outlier.
        by_metre: (m,) relative change of the scale if the length was a metre longer.
    """

    value: float
    components: dict[str, float]
    rows: Indices
    is_kept: Mask
    too_long_m: Array
    stddev_m: Array
    redundancy: Array
    threshold: Array
    by_metre: Array

    @property
    def relative_stddev(self) -> float:
        return float(np.linalg.norm(list(self.components.values())))

    @property
    def alone(self) -> ScaleByKind:
        """The scale, with its standard deviation."""
        return ScaleByKind(self.value, self.value * self.relative_stddev)

    @property
    def is_used(self) -> bool:
        """Return whether any of the lengths takes part."""
        return bool(self.is_kept.any())

    @property
    def statistic(self) -> Array:
        """(m,) squared excess of each length, in standard deviations."""
        return (self.too_long_m / self.stddev_m) ** 2

    def scaled_by(self, factor: float) -> LengthScale:
        """Return the lengths for the map with all its coordinates multiplied by a factor."""
        return replace(self, value=self.value / factor)

    def beside_ranges(self, distances: LocatedDistances, *, with_bending: bool = False) -> LocatedDistances:
        """Return the distances with one length that gives the same scale in place of all those between points, if used.

        Its standard deviation is that of the measurement and the marks. The bending is left out, because it should only
        widen the interval, as most systematic errors of radios do.

        Args:
            with_bending: whether the standard deviation includes the bending after all.
        """
        others = distances.subset(~distances.is_between_points)
        if not self.is_used:
            return others
        unit = np.array([1.0])
        measured = float(np.hypot(self.components["tape"], self.components["marks"]))
        stddev_m = self.value * (self.relative_stddev if with_bending else measured) * unit
        one = LocatedDistances.of(self.value * unit, stddev_m, model_length=unit)
        return one.joined(others)


def scale_by_lengths(
    distances: LocatedDistances | None, centers: Array, others: Sequence[ScaleByKind] = ()
) -> LengthScale | None:
    """Estimate the scale with outlying lengths left out; None where there is no length between points.

    Args:
        centers: (n, 3) camera centres of the path, in the model's unit.
        others: scales by other kinds of measurement. They only help to tell which lengths are wrong.

    Raises:
        GeometryError: both ends of a length are in one place of the map.
    """
    if distances is None:
        return None
    rows = np.flatnonzero(distances.is_between_points & ~distances.is_check)
    if not len(rows):
        return None
    lengths = _Lengths.of(distances, rows, float(np.linalg.norm(path_shape(centers).stddevs))).beside(others)
    is_length = np.arange(len(lengths.model)) < len(rows)
    agree = lengths.agreeing()
    fit = lengths.fit(agree & is_length if (agree & is_length).any() else is_length)
    of_all = lengths.fit(agree)
    tests = [lengths.test(agree, k, of_all) for k in range(len(rows))]
    kept, by_metre = agree[is_length], np.zeros(len(rows))
    by_metre[kept if kept.any() else slice(None)] = fit.gains / fit.scale
    components = {name: float(np.sqrt(fit.gains @ part @ fit.gains)) / fit.scale for name, part in fit.parts.items()}
    too_long_m, stddev_m, redundancy, threshold = np.array(tests).T
    return LengthScale(fit.scale, components, rows, kept, too_long_m, stddev_m, redundancy, threshold, by_metre)


@dataclass(frozen=True)
class _Fit:
    """A least squares fit.

    Attributes:
        scale: metres per SfM unit. bending: relative variation of the scale, root of its mean square.
        sizes, probabilities: (t,) possible variations over that, and how likely they are.
        parts: (k, k) covariances of the lengths by cause, square metres.
        gains: (k,) derivatives of the scale by each length.
    """

    scale: float
    bending: float
    sizes: Array
    probabilities: Array
    parts: dict[str, Array]
    gains: Array


class _Test(NamedTuple):
    """Test of one length against all else (Baarda's test); attributes as in ``LengthScale``."""

    too_long_m: float
    stddev_m: float
    redundancy: float
    threshold: float

    @property
    def excess(self) -> float:
        """Statistic over its threshold."""
        return (self.too_long_m / self.stddev_m) ** 2 / self.threshold


@dataclass(frozen=True)
class _Lengths:
    """Lengths in the model and as measured, (m,) each.

    The (m, m) covariances are of the measurement (square metres), of the marks (square model units) and of the bending
    (square model units, for a relative variation of 1).
    """

    model: Array
    metric: Array
    of_tape_m2: Array
    of_marks: Array
    of_bending: Array

    @classmethod
    def of(cls, distances: LocatedDistances, rows: Indices, extent: float) -> _Lengths:
        model, stddev_m, printed = distances.model_length[rows], distances.stddev_m[rows], distances.is_printed[rows]
        if not np.all(model > 1e-9 * extent):
            raise GeometryError("a measured length has both its ends in one place of the map")
        alone = ~(printed[:, None] & printed) & ~np.eye(len(rows), dtype=bool)
        shares = np.linspace(0, 1, NUM_WITHIN)[:, None, None]
        start, end = np.swapaxes(distances.ends[rows], 0, 1)
        places = np.swapaxes(start + shares * (end - start), 0, 1).reshape(-1, 3)
        squared = np.sum((places[:, None] - places) ** 2, axis=2) / (_ALIKE_WITHIN * extent) ** 2
        alike = np.exp(-0.5 * squared).reshape(len(rows), NUM_WITHIN, len(rows), NUM_WITHIN).mean(axis=(1, 3))
        # Lengths at unknown places are taken as independent: each has a scale of its own.
        alike = np.where(np.isfinite(alike), alike, np.eye(len(rows)))
        bends = ~distances.is_everywhere[rows]
        alike *= np.outer(bends, bends)
        return cls(
            model,
            distances.distance_m[rows],
            np.where(alone, 0.0, np.outer(stddev_m, stddev_m)),
            np.diag(distances.mark_stddev[rows] ** 2),
            alike * np.outer(model, model),
        )

    def beside(self, others: Sequence[ScaleByKind]) -> _Lengths:
        """Return the lengths and, after them, one length of one unit for each of the other scales."""
        values, variances = np.array([[each.value, each.stddev**2] for each in others]).reshape(-1, 2).T
        nothing = np.zeros((len(others), len(others)))
        return _Lengths(
            np.append(self.model, np.ones(len(others))),
            np.append(self.metric, values),
            block_diag(self.of_tape_m2, np.diag(variances)),
            block_diag(self.of_marks, nothing),
            block_diag(self.of_bending, nothing),
        )

    def agreeing(self) -> Mask:
        """Return which lengths agree with each other, a majority; one is left out at a time, the worst first."""
        num, kept = len(self.model), np.ones(len(self.model), dtype=bool)
        ratios = np.log(self.metric / self.model)
        while kept.sum() > 2 and (~kept).sum() + 1 < num / 2:
            among = np.flatnonzero(kept)
            far = np.argsort(-np.abs(ratios[among] - np.median(ratios[among])), kind="stable")[:NUM_SUSPECTS]
            excess = {k: self.test(kept & (np.arange(num) != k), k).excess for k in among[far].tolist()}
            worst = max(excess, key=excess.__getitem__)
            if excess[worst] <= 1:
                break
            kept[worst] = False
        return kept

    def _parts(self, chosen: Mask, scale: float, bending: float) -> dict[str, Array]:
        part = np.ix_(chosen, chosen)
        return {
            "tape": self.of_tape_m2[part],
            "marks": scale**2 * self.of_marks[part],
            "bending": (scale * bending) ** 2 * self.of_bending[part],
        }

    def fit(self, chosen: Mask) -> _Fit:
        """Fit the scale by generalised least squares.

        The size of the bending is the root of its mean square under its restricted likelihood. The most likely size
        would be too small with few lengths. The errors of marks and of the bending are in the model's unit, and change
        with the scale, so that it is fitted until it stays.
        """
        model, metric = self.model[chosen], self.metric[chosen]
        scale, bending = float(np.median(metric / model)), BENDING
        logs = np.linspace(-4 * _BENDING_SPREAD, 6 * _BENDING_SPREAD, _NUM_TRIED)
        for _ in range(MAX_NUM_ROUNDS):
            of_sizes = [self._parts(chosen, scale, BENDING * np.exp(each)) for each in logs]
            unlikeliness = np.array([_unlikeliness(_total(p), model, metric) for p in of_sizes])
            weights = np.exp(-(unlikeliness - unlikeliness.min()) - 0.5 * (logs / _BENDING_SPREAD) ** 2)
            probabilities = weights / weights.sum()
            bending = BENDING * float(np.sqrt(probabilities @ np.exp(2 * logs)))
            parts = self._parts(chosen, scale, bending)
            by_model = np.linalg.solve(_total(parts), model)
            gains = by_model / (model @ by_model)
            before, scale = scale, float(gains @ metric)
            if abs(scale - before) <= ROUNDING * before:
                break
        return _Fit(scale, bending, BENDING * np.exp(logs) / bending, probabilities, parts, gains)

    def test(self, kept: Mask, k: int, fit: _Fit | None = None) -> _Test:
        """Test length k against the other kept ones.

        The distribution of the statistic is that over all sizes that the bending may have.

        Args:
            fit: whose size of the bending is used, as that of a fit for each of many lengths takes long; None: fit
                the other kept ones.
        """
        others, risk = kept & (np.arange(len(kept)) != k), FALSE_ALARM_RATE / len(kept)
        if not others.any():
            return _Test(0.0, np.inf, 0.0, float(special.chdtri(1, risk)))
        fit, chosen, at = fit or self.fit(others), others | (np.arange(len(kept)) == k), int(others[:k].sum())
        model, parts = self.model[chosen], self._parts(chosen, fit.scale, fit.bending)
        inverse = np.linalg.inv(_total(parts))
        by_model = inverse @ model
        off = inverse - np.outer(by_model, by_model) / (model @ by_model)
        by = off[at] / off[at, at]
        of_bending = float(by @ parts["bending"] @ by)
        variances = 1 / off[at, at] + (fit.sizes**2 - 1) * of_bending
        threshold = off[at, at] * _quantile(variances, fit.probabilities, risk) ** 2
        excess_m, redundancy = float(by @ self.metric[chosen]), float(off[at, at] / inverse[at, at])
        return _Test(excess_m, float(off[at, at] ** -0.5), redundancy, float(threshold))


def _quantile(variances: Array, probabilities: Array, risk: float) -> float:
    """Return the size that a normal number with one of these variances (t,) exceeds, on either side, with this risk."""
    stddevs = np.sqrt(np.maximum(variances, 0.0)) + 1e-300
    # A little beyond the quantile of the largest variance, which it is but for rounding if all variances are equal.
    widest = -special.ndtri(risk / 2) * float(stddevs.max()) * (1 + 1e-6)

    def excess_risk(size: float) -> float:
        return float(2 * probabilities @ special.ndtr(-size / stddevs)) - risk

    return float(brentq(excess_risk, 0.0, widest))


def _total(parts: Mapping[str, Array]) -> Array:
    return np.asarray(np.sum(list(parts.values()), axis=0))


def _unlikeliness(covariance: Array, model: Array, metric: Array) -> float:
    """Return the negative logarithm of the restricted likelihood, up to a constant."""
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), np.column_stack([model, metric]))
    (information, right), (_, square) = whitened.T @ whitened
    determinant = np.linalg.slogdet(covariance)[1]
    return float(0.5 * (determinant + np.log(information) + square - right**2 / information))
