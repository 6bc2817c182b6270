"""Paths of a camera for tests and studies: a walk around a place, an orbit, a way that never returns, a rover's lap.

World z is up. Camera frame as in COLMAP: x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rangesfm.demo.simulated_radio import CameraPath

FloatArray = npt.NDArray[np.float64]

# How far the ground of a lap goes up and down.
UNEVENNESS_M = 0.15


def look_at(centers_m: FloatArray, targets_m: FloatArray, roll_deg: FloatArray | float = 0.0) -> FloatArray:
    """(n, 3, 3) world_from_cam of upright cameras that look from (n, 3) to (n, 3), then rolled clockwise."""
    forward = targets_m - centers_m
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    upright = np.stack([right, np.cross(forward, right), forward], axis=2)
    roll = np.zeros((len(centers_m), 3))
    roll[:, 2] = np.radians(roll_deg)
    return np.asarray(upright @ Rotation.from_rotvec(roll).as_matrix())


def along(path: CameraPath, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (n,), centres (n, 3) and world_from_cam (n, 3, 3) of photos on a path, for ``synthetic_model``."""
    return times, path.centers(times), path.world_from_cam(times)


def loop_path(
    duration_s: float,
    *,
    start_s: float = 0.0,
    center_m: Sequence[float] = (0.0, 0.0, 1.6),
    semi_axes_m: tuple[float, float] = (4.0, 3.0),
    height_amplitude_m: float = 0.35,
    num_turns: float = 1.15,
    start_deg: float = 0.0,
    unsteadiness_m: float = 0.05,
    seed: int = 0,
) -> CameraPath:
    """A hand-held walk around ``center_m``, looking across it; after one turn, the same places are seen again.

    Args:
        duration_s: of the walk.
        start_s: when it starts.
        center_m: middle of the loop, at the mean height of the camera.
        semi_axes_m: of the ellipse, along x and y.
        height_amplitude_m: how far the camera goes up and down, about 1.5 times a turn.
        num_turns: of the walk, counter-clockwise.
        start_deg: direction of the start from the centre, from x towards y.
        unsteadiness_m: stddev of the slow sway; the viewing direction sways accordingly.
        seed: of the sway.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, duration_s, max(8, round(duration_s / 2.5)))
    angle = np.radians(start_deg) + 2 * np.pi * num_turns * times / duration_s
    wave = np.sin(1.5 * angle)
    shape = np.stack(
        [semi_axes_m[0] * np.cos(angle), semi_axes_m[1] * np.sin(angle), height_amplitude_m * wave], axis=1
    )
    centers = np.asarray(center_m) + shape + unsteadiness_m * rng.standard_normal(shape.shape)
    # The camera looks at points beyond the middle that wander left, right, up and down.
    across = np.asarray(center_m) - 0.25 * shape * [1, 1, 0]
    stray = np.stack([0.25 * np.sin(2.1 * angle), 0.25 * np.cos(1.7 * angle), -0.09 + 0.05 * wave], axis=1)
    targets = across + stray * np.linalg.norm(semi_axes_m)
    targets += 2 * unsteadiness_m * rng.standard_normal(targets.shape)
    rolls = 20 * unsteadiness_m * rng.standard_normal(len(times))
    return CameraPath.through(start_s + times, centers, look_at(centers, targets, rolls))


def orbit_path(duration_s: float, *, radius_m: float = 5.0, height_amplitude_m: float = 1.0) -> CameraPath:
    """A steady circle around the origin, rising and falling, looking at the middle."""
    return loop_path(
        duration_s,
        center_m=(0.0, 0.0, 0.0),
        semi_axes_m=(radius_m, radius_m),
        height_amplitude_m=height_amplitude_m,
        num_turns=1.0,
        unsteadiness_m=0.0,
    )


def sequence_path(duration_s: float, *, speed_m_per_s: float = 1.0, seed: int = 0) -> CameraPath:
    """A way that never returns: ahead along x in bends, over low hills, looking ahead.

    Args:
        duration_s: from time 0.
        speed_m_per_s: constant.
        seed: of the bends; the heading wanders around the x axis with a stddev of 12 degrees.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, duration_s, max(8, round(duration_s / 4)))
    heading = np.radians(12.0) * rng.standard_normal(len(times))
    climb = 0.05 * rng.standard_normal(len(times))
    direction = CubicSpline(times, np.stack([np.cos(heading), np.sin(heading), climb], axis=1))
    position = direction.antiderivative()
    centers = speed_m_per_s * position(times)
    return CameraPath.through(times, centers, look_at(centers, centers + direction(times)))


def lap_path(
    duration_s: float,
    *,
    size_m: tuple[float, float] = (105.0, 68.0),
    corner_radius_m: float = 8.0,
    share: float = 0.98,
) -> CameraPath:
    """A rover's lap around a soccer field, looking ahead; it ends before it sees the start again.

    The camera is 1 m above uneven ground.

    Args:
        duration_s: from time 0, at constant speed.
        size_m: of the field along x and y; its middle is the origin, and the first side runs along +x at -y.
        corner_radius_m: of the turns.
        share: of the lap; more than 1 goes around again.
    """
    sides = [size - 2 * corner_radius_m for size in size_m] * 2
    corner = 0.5 * np.pi * corner_radius_m
    ends = np.cumsum([length for side in sides for length in (side, corner)])
    way = np.linspace(0.0, ends[-1], 20000)
    is_corner = np.searchsorted(ends, way, side="right") % 2 == 1
    heading = np.concatenate([[0.0], np.cumsum(np.diff(way) * is_corner[1:])]) / corner_radius_m
    steps = np.diff(way)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])[1:]
    plan = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) - [0.5 * sides[0], 0.5 * size_m[1]]
    times = np.linspace(0.0, duration_s, max(8, round(duration_s)))
    at = share * ends[-1] * times / duration_s
    x, y, turn = (np.interp(at % ends[-1], way, values) for values in (plan[:, 0], plan[:, 1], heading))
    wave = at / corner_radius_m
    centers = np.column_stack([x, y, 1.0 + UNEVENNESS_M * np.sin(wave)])
    climb = UNEVENNESS_M / corner_radius_m * np.cos(wave)
    ahead = np.column_stack([np.cos(turn), np.sin(turn), climb])
    return CameraPath.through(times, centers, look_at(centers, centers + ahead))
