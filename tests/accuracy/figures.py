"""Figures over the cases of a group of surveys, and whether they are worse than those that are stored."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

Array = npt.NDArray[np.float64]
Values = Mapping[str, float | None]
"""Numbers of one case by key; None where the case has none."""
Cases = Mapping[str, Values]
"""Values by case."""

# A figure is worse if its cases are, on the average, by more than their scatter allows for with this probability, ...
_CONFIDENCE = 0.99
# ... and by more than this share of it, which other processors and versions of libraries may change.
_TRIFLE = 0.01


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

        What makes one kind of case worse hides among the others, which it leaves as they were.
        """
        now, before = self.values(cases), self.values(stored)
        both = sorted(now.keys() & before.keys())
        if self.worse is None or len(both) < 2:
            return []
        kinds = {kind_of(case): [other for other in both if kind_of(other) == kind_of(case)] for case in both}
        parts = {"": both} | {kind: part for kind, part in kinds.items() if 1 < len(part) < len(both)}
        # All comparisons of a figure together are to have this confidence.
        confidence = 1 - (1 - _CONFIDENCE) / len(parts)
        return [self._loss(kind, before, now, part, confidence) for kind, part in parts.items()]

    def _loss(
        self, kind: str, before: dict[str, float], now: dict[str, float], cases: list[str], confidence: float
    ) -> Loss:
        old, new = (self._cost(np.array([values[case] for case in cases])) for values in (before, now))
        change = (new - old) * (1 if self.worse == "higher" else -1)
        # With the same cases in both, what they have in common falls out.
        stderr = float(np.std(change, ddof=1) / np.sqrt(len(cases)))
        allowed = float(student.ppf(confidence, len(cases) - 1)) * stderr + _TRIFLE * float(np.mean(np.abs(old)))
        return Loss(f"{self.words}, {kind}" if kind else self.words, float(np.mean(change)), allowed)

    def _cost(self, values: Array) -> Array:
        """Return what the figure averages: squares for a root mean square."""
        return values**2 if self.over == "rms" else values


def kind_of(case: str) -> str:
    """Return the name of a case without the number at its end, which is mostly its seed."""
    return re.sub(r",? ?\d+$", "", case)


@dataclass(frozen=True)
class Loss:
    """By how much the mean of cases is for the worse, and by how much it may be.

    Attributes:
        words: the figure, and the cases if they are not all of their group.
    """

    words: str
    by: float
    allowed: float

    @property
    def is_real(self) -> bool:
        return self.by > self.allowed
