"""How large each component of the ranges' errors is in a survey: learnt from residuals, on what radios let expect."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.bending import BendingOfCells
from rangesfm.ranging.errors.components import BENDS, COMPONENTS, LEARNT_CURVE, Component
from rangesfm.ranging.errors.range_bins import Cells

# Noise of single ranges up to which a radio is one of the population. Of one with more all else may be off by more, and
# faster than in proportion: an old one with five times the noise reads 7 % long, where the others are right to a
# percent.
_USUAL_NOISE_M, _WIDENING_POWER = 0.1, 1.5
_MAX_NUM_ITERATIONS = 100
_TOLERANCE = 1e-9
# Logarithms of stddevs, beside the median: farther away the likelihood is flat.
_FARTHEST_BELOW, _FARTHEST_ABOVE = 5.0, 4.0
# Of unknowns, of unit length: what a combination of them changes less than this changes nothing.
_DEPENDENT = 1e-7
# Of the trace of a covariance, which rounding may leave singular.
ROUNDING = 1e-12


@dataclass(frozen=True)
class LearnedErrors:
    """What c cells of ranges get wrong.

    Attributes:
        cells: of the ranges.
        of_range: (n,) the cell of each range; -1 of one that took no part.
        names, stddevs: of the components; metres, ``slope`` a share of the distance; of what is not learnt, of cells on
            average.
        covariances_m2: (k, c, c) that each of them adds.
        unlikeliness: what is expected has against these stddevs, as -2 times a logarithm.
    """

    cells: Cells
    of_range: Indices
    names: tuple[str, ...]
    stddevs: Array
    covariances_m2: Array
    unlikeliness: float = 0.0

    @property
    def covariance_m2(self) -> Array:
        """(c, c) of all of them."""
        return np.asarray(self.covariances_m2.sum(axis=0))

    @property
    def stddev_of_component(self) -> dict[str, float]:
        """By name."""
        return dict(zip(self.names, self.stddevs.tolist(), strict=True))

    def without(self, *names: str) -> LearnedErrors:
        """But for some components."""
        kept = [row for row, each in enumerate(self.names) if each not in names]
        return replace(
            self,
            names=tuple(self.names[row] for row in kept),
            stddevs=self.stddevs[kept],
            covariances_m2=self.covariances_m2[kept],
        )

    def subset(self, rows: Indices) -> LearnedErrors:
        """Of some of the ranges."""
        return replace(self, of_range=self.of_range[rows])

    def spread(self, rows: Indices, num: int) -> LearnedErrors:
        """The same as ``rows`` of ``num`` ranges, of which the others take no part."""
        of_range = np.full(num, -1, dtype=np.int64)
        of_range[rows] = self.of_range
        return replace(self, of_range=of_range)

    def stddev_of(self, influence: Array) -> dict[str, float]:
        """What each component does to a number that moves by (n,) ``influence`` for each metre of a range."""
        return self.stddev_of_cells(self.cells.total(influence))

    def stddev_of_cells(self, of_cells: Array) -> dict[str, float]:
        """The same by (c,) influence for each metre of a cell."""
        variances = np.einsum("i,kij,j->k", of_cells, self.covariances_m2, of_cells)
        return dict(zip(self.names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))


def learn_errors(
    cells: Cells,
    off_m: Array,
    design: Array,
    prior_design: Array,
    noise_m: float,
    curve_stddev_m: Array | None = None,
    ruled_out: Collection[str] = (),
    others_m2: Mapping[str, Array] | None = None,
    bending: BendingOfCells | None = None,
) -> LearnedErrors:
    """Restricted maximum likelihood (Patterson and Thompson, 1971) with lognormal priors on the stddevs.

    Args:
        off_m: (n,) measured minus predicted, without any bias.
        design: (n, p) by how much each predicted range grows with the unknowns of the map.
        prior_design: (r, p) what is known of these beforehand, in stddevs.
        noise_m: of single ranges.
        curve_stddev_m: (n,) of a learnt error curve that has been taken off; None if none has.
        ruled_out: components that the user knows not to be there.
        others_m2: (c, c) covariances of what else there is, by name, of which nothing is to be learnt.
        bending: of the map; None: it is not bent.
    """
    expected = ExpectedErrors.of(cells, curve_stddev_m, ruled_out, others_m2, bending)
    return expected.learnt(cells.mean(off_m), cells.mean(design), prior_design, noise_m)


def usual_stddevs(*, is_calibrated: bool) -> dict[str, float]:
    """Of all components by name: roots of the mean variances over radios (of a lognormal stddev)."""
    return _usual(COMPONENTS, is_calibrated=is_calibrated)


def _usual(components: Iterable[Component], *, is_calibrated: bool) -> dict[str, float]:
    return {c.name: float(_median(c, is_calibrated) * np.exp(c.spread**2)) for c in components}


@dataclass(frozen=True)
class ExpectedErrors:
    """What radios let expect of c cells before anything is measured: k components of which there is to learn.

    Attributes:
        components: these. of_components: (k, c, c) covariances for a stddev of 1 of each.
        known: (c, c) covariances that nothing is to be learnt of, by name.
        shift_m: (c,) by how much predicted ranges grow as the map goes to where the photos alone would have it.
        is_calibrated: whether a learnt error curve has been taken off.
    """

    cells: Cells
    components: tuple[Component, ...]
    of_components: Array
    known: Mapping[str, Array]
    shift_m: Array
    is_calibrated: bool

    @classmethod
    def of(
        cls,
        cells: Cells,
        curve_stddev_m: Array | None = None,
        ruled_out: Collection[str] = (),
        others_m2: Mapping[str, Array] | None = None,
        bending: BendingOfCells | None = None,
    ) -> ExpectedErrors:
        """As of ``learn_errors``."""
        # One tag's own bias is that of all ranges.
        left_out = {*ruled_out, *(() if np.ptp(cells.tag_index) else ("tag_bias",))}
        components = tuple(component for component in COMPONENTS if component.name not in left_out)
        components += () if bending is None else bending.components
        of_anchor = np.outer(cells.noisiness, cells.noisiness)
        of_components = [c.correlation(cells) * (of_anchor if c.is_of_anchor else 1.0) for c in components]
        known = dict(others_m2 or {})
        if curve_stddev_m is not None:
            stddev = cells.mean(curve_stddev_m)
            smooth = next(component for component in COMPONENTS if component.name == "curve")
            known[LEARNT_CURVE] = np.outer(stddev, stddev) * smooth.correlation(cells)
        shift_m = np.zeros(len(cells)) if bending is None else bending.shift_m
        return cls(cells, components, np.array(of_components), known, shift_m, curve_stddev_m is not None)

    def usual(self, stddevs: Mapping[str, float]) -> LearnedErrors:
        """Roots of the mean variances over radios, or by name what is known better."""
        usual = _usual(self.components, is_calibrated=self.is_calibrated) | dict(stddevs)
        sizes = np.array([usual[component.name] for component in self.components])
        return self._of(sizes, sizes[:, None, None] ** 2 * self.of_components)

    def learnt(
        self, off_m: Array, design: Array, prior_design: Array, noise_m: float, most_unusual: float = np.inf
    ) -> LearnedErrors:
        """As of ``learn_errors``, with (c,) and (c, p) of cells of the map as it is.

        Args:
            most_unusual: how far above its median any stddev may be, in spreads over radios.
        """
        # A map bends no more for a bad radio, and the noise says itself how large it is.
        widening = max(1.0, noise_m / _USUAL_NOISE_M) ** _WIDENING_POWER
        widened = [1.0 if c.name in (*BENDS, "white") else widening**2 for c in self.components]
        likelihood = _Likelihood(
            np.array(widened)[:, None, None] * self.of_components if widening > 1 else self.of_components,
            np.log([_median(component, self.is_calibrated) for component in self.components]),
            np.array([component.spread for component in self.components]),
            np.sum([*self.known.values(), np.zeros((len(self.cells), len(self.cells)))], axis=0),
            off_m - self.shift_m,
            *_independent(design, prior_design),
        )
        stddevs = likelihood.mean_stddevs(likelihood.most_likely(most_unusual))
        off_expected = [
            np.log(stddev / _median(component, self.is_calibrated)) / component.spread
            for component, stddev in zip(self.components, stddevs, strict=True)
        ]
        found = self._of(stddevs, stddevs[:, None, None] ** 2 * likelihood.of_components)
        return replace(found, unlikeliness=float(np.sum(np.square(off_expected))))

    def _of(self, stddevs: Array, covariances: Array) -> LearnedErrors:
        """With what is known otherwise."""
        names = (*(component.name for component in self.components), *self.known)
        return LearnedErrors(
            self.cells,
            self.cells.of_range,
            names,
            np.append(stddevs, [np.sqrt(np.trace(m) / len(m)) for m in self.known.values()]),
            np.concatenate([covariances, *(m[None] for m in self.known.values())]),
        )


def _median(component: Component, is_calibrated: bool) -> float:
    if is_calibrated and component.calibrated_median is not None:
        return component.calibrated_median
    return component.median


@dataclass(frozen=True)
class _Likelihood:
    """Of the logarithms of k stddevs, given c cells."""

    of_components: Array
    log_medians: Array
    spreads: Array
    known: Array
    off_m: Array
    design: Array
    prior_design: Array

    def most_likely(self, most_unusual: float) -> Array:
        """(k,)"""
        above = np.minimum(most_unusual * self.spreads, _FARTHEST_ABOVE)
        bounds = np.column_stack([self.log_medians - _FARTHEST_BELOW, self.log_medians + above])
        options = {"maxiter": _MAX_NUM_ITERATIONS, "ftol": _TOLERANCE}
        found = minimize(
            self._negative_with_gradient, self.log_medians, jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        return np.asarray(found.x)

    def _negative_with_gradient(self, logs: Array) -> tuple[float, Array]:
        lower, inverse = self._factored(logs)
        whitened, spread, determinant = self._unknowns(inverse)
        moved = spread @ (whitened.T @ self.off_m)
        pulls = inverse @ self.off_m - whitened @ moved
        projector = inverse - whitened @ spread @ whitened.T
        off_median = (logs - self.log_medians) / self.spreads
        negative = (
            np.log(np.diag(lower)).sum()
            + 0.5 * determinant
            + 0.5 * float(self.off_m @ pulls)
            + 0.5 * float(off_median @ off_median)
        )
        slopes = self.of_components.reshape(len(logs), -1) @ (projector - np.outer(pulls, pulls)).ravel()
        return negative, np.exp(2 * logs) * slopes + off_median / self.spreads

    def mean_stddevs(self, logs: Array) -> Array:
        """(k,) roots of the mean variances, where these logarithms are the likeliest.

        What a survey does not show is as likely twice as large as half as large, and the larger does more.
        """
        _, inverse = self._factored(logs)
        whitened, spread, _ = self._unknowns(inverse)
        seen = (inverse - whitened @ spread @ whitened.T) @ self.of_components
        # Expected information of restricted likelihood (Patterson and Thompson), about logarithms of stddevs.
        information = 2 * np.einsum("kij,lji->kl", seen, seen, optimize=True) * np.exp(2 * np.add.outer(logs, logs))
        return np.asarray(np.exp(logs + np.diag(np.linalg.inv(information + np.diag(self.spreads**-2)))))

    def _factored(self, logs: Array) -> tuple[Array, Array]:
        """(c, c) lower factor and inverse of the covariance."""
        covariance = np.tensordot(np.exp(2 * logs), self.of_components, axes=1) + self.known
        covariance[np.diag_indices_from(covariance)] += ROUNDING * np.trace(covariance)
        lower = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        return lower, _inverse_of(lower)

    def _unknowns(self, inverse: Array) -> tuple[Array, Array, float]:
        """(c, p) whitened design, (p, p) covariance, and the logarithm of the determinant of its inverse."""
        whitened = inverse @ self.design
        information: Array = self.design.T @ whitened + self.prior_design.T @ self.prior_design
        lower = np.asarray(np.linalg.cholesky(information), dtype=np.float64)
        return whitened, _inverse_of(lower), 2 * float(np.log(np.diag(lower)).sum())


def _inverse_of(lower: Array) -> Array:
    """(n, n) of what (n, n) is the lower Cholesky factor of."""
    below = np.tril(lapack.dpotri(lower, lower=True)[0])
    return np.asarray(below + np.tril(below, -1).T)


def _independent(design: Array, prior_design: Array) -> tuple[Array, Array]:
    """The same functions of the unknowns, by as many unknowns as they depend on.

    Where several explain the same, as a map that turns and its anchors, normal equations would be singular but for
    rounding, and what they say noise.
    """
    stacked = np.vstack([design, prior_design])
    lengths = np.linalg.norm(stacked, axis=0)
    basis, strengths, _ = np.linalg.svd(stacked[:, lengths > 0] / lengths[lengths > 0], full_matrices=False)
    independent = basis[:, strengths > _DEPENDENT * strengths.max(initial=0.0)]
    return independent[: len(design)], independent[len(design) :]
