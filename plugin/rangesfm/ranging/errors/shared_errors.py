"""Errors that many ranges share, which no statistics of one survey can see: of the radio, and of anchors' antennas."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.log import RangeLog

# How wrong a radio's range may be as a smooth function of distance, where no error curve was learnt: the DW1000's
# own error changes by 0.05 to 0.1 m when the distance grows e-fold (Decawave application note APS011), in either
# direction once antennas and cases have their say. Every anchor has it alike, so no resampling sees it.
CURVE_STDDEV_M = 0.07
_CURVE_LOG_LENGTH = 1.0
_NUM_CURVE_KNOTS = 25
_MIN_DISTANCE_M = 0.05
# How wrong a range may be as a smooth function of the direction in which an anchor's antenna sees the tag: turning one
# antenna changes ranges by 0.1 to 0.25 m from least to most (Pelka, Cimdins and Hellbrück, "Impact of the antenna
# orientation for distance estimation", 2018), which is this stddev as for a uniform distribution. Each anchor has its
# own, which leaving out one anchor in turn shows; the data of a single one do not.
ANTENNA_STDDEV_M = 0.05


def curve_stddev(log: RangeLog) -> Array:
    """(n,) how wrong the radio's error curve may be at each range: as was learnt with it, else as it is unknown."""
    return np.full(len(log), CURVE_STDDEV_M) if log.shared_stddev_m is None else log.shared_stddev_m


def curve_modes(distance_m: Array, stddev_m: Array) -> Array:
    """(n, k) what an unknown error curve adds to n ranges: times k independent numbers of stddev 1.

    The curve is a random function, smooth in the logarithm of the distance.

    Args:
        distance_m: (n,) from anchor to tag. stddev_m: (n,) of the curve there.
    """
    place = np.log(np.maximum(distance_m, _MIN_DISTANCE_M))
    knots = np.linspace(place.min(), place.max() + 1e-6, _NUM_CURVE_KNOTS)
    hats = np.column_stack([np.interp(place, knots, unit) for unit in np.eye(_NUM_CURVE_KNOTS)])
    correlation = np.exp(-0.5 * ((knots[:, None] - knots) / _CURVE_LOG_LENGTH) ** 2)
    values, vectors = np.linalg.eigh(correlation)
    strong = values > 1e-9 * values.max()
    modes: Array = stddev_m[:, None] * (hats @ (vectors[:, strong] * np.sqrt(values[strong])))
    return modes


def antenna_modes(directions: Array) -> Array:
    """(n, 12) what one anchor's antenna adds to its n ranges, likewise.

    A random polynomial of the direction. Half of its variance is linear, half quadratic in the unit vector; the
    constant part is the bias, which has its own prior. The covariance depends on the angle alone:
    c / 2 + (3 c^2 - 1) / 4 with c its cosine.

    Args:
        directions: (n, 3) unit vectors from anchor to tag.
    """
    quadratic = np.sqrt(1.5) * (directions[:, :, None] * directions[:, None, :] - np.eye(3) / 3)
    modes: Array = ANTENNA_STDDEV_M * np.sqrt(0.5) * np.column_stack([directions, quadratic.reshape(-1, 9)])
    return modes
