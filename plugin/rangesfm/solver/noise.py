"""Noise of observations: components of a known shape, whose sizes a survey shows (section 4 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.util.geometry.numerics import ROUNDING, UNDETERMINED

# Bounds of the logarithms of standard deviations, relative to the median. Farther below, the likelihood is flat. Above,
# a path without loops may drift by some hundred times the median.
_FARTHEST_BELOW, _FARTHEST_ABOVE = 5.0, 8.0

_Noise = TypeVar("_Noise", bound="Noise")


MAX_NUM_OBSERVATIONS = 450
"""Largest number of observations of a map: learning their errors takes some twenty inversions of their covariance."""


@dataclass(frozen=True)
class Component:
    """One component of the errors of c observations, before its size is learnt.

    Attributes:
        name: of its standard deviation.
        alike: (c, c) covariance for a size of 1.
        median: of the size over surveys. spread: standard deviation of the logarithm of the size over surveys; 0: the
            size is known.
        tied: (c, c) covariances of further errors for a size of 1, by name; their size is tied to this one's.
    """

    name: str
    alike: Array
    median: float = 1.0
    spread: float = 0.0
    tied: Mapping[str, Array] = field(default_factory=dict)

    @property
    def usual(self) -> float:
        """Root mean square of the size over surveys (lognormal)."""
        return float(self.median * np.exp(self.spread**2))

    @property
    def whole(self) -> Array:
        """(c, c) covariance for a size of 1, with the further errors."""
        return np.asarray(np.sum([self.alike, *self.tied.values()], axis=0))

    def among(self, rows: slice, num: int) -> Component:
        """Return the component as one of ``num`` observations, of which the others, not in ``rows``, have no part."""

        def placed(covariance: Array) -> Array:
            of_all = np.zeros((num, num))
            of_all[rows, rows] = covariance
            return of_all

        return replace(self, alike=placed(self.alike), tied={name: placed(of) for name, of in self.tied.items()})


@dataclass(frozen=True)
class Noise:
    """Errors of c observations, by component, with their sizes.

    Attributes:
        names, sizes: of the components, as learnt; NaN where they were not.
        covariances_m2: (k, c, c) contribution of each.
    """

    names: tuple[str, ...]
    sizes: Array
    covariances_m2: Array

    @cached_property
    def covariance_m2(self) -> Array:
        """(c, c) covariance of all components together, square metres."""
        return np.asarray(self.covariances_m2.sum(axis=0))

    @property
    def stddevs(self) -> Array:
        """(k,) sizes as learnt; the root mean square over the observations, in metres, of those that were not."""
        variances = np.trace(self.covariances_m2, axis1=1, axis2=2) / max(self.covariances_m2.shape[1], 1)
        return np.where(np.isnan(self.sizes), np.sqrt(np.maximum(variances, 0.0)), self.sizes)

    @property
    def stddev_of_component(self) -> dict[str, float]:
        """Standard deviation of each component, by name."""
        return dict(zip(self.names, self.stddevs.tolist(), strict=True))

    def without(self: _Noise, *names: str) -> _Noise:
        """Return the errors without some components."""
        return self.only(*(each for each in self.names if each not in names))

    def only(self: _Noise, *names: str) -> _Noise:
        """Return the errors of some components."""
        kept = [row for row, each in enumerate(self.names) if each in names]
        return replace(
            self,
            names=tuple(self.names[row] for row in kept),
            sizes=self.sizes[kept],
            covariances_m2=self.covariances_m2[kept],
        )

    def of_rows(self: _Noise, rows: Mask | slice) -> _Noise:
        """Return the errors of some of the observations."""
        return replace(self, covariances_m2=self.covariances_m2[:, rows][:, :, rows])

    def effects(self, gains: Array) -> dict[str, float]:
        """Return the effect of each component on a number that changes by (c,) ``gains`` per metre of each."""
        variances = np.einsum("i,kij,j->k", gains, self.covariances_m2, gains)
        return dict(zip(self.names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))


def noise_of_sizes(components: Sequence[Component], sizes: Mapping[str, float], num: int) -> Noise:
    """Return the errors of ``num`` observations with components of these sizes; those of one name are one."""
    covariances: dict[str, Array] = {}
    stddevs: dict[str, float] = {}
    for component in sorted(components, key=lambda each: each.spread == 0):  # those that are learnt come first
        variance = sizes[component.name] ** 2
        for name, alike in {component.name: component.alike, **component.tied}.items():
            covariances[name] = covariances[name] + variance * alike if name in covariances else variance * alike
        stddevs[component.name] = sizes[component.name] if component.spread > 0 else np.nan
    of_all = np.array([*covariances.values(), *np.zeros((0, num, num))]).reshape(-1, num, num)
    learnt = np.array([stddevs.get(name, np.nan) for name in covariances])
    return Noise(tuple(covariances), learnt, of_all)


def usual_sizes(components: Sequence[Component], given: Mapping[str, float] = MappingProxyType({})) -> dict[str, float]:
    """Return the size of each component before anything is measured, by name: as given where it is not known anyway."""
    return {each.name: given.get(each.name, each.usual) if each.spread > 0 else each.usual for each in components}


def learnt_sizes(
    components: Sequence[Component],
    off_m: Array,
    design: Array,
    prior_design: Array,
    most_unusual: Mapping[str, float] = MappingProxyType({}),
    near: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, float]:
    """Return the size of each component by restricted maximum likelihood with lognormal priors, by name.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", 1971.

    Args:
        off_m: (c,) measured minus predicted.
        design, prior_design: (c, p), (r, p) derivatives of what is predicted, and of the priors in standard deviations,
            by all that is estimated.
        most_unusual: by name, largest size above the median, in spreads; the others may have any size.
        near: sizes to start from, by name; the others start from their medians.
    """
    sizes = usual_sizes(components)
    learnt = [component for component in components if component.spread > 0]
    if not learnt:
        return sizes
    known = [component.usual**2 * component.whole for component in components if component.spread == 0]
    likelihood = ComponentLikelihood(
        np.array([component.whole for component in learnt]),
        np.log([component.median for component in learnt]),
        np.array([component.spread for component in learnt]),
        np.sum([*known, np.zeros((len(off_m), len(off_m)))], axis=0),
        off_m,
        design,
        prior_design,
    )
    above = np.array([most_unusual.get(component.name, np.inf) for component in learnt])
    start = np.log([near.get(component.name, component.median) for component in learnt])
    found = likelihood.mean_stddevs(likelihood.most_likely(start, above))
    return sizes | dict(zip((component.name for component in learnt), found.tolist(), strict=True))


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

    def most_likely(self, start: Array, most_unusual: Array | float = np.inf) -> Array:
        """Return the (k,) most likely logarithms near a start, at most ``most_unusual`` spreads above their medians."""
        above = np.minimum(most_unusual * self.spreads, _FARTHEST_ABOVE)
        bounds = np.column_stack([self.log_medians - _FARTHEST_BELOW, self.log_medians + above])
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
        places, counts = self._upper_triangle
        slopes = self._packed[:-1] @ (counts * inverse.take(places))
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
    def _upper_triangle(self) -> tuple[Indices, Array]:
        """(h,) places of its elements in a symmetric (c, c) matrix, and (h,) how often each is in it."""
        num = len(self.known)
        places = np.flatnonzero(np.triu(np.ones((num, num))))
        return places, np.where(places % (num + 1) == 0, 1.0, 2.0)

    @cached_property
    def _packed(self) -> Array:
        """(k + 1, h) upper triangles of all components and of what is known, as their sums take most of the time."""
        places, counts = self._upper_triangle
        stacked = np.concatenate([self.of_components, self.known[None]])
        packed = np.take(stacked.reshape(len(stacked), -1), places, axis=1)
        # Rounding may leave a covariance singular, without this share of its trace on the diagonal.
        packed[:, counts == 1.0] += ROUNDING * np.trace(stacked, axis1=1, axis2=2)[:, None]
        return packed

    def _factored(self, logs: Array) -> tuple[float, Array]:
        """Return the log-determinant and the inverse (c, c) of the covariance."""
        num, (places, _) = len(self.off_m), self._upper_triangle
        covariance = np.zeros(num * num)
        covariance[places] = np.exp(2 * logs) @ self._packed[:-1] + self._packed[-1]
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
