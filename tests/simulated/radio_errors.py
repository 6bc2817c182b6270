"""Errors of simulated ranges, drawn as radios make them.

They are functions of time, distance and direction, each drawn in its own way, rather than from the covariances of bins
that the estimates use.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from rangesfm.measurements.ranges.errors.components import population
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]

LASTING_S, DRIFT_S, PLACE_M, LOBE = 3.0, 60.0, 0.5, 0.1
NUM_WAVES = 300
# Unevenness of real error curves, which the estimates have no component for.
UNEVEN_M = 0.009
# Knots of an uneven curve over the logarithm of distance.
_KNOTS = np.linspace(np.log(0.05), np.log(300.0), 400)
# Stddevs of a radio that is neither good nor bad.
DIRECTION_STDDEV_M, CURVE_STDDEV_M, BIAS_STDDEV_M, COMMON_BIAS_STDDEV_M = 0.03, 0.03, 0.01, 0.05
LASTING_STDDEV_M, DRIFT_STDDEV_M = 0.0018, 0.01
OBSTRUCTED_SHARE, OBSTRUCTED_MEAN_M = 0.04, 0.7


def usual_errors(
    time_s: Array, anchor: Labels, from_anchor_m: Array, stddev_m: float, rng: np.random.Generator
) -> Array:
    """(n,) errors of a usual radio, one range in 25 of which is obstructed.

    Args:
        time_s: (n,). anchor: (n,) numbers of the anchors. from_anchor_m: (n, 3) to the tag.
        stddev_m: of the white noise.
    """
    distance = np.linalg.norm(from_anchor_m, axis=1)
    errors = stddev_m * rng.standard_normal(len(distance)) + COMMON_BIAS_STDDEV_M * rng.standard_normal()
    errors += CURVE_STDDEV_M * error_curve(distance, rng)
    for k in range(anchor.max() + 1):
        rows = np.flatnonzero(anchor == k)
        direction = from_anchor_m[rows] / distance[rows, None]
        form = rng.normal(0, DIRECTION_STDDEV_M, (3, 3))
        errors[rows] += np.einsum("ni,ij,nj->n", direction, form, direction) + BIAS_STDDEV_M * rng.standard_normal()
        errors[rows] += LASTING_STDDEV_M * lasting(time_s[rows], LASTING_S, rng)
    errors += (rng.random(len(errors)) < OBSTRUCTED_SHARE) * rng.exponential(OBSTRUCTED_MEAN_M, len(errors))
    errors += DRIFT_STDDEV_M * lasting(time_s, DRIFT_S, rng)
    return np.asarray(errors)


def drawn_errors(places: RangeObservations, true: Trajectory, standing_m: Array, rng: np.random.Generator) -> Array:
    """(n,) errors of a radio drawn from the population of real ones, one range in 25 of which is obstructed."""
    stddevs = {
        name: float(median * np.exp(spread * rng.standard_normal())) for name, (median, spread) in population().items()
    }
    errors_m, _ = errors_of_radio(places, true, standing_m, stddevs, None, rng)
    is_obstructed = rng.random(len(errors_m)) < OBSTRUCTED_SHARE
    return np.asarray(np.nan_to_num(errors_m) + is_obstructed * rng.exponential(OBSTRUCTED_MEAN_M, len(errors_m)))


def errors_of_radio(
    places: RangeObservations,
    true: Trajectory,
    standing_m: Array,
    stddevs: Mapping[str, float],
    curve_stddev_m: float | None,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """(n,) errors of a radio and (n,) distances, metres.

    Args:
        places: (n) where the ranges were taken on the true path. standing_m: (k, 3) the anchors.
        stddevs: of the components of the errors. curve_stddev_m: of a further curve over distance.
    """
    index, times = places.log.anchor_index, places.log.timestamp_s
    assert times is not None
    from_anchor = places.centers + places.tag_from_center - standing_m[index]
    distance = np.linalg.norm(from_anchor, axis=1)
    direction = from_anchor / distance[:, None]
    nearest = np.where(places.fraction < 0.5, places.before, places.after)
    in_cam = np.einsum("nji,nj->ni", true.world_from_cam[nearest], direction)
    errors = stddevs["white"] * rng.standard_normal(len(distance)) + stddevs["common_bias"] * rng.standard_normal()
    errors += stddevs["short"] * rng.standard_normal() * np.exp(-distance)
    errors += stddevs["slope"] * rng.standard_normal() * distance
    errors += (stddevs["curve"] * error_curve(distance, rng)) + UNEVEN_M * _uneven(distance, rng)
    if curve_stddev_m is not None:
        errors += curve_stddev_m * error_curve(distance, rng)
    errors += stddevs["drift"] * lasting(times, DRIFT_S, rng)
    errors += stddevs["tag_antenna"] * _lobes(in_cam, rng)
    errors += stddevs["off_axis"] * _off_axis(direction, index, rng)
    for k in range(len(standing_m)):
        rows = np.flatnonzero(index == k)
        since = times[rows]
        errors[rows] += stddevs["bias"] * rng.standard_normal() + stddevs["antenna"] * _lobes(direction[rows], rng)
        errors[rows] += stddevs["time"] * lasting(since, LASTING_S, rng)
        # Sums of waves with Cauchy and with Gaussian wave vectors have correlations of exp(-d) and of exp(-d^2 / 2).
        cauchy = rng.standard_normal((NUM_WAVES, 3)) / np.abs(rng.standard_normal((NUM_WAVES, 1)))
        errors[rows] += stddevs["place"] * _field(from_anchor[rows] / PLACE_M, cauchy, rng)
        gaussian = rng.standard_normal((NUM_WAVES, 3))
        errors[rows] += stddevs["view"] * _field(in_cam[rows] / np.sqrt(LOBE), gaussian, rng)
    return np.asarray(errors), np.asarray(distance)


def lasting(times: Array, memory_s: float, rng: np.random.Generator) -> Array:
    """Draw a first-order autoregressive process of stddev 1."""
    kept = np.exp(-np.diff(times) / memory_s)
    fresh = np.sqrt(1 - kept**2) * rng.standard_normal(len(kept))
    values = np.empty(len(times))
    values[0] = rng.standard_normal()
    for i, share in enumerate(kept):
        values[i + 1] = share * values[i] + fresh[i]
    return values


def _field(at: Array, waves: Array, rng: np.random.Generator) -> Array:
    """(n,) random field of stddev 1 at (n, 3): a sum of waves (k, 3) with random phases."""
    phases = rng.uniform(0, 2 * np.pi, len(waves))
    return np.asarray(np.sqrt(2 / len(waves)) * np.cos(at @ waves.T + phases).sum(axis=1))


def _lobes(direction: Array, rng: np.random.Generator) -> Array:
    """(n,) function of stddev 1 on directions: half of the variance linear, half a quadratic form without a mean."""
    form = rng.standard_normal((3, 3))
    quadratic = np.einsum("ni,ij,nj->n", direction, form, direction) - np.trace(form) / 3
    return np.asarray(direction @ rng.standard_normal(3) / np.sqrt(2) + np.sqrt(3) / 2 * quadratic)


def _off_axis(direction: Array, index: Labels, rng: np.random.Generator) -> Array:
    """(n,) function of stddev 1, smooth in the angle from each anchor's mean direction (radians)."""
    facing = np.stack([direction[index == k].mean(axis=0) for k in range(index.max() + 1)])
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    angle = np.arccos(np.clip(np.sum(direction * facing[index], axis=1), -1.0, 1.0))
    return _field(angle[:, None], rng.standard_normal((NUM_WAVES, 1)), rng)


def error_curve(distance: Array, rng: np.random.Generator) -> Array:
    """Draw a Gaussian process in the logarithm of distance, with stddev 1 and a length scale of one e-fold."""
    knots = np.linspace(np.log(0.3), np.log(30.0), 40)
    covariance = np.exp(-0.5 * (knots[:, None] - knots) ** 2) + 1e-9 * np.eye(len(knots))
    curve = np.linalg.cholesky(covariance) @ rng.standard_normal(len(knots))
    return np.interp(np.log(distance), knots, curve)


def _uneven(distance: Array, rng: np.random.Generator) -> Array:
    """Draw an autoregressive process over the logarithm of distance with a length scale of half an e-fold."""
    return np.interp(np.log(np.maximum(distance, 0.05)), _KNOTS, lasting(_KNOTS, 0.5, rng))
