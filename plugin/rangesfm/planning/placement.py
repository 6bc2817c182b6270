"""Where to put anchors: places exchanged one by one, over a grid, as long as scale and place gain by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.planning.expected import expect
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.progress import Progress, SilentProgress
from rangesfm.ranging.anchors.anchor import Anchor

# Along x, y and z of the region.
_GRID = (4, 4, 2)
_MAX_NUM_ROUNDS = 4
# Of the sum of two logarithms.
_LEAST_GAIN = 0.01
# Coarse cells are enough to tell places apart.
_NUM_CELLS = 100


def spread_anchors(num: int, low_m: Sequence[float], high_m: Sequence[float], stddev_m: float) -> tuple[Anchor, ...]:
    """As far apart as a grid on the region allows: P1, P2, ..., each farthest from those before."""
    places = _grid(np.array(low_m, dtype=np.float64), np.array(high_m, dtype=np.float64))
    chosen = [0]
    while len(chosen) < num:
        distances = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distances)))
    return tuple(Anchor(f"P{k + 1}", places[row], stddev_m) for k, row in enumerate(chosen))


def place_anchors(planned: PlannedSurvey, progress: Progress | None = None) -> PlannedSurvey:
    """The same survey with its anchors where scale and place are known best, as far as single exchanges get.

    One anchor after the other is tried at every place of a grid on ``region_m`` (Fedorov's exchange); what counts is
    the product of the scale's stddev and that of the keyframe known least, or of the scale alone without a place.

    Raises:
        GeometryError: no place of the anchors determines the scale.
    """
    progress = progress or SilentProgress()
    if planned.region_m is None:
        return planned
    low, high = np.array(planned.region_m, dtype=np.float64)
    places, best = _grid(low, high), _badness(planned)
    progress.stage("placing anchors")
    num_anchors = len(planned.anchors)
    for turn in range(_MAX_NUM_ROUNDS):
        before = best
        for k in range(num_anchors):
            progress.update(turn * num_anchors + k, _MAX_NUM_ROUNDS * num_anchors)
            for place in places:
                if np.linalg.norm(planned.anchors_m - place, axis=1).min() == 0:
                    continue
                moved = replace(planned.anchors[k], position_m=place)
                tried = replace(planned, anchors=(*planned.anchors[:k], moved, *planned.anchors[k + 1 :]))
                badness = _badness(tried)
                if badness < best - _LEAST_GAIN:
                    planned, best = tried, badness
        if best == before:
            break
    if np.isinf(best):
        raise GeometryError("no place of the anchors in region_m determines the scale, with this path")
    return planned


def _badness(planned: PlannedSurvey) -> float:
    """Sum of logarithms; a place that is open is known to the size of the site."""
    try:
        expected = expect(planned, _NUM_CELLS)
    except GeometryError:
        return np.inf
    size_m = float(np.linalg.norm(np.ptp(planned.places_m, axis=0)))
    place_m = expected.worst_keyframe_m
    of_place = 0.0 if np.isnan(place_m) else float(np.log(min(place_m, size_m)))
    return float(np.log(expected.uncertainty.empirical)) + of_place


def _grid(low: Array, high: Array) -> Array:
    """(k, 3), each place once, of a region that may be flat."""
    axes = [np.unique(np.linspace(a, b, num)) for a, b, num in zip(low, high, _GRID, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
