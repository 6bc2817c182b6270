"""Exact maximum consensus over the scale, for anchors known in the frame of the path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.errors import GeometryError
from rangesfm.scale.range_equation import RangeProblem

Array = npt.NDArray[np.float64]

# A range agrees with a scale if it fits to this many stddevs of noise and bias together.
_TOLERANCE_STDDEVS = 2.5
_MAX_CANDIDATES = 5
_SAME_CANDIDATE = 1.02


def consensus_scales(problem: RangeProblem) -> list[float]:
    """Scales that most ranges agree on, best first; the first is the exact maximum.

    Raises:
        GeometryError: no positive scale explains any range.
    """
    bias_stddev = np.where(np.isfinite(problem.bias_stddev_m), problem.bias_stddev_m, 0.0)[problem.anchor_index]
    tolerance = _TOLERANCE_STDDEVS * np.hypot(problem.stddev_m, bias_stddev)
    ranges = problem.range_m - problem.bias_mean_m[problem.anchor_index]
    offset = problem.tag_from_center - problem.anchor_mean_m[problem.anchor_index]
    starts, ends = agreeing_intervals(problem.centers, offset, ranges, tolerance)
    if not len(starts):
        raise GeometryError("no scale explains any range: are the anchors given in the first camera's frame?")
    middles, counts = _stab(starts, ends)
    found: list[float] = []
    for i in np.argsort(-counts, kind="stable"):
        if all(max(middles[i] / s, s / middles[i]) > _SAME_CANDIDATE for s in found):
            found.append(float(middles[i]))
        if len(found) == _MAX_CANDIDATES:
            break
    return found


def agreeing_intervals(centers: Array, offset: Array, ranges: Array, tolerance: Array) -> tuple[Array, Array]:
    """Positive scales for which ``| ||scale c + offset|| - range | <= tolerance``, range by range.

    The squared distance is a parabola in the scale, so the set is one interval, or two where
    the path comes nearer to the anchor than the range and leaves again.

    Args:
        centers, offset: (n, 3). ranges, tolerance: (n,).

    Returns:
        interval starts and ends, up to 2 n, in no particular order.
    """
    a = np.sum(centers**2, axis=1)
    b = np.sum(centers * offset, axis=1)
    d = np.sum(offset**2, axis=1)
    outer_low, outer_high, reaches = _roots(a, b, d - (ranges + tolerance) ** 2)
    inner_low, inner_high, enters = _roots(a, b, d - np.maximum(ranges - tolerance, 0.0) ** 2)
    enters &= ranges > tolerance
    starts = np.concatenate([outer_low[reaches], inner_high[reaches & enters]])
    ends = np.concatenate([np.where(enters, inner_low, outer_high)[reaches], outer_high[reaches & enters]])
    starts = np.maximum(starts, 0.0)
    keep = ends > starts
    return starts[keep], ends[keep]


def _roots(a: Array, b: Array, c: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Roots of ``a x^2 + 2 b x + c``, and where they are real. Without motion (a = 0) there are none."""
    discriminant = b**2 - a * c
    real = (discriminant > 0) & (a > 0)
    root = np.sqrt(np.where(real, discriminant, 0.0))
    safe = np.where(a > 0, a, 1.0)
    return (-b - root) / safe, (-b + root) / safe, real


def _stab(starts: Array, ends: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Middle of every stretch between interval ends, and how many intervals cover it. O(n log n)."""
    places = np.concatenate([starts, ends])
    steps = np.concatenate([np.ones(len(starts), dtype=np.int64), -np.ones(len(ends), dtype=np.int64)])
    order = np.argsort(places, kind="stable")
    places, counts = places[order], np.cumsum(steps[order])
    middles = 0.5 * (places[:-1] + places[1:])
    wide = places[1:] > places[:-1]
    return middles[wide], counts[:-1][wide]
