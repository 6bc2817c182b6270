"""The components of the ranges' errors, each with its typical size over a population of radios.

The errors of two bins are correlated if their anchors, places, directions, distances or times are similar. Each survey
learns its own standard deviations, with the population as prior.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from scipy.spatial.distance import cdist

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.errors.noise import SHORT_RANGE_LENGTH_M
from rangesfm.measurements.ranges.errors.range_bins import RangeBins

LASTING_S = 3.0
"""Correlation time of errors that last for seconds."""
DRIFT_S = 60.0
"""Correlation time of slow drift, seconds, as of a warming radio or of moving hands and bodies."""
# Correlation lengths: of errors by the tag's position (metres), as for echoes; of errors by direction in the camera (1
# minus the cosine), as for the lobes of antennas.
_PLACE_M, _LOBE = 0.5, 0.1
MIN_DISTANCE_M = 0.05
"""Distance, metres, below which a tag is at the anchor: its logarithm has no meaning there."""
# Standard deviations in metres (slope: share of the distance), learnt against the true distances, with one start for
# all, by ``python -m tests.studies.shown_errors``. A dash stands where a log has one tag, whose bias is then the common
# bias. The logs are described in ``examples/radios.md``.
_SHOWN = """
log         room_env1 room_calibration starloc_s5 rcv_sequence1 rcv_sequence3 lias_mid plaza1 starloc_fast_s1
radio       room      room             starloc    rcv           rcv           lias     plaza  starloc_fast
white       0.061     0.031            0.043      0.025         0.037         0.083    0.359  0.095
time        0.012     0.027            0.011      0.005         0.004         0.007    0.003  0.008
drift       0.014     0.008            0.006      0.007         0.005         0.005    0.002  0.006
place       0.015     0.023            0.011      0.048         0.046         0.017    0.003  0.011
view        0.039     0.043            0.024      0.052         0.023         0.009    0.002  0.042
bias        0.036     0.024            0.029      0.040         0.027         0.047    0.012  0.035
tag_bias    -         -                -          -             -             0.029    -      0.037
common_bias 0.146     0.145            0.157      0.203         0.203         0.168    0.125  0.190
short       0.249     0.252            0.168      0.152         0.170         0.182    0.200  0.161
curve       0.031     0.037            0.050      0.042         0.034         0.038    0.017  0.035
slope       0.0046    0.0040           0.0045     0.0040        0.0040        0.0036   0.0032 0.0054
antenna     0.033     0.053            0.024      0.024         0.023         0.026    0.005  0.028
off_axis    0.052     0.043            0.040      0.040         0.042         0.038    0.020  0.039
tag_antenna 0.033     0.027            0.021      0.023         0.018         0.036    0.008  0.021
"""
_NOT_SHOWN = "-"
(_, *_LOGS), (_, *_RADIOS), *_ROWS = (line.split() for line in _SHOWN.strip().splitlines())
LOGS = tuple(_LOGS)
# Smallest standard deviation of the logarithms: eight logs do not show how similar other radios are.
_LEAST_SPREAD = 0.5


@dataclass(frozen=True)
class RadioComponent:
    """One component of the errors of ranges.

    Attributes:
        name: of its standard deviation in ``result.json``.
        median: over radios, of its standard deviation in metres (``slope``: share of the distance).
        spread: standard deviation of the logarithm of that over radios.
        calibrated_median: the median after a learnt error curve was subtracted: the change from one day, mounting and
            room to the next; as the median where the calibration makes no difference.
        is_of_anchor: whether it is independent for each anchor, and larger where the anchor's ranges are noisier.
        correlation: returns the (c, c) covariance of bins for a standard deviation of 1.
        words: description for people.
    """

    name: str
    median: float
    spread: float
    calibrated_median: float
    is_of_anchor: bool
    correlation: Callable[[RangeBins], Array]
    words: str

    def calibrated(self, median: float) -> RadioComponent:
        """Return the component with another median after a learnt error curve was subtracted."""
        return replace(self, calibrated_median=median)

    def median_if(self, is_calibrated: bool) -> float:
        """Return the median, also after a learnt error curve was subtracted."""
        return self.calibrated_median if is_calibrated else self.median


def _same(labels: Indices) -> Array:
    return np.asarray((labels[:, None] == labels).astype(np.float64))


def _same_link(bins: RangeBins) -> Array:
    return _same(bins.anchor_index) * _same(bins.tag_index)


def _fading(values: Array, within: float) -> Array:
    """Return the (c, c) covariance of a rough random function of (c,) values (exponential)."""
    return np.exp(-np.abs(values[:, None] - values) / within)


def _smooth(values: Array) -> Array:
    """Return the (c, c) covariance of a smooth random function that changes over a unit of its (c,) values.

    It is a squared exponential. Delays of antennas change over a radian, error curves over an e-fold of the distance.
    """
    return np.exp(-0.5 * (values[:, None] - values) ** 2)


def _log_distance(bins: RangeBins) -> Array:
    return np.log(np.maximum(bins.distance_m, MIN_DISTANCE_M))


def _in_place(bins: RangeBins) -> Array:
    places_m = bins.distance_m[:, None] * bins.from_anchor
    return np.asarray(np.exp(-cdist(places_m, places_m) / _PLACE_M) * _same_link(bins))


def _short(bins: RangeBins) -> Array:
    shortness = np.exp(-bins.distance_m / SHORT_RANGE_LENGTH_M)
    return np.outer(shortness, shortness)


def _by_direction(directions: Array) -> Array:
    """Return the covariance of a random polynomial of the direction, half linear and half quadratic in its variance."""
    cosine = directions @ directions.T
    return cosine / 2 + (3 * cosine**2 - 1) / 4


def _off_axis(bins: RangeBins) -> Array:
    """Return the covariance of delays away from the direction an anchor faces; anchors of one make are alike."""
    same = _same(bins.anchor_index)
    facing = same @ bins.from_anchor
    cosine = np.sum(bins.from_anchor * facing, axis=1) / np.maximum(np.linalg.norm(facing, axis=1), 1e-9)
    return _smooth(np.arccos(np.clip(cosine, -1.0, 1.0)))


def components(expected: Mapping[str, tuple[float, float]]) -> tuple[RadioComponent, ...]:
    """Return all components, given median and spread over radios by name."""

    def component(
        name: str,
        words: str,
        correlation: Callable[[RangeBins], Array],
        *,
        is_of_anchor: bool = False,
    ) -> RadioComponent:
        median, spread = expected[name]
        return RadioComponent(name, median, spread, median, is_of_anchor, correlation, words)

    of_anchor = functools.partial(component, is_of_anchor=True)
    return (
        of_anchor("white", "noise of single ranges", lambda c: np.diag(1 / c.worth)),
        of_anchor("time", "range errors that last for seconds", lambda c: _fading(c.time_s, LASTING_S) * _same_link(c)),
        component(
            "drift",
            "slow drift of the radio, the same to all anchors",
            lambda c: _fading(c.time_s, DRIFT_S) * _same(c.tag_index),
        ),
        of_anchor("place", "range errors that depend on the place, as by reflections", _in_place),
        of_anchor(
            "view",
            "the tag's antenna by direction, fine pattern for each anchor",
            lambda c: np.exp((c.in_cam @ c.in_cam.T - 1) / _LOBE) * _same_link(c),
        ),
        of_anchor("bias", "constant range error of each anchor", lambda c: _same(c.anchor_index)),
        component("tag_bias", "constant range error of each tag", lambda c: _same(c.tag_index)),
        component("common_bias", "constant error of all ranges", lambda c: np.ones((len(c), len(c)))).calibrated(0.04),
        component("short", "errors of short ranges", _short).calibrated(0.08),
        component("curve", "range errors that vary with the distance", lambda c: _smooth(_log_distance(c))).calibrated(
            0.02
        ),
        component(
            "slope", "range errors proportional to the distance", lambda c: np.outer(c.distance_m, c.distance_m)
        ).calibrated(0.003),
        of_anchor(
            "antenna",
            "each anchor's antenna by direction",
            lambda c: _same(c.anchor_index) * _by_direction(c.from_anchor),
        ),
        component("off_axis", "anchors' antennas seen from the side, all alike", _off_axis),
        component(
            "tag_antenna", "the tag's antenna by direction", lambda c: _same(c.tag_index) * _by_direction(c.in_cam)
        ),
    )


def stddevs_in(log: str) -> dict[str, float]:
    """Return the standard deviation of each component, by name, in one of LOGS."""
    of_log = {name: sizes[LOGS.index(log)] for name, *sizes in _ROWS}
    return {name: float(size) for name, size in of_log.items() if size != _NOT_SHOWN}


def population(without: str | None = None) -> dict[str, tuple[float, float]]:
    """Return the median of each component's standard deviation over the logs, and the stddev of its logarithm.

    Args:
        without: a log; all logs of its radio are left out.
    """
    left_out = None if without is None else _RADIOS[LOGS.index(without)]
    kept = [i for i, radio in enumerate(_RADIOS) if radio != left_out]
    of_components = {}
    for name, *sizes in _ROWS:
        shown = np.log([float(sizes[i]) for i in kept if sizes[i] != _NOT_SHOWN])
        spread = float(shown.std(ddof=1)) if len(shown) > 1 else 0.0
        of_components[name] = float(np.exp(shown.mean())), max(spread, _LEAST_SPREAD)
    return of_components


COMPONENTS = components(population())

OtherError = Literal["learnt_curve", "given", "clocks", "places", "wandering", "bursts"]
"""Names of errors that are no components to be learnt; the checker of types finds one without a description."""

OTHER_ERRORS: Mapping[OtherError, str] = {
    "learnt_curve": "what the calibration of the radio leaves open",
    "given": "given values: anchors' positions, lengths and others",
    "clocks": "time offset between the clocks",
    "places": "positions of the camera at and between the photos",
    "wandering": "slow wandering of the ranges, as hands and bodies move",
    "bursts": "seconds in which an anchor's ranges err, and are left out",
}

LEARNT_CURVE: Final = "learnt_curve"
"""Remaining error of an error curve that was subtracted, as learnt with the curve."""

CLOCKS: Final = "clocks"
"""Uncertainty of the camera-radio time offset; not a component of the ranges' errors."""

PLACES: Final = "places"
"""Uncertainty of the camera's positions at and between keyframes; not a component of the ranges' errors."""

WANDERING: Final = "wandering"
"""Slow wandering of the ranges that tests assume in addition to what is learnt."""

BURSTS: Final = "bursts"
"""Error of ranges that tests leave out, as they err for seconds and are right again."""
