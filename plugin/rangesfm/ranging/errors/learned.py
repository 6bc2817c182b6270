"""Learning of the size of each error component in a survey, from its residuals and the population of radios."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.numerics import ROUNDING, UNDETERMINED
from rangesfm.ranging.errors.bending import BendingOfBins
from rangesfm.ranging.errors.components import BENDS, COMPONENTS, LEARNT_CURVE, Component, OtherError
from rangesfm.ranging.errors.noise import START_STDDEV_M
from rangesfm.ranging.errors.range_bins import RangeBins

# With more noise than usual all other components may be larger too, to this power: an old radio with five times the
# noise reads 7 % too long, while the others are right to a percent.
_WIDENING_POWER = 1.5
# Bounds of the logarithms of standard deviations, relative to the median. Farther below, the likelihood is flat. Above,
# a path without loops may drift by some hundred times the median.
_FARTHEST_BELOW, _FARTHEST_ABOVE = 5.0, 8.0

_Parts = TypeVar("_Parts", bound="ErrorParts")


@dataclass(frozen=True)
class ErrorParts:
    """Errors of c observations, by component.

    Attributes:
        names, stddevs: of the components, in metres (``slope``: share of the distance). For covariances that were not
            learnt, the root mean square over observations.
        covariances_m2: (k, c, c) contribution of each.
    """

    names: tuple[str, ...]
    stddevs: Array
    covariances_m2: Array

    @property
    def covariance_m2(self) -> Array:
        """(c, c) covariance of all components together, square metres."""
        return np.asarray(self.covariances_m2.sum(axis=0))

    @property
    def stddev_of_component(self) -> dict[str, float]:
        """Standard deviation of each component, by name."""
        return dict(zip(self.names, self.stddevs.tolist(), strict=True))

    def without(self: _Parts, *names: str) -> _Parts:
        """Return the errors without some components."""
        return self.only(*(each for each in self.names if each not in names))

    def only(self: _Parts, *names: str) -> _Parts:
        """Return the errors of some components."""
        kept = [row for row, each in enumerate(self.names) if each in names]
        return replace(
            self,
            names=tuple(self.names[row] for row in kept),
            stddevs=self.stddevs[kept],
            covariances_m2=self.covariances_m2[kept],
        )

    def stddev_of_bins(self, of_bins: Array) -> dict[str, float]:
        """Return the effect of each component on a number that changes by (c,) ``of_bins`` per metre of each."""
        variances = np.einsum("i,kij,j->k", of_bins, self.covariances_m2, of_bins)
        return dict(zip(self.names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))


@dataclass(frozen=True)
class LearnedErrors(ErrorParts):
    """Errors of c bins of ranges.

    Attributes:
        bins: of the ranges.
        of_range: (n,) bin of each range; -1 for a range that did not take part.
        unlikeliness: -2 times the logarithm of the prior probability of these standard deviations.
    """

    bins: RangeBins
    of_range: Indices
    unlikeliness: float = 0.0

    def subset(self, rows: Indices) -> LearnedErrors:
        """Return the errors of some of the ranges."""
        return replace(self, of_range=self.of_range[rows])

    def spread(self, rows: Indices, num: int) -> LearnedErrors:
        """Return the errors as ``rows`` of ``num`` ranges; the others do not take part."""
        of_range = np.full(num, -1, dtype=np.int64)
        of_range[rows] = self.of_range
        return replace(self, of_range=of_range)


def learn_errors(
    bins: RangeBins,
    off_m: Array,
    design: Array,
    prior_design: Array,
    noise_m: float,
    curve_stddev_m: Array | None = None,
    ruled_out: Collection[str] = (),
    others_m2: Mapping[OtherError, Array] | None = None,
    bending: BendingOfBins | None = None,
) -> LearnedErrors:
    """Estimate the components by restricted maximum likelihood with lognormal priors on the standard deviations.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", 1971.

    Args:
        off_m: (n,) measured minus predicted range, without any bias.
        design: (n, p) derivatives of the predicted ranges by the unknowns of the map.
        prior_design: (r, p) derivatives of the priors by these, in standard deviations.
        noise_m: standard deviation of single ranges.
        curve_stddev_m: (n,) of a learnt error curve that was subtracted; None if none was.
        ruled_out: names of components that the user knows to be absent.
        others_m2: (c, c) covariances of further errors, by name, which are not learnt.
        bending: of the map; None: the map is not bent.
    """
    expected = ExpectedErrors.of(bins, curve_stddev_m, ruled_out, others_m2, bending)
    return expected.learnt(bins.mean(off_m), bins.mean(design), prior_design, noise_m)


def usual_stddevs(*, is_calibrated: bool) -> dict[str, float]:
    """Return the usual standard deviation of all components by name: the root mean variance over radios (lognormal)."""
    return _usual(COMPONENTS, is_calibrated=is_calibrated)


def _usual(components: Iterable[Component], *, is_calibrated: bool) -> dict[str, float]:
    return {c.name: float(_median(c, is_calibrated) * np.exp(c.spread**2)) for c in components}


@dataclass(frozen=True)
class ExpectedErrors:
    """Errors to expect in c bins before anything is measured, with k components to be learnt.

    Attributes:
        components: to be learnt. of_components: (k, c, c) covariances for a standard deviation of 1 of each.
        known: (c, c) covariances that are not learnt, by name.
        shift_m: (c,) change of the predicted ranges if the map moves to the minimum of the photos alone.
        is_calibrated: whether a learnt error curve was subtracted.
    """

    bins: RangeBins
    components: tuple[Component, ...]
    of_components: Array
    known: Mapping[OtherError, Array]
    shift_m: Array
    is_calibrated: bool

    @classmethod
    def of(
        cls,
        bins: RangeBins,
        curve_stddev_m: Array | None = None,
        ruled_out: Collection[str] = (),
        others_m2: Mapping[OtherError, Array] | None = None,
        bending: BendingOfBins | None = None,
    ) -> ExpectedErrors:
        """Set up the expected errors; arguments as for ``learn_errors``."""
        # With one tag, its own bias is the common bias.
        left_out = {*ruled_out, *(() if np.ptp(bins.tag_index) else ("tag_bias",))}
        components = tuple(component for component in COMPONENTS if component.name not in left_out)
        components += () if bending is None else bending.components
        of_anchor = np.outer(bins.noisiness, bins.noisiness)
        of_components = [c.correlation(bins) * (of_anchor if c.is_of_anchor else 1.0) for c in components]
        known = dict(others_m2 or {})
        if curve_stddev_m is not None:
            stddev = bins.mean(curve_stddev_m)
            smooth = next(component for component in COMPONENTS if component.name == "curve")
            known[LEARNT_CURVE] = np.outer(stddev, stddev) * smooth.correlation(bins)
        shift_m = np.zeros(len(bins)) if bending is None else bending.shift_m
        return cls(bins, components, np.array(of_components), known, shift_m, curve_stddev_m is not None)

    def usual(self, stddevs: Mapping[str, float]) -> LearnedErrors:
        """Return the errors with usual standard deviations, or with given ones by name."""
        usual = _usual(self.components, is_calibrated=self.is_calibrated) | dict(stddevs)
        sizes = np.array([usual[component.name] for component in self.components])
        return self._of(sizes, sizes[:, None, None] ** 2 * self.of_components)

    def learnt(
        self,
        off_m: Array,
        design: Array,
        prior_design: Array,
        noise_m: float,
        most_unusual: float = np.inf,
        near: Mapping[str, float] | None = None,
    ) -> LearnedErrors:
        """Learn the errors as in ``learn_errors``, from (c,) and (c, p) bins of the map as it is.

        Args:
            most_unusual: largest standard deviation of a radio's error above its median, in spreads over radios. A map
                may bend by any amount.
            near: standard deviations to start from, by name; the others start from their medians.
        """
        # Bending does not depend on the radio, and the noise is measured itself.
        widening = max(1.0, noise_m / START_STDDEV_M) ** _WIDENING_POWER
        widened = [1.0 if c.name in (*BENDS, "white") else widening**2 for c in self.components]
        medians = {component.name: _median(component, self.is_calibrated) for component in self.components}
        likelihood = ComponentLikelihood(
            np.array(widened)[:, None, None] * self.of_components if widening > 1 else self.of_components,
            np.log(list(medians.values())),
            np.array([component.spread for component in self.components]),
            np.sum([*self.known.values(), np.zeros((len(self.bins), len(self.bins)))], axis=0),
            off_m - self.shift_m,
            design,
            prior_design,
        )
        above = np.array([np.inf if c.name in BENDS else most_unusual for c in self.components])
        start = np.log([(near or {}).get(name, median) for name, median in medians.items()])
        stddevs = likelihood.mean_stddevs(likelihood.most_likely(above, start))
        off_expected = [
            np.log(stddev / medians[component.name]) / component.spread
            for component, stddev in zip(self.components, stddevs, strict=True)
        ]
        found = self._of(stddevs, stddevs[:, None, None] ** 2 * likelihood.of_components)
        return replace(found, unlikeliness=float(np.sum(np.square(off_expected))))

    def _of(self, stddevs: Array, covariances: Array) -> LearnedErrors:
        """Return the errors with the covariances that are not learnt added."""
        names = (*(component.name for component in self.components), *self.known)
        return LearnedErrors(
            names,
            np.append(stddevs, [np.sqrt(np.trace(m) / len(m)) for m in self.known.values()]),
            np.concatenate([covariances, *(m[None] for m in self.known.values())]),
            self.bins,
            self.bins.of_range,
        )


def _median(component: Component, is_calibrated: bool) -> float:
    if is_calibrated and component.calibrated_median is not None:
        return component.calibrated_median
    return component.median


@dataclass(frozen=True)
class ComponentLikelihood:
    """Posterior likelihood of the logarithms of the standard deviations of k components, given c observations.

    Attributes:
        of_components: (k, c, c) covariances for a standard deviation of 1.
        log_medians, spreads: (k,) lognormal priors.
        known: (c, c) covariance that is not learnt.
        off_m: (c,) measured minus predicted.
        design, prior_design: (c, p), (r, p) derivatives of observations and priors by the unknowns. Several may have
            the same effect.
    """

    of_components: Array
    log_medians: Array
    spreads: Array
    known: Array
    off_m: Array
    design: Array
    prior_design: Array

    def most_likely(self, most_unusual: Array | float = np.inf, start: Array | None = None) -> Array:
        """Return the (k,) most likely logarithms near a start, each at most ``most_unusual`` spreads above its median.

        Args:
            start: (k,); None: the medians.
        """
        above = np.minimum(most_unusual * self.spreads, _FARTHEST_ABOVE)
        bounds = np.column_stack([self.log_medians - _FARTHEST_BELOW, self.log_medians + above])
        start = self.log_medians if start is None else start
        found = minimize(self._negative_with_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds)
        return np.asarray(found.x)

    def _negative_with_gradient(self, logs: Array) -> tuple[float, Array]:
        log_determinant, inverse = self._factored(logs)
        whitened, spread, determinant = self._unknowns(inverse)
        moved = spread @ (whitened.T @ self.off_m)
        pulls = inverse @ self.off_m - whitened @ moved
        off_median = (logs - self.log_medians) / self.spreads
        negative = 0.5 * (log_determinant + determinant + float(self.off_m @ pulls) + float(off_median @ off_median))
        inverse -= (whitened @ spread) @ whitened.T
        inverse -= np.outer(pulls, pulls)
        half = self._half
        slopes = half.components @ (half.counts * inverse.take(half.places))
        return negative, np.exp(2 * logs) * slopes + off_median / self.spreads

    def mean_stddevs(self, logs: Array) -> Array:
        """Return (k,) roots of the mean variances, given the most likely logarithms.

        Where a survey does not determine a standard deviation, twice as much is as likely as half, and has more effect.
        """
        _, inverse = self._factored(logs)
        whitened, spread, _ = self._unknowns(inverse)
        seen = (inverse - whitened @ spread @ whitened.T) @ self.of_components
        # Expected information of restricted likelihood (Patterson and Thompson), about logarithms of stddevs.
        information = 2 * np.einsum("kij,lji->kl", seen, seen, optimize=True) * np.exp(2 * np.add.outer(logs, logs))
        return np.asarray(np.exp(logs + np.diag(np.linalg.inv(information + np.diag(self.spreads**-2)))))

    @cached_property
    def _half(self) -> _Half:
        return _Half.of(self.of_components, self.known)

    def _factored(self, logs: Array) -> tuple[float, Array]:
        """Return the log-determinant and the inverse (c, c) of the covariance."""
        half, num = self._half, len(self.off_m)
        covariance = np.zeros(num * num)
        covariance[half.places] = np.exp(2 * logs) @ half.components + half.known
        return _determinant_and_inverse(covariance.reshape(num, num))

    @cached_property
    def _independent(self) -> tuple[Array, Array]:
        return independent_unknowns(self.design, self.prior_design)

    def _unknowns(self, inverse: Array) -> tuple[Array, Array, float]:
        """Return whitened design, covariance and log-determinant of the information, of p independent unknowns.

        They are (c, p), (p, p) and a number.
        """
        design, prior_design = self._independent
        whitened = inverse @ design
        information: Array = design.T @ whitened + prior_design.T @ prior_design
        determinant, covariance = _determinant_and_inverse(information)
        return whitened, covariance, determinant


@dataclass(frozen=True)
class _Half:
    """The upper triangles of symmetric (c, c) matrices, as the sums over these take most of the time.

    Attributes:
        places: (h,) of the elements in a matrix. counts: (h,) how often each is in it.
        components, known: (k, h) and (h,) elements, with what rounding needs added.
    """

    places: Indices
    counts: Array
    components: Array
    known: Array

    @classmethod
    def of(cls, components: Array, known: Array) -> _Half:
        num = len(known)
        places = np.flatnonzero(np.triu(np.ones((num, num))))
        # Rounding may leave a covariance singular, without this share of its trace on the diagonal.
        on_diagonal = places % (num + 1) == 0
        stacked = np.concatenate([components, known[None]])
        of_all = np.take(stacked.reshape(len(stacked), -1), places, axis=1)
        of_all[:, on_diagonal] += ROUNDING * np.trace(stacked, axis1=1, axis2=2)[:, None]
        return cls(places, np.where(on_diagonal, 1.0, 2.0), of_all[:-1], of_all[-1])


def _determinant_and_inverse(upper: Array) -> tuple[float, Array]:
    """Return the log-determinant and the inverse of a symmetric (n, n) matrix, given its upper triangle; it is lost."""
    # LAPACK has the columns one after the other: the upper triangle is the lower one there.
    lower, failed = lapack.dpotrf(upper.T, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    log_determinant = 2 * float(np.log(np.diag(lower)).sum())
    half = lapack.dpotri(lower, lower=True, overwrite_c=True)[0]
    inverse = half + half.T
    inverse[np.diag_indices_from(inverse)] *= 0.5
    return log_determinant, inverse


def independent_unknowns(design: Array, prior_design: Array) -> tuple[Array, Array]:
    """Return the designs in a basis of independent unknowns.

    If several unknowns have the same effect, such as a turn of the map and of all its anchors, the normal equations are
    singular up to rounding.
    """
    stacked = np.vstack([design, prior_design])
    lengths = np.linalg.norm(stacked, axis=0)
    basis, strengths, _ = np.linalg.svd(stacked[:, lengths > 0] / lengths[lengths > 0], full_matrices=False)
    independent = basis[:, strengths > UNDETERMINED * strengths.max(initial=0.0)]
    return independent[: len(design)], independent[len(design) :]
