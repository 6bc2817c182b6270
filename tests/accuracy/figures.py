"""Figures over the cases of a group of surveys, and whether they are worse than those that are stored."""

from __future__ import annotations

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

    def loss(self, cases: Cases, stored: Cases) -> Loss | None:
        """Compare the cases that both have; None if nothing is for the worse, or fewer than two cases are in both."""
        now, before = self.values(cases), self.values(stored)
        both = sorted(now.keys() & before.keys())
        if self.worse is None or len(both) < 2:
            return None
        old, new = (self._cost(np.array([values[case] for case in both])) for values in (before, now))
        change = (new - old) * (1 if self.worse == "higher" else -1)
        # With the same cases in both, what they have in common falls out.
        stderr = float(np.std(change, ddof=1) / np.sqrt(len(both)))
        allowed = float(student.ppf(_CONFIDENCE, len(both) - 1)) * stderr + _TRIFLE * float(np.mean(np.abs(old)))
        return Loss(self, float(np.mean(change)), allowed)

    def _cost(self, values: Array) -> Array:
        """Return what the figure averages: squares for a root mean square."""
        return values**2 if self.over == "rms" else values


@dataclass(frozen=True)
class Loss:
    """By how much the cases' mean is for the worse, and by how much it may be."""

    figure: Figure
    by: float
    allowed: float

    @property
    def is_real(self) -> bool:
        return self.by > self.allowed
