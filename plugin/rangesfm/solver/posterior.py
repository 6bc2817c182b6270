"""The posterior of a map by measurements of all kinds together (sections 6 and 7 of ``model.md``).

All are linear equations of the motions of the map as a whole, and of anchors: e = A x + noise. The noise of a kind is
its own; the bending of the map is that of all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag, cho_solve
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Mask
from rangesfm.solver.bending import BENDS, Bending, MapBending
from rangesfm.solver.linear_map import Columns, LinearMap, Solved
from rangesfm.solver.noise import Component, Noise, learnt_sizes, noise_of_sizes, usual_sizes
from rangesfm.util.geometry.numerics import NORMAL_95, SIGNIFICANT_STDDEVS

if TYPE_CHECKING:
    from typing_extensions import Self

GIVEN = "given"
"""Effect of priors; not a component of the noise."""


@dataclass(frozen=True, kw_only=True)
class Observations(LinearMap):
    """c observations of one kind, single ones or means of groups, linearised at a state of a map.

    Attributes:
        kind: its name.
        by_pose: (c, 6 n) derivatives by the poses of the path: turns in their own frames, and shifts in its world.
        components: of their errors, without the bending of the map.
        alone_m2: (c, c) covariance as if each single one erred independently.
        is_used: (c,) whether they take part in the estimate; the others are only tested or predicted.
        averages: (c, m) weights of single numbers that were measured, with a sum of 1 in each, where it matters which.
    """

    kind: str
    by_pose: Array
    components: tuple[Component, ...]
    alone_m2: Array
    is_used: Mask
    averages: csr_array = field(default_factory=lambda: csr_array((0, 0)))


@dataclass(frozen=True)
class ScaleByKind:
    """The scale by one kind of measurement alone, in metres per SfM unit.

    Attributes:
        value: middle of its interval. stddev: with all error components; inf where the scale is not determined.
    """

    value: float
    stddev: float


@dataclass(frozen=True)
class ScaleUncertainty:
    """Relative standard deviations of the scale, by their causes.

    Attributes:
        formal: from the Jacobian, as if all measurements erred independently (Cramer-Rao bound).
        components: standard deviation due to each component of the errors, by its name.
    """

    formal: float
    components: dict[str, float]

    @property
    def empirical(self) -> float:
        """Realistic standard deviation: all components together, and never less than the formal one."""
        return max(float(np.linalg.norm(list(self.components.values()))), self.formal)

    def beside(self, name: str, stddev: float) -> ScaleUncertainty:
        """Return a copy with more of one component, added in quadrature."""
        return replace(
            self, components={**self.components, name: float(np.hypot(self.components.get(name, 0), stddev))}
        )

    def about(self, value: float) -> ScaleByKind:
        """Return an estimate with its standard deviation."""
        return ScaleByKind(value, value * self.empirical)

    @property
    def interval_95(self) -> tuple[float, float]:
        """Bounds, with 95 % probability, of the logarithm of the true scale divided by the estimate."""
        return -self.half_width_95, self.half_width_95

    @property
    def half_width_95(self) -> float:
        """Half the width of the 95 % interval, in the logarithm of the scale."""
        return NORMAL_95 * self.empirical


@dataclass(frozen=True)
class Posterior:
    """What is known of a map as a whole and of its anchors.

    Attributes:
        uncertainty: of the scale.
        columns: the p unknowns. covariance: (p, p) of these.
        step: (p,) from the state at which the map is to the estimate, to which everything else refers.
        gains: (c,) change of the scale's logarithm per metre of each observation that is used.
        pulls: (c,) inverse covariance times what the estimate leaves of each, measured minus predicted.
    """

    uncertainty: ScaleUncertainty
    columns: Columns
    covariance: Array
    step: Array
    gains: Array
    pulls: Array

    @property
    def placement(self) -> Array | None:
        """(7, 7) covariance of the scale's logarithm, a turn and a shift; None if the map's place is not estimated."""
        return self.columns.placement(self.covariance)

    @property
    def place(self) -> Array:
        """(7, 7) the same covariance, of a map that is placed."""
        assert self.placement is not None, "the map is placed"
        return self.placement


@dataclass(frozen=True, kw_only=True)
class JointProblem(LinearMap):
    """The linear equations of all kinds of observations, one below the other, and of the priors.

    Residuals are those of the map as the photos alone would have it.

    Attributes:
        rows: of each kind, by its name.
        components: of the errors. sizes: of these, by name.
        bending: of the map, in all observations.
        alone_m2, is_used: as of ``Observations``.
    """

    rows: Mapping[str, slice]
    components: tuple[Component, ...]
    sizes: Mapping[str, float]
    bending: Bending
    alone_m2: Array
    is_used: Mask

    @cached_property
    def noise(self) -> Noise:
        """Errors of all observations."""
        return noise_of_sizes(self.components, self.sizes, len(self.is_used))

    @cached_property
    def solution(self) -> Solved:
        """The estimate by the observations that are used, with the best weights for these errors (Gauss and Markov)."""
        linear, noise = self.among(self.is_used)
        return linear.solved(noise.covariance_m2)

    @property
    def deviance(self) -> float:
        """-2 times the log-likelihood of observations and sizes, up to a constant.

        It compares two explanations of the same observations, each with the errors that it leaves.
        """
        learnt = (each for each in self.components if each.spread > 0)
        of_sizes = (np.log(self.sizes[each.name] / each.median) / each.spread for each in learnt)
        log_determinant = 2 * float(np.sum(np.log(np.diag(self.solution.lower))))
        return self.solution.misfit + log_determinant + float(sum(off**2 for off in of_sizes))

    def without(self, kind: str, name: str) -> JointProblem:
        """Return the problem without one component of the errors of a kind."""
        rows = self.rows[kind]
        kept = (each for each in self.components if each.name != name or not each.alike[rows].any())
        return replace(self, components=tuple(kept))

    def of_kind(self, kind: str, of_used: Array) -> Array:
        """Return the (c,) numbers of one kind from those of all observations that are used; 0 for the others."""
        of_all = np.zeros(len(self.is_used))
        of_all[self.is_used] = of_used
        return of_all[self.rows[kind]]

    def noise_of(self, kind: str) -> Noise:
        """Return the errors of the observations of one kind, with those of the map, as large as they are in these."""
        found = self.noise.of_rows(self.rows[kind])
        found = replace(found, sizes=np.where([name in BENDS for name in found.names], np.nan, found.sizes))
        return found.only(*(name for name, of in zip(found.names, found.covariances_m2, strict=True) if of.any()))

    @property
    def bending_factor(self) -> float:
        """Return the learnt bending over the bending expected from the photos' residuals; 1 if that is unknown."""
        expected_m = float(np.sqrt(np.trace(self.bending.formal_m2) / len(self.is_used)))
        return self.noise.stddev_of_component["bending"] / expected_m if expected_m > 0 else 1.0

    def learnt(
        self,
        *mistakes: Array,
        most_unusual: float = np.inf,
        most_bent: float = np.inf,
        near: Mapping[str, float] = MappingProxyType({}),
    ) -> Self:
        """Return the problem with the sizes of the errors that the observations show, if they are not given.

        Args:
            mistakes: (c, m) effects of each on the observations, or (c + r, m) also on the priors. They explain what
                they can, as the errors that they cause would otherwise be taken for noise, in which they then hide.
            most_unusual, most_bent: largest size of a component above its median, in spreads over surveys, of what
                errs in measurements, and in the map.
            near: sizes in nearly the same problem to start from, by name, which takes half the time.
        """
        if self.bending.given_sizes is not None:
            return self
        used, widened = self.is_used, self.with_more(mistakes)
        # Kinds that contradict each other by more than maps bend are mistaken, which must not pass for bending.
        num_kinds = sum(used[rows].any() for rows in self.rows.values())
        most_bent = min(most_bent, SIGNIFICANT_STDDEVS) if num_kinds > 1 else most_bent
        components = self.components
        if not used.all():
            at = np.ix_(used, used)
            components = tuple(
                replace(each, alike=each.alike[at], tied={name: of[at] for name, of in each.tied.items()})
                for each in components
            )
        sizes = learnt_sizes(
            components,
            -self.residual_m[used],
            widened.design[used],
            widened.prior_design,
            {name: most_bent if name in BENDS else most_unusual for name in self.sizes},
            near,
        )
        return replace(self, sizes=sizes)

    def among(self, rows: Mask) -> tuple[LinearMap, Noise]:
        """Return the equations and the errors of some of the observations."""
        priors = self.prior_residual, self.prior_design
        return LinearMap(self.columns, self.design[rows], self.residual_m[rows], *priors), self.noise.of_rows(rows)

    def posterior(self, *, formal: float | None = None, is_refined: bool = False) -> Posterior:
        """Return what the observations that are used say of the map.

        Args:
            formal: relative standard deviation of the scale as if all of them erred independently; None: that of the
                estimate with weights for such errors. is_refined: whether the photos let the map bend in its fit.
        """
        best, (linear, noise) = self.solution, self.among(self.is_used)
        if formal is None:
            alone_m2 = self.alone_m2 + self.bending.formal_m2 if is_refined else self.alone_m2
            alone = linear.solved(alone_m2[np.ix_(self.is_used, self.is_used)])
            formal = float(np.sqrt(alone.covariance[0, 0]))
        of_observations, of_priors = best.gains
        components = noise.effects(of_observations[0])
        if (given := float(np.linalg.norm(of_priors[0]))) > 0:
            components[GIVEN] = given
        uncertainty = ScaleUncertainty(formal, components)
        return Posterior(uncertainty, self.columns, best.covariance, best.step, of_observations[0], best.pulls)

    def predicted_m2(self, kind: str, covariance: Array) -> Array:
        """Return the (c, c) covariance of the errors of unused functions of the map, after all that is observed.

        Universal kriging: Rasmussen and Williams, "Gaussian processes for machine learning", 2006, eq. 2.42.

        Args:
            covariance: (p, p) of the unknowns.
        """
        used, rows, noise_m2 = self.is_used, self.rows[kind], self.noise.covariance_m2
        across = noise_m2[rows][:, used]
        factor = self.solution.lower, True
        left = self.design[rows] - across @ cho_solve(factor, self.design[used])
        return np.asarray(noise_m2[rows, rows] - across @ cho_solve(factor, across.T) + left @ covariance @ left.T)


