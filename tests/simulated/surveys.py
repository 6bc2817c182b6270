"""Simulated outcomes of a planned survey: ranges of a radio with errors, a bent map, and what the surveyor knows.

The errors are drawn as functions of time, distance and direction, each in its own way, rather than from the covariances
of bins that the estimates use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.learned import usual_stddevs
from rangesfm.ranging.range_log import RangeLog
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.scale.scale_by_lengths import BENDING

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]

METRES_PER_UNIT = 2.3
LASTING_S, DRIFT_S, PLACE_M, LOBE = 3.0, 60.0, 0.5, 0.1
NUM_WAVES = 300
BENDING_M = 0.007
# Unevenness of real error curves, which the estimates have no component for.
UNEVEN_M = 0.009
# Knots of an uneven curve over the logarithm of distance.
_KNOTS = np.linspace(np.log(0.05), np.log(300.0), 400)


@dataclass(frozen=True)
class Measured:
    """The data of a surveyed plan, and the true similarity."""

    observations: RangeObservations
    trajectory: Trajectory
    anchors: tuple[Anchor, ...]
    distances: LocatedDistances | None
    metric_from_map: Similarity


def stddevs_of(planned: PlannedSurvey) -> dict[str, float]:
    """Stddevs of the components of the range errors: the plan's, or those that radios have on average."""
    usual = usual_stddevs(is_calibrated=planned.curve_stddev_m is not None)
    return usual | {"bending": BENDING_M} | dict(planned.component_stddevs)


def measured(planned: PlannedSurvey, seed: int) -> Measured:
    """Simulate one such survey with all of its ranges."""
    rng = np.random.default_rng(seed)
    stddevs, true = stddevs_of(planned), planned.trajectory
    times = _required(true.timestamps_s)
    ids = [anchor.anchor_id for anchor in planned.anchors]
    turn = np.arange(planned.num_ranges)
    at_s = times[0] + (turn + 0.5) / (planned.rate_hz * len(ids))
    log = RangeLog.from_arrays([ids[k] for k in turn % len(ids)], np.ones(len(turn)), timestamp_s=at_s)
    places = associate(log, true, planned.tag_in_cam_m)
    standing_m = np.array([planned.anchors_m[ids.index(name)] for name in log.anchor_ids])
    errors_m, distance_m = errors_of_radio(places, true, standing_m, stddevs, planned.curve_stddev_m, rng)
    ranges_m = np.maximum(np.nan_to_num(distance_m + errors_m, nan=1.0), 0.02)
    curve = None if planned.curve_stddev_m is None else np.full(len(log), planned.curve_stddev_m)
    log = replace(log, range_m=ranges_m, shared_stddev_m=curve)
    bent = replace(true, centers=true.centers + stddevs["bending"] * _bend(times, rng))
    turned = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    map_from_metric = Similarity(1 / METRES_PER_UNIT, turned, rng.normal(size=3))
    seen = bent.transformed(map_from_metric.scale, map_from_metric.rotation, map_from_metric.translation)
    return Measured(
        associate(log, seen, planned.tag_in_cam_m),
        seen,
        _told(planned, rng),
        _taped(planned, rng),
        map_from_metric.inverse(),
    )


def _required(times: Array | None) -> Array:
    assert times is not None
    return times


def errors_of_radio(
    places: RangeObservations,
    true: Trajectory,
    standing_m: Array,
    stddevs: dict[str, float],
    curve_stddev_m: float | None,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """(n,) errors and (n,) distances, metres."""
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


def _bend(times: Array, rng: np.random.Generator) -> Array:
    """(n, 3) curve of stddev 1 in each coordinate, smooth within an eighth of the time."""
    knots = np.linspace(times[0], times[-1], 60)
    apart = (knots[:, None] - knots) / (np.ptp(times) / 8)
    lower = np.linalg.cholesky(np.exp(-0.5 * apart**2) + 1e-9 * np.eye(len(knots)))
    return np.stack([np.interp(times, knots, lower @ rng.standard_normal(len(knots))) for _ in range(3)], axis=1)


def _told(planned: PlannedSurvey, rng: np.random.Generator) -> tuple[Anchor, ...]:
    if planned.anchor_frame == "unknown":
        return tuple(replace(anchor, position_m=None) for anchor in planned.anchors)
    path = planned.trajectory
    first = Similarity(1.0, path.world_from_cam[0], path.centers[0])
    into = first.inverse() if planned.anchor_frame == "first_camera" else Similarity(1.0, np.eye(3), np.zeros(3))
    return tuple(
        replace(anchor, position_m=into.apply(at) + anchor.position_stddev_m * rng.standard_normal(3))
        for anchor, at in zip(planned.anchors, planned.anchors_m, strict=True)
    )


def _taped(planned: PlannedSurvey, rng: np.random.Generator) -> LocatedDistances | None:
    if not planned.taped:
        return None
    lengths, stddevs = np.array(planned.taped, dtype=np.float64).T
    found = lengths + stddevs * rng.standard_normal(len(lengths))
    bent = lengths * (1 + BENDING * rng.standard_normal(len(lengths)))
    return LocatedDistances.of(found, stddevs, model_length=bent / METRES_PER_UNIT)
