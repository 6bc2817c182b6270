"""Figures over the cases of a group of surveys, and whether they are worse than those that are stored."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student
from scipy.stats import wilcoxon

Array = npt.NDArray[np.float64]
Values = Mapping[str, float | None]
"""Numbers of one case by key; None where the case has none."""
Cases = Mapping[str, Values]
"""Values by case."""

# Probability that a figure is named whose cases became worse or better by chance. A change by a smaller share of a
# value counts as none, as other processors and versions of libraries may make it.
_CHANCE, _TRIFLE = 0.01, 0.01
# Divisor where nothing scatters.
_SMALLEST = 1e-300


@dataclass(frozen=True)
class Figure:
    """One number of a group.

    Attributes:
        words: what it is.
        key: of the cases' values.
        over: how the cases are put together.
        unit: "%" for shares and relative errors, or the values' own.
        worse: which change is for the worse; None for what only informs, as times do.
    """

    words: str
    key: str
    over: Literal["rms", "median", "mean"]
    unit: str
    worse: Literal["higher", "lower"] | None

    def values(self, cases: Cases) -> dict[str, float]:
        """Return the value of each case that has one."""
        found = {case: values.get(self.key) for case, values in cases.items()}
        return {case: value for case, value in found.items() if value is not None and np.isfinite(value)}

    def of(self, cases: Cases) -> float:
        """Return the figure; not a number where no case has a value."""
        values = np.array(list(self.values(cases).values()), dtype=np.float64)
        if not len(values):
            return float("nan")
        if self.over == "rms":
            return float(np.sqrt(np.mean(values**2)) if len(values) > 1 else values[0])
        return float(np.median(values) if self.over == "median" else np.mean(values))

    def text(self, cases: Cases) -> str:
        """Return the figure with its unit."""
        value = self.of(cases)
        if not np.isfinite(value):
            return "-"
        return f"{100 * value:.3g} %" if self.unit == "%" else f"{value:.3g} {self.unit}".strip()

    def losses(self, cases: Cases, stored: Cases) -> list[Loss]:
        """Compare the cases that both have: all of them, and those of each kind of which there are several.

        Cases of different kinds differ in size by a factor of a thousand, so that only the ranks of their changes say
        something of all (Wilcoxon, "Individual comparisons by ranking methods", 1945). Cases of one kind differ in
        their seed alone, so that their scatter shows what is chance (Student's t); among all cases hides what makes one
        kind worse.
        """
        now, before = self.values(cases), self.values(stored)
        both = sorted(now.keys() & before.keys())
        if self.worse is None or len(both) < 2:
            return []
        old, new = (self._cost(np.array([values[case] for case in both])) for values in (before, now))
        change = (new - old) * (1 if self.worse == "higher" else -1)
        change = np.where(np.abs(change) > _TRIFLE * np.abs(old), change, 0.0)
        kinds = np.array([kind_of(case) for case in both])
        several = [kind for kind in sorted(set(kinds)) if np.count_nonzero(kinds == kind) > 1]
        found = [Loss(self.words, float(np.mean(change)), _chance_by_ranks(change) < _CHANCE)]
        for kind in several:
            of_kind = change[kinds == kind]
            # All kinds together are to be named by chance as seldom as the figure itself.
            is_real = _chance_by_scatter(of_kind) < _CHANCE / len(several)
            found.append(Loss(f"{self.words}, {kind}", float(np.mean(of_kind)), is_real))
        return found

    def _cost(self, values: Array) -> Array:
        """Return what the figure averages: sizes for a root mean square."""
        return np.abs(values) if self.over == "rms" else values


def _chance_by_ranks(change: Array) -> float:
    """Return the probability that changes for the worse are as many and as large by chance."""
    return float(wilcoxon(change[change != 0], alternative="greater").pvalue) if change.any() else 1.0


def _chance_by_scatter(change: Array) -> float:
    """Return the probability that the mean change is as large by chance, given the scatter of changes."""
    stderr = np.std(change, ddof=1) / np.sqrt(len(change))
    return float(student.sf(np.mean(change) / max(float(stderr), _SMALLEST), len(change) - 1))


def kind_of(case: str) -> str:
    """Return the name of a case without the number at its end, which is mostly its seed."""
    return re.sub(r",? ?\d+$", "", case)


@dataclass(frozen=True)
class Loss:
    """By how much the mean of cases is for the worse.

    Attributes:
        words: the figure, and the cases if they are not all of their group.
        is_real: whether it is hardly chance.
    """

    words: str
    by: float
    is_real: bool
