"""Planned camera paths: through waypoints, around a floor, along a recorded trajectory, or from an earlier model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, OptionError
from rangesfm.geometry.reference import read_reference
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction

_MAX_NUM_KEYFRAMES = 20_000
# Size of a loop relative to its floor.
_LOOP_SHARE = 2 / 3
# Distance between waypoints of a loop, and number of its waves up and down.
_LOOP_STEP_M, _NUM_WAVES = 0.25, 3
# Below this ratio of its horizontal part to its length a direction counts as vertical.
_STEEP = 1e-6


def path_through(
    waypoints: Sequence[Sequence[float]], speed_m_per_s: float, photo_rate_hz: float, num_rounds: int = 1
) -> Trajectory:
    """Return a walk at constant speed along straight lines between waypoints, with an upright camera that looks ahead.

    Args:
        waypoints: points (3,), metres, z up.
        speed_m_per_s: speed of the walk.
        photo_rate_hz: keyframes per second.
        num_rounds: number of times that the waypoints are walked.
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
    at = speed_m_per_s * times
    centers = places_on_way(at, way, corners)
    leg = np.clip(np.searchsorted(way, at, side="right") - 1, 0, len(corners) - 2)
    return _trajectory(times, centers, _looking(np.diff(corners, axis=0)[leg]))


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
    at = np.linspace(0.0, way[-1], max(int(_LOOP_SHARE * way[-1] / _LOOP_STEP_M), 4 * _NUM_WAVES) + 1)
    outline = places_on_way(at, way, closed)
    middle = sides @ (closed[:-1] + closed[1:]) / (2 * max(float(way[-1]), 1e-9))
    low, high = heights_m
    heights = (low + high) / 2 + (high - low) / 2 * np.sin(2 * np.pi * _NUM_WAVES * at / max(float(way[-1]), 1e-9))
    return [tuple(place) for place in np.insert(middle + _LOOP_SHARE * (outline - middle), 2, heights, axis=1).tolist()]


def path_from_file(path: Path, photo_rate_hz: float) -> Trajectory:
    """Read a recorded trajectory, thinned to a rate of keyframes.

    Raises:
        InputError: the file has no times or no rotations, or is not valid.
    """
    recorded = read_reference(path)
    if recorded.timestamps_s is None or recorded.world_from_cam is None:
        raise InputError("has no times or no rotations, expected timestamp tx ty tz qx qy qz qw", path)
    _, chosen = np.unique(
        np.floor((recorded.timestamps_s - recorded.timestamps_s[0]) * photo_rate_hz), return_index=True
    )
    _require_possible(len(chosen))
    times = recorded.timestamps_s[chosen]
    return _trajectory(times - times[0], recorded.positions_m[chosen], recorded.world_from_cam[chosen])


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


def _looking(ahead: Array) -> Array:
    """Return world_from_cam (n, 3, 3) of level cameras that look along the horizontal parts of directions (n, 3)."""
    forward = ahead * [1.0, 1.0, 0.0]
    level = np.linalg.norm(forward, axis=1) > _STEEP * np.linalg.norm(ahead, axis=1)
    forward = np.where(level[:, None], forward, [1.0, 0.0, 0.0])
    forward = forward / np.linalg.norm(forward, axis=1)[:, None]
    down = np.broadcast_to([0.0, 0.0, -1.0], forward.shape)
    return np.stack([np.cross(down, forward), down, forward], axis=2)
