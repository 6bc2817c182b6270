"""Tests of hypotheses: how much better each explains the observations than chance would (Baarda; Teunissen).

Let e be the residuals, A the design and H the columns of a mistake, all whitened by the residuals' covariance and
projected off A. The statistic is T = e'H (H'H)^-1 H'e; without a mistake it is chi-square distributed with as many
degrees of freedom as H has columns. The size of the mistake is estimated as (H'H)^-1 H'e (Teunissen, Network Quality
Control, 2024). One Cholesky and one QR decomposition serve all tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import special
from scipy.linalg import solve_triangular

from rangesfm.arrays import Array
from rangesfm.diagnostics.hypothesis import Effect, Hypothesis
from rangesfm.diagnostics.linearized import Linearized

FALSE_ALARM_RATE = 0.02
# Baarda's significance level of a single test, and the probability that it misses a mistake of the smallest size.
_ALPHA, _BETA = 0.001, 0.2
_NUM_DRAWS = 1000
# Squared share of an effect below which what the unknowns leave of it is only rounding.
_NOTHING_LEFT = 1e-7


@dataclass(frozen=True)
class Test:
    """The result of the test of one hypothesis.

    Attributes:
        statistic: chi-square distributed with ``num`` degrees of freedom if there is no such mistake of any size.
        threshold: for all hypotheses together.
        sizes, stddevs: (k,) estimate of the mistake's numbers.
        smallest_detectable: minimal detectable bias in the worst direction; inf: it cannot be detected.
        redundancy: how much of the mistake the other observations check, 0 to 1: the share of its information in the
            ranges that the unknowns leave, in the worst direction (Baarda's redundancy number, for several numbers).
        effect_on_log_scale, effect_on_place_m: largest effect of an undetected mistake of that size.
        log_scale_by_unit: largest change of the scale's logarithm per unit of the mistake, also where none is found.
        basis: (c + r, num) orthonormal basis of the effect, whitened and projected.
    """

    hypothesis: Hypothesis
    statistic: float
    threshold: float
    num: int
    sizes: Array
    stddevs: Array
    smallest_detectable: float
    redundancy: float
    effect_on_log_scale: float
    effect_on_place_m: float
    log_scale_by_unit: float
    basis: Array

    @property
    def is_possible(self) -> bool:
        """True if a mistake of the estimated size is possible."""
        return self.hypothesis.can_be(self.sizes)

    @property
    def is_checked(self) -> bool:
        """True if some mistake of this kind that is possible would be found."""
        return self.smallest_detectable <= self.hypothesis.most

    @property
    def is_rejected(self) -> bool:
        """True if the estimated size is possible and chance alone does not explain the observations."""
        return self.is_possible and self.statistic > self.threshold


@dataclass(frozen=True)
class MistakeTest:
    """One hypothesis on one survey, as a row of the table.

    Attributes:
        name, subject: its kind, and what it is about: an anchor's id, or nothing.
        statistic, threshold: a larger statistic than the threshold means that the mistake, or one that looks like it,
            was made. The statistic is 0 if its estimated size is impossible.
        words: what is the case if it was made. remedy: what to do then.
        unit: of ``size``, ``stddev`` and ``smallest_detectable``; "1": a ratio.
        size, stddev: of the mistake, estimated; the length of a vector. None: not estimated, or impossible.
        smallest_detectable: a mistake of this size is found in four cases of five; None: it cannot be detected.
        redundancy: how much of the mistake the other observations check, 0 to 1; None: not known.
        is_checked: whether some mistake of this kind that is possible would be found; None: not known.
        effect_on_scale, effect_on_place_m: largest effect of a mistake of that size, relative and as root mean square
            along the path; None: unlimited.
    """

    name: str
    subject: str
    statistic: float
    threshold: float
    words: str
    remedy: str
    unit: str = ""
    size: float | None = None
    stddev: float | None = None
    smallest_detectable: float | None = None
    effect_on_scale: float | None = None
    effect_on_place_m: float | None = None
    redundancy: float | None = None
    is_checked: bool | None = None

    @property
    def rejected(self) -> bool:
        """True if chance alone does not explain the statistic."""
        return self.statistic > self.threshold


class Factorization:
    """The matrix decompositions that all tests share."""

    def __init__(self, problem: Linearized):
        self.problem = problem
        self._factor = np.linalg.cholesky(problem.errors.covariance_m2)
        self._basis, triangle = np.linalg.qr(self._whitened(problem.design, problem.prior_design))
        scale = np.maximum(np.abs(np.diag(triangle)), 1e-12)
        self._triangle = triangle + np.diag(np.where(np.abs(np.diag(triangle)) < 1e-9, 1e-9, 0.0) * scale)
        # Quadratic form of the path's mean square displacement in the unknowns.
        place = problem.place.reshape(-1, problem.columns.num)
        self._place = place.T @ place / len(problem.place)
        self.residual = self._off(self._whitened(problem.residual_m[:, None], problem.prior_residual[:, None]))[:, 0]

    def _whitened(self, bins: Array, priors: Array) -> Array:
        return np.vstack([solve_triangular(self._factor, bins, lower=True), priors])

    def _off(self, whitened: Array) -> Array:
        """Project off what the unknowns can explain."""
        left: Array = whitened - self._basis @ (self._basis.T @ whitened)
        return left

    def deviance(self, made: Test | None = None) -> float:
        """Return -2 times the log-likelihood of observations and errors, up to a constant; with a mistake if given.

        It compares two explanations of the same bins, each with the errors that it leaves.
        """
        squares = float(self.residual @ self.residual) - (made.statistic if made else 0.0)
        return squares + 2 * float(np.sum(np.log(np.diag(self._factor)))) + self.problem.errors.unlikeliness

    def step(self, made: tuple[Effect, Array] | None = None) -> Array:
        """Return the (p,) step from the state to the likeliest one, given a mistake of some size (k,)."""
        bins, priors = self.problem.residual_m, self.problem.prior_residual
        if made is not None:
            effect, sizes = made
            bins, priors = bins - effect.columns @ sizes, priors - effect.priors @ sizes
        return -self._solved(self._whitened(bins[:, None], priors[:, None]))[:, 0]

    def _solved(self, whitened: Array) -> Array:
        return np.asarray(solve_triangular(self._triangle, self._basis.T @ whitened))

    def test(self, hypotheses: Sequence[Hypothesis], seed: int) -> list[Test]:
        """Test all hypotheses, with thresholds that hold for all together."""
        tests = self.estimates(hypotheses)
        thresholds = _thresholds([t.basis for t in tests], np.array([t.num for t in tests]), seed)
        return [replace(t, threshold=threshold) for t, threshold in zip(tests, thresholds.tolist(), strict=True)]

    def estimates(self, hypotheses: Sequence[Hypothesis]) -> list[Test]:
        """Test all hypotheses without thresholds."""
        effects = Effect.of_all([h.effect for h in hypotheses])
        whitened = self._whitened(effects.columns, effects.priors)
        left = self._off(whitened)
        ends = np.cumsum([h.num for h in hypotheses])
        parts = [slice(end - h.num, end) for end, h in zip(ends, hypotheses, strict=True)]
        bases = [_basis_of(left[:, part], whitened[:, part]) for part in parts]
        by_unknowns = -self._solved(whitened)
        seen = self._seen(hypotheses, whitened, parts)
        return [
            self._test(h, left[:, part], basis, by_unknowns[:, part], of_ranges)
            for h, part, basis, of_ranges in zip(hypotheses, parts, bases, seen, strict=True)
        ]

    def _seen(self, hypotheses: Sequence[Hypothesis], whitened: Array, parts: Sequence[slice]) -> list[Array]:
        """Return the whitened effects on ranges with a known map, a matrix for each hypothesis."""
        num = len(self._factor)
        return [
            whitened[:num, part] if h.seen is None else solve_triangular(self._factor, h.seen, lower=True)
            for h, part in zip(hypotheses, parts, strict=True)
        ]

    def _test(self, hypothesis: Hypothesis, left: Array, basis: Array, by_unknowns: Array, seen: Array) -> Test:
        values, vectors = np.linalg.eigh(left.T @ left)
        is_seen = values > _NOTHING_LEFT * values[-1]
        # Root of the inverse, without the directions that cannot be seen.
        root = vectors[:, is_seen] / np.sqrt(values[is_seen])
        inverse = root @ root.T
        is_whole = basis.shape[1] == left.shape[1]
        worst, on_scale, on_place = np.inf, np.inf, np.inf
        if is_whole:
            needed = noncentrality(basis.shape[1])
            worst = float(np.sqrt(needed / values[is_seen][0]))
            # The mistake with the largest effect among those that are just detectable.
            of_unit = by_unknowns @ root
            on_scale = float(np.sqrt(needed) * np.linalg.norm(of_unit[0]))
            on_place = float(np.sqrt(needed * max(np.linalg.eigvalsh(of_unit.T @ self._place @ of_unit)[-1], 0.0)))
        return Test(
            hypothesis=hypothesis,
            statistic=float(np.sum((basis.T @ self.residual) ** 2)),
            threshold=np.inf,
            num=basis.shape[1],
            sizes=inverse @ (left.T @ self.residual),
            stddevs=np.sqrt(np.diag(inverse)) if is_whole else np.full(len(inverse), np.inf),
            smallest_detectable=worst,
            redundancy=_redundancy(left, seen) if is_whole else 0.0,
            log_scale_by_unit=float(np.linalg.norm(by_unknowns[0])),
            effect_on_log_scale=on_scale,
            effect_on_place_m=on_place,
            basis=basis,
        )


@cache
def noncentrality(num: int) -> float:
    """Return the noncentrality at which a mistake of ``num`` numbers is found (Baarda's lambda_0)."""
    return float(special.chndtrinc(special.chdtri(num, _ALPHA), num, _BETA))


def _redundancy(left: Array, seen: Array) -> float:
    """Return the smallest share, over all directions, of an effect's squared length that is left.

    Args:
        left, seen: (c + r, k) and (c, k) whitened effects, with all unknowns projected off, and with all of them known.
    """
    of_left, of_seen = left.T @ left, seen.T @ seen
    values, vectors = np.linalg.eigh(of_seen)
    if values[0] <= _NOTHING_LEFT * values[-1]:
        return 0.0
    root = vectors / np.sqrt(values)
    return float(np.clip(np.linalg.eigvalsh(root.T @ of_left @ root)[0], 0.0, 1.0))


def _basis_of(left: Array, whitened: Array) -> Array:
    """Return a (c + r, k') orthonormal basis of an effect after projection, without what is only rounding."""
    sizes = np.maximum(np.linalg.norm(whitened, axis=0), 1e-12)
    if left.shape[1] == 1:
        length = np.linalg.norm(left)
        return left / length if (length / sizes[0]) ** 2 > _NOTHING_LEFT else left[:, :0]
    vectors, values, _ = np.linalg.svd(left / sizes, full_matrices=False)
    return np.asarray(vectors[:, values**2 > _NOTHING_LEFT])


def _thresholds(bases: Sequence[Array], nums: Array, seed: int) -> Array:
    """Return thresholds (h,) with which all tests together keep their false alarm rate (Westfall and Young, 1993).

    It comes from random residuals without a mistake, and the smallest p-value of all tests for each.
    """
    draws = np.random.default_rng(seed).standard_normal((_NUM_DRAWS, len(bases[0])))
    projected = (draws @ np.hstack(bases)) ** 2
    ends = np.cumsum(nums)
    statistics = np.add.reduceat(np.hstack([projected, np.zeros((_NUM_DRAWS, 1))]), np.append(ends - nums, ends[-1]), 1)
    statistics = np.where(nums > 0, statistics[:, :-1], 0.0)
    smallest = np.ones(_NUM_DRAWS)
    for num in np.unique(nums[nums > 0]):
        smallest = np.minimum(smallest, special.chdtrc(num, statistics[:, nums == num].max(axis=1)))
    alpha = float(np.quantile(smallest, FALSE_ALARM_RATE))
    of_num = {num: special.chdtri(num, alpha) if num else np.inf for num in np.unique(nums).tolist()}
    return np.array([of_num[num] for num in nums.tolist()])


def overlap(first: Test, second: Test) -> float:
    """Return how much of the smaller hypothesis the other explains; 1: all of it, so that nothing tells them apart."""
    if not first.num or not second.num:
        return 0.0
    return float(np.linalg.norm(first.basis.T @ second.basis) / np.sqrt(min(first.num, second.num)))


def row_of(test: Test) -> MistakeTest:
    """Return the row of the table; an impossible estimate is shown without its size."""
    if not test.is_possible:
        row = row_of(replace(test, statistic=0.0, sizes=np.zeros_like(test.sizes)))
        name, unit = " ".join(test.hypothesis.key).strip(), test.hypothesis.unit.replace("1", "")
        most = f"{test.hypothesis.most:.2g} {unit}".rstrip()
        words = f"no {name} that can happen ({most} at most) explains the ranges"
        return replace(row, size=None, stddev=None, words=words)
    one = len(test.sizes) == 1
    return MistakeTest(
        name=test.hypothesis.name,
        subject=test.hypothesis.subject,
        statistic=test.statistic,
        threshold=test.threshold if np.isfinite(test.threshold) else 0.0,
        size=finite(float(test.sizes[0] if one else np.linalg.norm(test.sizes))),
        stddev=finite(float(test.stddevs[0] if one else np.linalg.norm(test.stddevs))),
        unit=test.hypothesis.unit,
        smallest_detectable=finite(test.smallest_detectable),
        effect_on_scale=finite(test.effect_on_log_scale),
        effect_on_place_m=finite(test.effect_on_place_m),
        redundancy=test.redundancy,
        is_checked=test.is_checked,
        words=test.hypothesis.words(test.sizes),
        remedy=test.hypothesis.remedy,
    )


def finite(value: float) -> float | None:
    """Return the value, or None if it is infinite."""
    return float(value) if np.isfinite(value) else None
