"""How well every offset of the clocks explains the ranges: all of them at once, by correlation.

The sums in the normal equations of the linear fit (see ``squares``) at every offset
are correlations in time of the ranges with products of |c|^2, c and 1 along the path, so that
fast Fourier transforms give the best fit at all offsets in one pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import maximum_filter1d

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.geometry.similarity import rounding_of
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import AssociationOptions
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.squares import MIN_RANGE_M, rows_by_anchor
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.observations import RangeStatus

# Between samples this close a straight line is off by less than a millimetre, even at 10 m/s^2.
_SAMPLE_STEP_S = 0.025
# Photos of more than seven hours are sampled more coarsely.
_MAX_NUM_SAMPLES = 1 << 20
# An offset that puts fewer ranges on the path than this share of the most possible is not tried.
_MIN_COVERAGE = 0.5
# A twentieth of what a walker's motion needs to change; less than that for logs of more than seven hours.
_STEP_S = 0.05
_MAX_NUM_STEPS = 1 << 19
_NUM_COARSE, _MAX_NUM_FINE = 160, 200
_NUM_COLUMNS = 5
_PAIRS = [(i, j) for i in range(_NUM_COLUMNS) for j in range(i, _NUM_COLUMNS)]


class TimedRanges(NamedTuple):
    """n ranges: radio's clock, metres, and the numbers of each one's anchor and tag."""

    times_s: Array
    range_m: Array
    anchor: Indices
    tag: Indices

    def take(self, rows: Indices | Mask) -> TimedRanges:
        return TimedRanges(self.times_s[rows], self.range_m[rows], self.anchor[rows], self.tag[rows])


@dataclass(frozen=True)
class PathSamples:
    """m camera poses, ``step_s`` apart, from ``start_s`` on (camera's clock).

    Attributes:
        centers: (m, 3) camera centres, model units; 0 where unknown.
        tag_from_center: (num_tags, m, 3) lever arms turned into the world, metres.
        is_known: (m,) whether the camera's pose is known then.
    """

    start_s: float
    step_s: float
    centers: Array
    tag_from_center: Array
    is_known: Mask

    def __len__(self) -> int:
        return len(self.is_known)

    def knows(self, times_s: Array) -> Mask:
        """(n,) times at which the pose is known."""
        place = (times_s - self.start_s) / self.step_s
        inside = (place >= 0) & (place < len(self) - 1)
        before = np.where(inside, place, 0).astype(np.int64)
        return np.asarray(inside & self.is_known[before] & self.is_known[np.minimum(before + 1, len(self) - 1)])

    def tag(self, times_s: Array, tag: Indices, scale: float) -> tuple[Array, Array]:
        """Where the antenna of a tag is at known times, and how it moves.

        Args:
            scale: metres per model unit; infinite to leave the lever arm out.

        Returns:
            (n, 3) positions, model units; (n, 3) velocities, model units a second.
        """
        place = (times_s - self.start_s) / self.step_s
        before = np.clip(place, 0, len(self) - 2).astype(np.int64)
        points = self.centers + self.tag_from_center / scale
        here = points[tag, before]
        step = points[tag, before + 1] - here
        return here + (place - before)[:, None] * step, step / self.step_s


def moving_path(trajectory: Trajectory, tags_in_cam_m: Array, options: AssociationOptions) -> PathSamples:
    """The path where ranges would be interpolated between keyframes; ``tags_in_cam_m``: (num_tags, 3)."""
    assert trajectory.timestamps_s is not None, "a path in time needs times"
    start_s = float(trajectory.timestamps_s[0])
    span_s = float(trajectory.timestamps_s[-1]) - start_s
    step_s = max(_SAMPLE_STEP_S, span_s / _MAX_NUM_SAMPLES)
    times = start_s + step_s * np.arange(int(span_s / step_s) + 1)
    probe = RangeLog.from_arrays(["probe"] * len(times), np.ones(len(times)), timestamp_s=times)
    # A negative tolerance: a sample next to a keyframe is interpolated like all others.
    options = options.model_copy(update={"max_time_difference_s": -1.0})
    by_tag = [associate(probe, trajectory, tag_in_cam_m, options=options) for tag_in_cam_m in tags_in_cam_m]
    places = by_tag[0]
    is_known = (places.status == RangeStatus.USED) & (places.before != places.after)
    known = is_known[:, None]
    tag_from_center = np.stack([np.where(known, places_of_tag.tag_from_center, 0.0) for places_of_tag in by_tag])
    return PathSamples(start_s, step_s, np.where(known, places.centers, 0.0), tag_from_center, is_known)


def ranges_on_path(ranges: TimedRanges, path: PathSamples, offset_s: float, max_num: int) -> TimedRanges:
    """The first ranges that an offset puts on the path, at most so many."""
    return ranges.take(np.flatnonzero(path.knows(ranges.times_s + offset_s))[:max_num])


@dataclass(frozen=True)
class CostCurve:
    """What offsets of the clocks cost.

    Attributes:
        offsets_s: (m,) increasing: all offsets at which log and photos overlap, closer together
            near the best one.
        costs_m: (m,) root mean square of the residuals of the ranges on the path, with the anchors and the scale that
            suit each offset best; each range weighs as it does at the best offset.
    """

    offsets_s: Array
    costs_m: Array


@dataclass(frozen=True)
class OffsetCurve(CostCurve):
    """How well each of m offsets explains the ranges: only those that put a fair share of them on the path.

    Attributes:
        scores: (m,) natural log of how many times smaller the residuals on the path are than
            the ranges' own variation there; 0 explains nothing.
    """

    scores: Array

    def around(self, best_s: float, reach_s: float) -> CostCurve:
        """To look at: the best offset of each stretch of all, and all those within reach of the best of all."""
        from_best_s = np.abs(self.offsets_s - best_s)
        near = np.flatnonzero(from_best_s < reach_s)
        fine = near[np.argsort(from_best_s[near])[:_MAX_NUM_FINE]]
        stretches = np.array_split(np.arange(len(from_best_s)), min(_NUM_COARSE, len(from_best_s)))
        coarse = [rows[np.argmin(self.costs_m[rows])] for rows in stretches]
        shown = np.unique(np.concatenate([fine, coarse]))
        return CostCurve(self.offsets_s[shown], self.costs_m[shown])

    def peaks(self, separation_s: float, max_num: int) -> list[float]:
        """The offsets whose score is the highest within ``separation_s``, best first."""
        if len(self.offsets_s) < 2:
            return list(map(float, self.offsets_s))
        step_s = float(np.median(np.diff(self.offsets_s)))
        highest = maximum_filter1d(self.scores, 2 * round(separation_s / step_s) + 1)
        peaks = np.flatnonzero(self.scores == highest)
        best = peaks[np.argsort(-self.scores[peaks], kind="stable")[:max_num]]
        return list(map(float, self.offsets_s[best]))


def scan_offsets(ranges: TimedRanges, path: PathSamples, weights: Array | None = None) -> OffsetCurve:
    """Try every offset at which log and path overlap; the lever arm changes little at this resolution.

    Args:
        path: with some pose known. weights: (n,) of the ranges, in any order; None: all weigh the same.
    """
    weights = np.ones(len(ranges.range_m)) if weights is None else weights
    scanned: list[tuple[Array, Array, Array, Array]] = []
    most = 0.0
    for rows in sorted(_parts(ranges.times_s, len(path) * path.step_s), key=len, reverse=True):
        if len(rows) < _MIN_COVERAGE * most:
            break
        scanned.append(_scan(ranges.take(rows), weights[rows], path))
        most = max(most, float(scanned[-1][0].max()))
    num_on_path, offsets, scores, costs = (np.concatenate(column) for column in zip(*scanned))
    tried = np.flatnonzero(num_on_path >= max(1.0, _MIN_COVERAGE * most))
    order = tried[np.argsort(offsets[tried], kind="stable")]
    return OffsetCurve(offsets[order], costs[order], scores[order])


def _parts(times: Array, path_span_s: float) -> list[Indices]:
    """The log's rows, cut where its pauses are longer than the path: no offset puts both sides on it.

    A clock that starts at zero and is set to the date later costs nothing so.
    """
    order = np.argsort(times, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(times[order]) > path_span_s) + 1)


def _scan(ranges: TimedRanges, weights: Array, path: PathSamples) -> tuple[Array, Array, Array, Array]:
    """(m,) numbers on the path (sums of weights), offsets, scores and costs of one part of the log."""
    first_s, last_s = float(ranges.times_s.min()), float(ranges.times_s.max())
    span_s = len(path) * path.step_s + last_s - first_s
    stride = max(1, round(max(_STEP_S, span_s / _MAX_NUM_STEPS) / path.step_s))
    step_s = stride * path.step_s
    columns = _columns(path, stride)
    cell = np.rint((ranges.times_s - first_s) / step_s).astype(np.int64)
    correlate = _Correlation(len(columns), int(cell.max()) + 1)
    products = {(i, j): correlate.transform(columns[:, i] * columns[:, j]) for i, j in _PAIRS}

    sums = np.zeros((5, correlate.num_offsets))
    for rows in rows_by_anchor(ranges.anchor):
        sums += _sums_of_anchor(ranges.range_m[rows], weights[rows], cell[rows], products, correlate)
    num, variation, without, column, cross = sums
    scale_squared = np.maximum(cross, 0.0) / np.maximum(column, 1e-12)
    floor = 1e-12 * max(float(variation.max()), 1e-300)
    residual = np.maximum(without - 2 * scale_squared * cross + scale_squared**2 * column, floor)
    offsets = path.start_s - first_s + step_s * np.arange(1.0 - correlate.num_cells, len(columns))
    return num, offsets, 0.5 * np.log(np.maximum(variation, floor) / residual), np.sqrt(residual / np.maximum(num, 1.0))


def _columns(path: PathSamples, stride: int) -> Array:
    """(m, 5) what the squared range is linear in: |c|^2, c (centred and scaled) and 1; 0 off the path."""
    known = path.is_known[::stride, None]
    num_known = max(int(np.count_nonzero(known)), 1)
    centers = path.centers[::stride]
    least = rounding_of(centers)
    centers = np.where(known, centers - centers.sum(axis=0) / num_known, 0.0)
    spread = float(np.sqrt(np.sum(centers**2) / num_known))
    centers = centers / spread if spread > least else np.zeros_like(centers)
    return np.column_stack([np.sum(centers**2, axis=1, keepdims=True), centers, known])


class _Correlation:
    """Correlations in time of cells of the log with samples of the path, at every shift that lets them meet."""

    def __init__(self, num_samples: int, num_cells: int):
        self.num_samples, self.num_cells = num_samples, num_cells
        self.num_offsets = num_samples + num_cells - 1
        self._size = next_fast_len(self.num_offsets, real=True)

    def transform(self, values: Array) -> npt.NDArray[np.complex128]:
        return np.asarray(rfft(values, self._size))

    def __call__(self, samples: npt.NDArray[np.complex128], cells: npt.NDArray[np.complex128]) -> Array:
        """(num_offsets,) from both transforms; first the last cell on the first sample."""
        around = irfft(samples * np.conj(cells), self._size)
        return np.concatenate([around[self._size - self.num_cells + 1 :], around[: self.num_samples]])


def _sums_of_anchor(
    range_m: Array,
    weights: Array,
    cell: Indices,
    products: dict[tuple[int, int], npt.NDArray[np.complex128]],
    correlate: _Correlation,
) -> Array:
    """(5, num_offsets) sums over the ranges on the path.

    How many they are; their squared deviation from the anchor's mean; that which c and 1 leave of it; the square of
    what these leave of the column |c|^2; the product of what they leave of both.
    """
    squared = range_m**2 - np.median(range_m**2)
    # The derivative of rho^2 turns residuals back into metres.
    weight = weights / (2 * np.maximum(range_m, MIN_RANGE_M)) ** 2

    def cells(values: Array) -> npt.NDArray[np.complex128]:
        return correlate.transform(np.bincount(cell, values, minlength=correlate.num_cells).astype(np.float64))

    own_weights, weighted = cells(weight), cells(weight * squared)
    normal = np.empty((correlate.num_offsets, _NUM_COLUMNS, _NUM_COLUMNS))
    for i, j in _PAIRS:
        normal[:, i, j] = normal[:, j, i] = correlate(products[i, j], own_weights)
    right = np.stack([correlate(products[i, 4], weighted) for i in range(_NUM_COLUMNS)], axis=1)
    total = correlate(products[4, 4], cells(weight * squared**2))
    num = correlate(products[4, 4], cells(weights))

    # The anchor's own unknowns are eliminated; what they leave adds up over the anchors.
    own = normal[:, 1:, 1:] + (1e-6 * normal[:, 4, 4] + 1e-9 * weight.sum())[:, None, None] * np.eye(4)
    solved = np.linalg.solve(own, np.stack([normal[:, 1:, 0], right[:, 1:]], axis=2))
    return np.stack(
        [
            num,
            np.maximum(total - right[:, 4] ** 2 / own[:, 3, 3], 0.0),
            total - np.einsum("mi,mi->m", right[:, 1:], solved[:, :, 1]),
            normal[:, 0, 0] - np.einsum("mi,mi->m", normal[:, 1:, 0], solved[:, :, 0]),
            right[:, 0] - np.einsum("mi,mi->m", normal[:, 1:, 0], solved[:, :, 1]),
        ]
    )
