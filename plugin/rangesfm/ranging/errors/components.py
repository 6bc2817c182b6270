"""What ranges get wrong: the components of their errors, each with what the population of radios lets expect of it.

An error of two cells is covariant as their anchors, places, directions, distances and times are alike. Each survey
learns its own stddevs on top of what the population shows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.range_bins import Cells

_SHORT_M = 1.0
_TIME_S = 3.0
# As a warming radio has it.
_DRIFT_S = 60.0
# Of the tag's place, and of 1 minus the cosine between directions in the camera: as echoes and antennas' lobes have it.
_PLACE_M, _LOBE = 0.5, 0.1
# Radians away from the way an anchor faces.
_OFF_AXIS_RAD = 1.0
# In logarithms of distance.
_SMOOTH = 1.0
_MIN_DISTANCE_M = 0.05
# Metres (slope: share of the distance), as learnt against the true distances from one start for all, by
# ``python -m tests.studies.shown_errors``. A dash stands where a log has one tag, whose bias is that of all ranges. The
# logs are those of ``examples/radios.md``.
_SHOWN = """
log         room_env1 room_calibration starloc_s5 rcv_sequence1 rcv_sequence3 lias_mid plaza1 starloc_fast_s1
radio       room      room             starloc    rcv           rcv           lias     plaza  starloc_fast
white       0.057     0.031            0.043      0.025         0.037         0.083    0.359  0.094
time        0.011     0.028            0.011      0.006         0.004         0.007    0.003  0.008
drift       0.014     0.008            0.006      0.007         0.005         0.005    0.002  0.006
place       0.015     0.025            0.011      0.050         0.046         0.017    0.003  0.011
view        0.038     0.043            0.024      0.053         0.023         0.009    0.002  0.042
bias        0.033     0.025            0.029      0.040         0.027         0.047    0.012  0.035
tag_bias    -         -                -          -             -             0.029    -      0.037
common_bias 0.146     0.136            0.157      0.206         0.203         0.168    0.125  0.190
short       0.260     0.265            0.168      0.152         0.170         0.183    0.200  0.161
curve       0.034     0.037            0.050      0.042         0.034         0.038    0.017  0.035
slope       0.0049    0.0040           0.0045     0.0040        0.0040        0.0036   0.0032 0.0054
antenna     0.035     0.049            0.024      0.025         0.023         0.026    0.005  0.028
off_axis    0.080     0.051            0.040      0.040         0.042         0.038    0.020  0.039
tag_antenna 0.033     0.029            0.021      0.023         0.018         0.036    0.008  0.021
"""
_NOT_SHOWN = "-"
LOGS = tuple(_SHOWN.split()[1:9])
# Of the logarithms: eight logs do not show how alike other radios are.
_LEAST_SPREAD = 0.5


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


def _fading(values: Array, within: float) -> Array:
    """(c, c) of a random function of (c,) values, rough at any scale."""
    return np.exp(-np.abs(values[:, None] - values) / within)


def _smooth(values: Array, within: float) -> Array:
    """The same of a smooth one."""
    return np.exp(-0.5 * (np.abs(values[:, None] - values) / within) ** 2)


def _log_distance(cells: Cells) -> Array:
    return np.log(np.maximum(cells.distance_m, _MIN_DISTANCE_M))


def _in_place(cells: Cells) -> Array:
    places_m = cells.distance_m[:, None] * cells.from_anchor
    return np.asarray(np.exp(-cdist(places_m, places_m) / _PLACE_M) * _same_link(cells))


def _short(cells: Cells) -> Array:
    shortness = np.exp(-cells.distance_m / _SHORT_M)
    return np.outer(shortness, shortness)


def _by_direction(directions: Array) -> Array:
    """Of a random polynomial of the direction, half of its variance linear and half quadratic in the unit vector."""
    cosine = directions @ directions.T
    return cosine / 2 + (3 * cosine**2 - 1) / 4


def _off_axis(cells: Cells) -> Array:
    """Anchors face the path: of one make, they are late alike towards where they do not face."""
    same = _same(cells.anchor_index)
    facing = same @ cells.from_anchor
    cosine = np.sum(cells.from_anchor * facing, axis=1) / np.maximum(np.linalg.norm(facing, axis=1), 1e-9)
    return _smooth(np.arccos(np.clip(cosine, -1.0, 1.0)), _OFF_AXIS_RAD)


def components(expected: Mapping[str, tuple[float, float]]) -> tuple[Component, ...]:
    """All of them, with median and spread over radios by name."""

    def of(
        name: str,
        words: str,
        correlation: Callable[[Cells], Array],
        *,
        is_of_anchor: bool = False,
        calibrated_median: float | None = None,
    ) -> Component:
        return Component(name, *expected[name], calibrated_median, is_of_anchor, correlation, words)

    of_anchor = functools.partial(of, is_of_anchor=True)
    return (
        of_anchor("white", "noise of single ranges", lambda c: np.diag(1 / np.maximum(c.worth, 1e-6))),
        of_anchor("time", "errors that last for seconds", lambda c: _fading(c.time_s, _TIME_S) * _same_link(c)),
        of(
            "drift",
            "slow drift of the radio, alike to all anchors",
            lambda c: _fading(c.time_s, _DRIFT_S) * _same(c.tag_index),
        ),
        of_anchor("place", "errors that belong to a place: echoes", _in_place),
        of_anchor(
            "view",
            "lobes of the tag's antenna towards each anchor",
            lambda c: np.exp((c.in_cam @ c.in_cam.T - 1) / _LOBE) * _same_link(c),
        ),
        of_anchor("bias", "each anchor's own bias", lambda c: _same(c.anchor_index)),
        of("tag_bias", "each tag's own bias", lambda c: _same(c.tag_index)),
        of("common_bias", "the bias of all ranges", lambda c: np.ones((len(c), len(c))), calibrated_median=0.04),
        of("short", "short ranges", _short, calibrated_median=0.08),
        of("curve", "the radio's error curve", lambda c: _smooth(_log_distance(c), _SMOOTH), calibrated_median=0.02),
        of("slope", "ranges long by a share", lambda c: np.outer(c.distance_m, c.distance_m), calibrated_median=0.003),
        of_anchor(
            "antenna",
            "anchors' antennas by direction",
            lambda c: _same(c.anchor_index) * _by_direction(c.from_anchor),
        ),
        of("off_axis", "anchors' antennas, alike, away from the path's middle", _off_axis),
        of("tag_antenna", "the tag's antenna by direction", lambda c: _same(c.tag_index) * _by_direction(c.in_cam)),
    )


def stddevs_in(log: str) -> dict[str, float]:
    """Of each component, as one of LOGS shows it."""
    _, _, *components = (line.split() for line in _SHOWN.strip().splitlines())
    of_log = {name: sizes[LOGS.index(log)] for name, *sizes in components}
    return {name: float(size) for name, size in of_log.items() if size != _NOT_SHOWN}


def population(without: str | None = None) -> dict[str, tuple[float, float]]:
    """Median of each component's stddev, and stddev of its logarithm, over the logs.

    Args:
        without: a log; all of its radio are left out.
    """
    logs, radios, *components = (line.split() for line in _SHOWN.strip().splitlines())
    left_out = None if without is None else radios[logs.index(without)]
    kept = [i for i, radio in enumerate(radios) if i > 0 and radio != left_out]
    of_components = {}
    for name, *sizes in components:
        shown = np.log([float(sizes[i - 1]) for i in kept if sizes[i - 1] != _NOT_SHOWN])
        spread = float(shown.std(ddof=1)) if len(shown) > 1 else 0.0
        of_components[name] = float(np.exp(shown.mean())), max(spread, _LEAST_SPREAD)
    return of_components


COMPONENTS = components(population())

BENDS = {
    "scale_drift": "the map's scale, drifting along the path",
    "heading_drift": "the map's heading, drifting along the path",
    "bending": "the map's own bending",
}
"""Components that are the map's, not the ranges', with words for people: what it does to them depends on the map."""

LEARNT_CURVE = "learnt_curve"
"""What is left of an error curve that has been taken off, as it was learnt with it."""

GIVEN = "given"
"""No component of the ranges' errors: what is known beforehand of the map and the anchors."""


REWEIGHTING = "reweighting"
"""None either: by how much the best weights for these errors would change the scale."""


CLOCKS = "clocks"
"""None either: by how far the clocks' offset may be another."""


PLACES = "places"
"""Not a component of the ranges' errors: the uncertainty of the camera's places, of keyframes and between them."""


def component_words(names: Iterable[str]) -> dict[str, str]:
    """What each component is, for people."""
    words = {component.name: component.words for component in COMPONENTS} | BENDS
    words |= {
        LEARNT_CURVE: "the learnt error curve",
        GIVEN: "tapes, anchors' positions and what else was given",
        REWEIGHTING: "what the best weights for these errors would change",
        CLOCKS: "the clocks' offset, as far as the motion leaves it open",
        PLACES: "the camera's places at and between the photos",
        "tape": "how the lengths were measured",
        "marks": "where their ends are in the photos",
    }
    return {name: words[name] for name in names}
