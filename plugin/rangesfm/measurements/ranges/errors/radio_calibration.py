"""Estimation of a radio's error curve from ranges of known length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.errors.components import COMPONENTS, MIN_DISTANCE_M
from rangesfm.measurements.ranges.errors.error_curve import ErrorCurve
from rangesfm.measurements.ranges.errors.learned import learn_errors, radio_components
from rangesfm.measurements.ranges.errors.noise import MIN_NUM_OF_SCATTER
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, noisiness, range_bins
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.util.geometry.numerics import NUM_REWEIGHTINGS, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY, robust_stddev
from rangesfm.util.processes.threads import with_one_blas_thread

# Components that depend on the distance alone: their sum is the curve.
_OF_CURVE = ("common_bias", "short", "curve", "slope")
# Knots this far apart, in the logarithm of the distance, follow every curve that antennas and received power produce.
_LOG_SPACING = 1 / 6
# With fewer ranges there is no curve.
_MIN_RANGES = 100
# Bins of ranges in each round of robust weights; with more, the curve does not change by a millimetre.
_NUM_BINS = 200


@dataclass(frozen=True)
class RadioCalibration:
    """Result of the calibration of a radio.

    Attributes:
        curve: error of the radio by distance.
        num_ranges: number of ranges used for the curve.
        noise_stddev_m: scatter of a range about the curve and its anchor's bias.
        outlier_share: share of ranges that do not fit, such as those without line of sight.
        anchor_bias_m: bias of each anchor beyond the curve.
        distance_m, error_m: (n,) of each range: true distance, and measured minus true.
    """

    curve: ErrorCurve
    num_ranges: int
    noise_stddev_m: float
    outlier_share: float
    anchor_bias_m: dict[str, float]
    distance_m: Array
    error_m: Array


@with_one_blas_thread
def calibrate_ranges(log: RangeLog, tags_m: Array, anchors: Sequence[Anchor]) -> RadioCalibration:
    """Learn the mean error of a radio as a smooth function of distance.

    The curve is the sum of those error components that depend on the distance alone, as expected after the ranges were
    measured (Gaussian process regression); it is common to all anchors. Bias, noise and all other components are learnt
    with it, so that its standard deviation allows for errors that last or belong to a place. A Cauchy loss reduces the
    effect of ranges without line of sight.

    Args:
        log: n ranges.
        tags_m: (n, 3) positions of the tag's antenna, in the anchors' frame; NaN where unknown.
        anchors: all with positions.

    Raises:
        InputError: an anchor of the log has no position.
        GeometryError: there are too few ranges of known length, or all are of one length.
    """
    from_anchor_m = tags_m - _positions(log, anchors)[log.anchor_index]
    distance = np.linalg.norm(from_anchor_m, axis=1)
    used = np.flatnonzero(distance > MIN_DISTANCE_M)
    if len(used) < _MIN_RANGES:
        raise GeometryError(f"{len(used)} ranges of known length, expected {_MIN_RANGES} or more to learn from")
    distance, error, index = distance[used], (log.range_m - distance)[used], log.anchor_index[used]
    knots, num_anchors = _knots(distance), len(log.anchor_ids)
    off, axes = error - np.median(error), np.tile(np.eye(3), (len(used), 1, 1))
    for _ in range(NUM_REWEIGHTINGS):
        noise_m = robust_stddev(off)
        weights = CAUCHY.weights(off / noise_m)
        bins = range_bins(
            index,
            log.tag_index[used],
            log.moments.sort_keys[used],
            from_anchor_m[used],
            axes,
            weights,
            noisiness(index, off, num_anchors),
            _NUM_BINS,
        )
        values, stddev, biases = _expected_curve(bins, bins.mean(error), knots, noise_m, num_anchors)
        off = error - np.interp(distance, knots, values) - biases[index]
    noise_m = robust_stddev(off)
    curve = ErrorCurve(knots, values, stddev, _noise_by_knot(knots, distance, off, noise_m))
    return RadioCalibration(
        curve,
        len(used),
        noise_m,
        float(np.mean(weights < 0.1)),
        dict(zip(log.anchor_ids, biases.tolist(), strict=True)),
        distance,
        error,
    )


def _positions(log: RangeLog, anchors: Sequence[Anchor]) -> Array:
    """Return the (m, 3) positions of the log's anchors."""
    by_id = {anchor.anchor_id: anchor.position_m for anchor in anchors}
    for anchor_id in log.anchor_ids:
        if by_id.get(anchor_id) is None:
            raise InputError(f"anchor {anchor_id} of the log has no position, expected all to be surveyed", log.source)
    return np.array([by_id[anchor_id] for anchor_id in log.anchor_ids], dtype=np.float64)


def _knots(distance: Array) -> Array:
    """Return (k,) distances with even spacing of their logarithms, from the shortest range to the longest."""
    ends = distance.min(), distance.max()
    low, high = np.log(ends)
    if not high - low > 2 * _LOG_SPACING:
        raise GeometryError(
            f"the ranges are {ends[0]:.2f} to {ends[1]:.2f} m long: a curve needs ranges of different lengths"
        )
    return np.exp(np.linspace(low, high, int(np.ceil((high - low) / _LOG_SPACING)) + 1))


def _expected_curve(
    bins: RangeBins, error_m: Array, knots: Array, noise_m: float, num_anchors: int
) -> tuple[Array, Array, Array]:
    """Return the (k,) expected curve at knots, given the errors (c,) of bins, its stddev, and the (m,) biases."""
    # Errors off the anchors' axes are alike at all anchors: the curve has them, and each survey expects its own anew.
    no_curve, nothing = np.full(len(bins.of_range), np.nan), np.zeros((len(bins), 1))
    expected = radio_components(bins, no_curve, ruled_out=("off_axis",))
    learned = learn_errors(expected, bins, error_m, nothing, np.ones((1, 1)), noise_m)
    total = learned.covariance_m2
    factor = cho_factor(total + ROUNDING * np.trace(total) * np.eye(len(total)))
    # The components' covariance is also computed at the knots, as if these were further bins.
    num, with_knots = (
        len(knots),
        replace(bins, distance_m=np.append(knots, bins.distance_m), worth=np.ones(len(knots) + len(bins))),
    )
    covariance = np.zeros((len(with_knots), len(with_knots)))
    biases = np.zeros(num_anchors)
    correlation_of = {each.name: each.correlation for each in COMPONENTS}
    for name, known in zip(learned.names, learned.covariances_m2, strict=True):
        if name in _OF_CURVE:
            alike = correlation_of[name](with_knots)
            covariance += alike * np.trace(known) / np.trace(alike[num:, num:])
        if name == "bias":
            heard, first = np.unique(bins.anchor_index, return_index=True)
            biases[heard] = known[first] @ cho_solve(factor, error_m)
    gain = cho_solve(factor, covariance[num:, :num]).T
    variances = np.diag(covariance[:num, :num] - gain @ covariance[num:, :num])
    return gain @ error_m, np.sqrt(np.maximum(variances, 0.0)), biases


def _noise_by_knot(knots: Array, distance: Array, residuals: Array, noise_m: float) -> Array:
    """Return the (k,) scatter of the ranges nearest to each knot; the scatter of all where they are few."""
    nearest = np.searchsorted((knots[1:] + knots[:-1]) / 2, distance)
    parts = [residuals[nearest == k] for k in range(len(knots))]
    return np.array([robust_stddev(part) if len(part) >= MIN_NUM_OF_SCATTER else noise_m for part in parts])
