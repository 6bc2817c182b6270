"""PathSamples: the camera's path, evenly sampled in time, and fits along it at all time offsets by correlation.

The sums in the normal equations of a linear fit are correlations in time of observations with products of |c|^2, c and
1 along the path. Fast Fourier transforms therefore give the best fit at all offsets in one pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError
from rangesfm.measurements.clock.offset import OffsetCurve
from rangesfm.measurements.places import places_on_path
from rangesfm.util.geometry.similarity import rounding_of
from rangesfm.util.geometry.trajectory import Trajectory, keyframes_around, places_in_time

STEP_S = 0.05
"""Time between samples of the path, and between offsets: a twentieth of the time in which a walker's motion changes.

Linear interpolation between samples is off by less than a millimetre at an acceleration of 3 m/s^2.
"""
# Largest number of samples, and of offsets; if path and log together last more than seven hours, the step is longer.
_MAX_NUM_STEPS = 500_000
MIN_COVERAGE = 0.5
"""Fraction of the largest possible number of observations on the path; an offset that puts fewer there is not tried."""
# To find the offset, poses are also interpolated across gaps up to this many times the median gap between photos.
_MAX_GAPS = 1.5


@dataclass(frozen=True)
class PathSamples:
    """m camera poses, evenly spaced in time.

    Attributes:
        start_s: time of the first pose, camera's clock.
        step_s: time between poses.
        centers: (m, 3) camera centres, model units; 0 where unknown.
        arms_m: (num_antennas, m, 3) lever arms in the axes of the world; 0 where unknown.
        is_known: (m,) whether the pose is known.
    """

    start_s: float
    step_s: float
    centers: Array
    arms_m: Array
    is_known: Mask

    def __len__(self) -> int:
        return len(self.is_known)

    def knows(self, times_s: Array) -> Mask:
        """Return whether the pose is known at each of the times (n,)."""
        place = (times_s - self.start_s) / self.step_s
        inside = (place >= 0) & (place < len(self) - 1)
        before = np.where(inside, place, 0).astype(np.int64)
        return np.asarray(inside & self.is_known[before] & self.is_known[np.minimum(before + 1, len(self) - 1)])

    @property
    def span_s(self) -> float:
        """Time from the first pose to the last."""
        return self.step_s * (len(self) - 1)

    def antennas(self, times_s: Array, antenna: Indices, scale: float) -> tuple[Array, Array]:
        """Return positions and velocities of antennas at times at which the pose is known.

        Args:
            times_s: (n,) times, camera's clock.
            antenna: (n,) index of the one that observed at each time.
            scale: metres per model unit; infinity leaves the lever arm out.

        Returns:
            (n, 3) positions in model units, and (n, 3) velocities in model units per second.
        """
        place = (times_s - self.start_s) / self.step_s
        before = np.clip(place, 0, len(self) - 2).astype(np.int64)
        points = self.centers + self.arms_m / scale
        here = points[antenna, before]
        step = points[antenna, before + 1] - here
        return here + (place - before)[:, None] * step, step / self.step_s


def moving_path(trajectory: Trajectory, antennas_in_cam_m: Array, max_gap_s: float, remedy: str) -> PathSamples:
    """Sample the path of keyframes with times, also across longer gaps than those in which observations are used.

    Args:
        antennas_in_cam_m: (num, 3) lever arms, metres. max_gap_s: longest gap in which observations are used.
        remedy: what the user can do if no part of the path is known.

    Raises:
        GeometryError: poses can be interpolated nowhere.
    """
    keyframes_s = trajectory.times_s
    start_s, step_s, num = _steps(keyframes_s, 0.0)
    times_s: Array = start_s + step_s * np.arange(num, dtype=np.float64)
    gap_s = max(_MAX_GAPS * float(np.median(np.diff(keyframes_s))), max_gap_s)
    at = places_in_time(times_s, keyframes_s, max_gap_s=gap_s, max_difference_s=-1.0)
    is_known = at.before >= 0
    num_known = int(np.count_nonzero(is_known))
    if num_known < 2:
        raise GeometryError(f"no part of the path can be compared with the log to find the time offset: {remedy}")
    centers, arms_m = np.zeros((num, 3)), np.zeros((len(antennas_in_cam_m), num, 3))
    for own_m, arm_m in zip(arms_m, antennas_in_cam_m, strict=True):
        own = np.tile(arm_m, (num_known, 1))
        places = places_on_path(trajectory, own, at.subset(is_known), max_gap_s=gap_s, time_resolution_s=0.0)
        centers[is_known], own_m[is_known] = places.centers, places.tag_from_center
    return PathSamples(start_s, step_s, centers, arms_m, is_known)


def standing_path(trajectory: Trajectory, antennas_in_cam_m: Array, reach_s: float) -> PathSamples:
    """Sample the path of a camera that stands still from ``reach_s`` before to as long after each keyframe."""
    keyframes_s = trajectory.times_s
    start_s, step_s, num = _steps(keyframes_s, reach_s)
    times_s: Array = start_s + step_s * np.arange(num, dtype=np.float64)
    nearest = keyframes_around(times_s, keyframes_s).nearest
    is_known = np.abs(times_s - keyframes_s[nearest]) <= reach_s
    arms_m = np.einsum("nij,aj->ani", trajectory.world_from_cam[nearest], antennas_in_cam_m)
    return PathSamples(start_s, step_s, trajectory.centers[nearest], arms_m, is_known)


def _steps(keyframes_s: Array, beyond_s: float) -> tuple[float, float, int]:
    """Return the first time of samples, the time between them and their number."""
    start_s, span_s = float(keyframes_s[0]) - beyond_s, float(np.ptp(keyframes_s)) + 2 * beyond_s
    step_s = max(STEP_S, span_s / _MAX_NUM_STEPS)
    return start_s, step_s, int(span_s / step_s) + 1


def scan_parts(times_s: Array, path_span_s: float, scan: Callable[[Indices], OffsetCurve]) -> OffsetCurve:
    """Join what was computed for the parts of a log, without the offsets that put few observations on the path.

    A log is split at pauses longer than the path, because no offset puts both sides on the path. A clock that starts at
    zero and is set to the date later therefore causes no huge search.

    Args:
        times_s: (n,) of the observations. scan: returns the result for some of them.
    """
    order = np.argsort(times_s, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(times_s[order]) > path_span_s) + 1)
    scanned: list[OffsetCurve] = []
    most = 0.0
    for rows in sorted(parts, key=len, reverse=True):
        if len(rows) < MIN_COVERAGE * most:
            break
        scanned.append(scan(rows))
        most = max(most, float(scanned[-1].weight.max()))
    of_all = OffsetCurve(
        *(np.concatenate([getattr(each, field.name) for each in scanned]) for field in fields(OffsetCurve))
    )
    tried = np.flatnonzero(of_all.weight >= max(1.0, MIN_COVERAGE * most))
    floor = 1e-12 * max(float(of_all.variation.max()), 1e-300)
    kept = of_all.take(tried[np.argsort(of_all.offsets_s[tried], kind="stable")])
    variation, residual = (np.maximum(values, floor) for values in (kept.variation, kept.residual))
    return replace(kept, variation=variation, residual=residual)


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
