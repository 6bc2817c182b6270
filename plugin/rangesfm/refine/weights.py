"""How far ranges are to be trusted, found from their own residuals (variance components), and whether they fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.errors.inlier_noise import InlierNoise, inlier_noise
from rangesfm.ranging.errors.noise import (
    START_STDDEV_M,
    correlation_inflation,
    robust_stddev,
    shared_stddev,
    stretch_labels,
)
from rangesfm.ranging.errors.place import place_labels, shares_by_residuals
from rangesfm.ranging.errors.robust_loss import RobustLoss
from rangesfm.ranging.observations import RangeObservations

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

BLOCK_S = 10.0
_MIN_STDDEV_M = 1e-3
# In stddevs: an anchor whose noise differs less from that of all has the noise of all.
_SIGNIFICANT = 3.0
# Of fewer ranges of one anchor its noise is not told from outliers.
_MIN_NUM_OF_ANCHOR = 20
_NUM_MEAN_ROUNDS = 10
_MIN_ORDINARY = 0.3
_MIN_BLOCK = 5


@dataclass(frozen=True)
class RangeWeights:
    """Noise of n ranges and how much their correlation takes from them.

    Attributes:
        stddev_m: (n,) of each range.
        inflation: of the stddev, by the errors' correlation in time.
        fixed_m: (n,) the part that is not estimated: of a short range, of an interpolated place.
        is_estimated: (n,) whether the rest is.
        anchor_index: (n,). block: (n,) label of each range's stretch of time. place: (n,) label of where it was taken.
        place_share: (n,) by how much each counts beside its stddev, as ranges from one place err alike.
        loss: of single ranges, in their stddevs. With a wide one the noise is what all residuals show, so that what
            drifts away is no outlier; with a bounded one that of the ranges that fit, as in the scale stage.
        max_noise_m: the scale stage's, of a range without special cases: a map that may bend explains the ranges no
            worse than one that could only grow.
        log_likelihood: of the likeliest residuals that the bounded loss has seen of these ranges.
    """

    stddev_m: Array
    inflation: float
    fixed_m: Array
    is_estimated: Mask
    anchor_index: Indices
    block: Indices
    place: Indices
    place_share: Array
    loss: RobustLoss
    max_noise_m: float = np.inf
    log_likelihood: float = -np.inf

    @property
    def share(self) -> Array:
        """(n,) by how much each counts against the photos, beside its stddev."""
        return self.place_share / self.inflation**2

    @property
    def group(self) -> Indices:
        """(n,) label of the stretch of one anchor's ranges that err together."""
        groups: Indices = self.block * (self.anchor_index.max() + 1) + self.anchor_index
        return groups

    def subset(self, rows: Indices) -> RangeWeights:
        """Of some of the ranges."""
        return RangeWeights(
            self.stddev_m[rows],
            self.inflation,
            self.fixed_m[rows],
            self.is_estimated[rows],
            self.anchor_index[rows],
            self.block[rows],
            np.unique(self.place[rows], return_inverse=True)[1],
            self.place_share[rows],
            self.loss,
            self.max_noise_m,
            self.log_likelihood,
        )

    def with_rows(self, rows: Indices, part: RangeWeights) -> RangeWeights:
        """These, but some of the ranges as in a subset that was estimated anew."""
        stddev, share = self.stddev_m.copy(), self.place_share.copy()
        stddev[rows], share[rows] = part.stddev_m, part.place_share
        return replace(
            self,
            stddev_m=stddev,
            place_share=share,
            inflation=part.inflation,
            log_likelihood=part.log_likelihood,
        )

    def noise_in(self, residuals_m: Array) -> InlierNoise:
        """Of the ranges without special cases."""
        return inlier_noise(residuals_m[self._ordinary])

    @property
    def _ordinary(self) -> Indices:
        """Ranges that may be off together by little, and so tell the noise of others."""
        ordinary = np.flatnonzero(self.is_estimated & (self.fixed_m < START_STDDEV_M))
        if len(ordinary) < _MIN_ORDINARY * np.count_nonzero(self.is_estimated) or not len(ordinary):
            ordinary = np.flatnonzero(self.is_estimated)
        return ordinary if len(ordinary) else np.arange(len(self.is_estimated))

    def estimated(self, residuals_m: Array, num_absorbed: float) -> RangeWeights:
        """As the residuals of a fit show them.

        While drift is large, so are residuals, and with the wide loss the noise is what all of them show. With the
        bounded loss it is that of the bulk. Where most ranges are wrong, a fit can follow them, find the noise larger,
        follow more of them, and so on: such a fit is less likely than the one before, and then the weights stay.

        Args:
            residuals_m: (n,). num_absorbed: degrees of freedom that the fit took from them.
        """
        if not self.is_estimated.any():
            return self
        if not self.loss.is_bounded:
            noise_m = np.full(len(residuals_m), robust_stddev(residuals_m[self._ordinary]))
            return self._with_noise(noise_m, residuals_m, num_absorbed)
        seen = self.noise_in(residuals_m)
        if seen.log_likelihood < self.log_likelihood:
            return self
        of_all_m = min(seen.stddev, self.max_noise_m)
        noise_m = of_all_m * self._noise_ratios(residuals_m, of_all_m)[self.anchor_index]
        return replace(
            self._with_noise(noise_m, residuals_m, num_absorbed),
            log_likelihood=seen.log_likelihood,
        )

    def _with_noise(self, noise_m: Array, residuals_m: Array, num_absorbed: float) -> RangeWeights:
        """With this noise (n,) of the residuals, and the correlation that it leaves in them."""
        n = len(residuals_m)
        widening = np.sqrt(n / max(n - num_absorbed, 0.1 * n))
        noise_m = np.maximum(widening * noise_m, _MIN_STDDEV_M)
        stddev = np.where(self.is_estimated, np.hypot(noise_m, self.fixed_m), self.stddev_m)
        scaled = residuals_m / stddev
        share = shares_by_residuals(self.place, scaled, self.loss)
        # What is left of the correlation once the places count for what they are worth.
        inflation = correlation_inflation(scaled, self.loss.weights(scaled), self.group, share)
        return replace(self, stddev_m=stddev, place_share=share, inflation=inflation)

    def _noise_ratios(self, residuals_m: Array, noise_m: float) -> Array:
        """(m,) noise of each anchor over that of all; 1 where the difference may be chance.

        Noise is what scatters about the anchor's own mean: what its ranges have in common is no noise, and taken for
        it would silence whoever disagrees.
        """
        rows = self._ordinary
        index, own = self.anchor_index[rows], residuals_m[rows].copy()
        ratios = np.ones(self.anchor_index.max() + 1)
        for k in range(len(ratios)):
            own[index == k] -= self._bulk_mean(own[index == k], noise_m)
        together = inlier_noise(own)
        for k in range(len(ratios)):
            if np.count_nonzero(index == k) < _MIN_NUM_OF_ANCHOR:
                continue
            alone = inlier_noise(own[index == k])
            # What tells outliers from noise takes some 2.7 times as many values as the variance to be as certain.
            chance = self.inflation * np.sqrt(2.7 / (2 * max(alone.num, 1.0)))
            ratio = alone.stddev / together.stddev
            ratios[k] = ratio if abs(np.log(ratio)) > _SIGNIFICANT * chance else 1.0
        return ratios

    def _bulk_mean(self, residuals_m: Array, noise_m: float) -> float:
        """Of the residuals that fit, found from zero."""
        mean = 0.0
        for _ in range(_NUM_MEAN_ROUNDS if len(residuals_m) else 0):
            mean = float(np.average(residuals_m, weights=self.loss.weights((residuals_m - mean) / noise_m)))
        return mean

    def change(self, other: RangeWeights) -> float:
        """Largest relative change of a weight from this one to another; of ranges without a place nothing is known."""
        ratio = np.sqrt(self.share / other.share) * other.stddev_m / self.stddev_m
        return float(np.nanmax(np.abs(np.log(ratio)), initial=0.0))


