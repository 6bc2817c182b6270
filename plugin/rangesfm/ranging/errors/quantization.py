"""Radios that report whole centimetres or decimetres: no range of theirs is better than the rounding."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

_STEPS_M = (0.1, 0.01)
_MIN_NUM = 20
_TOLERANCE_M = 1e-5  # what 32-bit numbers leave of a range of some hundred metres


def find_quantization_m(range_m: npt.NDArray[np.float64]) -> float | None:
    """The step (0.1 or 0.01 m) of which all ranges are multiples; None if of neither, or too few to tell."""
    if len(range_m) < _MIN_NUM:
        return None
    for step in _STEPS_M:
        if np.all(np.abs(range_m - np.round(range_m / step) * step) < _TOLERANCE_M):
            return step
    return None


def quantization_stddev_m(step_m: float) -> float:
    """Of the rounding error, which is uniform over one step."""
    return step_m / math.sqrt(12)
