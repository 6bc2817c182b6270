"""Mistakes that may have been made in what is measured, and their tests, for all kinds (section 8 of ``model.md``).

A kind yields its possible mistakes, each as columns with words; one function tests them all. Let e be the residuals
of observations and priors, A their derivatives by the unknowns and H those by the numbers of a mistake, all whitened by
the residuals' covariance, and e and H projected off A. The size of the mistake is estimated as (H'H)^-1 H'e (Teunissen,
Network Quality Control, 2024). The statistic is T = e'H (H'H)^-1 H'e; without a mistake it is chi-square distributed
with as many degrees of freedom as H has columns (Baarda).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices
from rangesfm.solver.posterior import JointProblem
from rangesfm.util.geometry.numerics import UNDETERMINED

FALSE_ALARM_RATE = 0.02
"""Share of surveys without any mistake in which one is named, or a correct length or point is set aside."""
# Baarda's significance level of a single test, and the probability that it misses a mistake of the smallest size.
_ALPHA, _BETA = 0.001, 0.2


@dataclass(frozen=True)
class Correction:
    """Changes of the input that undo a mistake.

    Attributes:
        anchors_m: corrected positions, (3,) by id; None: the anchor counts as unknown, and is where its ranges meet.
        tag_moves_m: (3,) additions to lever arms in the camera's frame, by tag id.
        time_shift_s: addition to the times of the ranges, one for all or (n,).
        left_out: which of the ranges are not used.
        longer_m: amount by which the ranges are too long, one for all or (n,).
        rows: (n,) rows of the log of the ranges that the others refer to.
    """

    anchors_m: Mapping[str, Array | None] = field(default_factory=dict)
    tag_moves_m: Mapping[str, Array] = field(default_factory=dict)
    time_shift_s: float | Array = 0.0
    left_out: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    longer_m: float | Array = 0.0
    rows: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


@dataclass(frozen=True)
class Mistake:
    """A possible mistake that k numbers describe; none, if it has no size and is tried as a whole.

    Attributes:
        name: of its kind.
        columns: (c, k) derivatives by these of the residuals of the observations, per unit; or (c + r, k), with those
            of the residuals of the priors below them, in standard deviations per unit.
        words: returns for an estimate (k,) what is probably the case.
        remedy: what to measure or to change.
        correction: returns for an estimate the changes that undo the mistake.
        most: largest possible size, as the length of the vector of numbers. A larger estimate is not this mistake.
        subject: which one of the kind, such as an anchor's id; may be empty.
        unit: of the numbers.
        adoption: returns the changes to make if the mistake is adopted; None: those of ``correction``.
        max_unnoticed: a mistake larger than this is noticed without a test, so it need not be feared.
        refine_time: returns the same mistake at times between those that are searched; nothing if it has no time.
        narrower: mistakes with fewer numbers, which explain as much if it was one of them.
        is_linear: whether one step finds its size, however large it is.
        seen: (c, k) effect on the observations if the map was known, where that differs from ``columns``: an error of
            an anchor's coordinates is an effect on their prior.
        is_in_interval: whether the scale's interval already includes its usual size, or it changes the unit of length.
    """

    name: str
    columns: Array
    words: Callable[[Array], str] = lambda _: ""
    remedy: str = ""
    correction: Callable[[Array], Correction] = lambda _: Correction()
    most: float = np.inf
    subject: str = ""
    unit: str = "m"
    adoption: Callable[[Array], Correction] | None = None
    max_unnoticed: float = np.inf
    refine_time: Callable[[], Iterable[Mistake]] = tuple
    narrower: tuple[Mistake, ...] = ()
    is_linear: bool = False
    is_in_interval: bool = False
    seen: Array | None = None

    @classmethod
    def without_size(cls, name: str, subject: str, words: str, remedy: str, correction: Correction) -> Mistake:
        """Return a mistake that is tried as a whole."""
        return cls(name, np.zeros((0, 0)), lambda _: words, remedy, lambda _: correction, 0.0, subject)

    @property
    def num(self) -> int:
        """Number of its numbers."""
        return int(self.columns.shape[1])

    @property
    def key(self) -> tuple[str, str]:
        """Name and subject."""
        return self.name, self.subject

    @property
    def most_unnoticed(self) -> float:
        """Largest possible size that nobody notices without a test."""
        return min(self.most, self.max_unnoticed)

    def can_be(self, sizes: Array) -> bool:
        """Return whether a mistake of this size (k,) is possible."""
        return bool(np.linalg.norm(sizes) <= self.most)


@dataclass(frozen=True)
class MistakeTest:
    """One possible mistake in one survey, as a row of the table.

    Attributes:
        name, subject: its kind, and what it is about: an anchor's id, or nothing.
        statistic, threshold: a larger statistic than the threshold means that the mistake, or one that looks like it,
            was made. The statistic is 0 if its estimated size is impossible.
        words: what is the case if it was made. remedy: what to do then.
        unit: of ``size``, ``stddev`` and ``smallest_detectable``; "1": a ratio.
        size, stddev: of the mistake, estimated; the length of a vector. NaN: not estimated, or impossible.
        smallest_detectable: a mistake of this size is found in four cases of five; inf: it cannot be detected.
        effect_on_scale, effect_on_place_m: largest effect of a mistake of that size, relative and as root mean square
            along the path; inf: unlimited, NaN: not computed.
        redundancy: how much of the mistake the other observations check, 0 to 1; NaN: not computed.
        is_checked: whether some mistake of this kind that is possible would be found; None: not known.
        num: degrees of freedom of the statistic.
        most_unnoticed: largest change of the scale's logarithm by such a mistake that people would not notice.
        correction: changes of the input that undo it, if it is a likeliest cause of what is observed; None for others.
    """

    name: str
    subject: str
    statistic: float
    threshold: float
    words: str
    remedy: str
    unit: str = ""
    size: float = np.nan
    stddev: float = np.nan
    smallest_detectable: float = np.inf
    effect_on_scale: float = np.nan
    effect_on_place_m: float = np.nan
    redundancy: float = np.nan
    is_checked: bool | None = None
    num: int = 1
    most_unnoticed: float = np.inf
    correction: Correction | None = None

    @property
    def rejected(self) -> bool:
        """True if chance alone does not explain the statistic."""
        return self.statistic > self.threshold


@dataclass(frozen=True)
class MistakeTests:
    """The tests of some measurements and the mistakes that they found.

    Attributes:
        tests: rows of the table; what was found comes first.
        reasons: sentences, the likeliest cause first.
        hidden: rows, at all times, of mistakes that the tests may miss.
        likeliest: sentence on the likeliest mistake, with its remedy; empty if none shows.
        of_place: sentences of what makes the map's place doubtful.
    """

    tests: tuple[MistakeTest, ...] = ()
    reasons: tuple[str, ...] = ()
    hidden: tuple[MistakeTest, ...] = ()
    likeliest: str = ""
    of_place: tuple[str, ...] = ()

    @property
    def causes(self) -> tuple[MistakeTest, ...]:
        """Rows of the likeliest cause, and of those that cannot be told from it, which can be corrected."""
        return tuple(row for row in self.tests if row.correction is not None)

    def with_more(self, more: MistakeTests) -> MistakeTests:
        """Return the tests with those of another kind added."""
        return MistakeTests(
            (*more.tests, *self.tests),
            (*self.reasons, *more.reasons),
            (*self.hidden, *more.hidden),
            self.likeliest or more.likeliest,
            (*self.of_place, *more.of_place),
        )


@dataclass(frozen=True)
class EstimatedMistake:
    """A mistake of k numbers, as estimated.

    Attributes:
        mistake: the mistake.
        sizes: (k,). root: (k, j) root of their covariance, without directions that the residuals do not show.
        statistic: chi-square distributed with j degrees of freedom where no such mistake was made.
        by_unknowns: (p, k) change of the estimate by the mistake.
        basis: (c + r, j) orthonormal basis of the effect, whitened and projected.
        smallest_detectable: minimal detectable bias in the worst direction; inf: it cannot be detected.
        effect_on_log_scale: largest effect of an undetected mistake of that size.
        redundancy: how much of the mistake the other observations check, 0 to 1: the share of its information in the
            observations that the unknowns leave, in the worst direction (Baarda's redundancy number, for several
            numbers).
        effect_on_place_m: largest effect of an undetected mistake of that size; NaN: not computed.
        threshold: of the statistic; inf before there is one.
    """

    mistake: Mistake
    sizes: Array
    root: Array
    statistic: float
    by_unknowns: Array
    basis: Array
    smallest_detectable: float
    effect_on_log_scale: float
    redundancy: float
    effect_on_place_m: float = np.nan
    threshold: float = np.inf

    @property
    def num(self) -> int:
        """Degrees of freedom of the statistic."""
        return int(self.root.shape[1])

    @property
    def is_seen(self) -> bool:
        """True if the residuals show the mistake in every direction."""
        return self.num == len(self.sizes)

    @property
    def stddevs(self) -> Array:
        """(k,) standard deviations of the sizes; inf if a direction is hidden."""
        return np.linalg.norm(self.root, axis=1) if self.is_seen else np.full(len(self.sizes), np.inf)

    @property
    def is_possible(self) -> bool:
        """True if a mistake of the estimated size is possible."""
        return self.mistake.can_be(self.sizes)

    @property
    def is_checked(self) -> bool:
        """True if some mistake of this kind that is possible would be found."""
        return self.is_seen and self.smallest_detectable <= self.mistake.most

    @property
    def is_rejected(self) -> bool:
        """True if the estimated size is possible and chance alone does not explain the observations."""
        return self.is_possible and self.statistic > self.threshold

    def penalty(self, num_observations: int) -> float:
        """Return the cost of the numbers that a mistake may choose (Schwarz, 1978)."""
        return self.num * float(np.log(num_observations))

    @property
    def row(self) -> MistakeTest:
        """The row of the table: one number with its sign, or the length of a vector; without an impossible size."""
        made, is_possible = self.mistake, self.is_possible
        length = float(self.sizes[0] if len(self.sizes) == 1 else np.linalg.norm(self.sizes))
        most = f"{made.most:.2g} {made.unit.replace('1', '')}".rstrip()
        nothing = f"no {' '.join(made.key).strip()} that can happen ({most} at most) explains the measurements"
        return MistakeTest(
            *made.key,
            self.statistic if is_possible else 0.0,
            self.threshold if np.isfinite(self.threshold) else 0.0,
            made.words(self.sizes) if is_possible else nothing,
            made.remedy,
            made.unit,
            size=length if self.is_seen and is_possible else np.nan,
            stddev=float(np.linalg.norm(self.stddevs)) if is_possible else np.nan,
            smallest_detectable=self.smallest_detectable,
            effect_on_scale=self.effect_on_log_scale,
            effect_on_place_m=self.effect_on_place_m,
            redundancy=self.redundancy,
            is_checked=self.is_checked,
            num=self.num,
            most_unnoticed=float(np.linalg.norm(self.by_unknowns[0])) * made.most_unnoticed,
        )


def estimated(
    problem: JointProblem, mistakes: Sequence[Mistake], beside: Sequence[Mistake] = ()
) -> list[EstimatedMistake]:
    """Estimate each of some mistakes, as if no other one of them was made.

    Observations that any of them changes are taken into the equations, whether they take part or not.

    Args:
        beside: mistakes that may have been made as well, and explain what they can.
    """
    if not mistakes:
        return []
    num, rows = len(problem.is_used), problem.is_used
    if not rows.all():
        rows = np.any([rows, *(np.any(each.columns[:num] != 0, axis=1) for each in (*mistakes, *beside))], axis=0)
    if not np.array_equal(rows, problem.is_used):
        problem = replace(problem, is_used=rows)
    kept = np.append(rows, np.ones(len(problem.prior_residual), dtype=bool))
    if beside:
        linear, noise = problem.among(rows)
        solution = linear.with_more([each.columns[kept[: len(each.columns)]] for each in beside]).solved(
            noise.covariance_m2
        )
    else:
        solution = problem.solution
    whitened = solution.whitened(*(each.columns[kept[: len(each.columns)]] for each in mistakes))
    effects = whitened, solution.left(whitened), solution.by_unknowns(whitened)
    ends, found = np.cumsum([each.num for each in mistakes]).tolist(), list[EstimatedMistake]()
    for mistake, end in zip(mistakes, ends, strict=True):
        own, left, by_unknowns = (of[:, end - mistake.num : end] for of in effects)
        known = own[: len(solution.lower)] if mistake.seen is None else solution.whitened(mistake.seen[rows])
        found.append(_estimated(mistake, solution.residual, own, left, by_unknowns, known))
    return found


def _estimated(
    mistake: Mistake, residual: Array, whitened: Array, left: Array, by_unknowns: Array, known: Array
) -> EstimatedMistake:
    """Estimate a mistake.

    Args:
        residual: (c + r,) that the unknowns leave. whitened: (c + r, k) effect of the mistake. left: what they leave of
            that. by_unknowns: (p, k) change of the estimate by it. known: effect on the observations, whitened, if the
            map was known; (c, k), or with zeros for the priors below them.
    """
    lengths = np.maximum(np.linalg.norm(whitened, axis=0), 1e-12)
    basis, values, turns = np.linalg.svd(left / lengths, full_matrices=False)
    # Of an effect with a smaller squared share the unknowns leave only rounding.
    shown = values**2 > UNDETERMINED
    basis, root = basis[:, shown], turns[shown].T / values[shown] / lengths[:, None]
    pulls, smallest, effect, redundancy = basis.T @ residual, np.inf, np.inf, 0.0
    if shown.all():
        # The mistake with the largest effect among those that are just detectable.
        size = float(np.sqrt(noncentrality(len(shown))))
        smallest = size * float(np.linalg.norm(root, 2) if len(root) > 1 else abs(root[0, 0]))
        effect = size * float(np.linalg.norm(by_unknowns[:1] @ root))
        strength = float(np.linalg.norm(known @ root, 2))
        redundancy = min(strength**-2, 1.0) if strength > 0 else 0.0
    return EstimatedMistake(
        mistake, root @ pulls, root, float(pulls @ pulls), by_unknowns, basis, smallest, effect, redundancy
    )


@cache
def noncentrality(num: int) -> float:
    """Return the noncentrality at which a mistake of ``num`` numbers is found (Baarda's lambda_0)."""
    return float(special.chndtrinc(special.chdtri(num, _ALPHA), num, _BETA))


def in_axes(shift: Array) -> str:
    """Return a shift (3,) in words."""
    return f"{shift[0]:+.2f}, {shift[1]:+.2f}, {shift[2]:+.2f} m"
