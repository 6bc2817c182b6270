"""Placement of anchors: anchors are moved one at a time to the allowed place that most improves scale and position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.planning.expected import expect_roughly
from rangesfm.planning.paths import places_on_way, way_along
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.progress import SILENT, Progress
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS
from rangesfm.util.processes.threads import with_one_blas_thread

# Numbers of places along x, y and z of a box. As many are tried along all walls together, at two heights.
_GRID = (4, 4, 2)
LEAST_GAIN = 0.02
"""Smallest relative reduction of a standard deviation for which a change of a plan is worth the trouble."""


def places_in_box(low_m: Sequence[float], high_m: Sequence[float]) -> Array:
    """Return a grid of different places (k, 3) in a box, which may be flat.

    Args:
        low_m, high_m: two opposite corners (3,), metres.
    """
    axes = [np.unique(np.linspace(a, b, num)) for a, b, num in zip(low_m, high_m, _GRID, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def places_on_walls(walls_m: Sequence[Sequence[Sequence[float]]], heights_m: tuple[float, float]) -> Array:
    """Return places (k, 3) evenly spaced along walls, at two heights.

    Args:
        walls_m: walls, each a list of corners (2,) as seen from above, metres.
        heights_m: the two heights, metres.
    """
    walls = [np.array(wall, dtype=np.float64) for wall in walls_m]
    ways = [way_along(wall) for wall in walls]
    along_x, along_y, _ = _GRID
    step = sum(way[-1] for way in ways) / (along_x * along_y)
    spots = []
    for wall, way in zip(walls, ways, strict=True):
        at = np.linspace(0.0, way[-1], max(round(way[-1] / step), 1) + 1)
        spots.append(places_on_way(at, way, wall))
    # A closed wall has the same first and last place.
    distinct = np.unique(np.round(np.vstack(spots), 6), axis=0)
    return np.vstack([np.insert(distinct, 2, height, axis=1) for height in heights_m])


def spread_places(num: int, places: Array) -> Array:
    """Choose places (num, 3), each as far as possible from those chosen before."""
    chosen = [0]
    while len(chosen) < num:
        distances = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distances)))
    return places[chosen]


def spread_anchors(num: int, places: Array, stddev_m: float) -> tuple[Anchor, ...]:
    """Return anchors P1, P2, ... at places as far apart as possible."""
    return tuple(Anchor(f"P{k}", place, stddev_m) for k, place in enumerate(spread_places(num, places), 1))


@with_one_blas_thread
def place_anchors(planned: PlannedSurvey, progress: Progress = SILENT) -> PlannedSurvey:
    """Return the survey with its anchors moved to improve scale and position; the result is a local optimum.

    One anchor after the other is tried at every allowed place (Fedorov's exchange). The product of the scale's relative
    standard deviation and the least certain keyframe's standard deviation is minimized, or the first alone if the map
    is not placed in the site.
    """
    if planned.is_placed or not len(planned.allowed_m):
        return planned
    best = _badness(planned)
    progress.stage("placing anchors")
    num_anchors = len(planned.anchors)
    for turn in range(MAX_NUM_ROUNDS):
        before = best
        for k in range(num_anchors):
            progress.update(turn * num_anchors + k)
            for place in planned.allowed_m:
                if np.linalg.norm(planned.anchors_m - place, axis=1).min() == 0:
                    continue
                tried = planned.with_anchor_at(k, place)
                badness = _badness(tried)
                if badness < best - LEAST_GAIN:
                    planned, best = tried, badness
        if best == before:
            break
    return planned


def _badness(planned: PlannedSurvey) -> float:
    """Return the sum of the logarithms of both standard deviations; that of the position is at most the site's size."""
    try:
        expected = expect_roughly(planned)
    except GeometryError:  # a run will find too few ranges
        return np.inf
    size_m = float(np.linalg.norm(np.ptp(planned.places_m, axis=0)))
    place_m = expected.worst_keyframe_m
    of_place = 0.0 if np.isnan(place_m) else float(np.log(min(place_m, size_m)))
    return float(np.log(expected.uncertainty.empirical)) + of_place
