"""Exact maximum consensus over the scale, for anchors known in the frame of the path."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import off_origin
from rangesfm.scale.range_equation import RangeProblem

# A range agrees with a scale if it fits to this many stddevs of noise and bias together.
TOLERANCE_STDDEVS = 2.5
# Hills of agreement are told apart on a logarithmic grid of the scale; only those at least so high beside the best.
_LOG_CELL = 0.02
_MIN_SHARE_OF_BEST = 0.5
_MAX_CANDIDATES = 12


def consensus_scales(problem: RangeProblem) -> list[float]:
    """Scales that most ranges agree on, best first; the first is the exact maximum.

    The others are the tops of lower hills: local maxima of the number of ranges that agree.

    Raises:
        GeometryError: no positive scale explains any range.
    """
    bias_stddev = np.where(np.isfinite(problem.bias_stddev_m), problem.bias_stddev_m, 0.0)[problem.anchor_index]
    tolerance = TOLERANCE_STDDEVS * np.hypot(problem.stddev_m, bias_stddev)
    ranges = problem.range_m - problem.bias_mean_m[problem.anchor_index]
    offset = problem.tag_from_center - problem.anchor_mean_m[problem.anchor_index]
    starts, ends = agreeing_intervals(problem.centers, offset, ranges, tolerance)
    if not len(starts):
        raise GeometryError("no scale explains any range: are the anchors given in the first camera's frame?")
    return _hilltops(*local_maxima(starts, ends))


def _hilltops(scales: Array, counts: Indices) -> list[float]:
    """Best first: scales with no better one in their cell of the grid or in the two beside it."""
    cells = np.floor(np.log(scales) / _LOG_CELL).astype(np.int64)
    first = np.flatnonzero(np.diff(cells, prepend=cells[0] - 1))
    best = np.maximum.reduceat(counts, first)
    if len(first) == 1:
        return [float(scales[np.argmax(counts)])]
    beside = np.diff(cells[first]) == 1
    lower = np.concatenate([[0], np.where(beside, best[:-1], 0)])
    higher = np.concatenate([np.where(beside, best[1:], 0), [0]])
    # Of equal neighbours the first is the top.
    tops = np.flatnonzero((best > lower) & (best >= higher) & (best >= _MIN_SHARE_OF_BEST * best.max()))
    tops = tops[np.argsort(-best[tops], kind="stable")][:_MAX_CANDIDATES]
    ends = np.append(first[1:], len(scales))
    return [float(scales[first[top] + np.argmax(counts[first[top] : ends[top]])]) for top in tops]


def agreeing_intervals(centers: Array, offset: Array, ranges: Array, tolerance: Array) -> tuple[Array, Array]:
    """Positive scales for which ``| ||scale c + offset|| - range | <= tolerance``, range by range.

    The squared distance is a parabola in the scale, so the set is one interval, or two where
    the path comes nearer to the anchor than the range and leaves again.

    Args:
        centers, offset: (n, 3). ranges, tolerance: (n,).

    Returns:
        interval starts and ends, up to 2 n, in no particular order.
    """
    a = np.where(off_origin(centers), np.sum(centers**2, axis=1), 0.0)
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


def _roots(a: Array, b: Array, c: Array) -> tuple[Array, Array, Mask]:
    """Roots of ``a x^2 + 2 b x + c``, and where they are real. Without motion (a = 0) there are none."""
    discriminant = b**2 - a * c
    real = (discriminant > 0) & (a > 0)
    root = np.sqrt(np.where(real, discriminant, 0.0))
    safe = np.where(a > 0, a, 1.0)
    return (-b - root) / safe, (-b + root) / safe, real


def local_maxima(starts: Array, ends: Array) -> tuple[Array, Indices]:
    """Where more of the closed intervals overlap than just before and just after: the stretches' middles, and counts.

    Such a stretch lies between a start and the next end, without another start between them. O(n log n); starts and
    ends are sorted apart, as sorting numbers is many times faster than sorting an index to them.

    Args:
        starts, ends: (n,) n > 0.

    Returns:
        (k,) ascending middles, and how many intervals hold each.
    """
    starts, ends = np.sort(starts), np.sort(ends)
    num_ended = np.searchsorted(ends, starts, side="left")
    next_start = np.append(starts[1:], np.inf)
    tops = np.flatnonzero(ends[num_ended] < next_start)
    counts = tops + 1 - num_ended[tops]
    return 0.5 * (starts[tops] + ends[num_ended[tops]]), counts
