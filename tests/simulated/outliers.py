"""Ranges of which a share is wrong: too long alone or in stretches, as without line of sight, or too short."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MEAN_EXCESS_M = 2.0
STRETCH = 15


def spoilt(ranges: Array, kind: str, share: float, rng: np.random.Generator) -> Array:
    """Make exactly this share of the ranges wrong: "long", "short", or "clustered" (a share of the stretches)."""
    num = len(ranges)
    if kind == "clustered":
        num_stretches = -(-num // STRETCH)
        excess = rng.exponential(MEAN_EXCESS_M, num_stretches) * chosen(num_stretches, share, rng)
        return ranges + np.repeat(excess, STRETCH)[:num]
    wrong = chosen(num, share, rng)
    if kind == "long":
        return ranges + wrong * rng.exponential(MEAN_EXCESS_M, num)
    return np.where(wrong, ranges * rng.uniform(0.1, 0.9, num), ranges)


def chosen(num: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    return rng.permutation(num) < round(share * num)
