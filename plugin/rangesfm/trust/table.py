"""The tests as a table: of each hypothesis a row, whether it was found, could have been, and what it would do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MistakeTest:
    """One hypothesis on one survey.

    Attributes:
        name, subject: of which kind, and of what; an anchor's id, or nothing.
        statistic, threshold: the mistake was made, or something that looks like it, where the first is larger.
        size, stddev: of the mistake, as estimated; the length of a vector. None: not estimated.
        unit: of both and of ``smallest_detectable``; "1": a share.
        smallest_detectable: that would have been found, in four cases of five; None: no such mistake is ever found.
        effect_on_scale: relative, effect_on_place_m: root mean square along the path: the most that a mistake of that
            size does; None: there is no limit to it.
        words: what is the case if it was made. remedy: what to do then.
    """

    name: str
    subject: str
    statistic: float
    threshold: float
    size: float | None
    stddev: float | None
    unit: str
    smallest_detectable: float | None
    effect_on_scale: float | None
    effect_on_place_m: float | None
    words: str
    remedy: str

    @property
    def rejected(self) -> bool:
        """Whether chance alone does not explain it."""
        return self.statistic > self.threshold


def finite(value: float) -> float | None:
    """None for what has no limit."""
    return float(value) if np.isfinite(value) else None
