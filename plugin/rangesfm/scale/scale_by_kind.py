"""ScaleByKind: the scale by one kind of measurement alone."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScaleByKind:
    """The scale by ranges, measured lengths or known positions alone, in metres per SfM unit.

    Attributes:
        value: middle of its interval. stddev: with all error components; inf where the scale is not determined.
    """

    value: float
    stddev: float
