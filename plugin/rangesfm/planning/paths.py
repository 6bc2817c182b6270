"""Planned camera paths: through waypoints, around a floor, along a recorded trajectory, or from an earlier model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, OptionError
from rangesfm.measurements.positions.true_positions import read_true_positions
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import UNDETERMINED
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

# A plan of more would take minutes.
_MAX_NUM_KEYFRAMES = 20_000
# Size of a loop relative to its floor.
_LOOP_SHARE = 2 / 3
# Distance between waypoints of a loop.
_LOOP_STEP_M = 0.25
NUM_WAVES = 3
"""Number of the waves of a path that goes up and down."""


def path_through(
    waypoints: Sequence[Sequence[float]],
    speed_m_per_s: float,
    photo_rate_hz: float,
    num_rounds: int = 1,
    turn_deg_per_s: float = 30.0,
) -> Trajectory:
    """Return a walk along straight lines between waypoints, with an upright camera that looks ahead.

    Corners are walked as people walk them: place and heading are means over the time that the sharpest turn takes. So
    corners are rounded off, and the camera turns evenly from one line to the next.

    Args:
        waypoints: points (3,), metres, z up.
        speed_m_per_s: speed of the walk; it is lower in corners.
        photo_rate_hz: keyframes per second.
        num_rounds: number of times that the waypoints are walked.
        turn_deg_per_s: angular velocity in the sharpest turn.
    """
    corners = np.array(waypoints, dtype=np.float64).reshape(-1, 3)
    if len(corners):
        corners = np.vstack([corners] * num_rounds)
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    if not steps.sum() > 0:
        raise OptionError("[path] waypoints go nowhere, expected two different places or more", "path", "waypoints")
    corners = corners[np.append(True, steps > 0)]
    way = way_along(corners)
    num = int(way[-1] / speed_m_per_s * photo_rate_hz) + 1
    _require_possible(num)
    times = np.arange(num) / photo_rate_hz
    headings = _headings(np.diff(corners, axis=0))
    turn_s = np.rad2deg(np.abs(np.diff(headings)).max(initial=0.0)) / turn_deg_per_s
    # A mean over a much shorter part of the way would be a difference of nearly equal numbers.
    half_m = max(speed_m_per_s * turn_s / 2, UNDETERMINED * float(way[-1]))
    centers, heading = _means_on_way(speed_m_per_s * times, half_m, way, corners, headings)
    return _trajectory(times, centers, _looking(heading))


def _means_on_way(at: Array, half_m: float, way: Array, corners: Array, headings: Array) -> tuple[Array, Array]:
    """Return the mean places (k, 3) and headings (k,) over parts of a way, standing still before and after it.

    Args:
        at: (k,) middles of the parts. half_m: half their length. way, corners, headings: (n,), (n, 3), (n - 1,).
    """
    way = np.concatenate([way[:1] - half_m, way, way[-1:] + half_m])
    # Relative to the first one, what does not change is exact.
    first, facing = corners[0], headings[0]
    corners = np.vstack([corners[:1], corners, corners[-1:]]) - first
    headings = np.concatenate([headings[:1], headings, headings[-1:]]) - facing
    # Integrals from the beginning: the place is linear between corners, and the heading is constant.
    legs = np.diff(way)[:, None] * np.column_stack([(corners[:-1] + corners[1:]) / 2, headings])
    to_corner = np.vstack([np.zeros(4), np.cumsum(legs, axis=0)])
    ends = np.concatenate([at - half_m, at + half_m])
    leg = np.clip(np.searchsorted(way, ends, side="right") - 1, 0, len(legs) - 1)
    middles = (corners[leg] + places_on_way(ends, way, corners)) / 2
    to_end = to_corner[leg] + (ends - way[leg])[:, None] * np.column_stack([middles, headings[leg]])
    means = (to_end[len(at) :] - to_end[: len(at)]) / (2 * half_m)
    return first + means[:, :3], facing + means[:, 3]


def way_along(corners: Array) -> Array:
    """Return the distances (n,) from the first of n corners to each, along the straight lines between them."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))


