"""RangeErrors: the errors and weights of ranges, estimated from their residuals (variance components)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices, Mask, rows_by_key
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.ranges.errors.noise import (
    MIN_NOISE_M,
    MIN_NUM_OF_SCATTER,
    MIN_ORDINARY,
    START_STDDEV_M,
    STRETCH_S,
    InlierNoise,
    correlation_inflation,
    inlier_noise,
    place_labels,
    shared_stddev,
    shares_by_residuals,
    stretch_labels,
)
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.options import RangeModelOptions
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE, RobustLoss, robust_stddev

# Smallest number of ranges in a stretch whose median shows whether it is off as a whole.
_MIN_BLOCK = 5
# Share of stretches that may be off without a reason for doubt: somebody stands between for some seconds.
_FEW_BLOCKS = 0.02
# Errors of real radios last for seconds, which makes residuals twice as large as their scatter, but not this many
# times.
_MAX_STDDEV_OVER_SCATTER = 5.0
_MIN_SCATTER_M = 0.01
# If the residuals of this share of the ranges, those nearest to the photos, are smaller than all by this factor, the
# path between the photos is the reason.
_NEAREST, _AT_PHOTOS = 0.2, 0.5
_CHECK = "check clocks, lever arm and anchors"
_MORE_PHOTOS = (
    "use more of the photos (every_nth, min_interval_s), or only ranges that are near to one (max_interpolation_gap_s)"
)


@dataclass(frozen=True)
class RangeErrors:
    """Errors of n ranges, and the weights that follow; the scale stage passes them on to the refinement.

    The cost of a map contains half of ``worth * loss(residual / stddev)`` for each range.

    Attributes:
        stddev_m: (n,) standard deviation of each range, as weighted; NaN for a range without a place.
        share: (n,) share of an independent range, as ranges from one place err alike.
        inflation: factor on the standard deviation of estimates from many ranges, for their errors' correlation in
            time.
        given_m: (n,) noise stated by the log or the survey; NaN where it is estimated.
        shared_m: (n,) standard deviation of the error that ranges of about this length share.
        placing_m: (n,) standard deviation of each coordinate of the place of each range.
        anchor_index: (n,). block: (n,) label of each range's stretch of time. place: (n,) label of its place.
        loss: of single ranges, in their standard deviations. With a wide loss the noise is the scatter of all
            residuals, so that drift is not taken for outliers; with a bounded loss it is the scatter of the ranges that
            fit.
        common_bias_stddev_m: prior of the bias that all anchors share (mean 0), besides their own priors.
        noise_m: standard deviation of an ordinary range on a map that is only scaled, turned and moved; an upper limit
            for maps that bend.
        log_likelihood: highest one of residuals of these ranges so far with the bounded loss.
    """

    stddev_m: Array
    share: Array
    inflation: float
    given_m: Array
    shared_m: Array
    placing_m: Array
    anchor_index: Indices
    block: Indices
    place: Indices
    loss: RobustLoss
    common_bias_stddev_m: float
    noise_m: float = np.inf
    log_likelihood: float = -np.inf

    @classmethod
    def begin(cls, observations: RangeObservations, rows: Indices, range_model: RangeModelOptions) -> RangeErrors:
        """Return the errors of some of the ranges, before a map is used.

        Args:
            rows: (n,) rows of the observations, all with a place.
        """
        log = observations.log
        given = log.range_stddev_m[rows]
        if range_model.range_stddev_m is not None:
            given = np.where(np.isfinite(given), given, range_model.range_stddev_m)
        is_by_photo = isinstance(log.moments, ByPhoto)
        shared, nothing = shared_stddev(log.range_m, log.shared_stddev_m)[rows], np.zeros(len(rows), dtype=np.int64)
        return cls(
            stddev_m=np.hypot(np.where(np.isfinite(given), given, START_STDDEV_M), shared),
            share=np.ones(len(rows)),
            inflation=1.0,
            given_m=given,
            shared_m=shared,
            placing_m=np.zeros(len(rows)),
            anchor_index=log.anchor_index[rows],
            block=observations.before[rows] if is_by_photo else stretch_labels(log.timestamp_s[rows], STRETCH_S),
            place=nothing,
            loss=GEMAN_MCCLURE,
            common_bias_stddev_m=range_model.common_bias_stddev_m,
        )

    @property
    def worth(self) -> Array:
        """(n,) number of independent ranges that each range counts as, at its standard deviation."""
        return self.share / self.inflation**2

    @property
    def group(self) -> Indices:
        """(n,) label of the stretch of one anchor's ranges that err alike."""
        return np.asarray(self.block * (self.anchor_index.max() + 1) + self.anchor_index)

    @property
    def is_estimated(self) -> Mask:
        """(n,) True where the noise is estimated from the residuals."""
        return np.isnan(self.given_m)

    def robust_weights(self, residuals_m: Array) -> Array:
        """Return (n,) robust weights in (0, 1]; 1 for a range that fits."""
        return self.loss.weights(residuals_m / self.stddev_m)

    def subset(self, rows: Indices) -> RangeErrors:
        """Return the errors of some of the ranges."""
        part: dict[str, Any] = {name: values[rows] for name, values in self._of_each_range()}
        part["place"] = np.unique(part["place"], return_inverse=True)[1]
        return replace(self, **part)

    def spread(self, rows: Indices, num: int) -> RangeErrors:
        """Return the errors as ``rows`` of ``num`` ranges; the others have no place, and get NaN or label 0."""
        spread: dict[str, Any] = {}
        for name, values in self._of_each_range():
            spread[name] = np.full(num, np.nan if values.dtype == np.float64 else 0, dtype=values.dtype)
            spread[name][rows] = values
        return replace(self, **spread)

    def _of_each_range(self) -> list[tuple[str, npt.NDArray[Any]]]:
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        return [(name, value) for name, value in values if isinstance(value, np.ndarray)]

    def at(self, tags_m: Array, placing_m: Array) -> RangeErrors:
        """Return the errors of ranges taken at places (n, 3) in the metric world, with (n,) standard deviations, m."""
        return replace(self, place=place_labels(tags_m, self.anchor_index), placing_m=placing_m)

    def without_shared(self) -> RangeErrors:
        """Return the errors for a map that estimates the common error of short ranges as a parameter."""
        stddev = np.sqrt(np.maximum(self.stddev_m**2 - self.shared_m**2, MIN_NOISE_M**2))
        return replace(self, stddev_m=stddev, shared_m=np.zeros_like(self.shared_m))

    def for_bending_map(self, loss: RobustLoss) -> RangeErrors:
        """Return the errors to start with on a map that may bend, under another loss; their noise is an upper limit."""
        beyond = (self.stddev_m**2 - self.shared_m**2 - self.placing_m**2)[self.is_estimated]
        noise_m = float(np.sqrt(max(np.median(beyond), MIN_NOISE_M**2))) if len(beyond) else np.inf
        return replace(self, loss=loss, noise_m=noise_m, log_likelihood=-np.inf)

    def noise_of_all(self, residuals_m: Array) -> InlierNoise:
        """Estimate the noise of ordinary ranges from the residuals of a map that may not bend."""
        return inlier_noise(residuals_m[self._ordinary(np.ones(len(residuals_m), dtype=bool), self.shared_m)])

    def noise_of_estimated(self, residuals_m: Array) -> InlierNoise:
        """Estimate the noise of the ordinary ranges that do not state theirs."""
        return inlier_noise(residuals_m[self._ordinary_estimated()])

    def _ordinary_estimated(self) -> Indices:
        return self._ordinary(self.is_estimated, np.hypot(self.shared_m, self.placing_m))

    def _ordinary(self, among: Mask, together_m: Array) -> Indices:
        """Return the rows of ranges with a small common error, which show the noise."""
        among = among if among.any() else np.ones(len(among), dtype=bool)
        usual = np.where(self.is_estimated, START_STDDEV_M, self.given_m)
        ordinary = among & (together_m < usual)
        is_enough = np.count_nonzero(ordinary) > MIN_ORDINARY * np.count_nonzero(among)
        return np.flatnonzero(ordinary if is_enough else among)

    def seen_by_rigid_map(self, residuals_m: Array, prior_cost: float) -> RangeErrors:
        """Estimate the errors from residuals of a map that was only scaled, turned and moved; anchors have one noise.

        A larger scatter of one anchor is mostly due to the map's own bending. If most ranges are wrong, a fit can
        follow them, find a larger noise, include more of them, and so on. Such a fit is less likely than the state it
        started from; then the noise of that state is kept.

        Args:
            residuals_m: (n,). prior_cost: cost of the priors, which is part of the likelihood.
        """
        seen = self.noise_of_all(residuals_m)
        likelihood, noise_m = seen.log_likelihood - prior_cost, seen.stddev
        if likelihood <= self.log_likelihood:
            likelihood, noise_m = self.log_likelihood, self.noise_m
        base = np.where(self.is_estimated, noise_m, self.given_m)
        stddev = np.sqrt(base**2 + self.placing_m**2 + self.shared_m**2)
        share = shares_by_residuals(self.place, residuals_m / stddev, self.loss)
        return replace(self, stddev_m=stddev, share=share, noise_m=noise_m, log_likelihood=likelihood)

    def seen_by_bending_map(self, residuals_m: Array, num_absorbed: float) -> RangeErrors:
        """Estimate the errors from the residuals of a map that bends to the ranges; each anchor may have its own noise.

        While drift is large, so are the residuals, and with the wide loss the noise is their scatter. With the bounded
        loss it is that of the bulk. A fit that is less likely than the one before leaves the errors unchanged.

        Args:
            residuals_m: (n,). num_absorbed: degrees of freedom that the fit absorbed.
        """
        if not self.is_estimated.any():
            return self
        if not self.loss.is_bounded:
            of_all_m = robust_stddev(residuals_m[self._ordinary_estimated()])
            return self._with_noise(np.full(len(residuals_m), of_all_m), residuals_m, num_absorbed)
        seen = self.noise_of_estimated(residuals_m)
        if seen.log_likelihood < self.log_likelihood:
            return self
        of_all_m = min(seen.stddev, self.noise_m)
        noise_m = of_all_m * self._noise_ratios(residuals_m, of_all_m)[self.anchor_index]
        return replace(self._with_noise(noise_m, residuals_m, num_absorbed), log_likelihood=seen.log_likelihood)

    def _with_noise(self, noise_m: Array, residuals_m: Array, num_absorbed: float) -> RangeErrors:
        """Return the errors with a given noise (n,) of the residuals, and with the correlation that remains."""
        n = len(residuals_m)
        widening = np.sqrt(n / max(n - num_absorbed, 0.1 * n))
        noise_m = np.maximum(widening * noise_m, MIN_NOISE_M)
        stddev = np.where(self.is_estimated, np.hypot(noise_m, np.hypot(self.shared_m, self.placing_m)), self.stddev_m)
        share = shares_by_residuals(self.place, residuals_m / stddev, self.loss)
        return replace(self, stddev_m=stddev, share=share).inflated(residuals_m)

    def inflated(self, residuals_m: Array) -> RangeErrors:
        """Return the errors with the correlation in time that remains after weighting by place."""
        scaled = residuals_m / self.stddev_m
        inflation = correlation_inflation(scaled, self.loss.weights(scaled), self.group, self.share)
        return replace(self, inflation=inflation)

    def _noise_ratios(self, residuals_m: Array, noise_m: float) -> Array:
        """Return the (m,) noise of each anchor relative to all; 1 where the difference may be chance.

        Noise is the scatter about the anchor's own mean. A common error of its ranges is not noise, and would otherwise
        reduce the weight of any anchor that disagrees.
        """
        rows = self._ordinary_estimated()
        index, own = self.anchor_index[rows], residuals_m[rows].copy()
        ratios = np.ones(self.anchor_index.max() + 1)
        for k in range(len(ratios)):
            own[index == k] -= self._bulk_mean(own[index == k], noise_m)
        together = inlier_noise(own)
        for k in range(len(ratios)):
            if np.count_nonzero(index == k) < MIN_NUM_OF_SCATTER:
                continue
            alone = inlier_noise(own[index == k])
            # The variance of the mixture's noise estimate is some 2.7 times that of an ordinary standard deviation.
            chance = self.inflation * np.sqrt(2.7 / (2 * max(alone.num, 1.0)))
            ratio = alone.stddev / together.stddev
            ratios[k] = ratio if abs(np.log(ratio)) > SIGNIFICANT_STDDEVS * chance else 1.0
        return ratios

    def _bulk_mean(self, residuals_m: Array, noise_m: float) -> float:
        """Return the mean of the residuals that fit, iterating from zero."""
        mean = 0.0
        for _ in range(MAX_NUM_ROUNDS if len(residuals_m) else 0):
            before = mean
            mean = float(np.average(residuals_m, weights=self.loss.weights((residuals_m - mean) / noise_m)))
            if abs(mean - before) <= ROUNDING * noise_m:
                break
        return mean

    def change(self, other: RangeErrors) -> float:
        """Return the largest relative difference of a range's information from that by other errors."""
        ratio = np.sqrt(self.worth / other.worth) * other.stddev_m / self.stddev_m
        return float(np.max(np.abs(np.log(ratio)), initial=0.0))


