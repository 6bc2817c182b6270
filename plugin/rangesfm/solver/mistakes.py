"""Tests of mistakes, and mistakes that they may miss, for people (section 8 of ``model.md``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from rangesfm.arrays import Array
from rangesfm.solver.linear_map import EstimatedMistake

RISK = 1e-4
"""Probability with which the scale may be off by more than the bound."""


@dataclass(frozen=True)
class HiddenMistake:
    """A mistake that a test may miss.

    Attributes:
        words: for people.
        slope: change of the scale's logarithm by a mistake that moves the test by one standard deviation; inf for a
            mistake that no test sees.
        threshold, num: of the test, and its degrees of freedom.
        most: largest change of the scale's logarithm by such a mistake that people would not notice.
    """

    words: str
    slope: float
    threshold: float
    num: int
    most: float

    @property
    def sizes(self) -> tuple[Array, Array]:
        """Possible changes of the scale's logarithm (k,), and the probabilities (k,) that the test misses them."""
        if not np.isfinite(self.slope):
            return np.array([self.most]), np.ones(1)
        # A mistake that moves the test farther beyond its threshold is missed with a smaller probability than the risk.
        farthest = np.sqrt(self.threshold) - special.ndtri(RISK)
        if self.slope > 0:
            farthest = min(farthest, self.most / self.slope)
        moves = np.linspace(0.0, farthest, 80)
        return self.slope * moves, np.asarray(special.chndtr(self.threshold, max(self.num, 1), moves**2))


@dataclass(frozen=True)
class MistakeTest:
    """One hypothesis on one survey, as a row of the table.

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
        hidden: mistakes that the tests may miss.
        likeliest: sentence on the likeliest mistake, with its remedy; empty if none shows.
        of_place: sentences of what makes the map's place doubtful.
    """

    tests: tuple[MistakeTest, ...] = ()
    reasons: tuple[str, ...] = ()
    hidden: tuple[HiddenMistake, ...] = ()
    likeliest: str = ""
    of_place: tuple[str, ...] = ()


def row_of_mistake(
    name: str, subject: str, found: EstimatedMistake, threshold: float, words: str, remedy: str, unit: str = "m"
) -> MistakeTest:
    """Return the row of the table for a mistake: one number with its sign, or the length of a vector."""
    return MistakeTest(
        name,
        subject,
        found.statistic,
        threshold,
        words,
        remedy,
        unit,
        size=float(found.sizes[0] if len(found.sizes) == 1 else np.linalg.norm(found.sizes))
        if found.is_seen
        else np.nan,
        stddev=float(np.linalg.norm(found.stddevs)),
        smallest_detectable=found.smallest_detectable,
        effect_on_scale=found.effect_on_log_scale,
    )


def in_axes(shift: Array) -> str:
    """Return a shift (3,) in words."""
    return f"{shift[0]:+.2f}, {shift[1]:+.2f}, {shift[2]:+.2f} m"
