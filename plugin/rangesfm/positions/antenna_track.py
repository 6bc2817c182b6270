"""An antenna's known positions on the camera's path: the time offset between the clocks, and the place of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csr_array

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError, InputError
from rangesfm.files.clock_times import time_text
from rangesfm.files.photo_names import rows_of_photos, told_none
from rangesfm.geometry.rotations import cross_matrices
from rangesfm.geometry.similarity import align_points, are_apart
from rangesfm.geometry.trajectory import Trajectory, keyframes_around
from rangesfm.options import AssociationOptions
from rangesfm.positions.known_positions import KnownPositions
from rangesfm.positions.position_log import PositionLog
from rangesfm.ranging.association import is_too_long, places_on_path
from rangesfm.ranging.errors.noise import STRETCH_S

# An offset that puts fewer positions on the path than this share of the largest possible number is not tried.
_MIN_COVERAGE = 0.5
_MIN_NUM = 5
# Largest number of positions for the search, and of offsets that are tried; the best is then refined with all.
_NUM_SEARCHED, _MAX_NUM_TRIED = 200, 4000
# Step between offsets, as a share of the median time between keyframes: the motion hardly changes within it.
_STEP = 0.25
_MOST_OUTLYING = 0.2
_NUM_REFINED = 12
# A given offset is wrong if the residuals with it are at least so many times those with another one.
_MUCH_WORSE = 3.0


@dataclass(frozen=True)
class AntennaTrack:
    """Positions of an antenna on the camera.

    Attributes:
        log: in the site's frame.
        antenna_in_cam_m: (3,) lever arm.
        offset_s: image time minus time of the positions; None: not known yet. offset_stddev_s: its standard deviation.
        association: how positions are placed between keyframes.
        other_offset_s: offset with which the positions fit the path much better than with the given one; None: none.
    """

    log: PositionLog
    antenna_in_cam_m: Array
    offset_s: float | None
    association: AssociationOptions
    offset_stddev_s: float = 0.0
    other_offset_s: float | None = None

    def with_offset(self, path: Trajectory) -> AntennaTrack:
        """Return the track with its time offset, which is searched for if it is not given.

        Raises:
            InputError: the positions are by time and the photos have none, or they are of other photos.
            GeometryError: too few positions and keyframes have a moment in common.
        """
        if self.log.timestamp_s is None:
            listed = self.log.image_name or ()
            if np.all(rows_of_photos(listed, path.image_names) < 0):
                raise InputError(told_none("the file", listed, path.image_names), self.log.path)
            return self
        if path.timestamps_s is None:
            raise InputError("the positions have times but the photos have none: give image times", self.log.path)
        given_s, times_s, at_m = self.offset_s, self.log.timestamp_s, self.log.position_m
        try:
            moving = _MovingAntenna(path.timestamps_s, path.centers, path.world_from_cam @ self.antenna_in_cam_m)
            offset_s, stddev_s = _search(times_s, at_m, moving)
        except GeometryError:
            if given_s is None:
                raise
            return self
        if given_s is None:
            return replace(self, offset_s=offset_s, offset_stddev_s=stddev_s)
        misfits = [moving.misfit_m(times_s + each_s, at_m) for each_s in (given_s, offset_s)]
        return replace(self, other_offset_s=offset_s) if misfits[0] > _MUCH_WORSE * misfits[1] else self

    def located(self, path: Trajectory) -> KnownPositions:
        """Return the positions that have a place on a path; the others are left out."""
        rows, before, after, fraction = self._places(path)
        k, times_s, velocity = len(rows), path.timestamps_s, np.zeros((len(rows), 3))
        arms_m = np.tile(self.antenna_in_cam_m, (k, 1))
        # The times of positions are those of a system's own epochs, so that they are exact.
        on_path = places_on_path(path, arms_m, before, after, fraction, time_resolution_s=0.0, options=self.association)
        if times_s is None or len(path) < 2:
            at_s = before.astype(np.float64)
        else:
            velocity = _velocities(times_s, path.centers, before)
            at_s = times_s[before] if self.log.timestamp_s is None else self._times_s[rows]
        names = self._names
        return KnownPositions(
            names=tuple(names[row] for row in rows.tolist()),
            is_mark=np.zeros(k, dtype=bool),
            is_check=np.zeros(k, dtype=bool),
            position_m=self.log.position_m[rows],
            covariance_m2=self.log.covariance_m2[rows],
            is_stated=np.asarray(np.isfinite(self.log.covariance_m2[rows]).all(axis=(1, 2))),
            places=on_path.centers,
            arms_m=on_path.arms_m,
            own_covariance=on_path.stddev[:, None, None] ** 2 * np.eye(3),
            arm_stddev_m=on_path.arm_stddev_m,
            time_s=at_s,
            clock_stddev_s=np.full(k, self.offset_stddev_s),
            velocity=velocity,
            world_from_cam=path.world_from_cam[np.where(fraction < 0.5, before, after)],
            by_pose=_by_shifts(before, after, fraction, len(path)),
            arms_by_pose=_by_turns(path, self.antenna_in_cam_m, before, after, fraction),
            on_path=np.column_stack([before, after]),
            fraction=fraction,
            from_line=on_path.offsets,
        )

    @property
    def _times_s(self) -> Array:
        assert self.log.timestamp_s is not None, "positions by time"
        return self.log.timestamp_s + (self.offset_s or 0.0)

    @property
    def _names(self) -> list[str]:
        if self.log.image_name is not None:
            return [*self.log.image_name]
        assert self.log.timestamp_s is not None, "positions by time"
        return [time_text(time_s) for time_s in self.log.timestamp_s.tolist()]

    def _places(self, path: Trajectory) -> tuple[Indices, Indices, Indices, Array]:
        """Return the rows of the log that have a place, and the keyframes before and after each with its fraction."""
        log, options = self.log, self.association
        if log.image_name is not None:
            at = rows_of_photos(log.image_name, path.image_names)
            rows = np.flatnonzero(at >= 0)
            return rows, at[rows], at[rows], np.zeros(len(rows))
        if path.timestamps_s is None:
            raise InputError("the positions have times but the photos have none: give image times", log.path)
        times, known = self._times_s, path.timestamps_s
        before, after, fraction, nearest = keyframes_around(times, known)
        gap = known[after] - known[before]
        is_between: Mask = (times >= known[0]) & (times <= known[-1]) & (gap > 0) & ~is_too_long(gap, options)
        is_at = ~is_between & (np.abs(times - known[nearest]) <= options.max_time_difference_s)
        before, after = np.where(is_at, nearest, before), np.where(is_at, nearest, after)
        rows = np.flatnonzero(is_between | is_at)
        return rows, before[rows], after[rows], np.where(is_at, 0.0, fraction)[rows]


def _velocities(times_s: Array, centers: Array, before: Indices) -> Array:
    """Return (k, 3) velocities along the path from each keyframe to the next; of the last two at the end."""
    steps = np.diff(centers, axis=0) / np.diff(times_s)[:, None]
    return np.asarray(steps[np.minimum(before, len(steps) - 1)])


def _by_shifts(before: Indices, after: Indices, fraction: Array, num: int) -> csr_array:
    """Return the (3 k, 6 n) derivatives of the places by shifts of the poses."""
    rows, axes = 3 * np.arange(len(before))[:, None] + np.arange(3), 3 + np.arange(3)
    parts = [(1 - fraction, before), (fraction, after)]
    values = np.concatenate([np.repeat(share, 3) for share, _ in parts])
    columns = np.concatenate([(6 * pose[:, None] + axes).ravel() for _, pose in parts])
    return coo_array((values, (np.tile(rows.ravel(), 2), columns)), shape=(3 * len(before), 6 * num)).tocsr()


def _by_turns(path: Trajectory, arm_m: Array, before: Indices, after: Indices, fraction: Array) -> csr_array:
    """Return the (3 k, 6 n) derivatives of the lever arms by turns of the poses in their own frames."""
    cross = -cross_matrices(arm_m[None])[0]
    rows = 3 * np.arange(len(before))[:, None, None] + np.arange(3)[:, None] + np.zeros(3, dtype=np.int64)
    values, columns = [], []
    for share, pose in ((1 - fraction, before), (fraction, after)):
        values.append((share[:, None, None] * (path.world_from_cam[pose] @ cross)).ravel())
        columns.append((6 * pose[:, None, None] + np.zeros((3, 1), dtype=np.int64) + np.arange(3)).ravel())
    shape = (3 * len(before), 6 * len(path))
    return coo_array((np.concatenate(values), (np.tile(rows.ravel(), 2), np.concatenate(columns))), shape=shape).tocsr()


@dataclass(frozen=True)
class _MovingAntenna:
    """The path of an antenna in a model: times, (n, 3) centres in its unit, and (n, 3) lever arms in metres."""

    times_s: Array
    centers: Array
    arms_m: Array

    def num_on(self, times_s: Array) -> int:
        """Return how many times are within those of the path."""
        return int(np.count_nonzero(self._is_on(times_s)))

    def _is_on(self, times_s: Array) -> Mask:
        return np.asarray((times_s >= self.times_s[0]) & (times_s <= self.times_s[-1]))

    def misfit_m(self, times_s: Array, position_m: Array) -> float:
        """Return the root mean square distance of positions from a similar path, without a share of the farthest."""
        on = self._is_on(times_s)
        if on.sum() < _MIN_NUM:
            return np.inf
        places, arms_m = (self._at(values, times_s[on]) for values in (self.centers, self.arms_m))
        fit, targets = align_points(places, position_m[on]), position_m[on]
        near = np.ones(len(targets), dtype=bool)
        for _ in range(2):
            targets = position_m[on] - arms_m @ fit.rotation.T
            fit = align_points(places[near], targets[near])
            off = np.linalg.norm(fit.apply(places) - targets, axis=1)
            near = off <= np.quantile(off, 1 - _MOST_OUTLYING)
            near = near if near.sum() >= _MIN_NUM else np.ones(len(targets), dtype=bool)
        return float(np.sqrt(np.mean(off[near] ** 2)))

    def _at(self, values: Array, times_s: Array) -> Array:
        return np.column_stack([np.interp(times_s, self.times_s, values[:, axis]) for axis in range(3)])


def _search(times_s: Array, position_m: Array, antenna: _MovingAntenna) -> tuple[float, float]:
    """Return the time offset with the best fit of a similarity, and its standard deviation.

    Raises:
        GeometryError: too few positions and keyframes have a moment in common, or the antenna did not move.
    """
    photo_times_s, num = antenna.times_s, len(times_s)
    if min(num, len(photo_times_s)) < _MIN_NUM or not (are_apart(antenna.centers) and are_apart(position_m)):
        raise GeometryError(
            f"the time offset of the positions is not determined: {num} positions, {len(photo_times_s)} keyframes"
        )
    some = np.unique(np.linspace(0, num - 1, min(num, _NUM_SEARCHED)).astype(np.int64))
    low, high = photo_times_s[0] - times_s[-1], photo_times_s[-1] - times_s[0]
    step = max(_STEP * float(np.median(np.diff(photo_times_s))), (high - low) / _MAX_NUM_TRIED)
    offsets = np.arange(low, high, step)
    nums = np.array([antenna.num_on(times_s[some] + offset) for offset in offsets.tolist()])
    enough = max(_MIN_COVERAGE * float(nums.max(initial=0)), _MIN_NUM)
    costs = np.array(
        [
            antenna.misfit_m(times_s[some] + offset, position_m[some]) if on >= enough else np.inf
            for offset, on in zip(offsets.tolist(), nums.tolist(), strict=True)
        ]
    )
    if not np.isfinite(costs).any():
        why = "hardly any lie within the photos' times"
        raise GeometryError(f"the time offset of the positions is not determined: {why}")
    best = float(offsets[int(np.argmin(costs))])
    for _ in range(_NUM_REFINED):
        before, now, after = (antenna.misfit_m(times_s + best + by, position_m) for by in (-step, 0.0, step))
        curvature = before - 2 * now + after
        moved = 0.5 * step * (before - after) / curvature if curvature > 0 else 0.0
        best, step = best + float(np.clip(moved, -step, step)), step / 2
    # An error of the offset shifts all positions along the path, by the speed. Errors that last for seconds leave one
    # independent position in each stretch of time.
    speed = float(np.median(np.linalg.norm(np.diff(position_m, axis=0), axis=1) / np.diff(times_s)))
    stretches = max(float(times_s[-1] - times_s[0]) / STRETCH_S, 1.0)
    return best, antenna.misfit_m(times_s + best, position_m) / max(speed, 1e-6) / np.sqrt(min(stretches, num))