def range_weights(
    observations: RangeObservations,
    tags_m: Array,
    range_stddev_m: Array,
    range_share: Array | None,
    inflation: float,
    is_estimated: Mask | None,
    metres_per_unit: float,
    loss_width: float,
    *,
    short_range_error_is_estimated: bool = False,
) -> RangeWeights:
    """The weights to begin with.

    Args:
        tags_m: (n, 3) antenna at each range, in the metric world; without meaning where a range has no place.
        range_stddev_m: (n,) as known or first estimated, with what is shared by all ranges of a length.
        range_share: (n,) by how much each counts beside its stddev; None: all alike.
        is_estimated: (n,) which of them are to be estimated; None: none.
        metres_per_unit: of the observations' world.
        loss_width: of the bounded loss, stddevs.
        short_range_error_is_estimated: then the stddevs go without what is shared.
    """
    log = observations.log
    shared, fixed = shared_stddev(log), metres_per_unit * observations.center_stddev
    if short_range_error_is_estimated:
        range_stddev_m = np.sqrt(np.maximum(range_stddev_m**2 - shared**2, _MIN_STDDEV_M**2))
    else:
        fixed = np.hypot(shared, fixed)
    estimated = np.zeros(len(log), dtype=bool) if is_estimated is None else is_estimated
    rows = observations.placed_rows
    place, block = np.zeros((2, len(log)), dtype=np.int64)
    place[rows] = place_labels(tags_m[rows], log.anchor_index[rows])
    block[rows] = (
        observations.before[rows] if log.timestamp_s is None else stretch_labels(log.timestamp_s[rows], BLOCK_S)
    )
    return RangeWeights(
        stddev_m=range_stddev_m,
        inflation=inflation,
        fixed_m=fixed,
        is_estimated=estimated,
        anchor_index=log.anchor_index,
        block=block,
        place=place,
        place_share=np.ones(len(log)) if range_share is None else range_share,
        loss=RobustLoss(loss_width, is_bounded=True),
        max_noise_m=_noise_without(fixed, range_stddev_m, rows[estimated[rows]]),
    )


