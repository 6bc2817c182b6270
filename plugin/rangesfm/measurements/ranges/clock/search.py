"""Search over all time offsets: the fit of what was observed at every offset, computed at once by correlation.

The sums in the normal equations of a linear fit are correlations in time of observations with products of |c|^2, c and
1 along the path. Fast Fourier transforms therefore give the best fit at all offsets in one pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import maximum_filter1d

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.clock.offset import CostCurve
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.options import RangesOptions
from rangesfm.util.geometry.similarity import rounding_of
from rangesfm.util.geometry.trajectory import Trajectory

# Time between samples of the path, and between offsets: a twentieth of the time in which a walker's motion changes.
# Linear interpolation between samples is off by less than a millimetre at an acceleration of 3 m/s^2.
_STEP_S = 0.05
# Largest number of samples, and of offsets; if path and log together last more than seven hours, the step is longer.
_MAX_NUM_STEPS = 500_000
MIN_COVERAGE = 0.5
"""Fraction of the largest possible number of ranges on the path; an offset that puts fewer there is not tried."""
# Number of offsets in the curve for the report that are taken from all, and of those nearest to the best one.
_NUM_SHOWN = 200


@dataclass(frozen=True)
class PathSamples:
    """m camera poses, evenly spaced in time.

    Attributes:
        start_s: time of the first pose, camera's clock.
        step_s: time between poses.
        centers: (m, 3) camera centres, model units; 0 where unknown.
        tag_from_center: (num_tags, m, 3) lever arms in the axes of the world, metres.
        is_known: (m,) whether the pose is known.
    """

    start_s: float
    step_s: float
    centers: Array
    tag_from_center: Array
    is_known: Mask

    def __len__(self) -> int:
        return len(self.is_known)

    def knows(self, times_s: Array) -> Mask:
        """Return whether the pose is known at each of the times (n,)."""
        place = (times_s - self.start_s) / self.step_s
        inside = (place >= 0) & (place < len(self) - 1)
        before = np.where(inside, place, 0).astype(np.int64)
        return np.asarray(inside & self.is_known[before] & self.is_known[np.minimum(before + 1, len(self) - 1)])

    def tag(self, times_s: Array, tag: Indices, scale: float) -> tuple[Array, Array]:
        """Return positions and velocities of tags' antennas at times at which the pose is known.

        Args:
            times_s: (n,) times, camera's clock.
            tag: (n,) index of the tag at each time.
            scale: metres per model unit; infinity leaves the lever arm out.

        Returns:
            (n, 3) positions in model units, and (n, 3) velocities in model units per second.
        """
        place = (times_s - self.start_s) / self.step_s
        before = np.clip(place, 0, len(self) - 2).astype(np.int64)
        points = self.centers + self.tag_from_center / scale
        here = points[tag, before]
        step = points[tag, before + 1] - here
        return here + (place - before)[:, None] * step, step / self.step_s


def moving_path(trajectory: Trajectory, tags_in_cam_m: Array, options: RangesOptions) -> PathSamples:
    """Sample the path where poses are interpolated between keyframes.

    Args:
        tags_in_cam_m: (num_tags, 3) lever arms, metres.
    """
    assert trajectory.timestamps_s is not None, "a path in time needs times"
    start_s = float(trajectory.timestamps_s[0])
    span_s = float(trajectory.timestamps_s[-1]) - start_s
    step_s = max(_STEP_S, span_s / _MAX_NUM_STEPS)
    times = start_s + step_s * np.arange(int(span_s / step_s) + 1)
    probe = RangeLog.from_arrays(["probe"] * len(times), np.ones(len(times)), timestamp_s=times)
    # With a negative tolerance, a sample next to a keyframe is interpolated like all others.
    options = options.model_copy(update={"max_time_difference_s": -1.0})
    by_tag = [associate(probe, trajectory, tag_in_cam_m, options=options) for tag_in_cam_m in tags_in_cam_m]
    places = by_tag[0]
    is_known = (places.status == RangeStatus.USED) & (places.before != places.after)
    known = is_known[:, None]
    tag_from_center = np.stack([np.where(known, places_of_tag.tag_from_center, 0.0) for places_of_tag in by_tag])
    return PathSamples(start_s, step_s, np.where(known, places.centers, 0.0), tag_from_center, is_known)


@dataclass(frozen=True)
class OffsetCurve(CostCurve):
    """Cost and score of m offsets that put a large enough fraction of the ranges on the path.

    Attributes:
        scores: (m,) natural logarithm of the ratio of the ranges' own variation to their residuals; 0 if the path
            explains nothing.
    """

    scores: Array

    def around(self, best_s: float) -> CostCurve:
        """Return a curve for the report: the best offset of each interval, and those nearest to the best one of all."""
        fine = np.argsort(np.abs(self.offsets_s - best_s))[:_NUM_SHOWN]
        stretches = np.array_split(np.arange(len(self.offsets_s)), min(_NUM_SHOWN, len(self.offsets_s)))
        coarse = [rows[np.argmin(self.costs_m[rows])] for rows in stretches]
        shown = np.unique(np.concatenate([fine, coarse]))
        return CostCurve(self.offsets_s[shown], self.costs_m[shown])

    def peaks(self, separation_s: float, max_num: int) -> list[float]:
        """Return the offsets whose score is the highest within ``separation_s``, the best first."""
        if len(self.offsets_s) < 2:
            return list(map(float, self.offsets_s))
        step_s = float(np.median(np.diff(self.offsets_s)))
        highest = maximum_filter1d(self.scores, 2 * round(separation_s / step_s) + 1)
        peaks = np.flatnonzero(self.scores == highest)
        best = peaks[np.argsort(-self.scores[peaks], kind="stable")[:max_num]]
        return list(map(float, self.offsets_s[best]))


def scan_parts(times_s: Array, path: PathSamples, scan: Callable[[Indices], Scanned]) -> OffsetCurve:
    """Join what was computed for the parts of a log, without the offsets that put few observations on the path.

    Args:
        times_s: (n,) of the observations. scan: returns the result for some of them.
    """
    scanned: list[Scanned] = []
    most = 0.0
    for rows in sorted(_parts(times_s, len(path) * path.step_s), key=len, reverse=True):
        if len(rows) < MIN_COVERAGE * most:
            break
        scanned.append(scan(rows))
        most = max(most, float(scanned[-1].num_on_path.max()))
    num_on_path, offsets, variation, residual = (np.concatenate(column) for column in zip(*scanned))
    tried = np.flatnonzero(num_on_path >= max(1.0, MIN_COVERAGE * most))
    order = tried[np.argsort(offsets[tried], kind="stable")]
    floor = 1e-12 * max(float(variation.max()), 1e-300)
    left, whole = np.maximum(residual[order], floor), np.maximum(variation[order], floor)
    costs = np.sqrt(left / np.maximum(num_on_path[order], 1.0))
    return OffsetCurve(offsets[order], costs, 0.5 * np.log(whole / left))


def _parts(times: Array, path_span_s: float) -> list[Indices]:
    """Split the rows of the log at pauses longer than the path, because no offset puts both sides on the path.

    A clock that starts at zero and is set to the date later therefore causes no huge search.
    """
    order = np.argsort(times, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(times[order]) > path_span_s) + 1)


class Scanned(NamedTuple):
    """Sums over the observations on the path at m offsets, with the best fit at each.

    Attributes:
        num_on_path: (m,) sums of weights. offsets_s: (m,).
        variation, residual: (m,) sums of squares of what is to be explained, and of what is left of it, square metres.
    """

    num_on_path: Array
    offsets_s: Array
    variation: Array
    residual: Array


@dataclass(frozen=True)
class Cells:
    """The times of n observations as cells of a grid that samples of the path share, to correlate both in time.

    Attributes:
        cell: (n,) index of each observation's cell. num_cells: their number.
        stride: every so many samples of the path are on the grid. num_samples: number of these.
        offsets_s: (m,) all offsets at which samples and cells overlap, ascending.
    """

    cell: Indices
    num_cells: int
    stride: int
    num_samples: int
    offsets_s: Array

    @classmethod
    def from_times(cls, times_s: Array, path: PathSamples) -> Cells:
        """Lay a grid that is as fine as the samples of the path, or coarser for very long logs."""
        first_s, last_s = float(times_s.min()), float(times_s.max())
        span_s = len(path) * path.step_s + last_s - first_s
        stride = max(1, round(span_s / (_MAX_NUM_STEPS * path.step_s)))
        step_s, num_samples = stride * path.step_s, len(range(0, len(path), stride))
        cell = np.rint((times_s - first_s) / step_s).astype(np.int64)
        num_cells = int(cell.max()) + 1
        offsets = path.start_s - first_s + step_s * np.arange(1.0 - num_cells, num_samples)
        return cls(cell, num_cells, stride, num_samples, offsets)

    @property
    def _size(self) -> int:
        return int(next_fast_len(len(self.offsets_s), real=True))

    def of_path(self, values: Array) -> npt.NDArray[np.complex128]:
        """Return the transform of values (num_samples,) along the path."""
        return np.asarray(rfft(values, self._size))

    def of_log(self, values: Array) -> npt.NDArray[np.complex128]:
        """Return the transform of the sums of (n,) values in the cells."""
        return self.of_path(np.bincount(self.cell, values, minlength=self.num_cells).astype(np.float64))

    def correlate(self, path: npt.NDArray[np.complex128], log: npt.NDArray[np.complex128]) -> Array:
        """Return the correlation (m,) at all offsets from both transforms."""
        around = irfft(path * np.conj(log), self._size)
        # At the first offset, the last cell is on the first sample.
        return np.concatenate([around[self._size - self.num_cells + 1 :], around[: self.num_samples]])


def centred_columns(path: PathSamples, stride: int) -> Array:
    """Return the columns (m, 5) in which the squared range is linear: |c|^2, c and 1, with c centred and scaled.

    Rows off the path are 0.
    """
    known = path.is_known[::stride, None]
    num_known = max(int(np.count_nonzero(known)), 1)
    centers = path.centers[::stride]
    least = rounding_of(centers)
    centers = np.where(known, centers - centers.sum(axis=0) / num_known, 0.0)
    spread = float(np.sqrt(np.sum(centers**2) / num_known))
    centers = centers / spread if spread > least else np.zeros_like(centers)
    return np.column_stack([np.sum(centers**2, axis=1, keepdims=True), centers, known])
