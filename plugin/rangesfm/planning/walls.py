"""Walls of a site as seen from above: what leads through them, and what is outside."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rangesfm.arrays import Array, Mask

AT_WALL_M = 0.3
"""Distance, metres, within which two corners are one, or a place is at a wall, where nobody walks with a camera."""


def lead_through(start: Array, end: Array, walls_m: Sequence[Array]) -> Mask:
    """Return for each of n straight lines whether it crosses a wall.

    Args:
        start, end: (n, 2) ends of the lines. walls_m: corners (k, 2) of each wall.
    """
    crosses = [_cross(start, end, *side) for side in _sides(walls_m)]
    return np.any(crosses, axis=0) if crosses else np.zeros(len(start), dtype=bool)


def are_outside(places: Array, walls_m: Sequence[Array]) -> Mask:
    """Return which places (n, 2) are in none of the rooms that walls enclose, nor at a wall; none without a room."""
    rooms = [wall for wall in walls_m if len(wall) > 3 and np.linalg.norm(wall[0] - wall[-1]) < AT_WALL_M]
    outside = np.full(len(places), bool(rooms))
    for room in rooms:
        # A line to the right crosses the walls around a place an odd number of times.
        num = np.zeros(len(places), dtype=np.int64)
        for (x0, y0), (x1, y1) in itertools.pairwise(room):
            is_beside = (y0 > places[:, 1]) != (y1 > places[:, 1])
            num += is_beside & (places[:, 0] < x0 + (places[:, 1] - y0) * (x1 - x0) / (y1 - y0 if y1 != y0 else 1.0))
        outside &= num % 2 == 0
    for from_, to in _sides(walls_m):
        along = to - from_
        share = np.clip((places - from_) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        outside &= np.linalg.norm(places - from_ - share[:, None] * along, axis=1) > AT_WALL_M
    return outside


def _sides(walls_m: Sequence[Array]) -> Iterator[tuple[Array, Array]]:
    for wall in walls_m:
        yield from itertools.pairwise(wall)


def _cross(start: Array, end: Array, from_: Array, to: Array) -> Mask:
    """Return for each of n straight lines (n, 2) in a plane whether it crosses another one, with ends (2,) each."""

    def side(a: Array, b: Array, point: Array) -> Array:
        (x, y), (dx, dy) = (point - a).T, (b - a).T
        return np.asarray(np.sign(dx * y - dy * x))

    apart = side(start, end, from_) * side(start, end, to) < 0
    return np.asarray(apart & (side(from_, to, start) * side(from_, to, end) < 0))
