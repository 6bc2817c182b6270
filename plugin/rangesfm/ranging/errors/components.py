"""What ranges get wrong: the components of their errors, each with what the population of radios lets expect of it.

An error of two cells is covariant as their anchors, places, directions, distances and times are alike. Each survey
learns its own stddevs on top of what the population shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.cells import Cells
from rangesfm.ranging.errors.population import population

_SHORT_M = 1.0
_TIME_S = 3.0
# As a warming radio has it.
_DRIFT_S = 60.0
# Of the tag's place, and of 1 minus the cosine between directions in the camera: as echoes and antennas' lobes have it.
_PLACE_M, _LOBE = 0.5, 0.1
# Radians away from the way an anchor faces.
_OFF_AXIS_RAD = 1.0
# In logarithms of distance.
_SMOOTH, _ROUGH = 1.0, 0.5
_MIN_DISTANCE_M = 0.05
# Of the time a path takes, within which it bends one way.
_BEND = 0.125


@dataclass(frozen=True)
class Component:
    """One way in which ranges err.

    Attributes:
        name: of its stddev in ``result.json``.
        median: stddev, metres (``slope``: share of the distance), over radios.
        spread: stddev of the logarithm of that over radios.
        calibrated_median: the same once a learnt error curve is taken off: its change from one day, mounting and
            room to the next. None: no matter.
        is_of_anchor: whether each anchor has it for itself, more where its ranges are noisier.
        correlation: (c, c) of cells, for a stddev of 1.
        words: for people.
    """

    name: str
    median: float
    spread: float
    calibrated_median: float | None
    is_of_anchor: bool
    correlation: Callable[[Cells], Array]
    words: str


def _same(labels: Indices) -> Array:
    return np.asarray((labels[:, None] == labels).astype(np.float64))


def _same_link(cells: Cells) -> Array:
    return _same(cells.anchor_index) * _same(cells.tag_index)


def _apart(values: Array) -> Array:
    return np.abs(values[:, None] - values)


def _in_time(cells: Cells) -> Array:
    return np.exp(-_apart(cells.time_s) / _TIME_S) * _same_link(cells)


def _drifting(cells: Cells) -> Array:
    return np.exp(-_apart(cells.time_s) / _DRIFT_S) * _same(cells.tag_index)


def _in_place(cells: Cells) -> Array:
    places_m = cells.distance_m[:, None] * cells.from_anchor
    return np.asarray(np.exp(-cdist(places_m, places_m) / _PLACE_M) * _same_link(cells))


def _in_view(cells: Cells) -> Array:
    return np.exp((cells.in_cam @ cells.in_cam.T - 1) / _LOBE) * _same_link(cells)


def _log_distance(distance_m: Array) -> Array:
    return np.log(np.maximum(distance_m, _MIN_DISTANCE_M))


def alike_by_distance(distance_m: Array) -> Array:
    """(c, c) of a random function, smooth in the logarithm of (c,) distances."""
    return np.exp(-0.5 * (_apart(_log_distance(distance_m)) / _SMOOTH) ** 2)


def _smooth(cells: Cells) -> Array:
    return alike_by_distance(cells.distance_m)


def _rough(cells: Cells) -> Array:
    return np.exp(-_apart(_log_distance(cells.distance_m)) / _ROUGH)


def _short(cells: Cells) -> Array:
    shortness = np.exp(-cells.distance_m / _SHORT_M)
    return np.outer(shortness, shortness)


def alike_by_direction(directions: Array) -> Array:
    """Of a random polynomial of the direction, half of its variance linear and half quadratic in the unit vector."""
    cosine = directions @ directions.T
    return cosine / 2 + (3 * cosine**2 - 1) / 4


def _white(cells: Cells) -> Array:
    return np.diag(1 / np.maximum(cells.worth, 1e-6))


def _proportional(cells: Cells) -> Array:
    return np.outer(cells.distance_m, cells.distance_m)


def _antenna(cells: Cells) -> Array:
    return _same(cells.anchor_index) * alike_by_direction(cells.from_anchor)


def _tag_antenna(cells: Cells) -> Array:
    return _same(cells.tag_index) * alike_by_direction(cells.in_cam)


def _off_axis(cells: Cells) -> Array:
    """Anchors face the path: of one make, they are late alike towards where they do not face."""
    same = _same(cells.anchor_index)
    facing = same @ cells.from_anchor
    cosine = np.sum(cells.from_anchor * facing, axis=1) / np.maximum(np.linalg.norm(facing, axis=1), 1e-9)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.exp(-0.5 * (_apart(angle) / _OFF_AXIS_RAD) ** 2)


def _bending(cells: Cells) -> Array:
    length_s = max(_BEND * float(np.ptp(cells.time_s)), 1e-9)
    return (cells.from_anchor @ cells.from_anchor.T) * np.exp(-_apart(cells.time_s) / length_s)


def components(expected: Mapping[str, tuple[float, float]]) -> tuple[Component, ...]:
    """All of them, with median and spread over radios by name."""

    def of(
        name: str,
        correlation: Callable[[Cells], Array],
        words: str,
        *,
        is_of_anchor: bool = False,
        calibrated_median: float | None = None,
    ) -> Component:
        median, spread = expected[name]
        return Component(name, median, spread, calibrated_median, is_of_anchor, correlation, words)

    return (
        of("white", _white, "noise of single ranges", is_of_anchor=True),
        of("time", _in_time, "errors that last for seconds", is_of_anchor=True),
        of("drift", _drifting, "slow drift of the radio, alike to all anchors"),
        of("place", _in_place, "errors that belong to a place: echoes", is_of_anchor=True),
        of("view", _in_view, "lobes of the tag's antenna towards each anchor", is_of_anchor=True),
        of("bias", lambda c: _same(c.anchor_index), "each anchor's own bias", is_of_anchor=True),
        of("common_bias", lambda c: np.ones((len(c), len(c))), "the bias of all ranges", calibrated_median=0.04),
        of("short", _short, "short ranges", calibrated_median=0.08),
        of("curve", _smooth, "the radio's error curve", calibrated_median=0.02),
        of("rough_curve", _rough, "unevenness of the error curve", calibrated_median=0.005),
        of("slope", _proportional, "ranges long by a share", calibrated_median=0.003),
        of("antenna", _antenna, "anchors' antennas by direction", is_of_anchor=True),
        of("off_axis", _off_axis, "anchors' antennas, alike, away from the path's middle"),
        of("tag_antenna", _tag_antenna, "the tag's antenna by direction"),
        of("bending", _bending, "the map's own bending"),
    )


COMPONENTS = components(population())

LEARNT_CURVE = "learnt_curve"
"""What is left of an error curve that has been taken off, as it was learnt with it."""

GIVEN = "given"
"""No component of the ranges' errors: what is known beforehand of the map and the anchors."""


REWEIGHTING = "reweighting"
"""None either: by how much the best weights for these errors would change the scale."""


CLOCKS = "clocks"
"""None either: by how far the clocks' offset may be another."""


def component_words(names: Iterable[str]) -> dict[str, str]:
    """What each component is, for people."""
    words = {component.name: component.words for component in COMPONENTS}
    words |= {
        LEARNT_CURVE: "the learnt error curve",
        GIVEN: "tapes, anchors' positions and what else was given",
        REWEIGHTING: "what the best weights for these errors would change",
        CLOCKS: "the clocks' offset, as far as the motion leaves it open",
        "tape": "how the lengths were measured",
        "marks": "where their ends are in the photos",
    }
    return {name: words[name] for name in names}