def places_on_way(at: Array, way: Array, corners: Array) -> Array:
    """Return the points (k, d) at distances ``at`` (k,) along corners (n, d), whose own distances are ``way`` (n,)."""
    return np.column_stack([np.interp(at, way, column) for column in corners.T])


def loop_inside(corners_m: Sequence[Sequence[float]], heights_m: tuple[float, float]) -> list[tuple[float, ...]]:
    """Return waypoints of a loop inside a floor, which goes up and down three times between two heights.

    The loop is the floor's outline, shrunk towards the outline's centroid.

    Args:
        corners_m: corners (2,) of the floor, in order.
        heights_m: lowest and highest height, metres.
    """
    corners = np.array(corners_m, dtype=np.float64)
    closed = np.vstack([corners, corners[:1]])
    sides = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    way = way_along(closed)
    at = np.linspace(0.0, way[-1], max(int(_LOOP_SHARE * way[-1] / _LOOP_STEP_M), 4 * NUM_WAVES) + 1)
    outline = places_on_way(at, way, closed)
    middle = sides @ (closed[:-1] + closed[1:]) / (2 * max(float(way[-1]), 1e-9))
    low, high = heights_m
    heights = (low + high) / 2 + (high - low) / 2 * np.sin(2 * np.pi * NUM_WAVES * at / max(float(way[-1]), 1e-9))
    return [tuple(place) for place in np.insert(middle + _LOOP_SHARE * (outline - middle), 2, heights, axis=1).tolist()]


def path_from_file(path: Path, photo_rate_hz: float) -> Trajectory:
    """Read a recorded trajectory, thinned to a rate of keyframes.

    Raises:
        InputError: the file has no times or no rotations, or is not valid.
    """
    recorded = read_true_positions(path)
    if isinstance(recorded.moments, ByPhoto) or recorded.world_from_cam is None:
        raise InputError("has no times or no rotations, expected timestamp tx ty tz qx qy qz qw", path)
    times = recorded.moments.timestamp_s
    _, chosen = np.unique(np.floor((times - times[0]) * photo_rate_hz), return_index=True)
    _require_possible(len(chosen))
    return _trajectory(times[chosen] - times[0], recorded.positions_m[chosen], recorded.world_from_cam[chosen])


def path_from_model(path: Path, photo_rate_hz: float) -> Trajectory:
    """Return the keyframes of a metric model in the site frame, in the order of their names, evenly spaced in time."""
    from rangesfm.colmap.model_files import read_model

    found = trajectory_from_reconstruction(read_model(path))
    _require_possible(len(found))
    return _trajectory(np.arange(len(found)) / photo_rate_hz, found.centers, found.world_from_cam)


def _require_possible(num_keyframes: int) -> None:
    if num_keyframes > _MAX_NUM_KEYFRAMES:
        message = f"[path] has {num_keyframes} keyframes, expected at most {_MAX_NUM_KEYFRAMES} (photo_rate_hz)"
        raise OptionError(message, "path", "photo_rate_hz")


def _trajectory(times: Array, centers: Array, world_from_cam: Array) -> Trajectory:
    num = len(times)
    names = tuple(f"{number:06d}" for number in range(num))
    return Trajectory(np.arange(1, num + 1), names, times, centers, world_from_cam)


def _headings(legs: Array) -> Array:
    """Return the headings (n,) of straight lines (n, 3): radians from x towards y, from each to the next the short way.

    A vertical line is walked with the heading of the line before it, or of the first that is not vertical.
    """
    is_level = np.linalg.norm(legs[:, :2], axis=1) > UNDETERMINED * np.linalg.norm(legs, axis=1)
    before = np.maximum.accumulate(np.where(is_level, np.arange(len(legs)), int(np.argmax(is_level))))
    return np.asarray(np.unwrap(np.arctan2(legs[before, 1], legs[before, 0])))


def _looking(headings: Array) -> Array:
    """Return world_from_cam (n, 3, 3) of level cameras that look in these directions (n,), radians from x towards y."""
    forward = np.column_stack([np.cos(headings), np.sin(headings), np.zeros(len(headings))])
    down = np.broadcast_to([0.0, 0.0, -1.0], forward.shape)
    return np.stack([np.cross(down, forward), down, forward], axis=2)
