"""How noisy ranges are, from the log alone: by how much they miss a smooth curve through their neighbours.

Nor is any range better than its rounding, of radios that report whole centimetres or decimetres.
"""

from __future__ import annotations

import math

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.errors.noise import robust_stddev, robust_stddevs

_WINDOW = 11
_MAX_NUM_WINDOWS = 20_000
_MAX_STRETCH = 3.0  # a window so much longer than the typical one has a gap in it
_CAUCHY_SCALE = 2.4
_NUM_ITERATIONS = 8
_TINY = 1e-9
_STEPS_M = (0.1, 0.01)
_MIN_NUM_ROUNDED = 20
_ROUNDED_TO_M = 1e-5  # what 32-bit numbers leave of a range of some hundred metres


def estimate_noise_m(timestamp_s: Array, range_m: Array) -> float | None:
    """Robust stddev of the ranges between one tag and one anchor.

    A parabola is fitted robustly to every 11 ranges in a row; the middle one's distance from it, corrected
    for its own pull on the fit, is a sample of the noise. Errors that last longer than a window, such as a
    bias, are not seen; motion that is no parabola within a window counts as noise.

    Args:
        timestamp_s: (n,) in any order.
        range_m: (n,).

    Returns:
        Metres; None for fewer than two windows' worth of ranges, or if they are absurd.
    """
    if len(range_m) < 2 * _WINDOW:
        return None
    order = np.argsort(timestamp_s, kind="stable")
    times = np.lib.stride_tricks.sliding_window_view(timestamp_s[order], _WINDOW)
    ranges = np.lib.stride_tricks.sliding_window_view(range_m[order], _WINDOW)
    span = times[:, -1] - times[:, 0]
    whole = np.flatnonzero(span <= _MAX_STRETCH * np.median(span))
    chosen = whole[:: -(-len(whole) // _MAX_NUM_WINDOWS)]
    with np.errstate(over="ignore", invalid="ignore"):  # times or ranges that no radio can mean
        misses = _misses_of_parabola(times[chosen], ranges[chosen])
        noise = robust_stddev(misses - np.median(misses))
    return noise if np.isfinite(noise) else None


def _misses_of_parabola(times: Array, ranges: Array) -> Array:
    """What the middle of each row of (m, 11) ranges is off a robust parabola, as if it had not pulled on it, (m,)."""
    middle = _WINDOW // 2
    centred = times - times[:, middle : middle + 1]
    scaled = centred / np.maximum(np.abs(centred).max(axis=1, keepdims=True), _TINY)
    powers = np.stack([np.ones_like(scaled), scaled, scaled**2], axis=2)
    weights = np.ones_like(ranges)
    offset = np.median(ranges, axis=1, keepdims=True)
    for _ in range(_NUM_ITERATIONS):
        normal = np.einsum("mi,mij,mik->mjk", weights, powers, powers) + _TINY * np.eye(3)
        right = np.einsum("mi,mij,mi->mj", weights, powers, ranges - offset)
        coefficients = np.linalg.solve(normal, right[..., np.newaxis])
        residuals = ranges - offset - (powers @ coefficients)[..., 0]
        weights = 1 / (1 + (residuals / (_CAUCHY_SCALE * robust_stddevs(residuals))) ** 2)
    plain = np.einsum("mij,mik->mjk", powers, powers) + _TINY * np.eye(3)
    pull = np.linalg.inv(plain)[:, 0, 0]  # of the middle, where the powers are 1, 0, 0
    return np.asarray(residuals[:, middle] / np.sqrt(np.maximum(1 - pull, _TINY)), np.float64)


def find_quantization_m(range_m: Array) -> float | None:
    """The step (0.1 or 0.01 m) of which all ranges are multiples; None if of neither, or too few to tell."""
    if len(range_m) < _MIN_NUM_ROUNDED:
        return None
    for step in _STEPS_M:
        if np.all(np.abs(range_m - np.round(range_m / step) * step) < _ROUNDED_TO_M):
            return step
    return None


def quantization_stddev_m(step_m: float) -> float:
    """Of the rounding error, which is uniform over one step."""
    return step_m / math.sqrt(12)