def _noise_without(fixed_m: Array, range_stddev_m: Array, rows: Indices) -> float:
    """What is left of stddevs without the part that is not estimated; infinite if there are none."""
    if not len(rows):
        return np.inf
    return float(np.sqrt(max(np.median(range_stddev_m[rows] ** 2 - fixed_m[rows] ** 2), _MIN_STDDEV_M**2)))


# Median block residuals beyond this many stddevs are no noise.
_MAX_BLOCK_STDDEVS = 3.0
# Real radios' errors stay alike for seconds; that makes their residuals twice as large as their scatter, not this.
_MAX_STDDEV_OVER_SCATTER = 5.0
_MIN_SCATTER_M = 0.01
_MIN_DIFFERENCES = 20


def misfits(weights: RangeWeights, residuals_m: Array, time_order: Array) -> tuple[str, ...]:
    """Why ranges that took part do not fit as their noise lets expect; empty if they do.

    Args:
        weights, residuals_m: of the k ranges that took part. time_order: (k,) anything that grows with time.
    """
    reasons = []
    stated = residuals_m / weights.stddev_m
    typical = robust_stddev(stated)
    if len(stated) >= _MIN_DIFFERENCES and typical > _MAX_BLOCK_STDDEVS:
        reasons.append(f"range residuals are typically {typical:.1f} times their stddev")
    off = [np.median(stated[rows]) for rows in _by_group(weights.group) if len(rows) >= _MIN_BLOCK]
    num_off = int(np.sum(np.abs(off) > _MAX_BLOCK_STDDEVS))
    if num_off:
        reasons.append(f"in {num_off} of {len(off)} stretches of time the ranges to an anchor are off as a whole")
    order = np.lexsort((time_order, weights.anchor_index))
    steps = np.diff(residuals_m[order])[np.diff(weights.anchor_index[order]) == 0]
    if len(steps) >= _MIN_DIFFERENCES:
        scatter = max(robust_stddev(steps) / np.sqrt(2), _MIN_SCATTER_M)
        size = robust_stddev(residuals_m)
        if size > _MAX_STDDEV_OVER_SCATTER * scatter:
            reasons.append(f"range residuals ({size:.2f} m) are far larger than the ranges' scatter ({scatter:.2f} m)")
    return tuple(reasons)


def _by_group(labels: Indices) -> list[Indices]:
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