def joined(observations: Sequence[Observations], bending: MapBending) -> JointProblem:
    """Join observations of all kinds on one map, with the given or usual sizes of their errors.

    Args:
        bending: of the map.
    """
    columns = max((each.columns for each in observations), key=lambda each: each.num)
    ends = np.cumsum([len(each.residual_m) for each in observations])
    num = int(ends[-1])
    rows = {
        each.kind: slice(int(end) - len(each.residual_m), int(end))
        for each, end in zip(observations, ends, strict=True)
    }
    bent = bending.of_functions(np.vstack([each.by_pose for each in observations]), frame_is_free=columns.frame >= 0)
    own = (part.among(rows[each.kind], num) for each in observations for part in each.components)
    components = (*own, *bent.parts)
    return JointProblem(
        columns,
        np.vstack([_in_columns(each.design, each.columns, columns) for each in observations]),
        np.concatenate([each.residual_m for each in observations]) + bent.shift_m,
        np.concatenate([each.prior_residual for each in observations]),
        np.vstack([_in_columns(each.prior_design, each.columns, columns) for each in observations]),
        rows=rows,
        components=components,
        sizes=usual_sizes(components, bent.given_sizes or {}),
        bending=bent,
        alone_m2=np.asarray(block_diag(*(each.alone_m2 for each in observations))),
        is_used=np.concatenate([each.is_used for each in observations]),
    )


def _in_columns(design: Array, own: Columns, columns: Columns) -> Array:
    """Return derivatives by all unknowns; kinds without anchors have those by the map as a whole."""
    widened = np.zeros((len(design), columns.num))
    if not len(design) or own.num == columns.num:
        return design if len(design) else widened
    of_map = columns.of_map[: len(own.of_map)]
    widened[:, of_map] = design[:, : len(of_map)]
    return widened