def misfits(errors: RangeErrors, residuals_m: Array, time_order: Array) -> tuple[Doubt, ...]:
    """Return reasons why the ranges fit worse than their noise suggests; empty if they do not.

    Args:
        errors, residuals_m: of the k ranges that take part. time_order: (k,) values that increase with time.
    """
    if not len(residuals_m):
        return ()
    reasons = []
    stated = residuals_m / errors.stddev_m
    typical = robust_stddev(stated)
    if len(stated) >= MIN_NUM_OF_SCATTER and typical > SIGNIFICANT_STDDEVS:
        told = f"the ranges typically miss the map by {typical:.1f} times their standard deviation"
        reasons.append(Doubt(told, _CHECK))
    off = [np.median(stated[rows]) for rows in rows_by_key(errors.group) if len(rows) >= _MIN_BLOCK]
    num_off = int(np.sum(np.abs(off) > SIGNIFICANT_STDDEVS))
    if num_off > _FEW_BLOCKS * len(off):
        told = (
            f"in {num_off} of {len(off)} short periods all ranges to one anchor miss the map on the same side, by more "
            "than their noise explains"
        )
        reasons.append(Doubt(told, _CHECK))
    order = np.lexsort((time_order, errors.anchor_index))
    steps, is_of_one = np.diff(residuals_m[order]), np.diff(errors.anchor_index[order]) == 0
    steps = steps[is_of_one & ((steps != 0) | (np.diff(time_order[order]) != 0))]  # a range that a log has twice is one
    if len(steps) >= MIN_NUM_OF_SCATTER:
        scatter = max(robust_stddev(steps) / np.sqrt(2), _MIN_SCATTER_M)
        size = robust_stddev(residuals_m)
        if size > _MAX_STDDEV_OVER_SCATTER * scatter:
            told = f"the ranges miss the map by {size:.2f} m, far more than they scatter from one to the next"
            told += f" ({scatter:.2f} m)"
            at_photos_m = robust_stddev(residuals_m[errors.placing_m <= np.quantile(errors.placing_m, _NEAREST)])
            if at_photos_m < _AT_PHOTOS * size:
                told += f", but not those nearest to the photos ({at_photos_m:.2f} m): the photos are too far apart"
                reasons.append(Doubt(told, _MORE_PHOTOS))
            else:
                reasons.append(Doubt(told, _CHECK))
    return tuple(reasons)
