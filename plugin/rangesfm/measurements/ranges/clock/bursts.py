"""Time offset of a stop-and-go survey, in which there is a burst of ranges around each photo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.clock.offset import CostCurve
from rangesfm.measurements.ranges.clock.squares import fit_squares
from rangesfm.measurements.ranges.clock.timed_ranges import TimedRanges
from rangesfm.measurements.ranges.errors.noise import MIN_NOISE_M
from rangesfm.util.geometry.numerics import SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.trajectory import Trajectory

# Times that are no further apart than this fraction of the median time between photos belong together: ranges to a
# burst, and a burst to a photo.
_TOGETHER_SHARE = 0.25
# A burst with fewer ranges than this fraction of the median number is ignored.
_MIN_SIZE_SHARE = 0.25
# With fewer bursts than this fraction of the photos, the log is not one of bursts.
_MIN_BURST_SHARE = 0.5
# An offset that pairs fewer bursts than this fraction of the largest possible number is not tried.
_MIN_PAIRED_SHARE = 0.75
# Width of the robust loss in standard deviations. Medians of bursts are nearly Gaussian, and there are few of them, so
# that the loss is wide.
_LOSS_SCALE = 5.0
# Smallest number of medians beyond the unknowns for a pairing to be tested.
_MIN_NUM_SPARE = 4.0


class Bursts(NamedTuple):
    """B groups of ranges between pauses of the log.

    Attributes:
        start_s, end_s: (B,) times of the first and the last range, radio's clock.
        num_ranges: (B,) number of ranges.
        range_m: (B, L) median range of each link (an anchor and a tag); NaN where there is none.
        anchor, tag: (L,) indices of the anchor and the tag of each link.
    """

    start_s: Array
    end_s: Array
    num_ranges: Indices
    range_m: Array
    anchor: Indices
    tag: Indices

    @property
    def middle_s(self) -> Array:
        return 0.5 * (self.start_s + self.end_s)


@dataclass(frozen=True)
class BurstPairing:
    """Assignment of bursts to photos, and how well the ranges then fit the path.

    Attributes:
        offset_s: time offset that centres the bursts on their photos.
        burst, photo: (k,) indices of the pairs.
        variance: variance of the medians' residuals, m^2.
        num_spare: number of medians beyond the unknowns.
        chance: p-value of the hypothesis that the path fits the medians no better than no motion (F test).
    """

    offset_s: float
    burst: Indices
    photo: Indices
    variance: float
    num_spare: float
    chance: float

    def explains(self) -> bool:
        """Return whether there are enough medians, and the path explains them better than no motion at all."""
        return self.num_spare >= _MIN_NUM_SPARE and self.chance < special.ndtr(-SIGNIFICANT_STDDEVS)

    def log_odds(self, rival: BurstPairing) -> float:
        """Return the logarithm of the likelihood ratio to a rival; infinite if the rival has too few medians."""
        if rival.num_spare < _MIN_NUM_SPARE:
            return np.inf
        return 0.5 * min(self.num_spare, rival.num_spare) * float(np.log(rival.variance / self.variance))


def find_bursts(ranges: TimedRanges, photo_times_s: Array) -> Bursts | None:
    """Cut the log at its pauses into bursts; None if it does not pause between photos."""
    ranges = ranges.take(np.argsort(ranges.times_s, kind="stable"))
    pause_s = _TOGETHER_SHARE * float(np.median(np.diff(photo_times_s)))
    starts = np.flatnonzero(np.diff(ranges.times_s, prepend=-np.inf) > pause_s)
    ends = np.append(starts[1:], len(ranges.times_s))
    kept = ends - starts >= _MIN_SIZE_SHARE * np.median(ends - starts)
    if kept.sum() < _MIN_BURST_SHARE * len(photo_times_s):
        return None
    starts, ends = starts[kept], ends[kept]
    (anchor, tag), link = np.unique(np.stack([ranges.anchor, ranges.tag]), axis=1, return_inverse=True)
    link = link.ravel()
    medians = np.full((len(starts), len(anchor)), np.nan)
    for burst, (start, end) in enumerate(zip(starts, ends)):
        range_m, links = ranges.range_m[start:end], link[start:end]
        for number in np.unique(links):
            medians[burst, number] = np.median(range_m[links == number])
    return Bursts(ranges.times_s[starts], ranges.times_s[ends - 1], ends - starts, medians, anchor, tag)


def pair_bursts(bursts: Bursts, trajectory: Trajectory, tags_in_cam_m: Array) -> list[BurstPairing]:
    """Return all assignments of bursts to photos that pair most of them, the best first.

    Args:
        tags_in_cam_m: (num_tags, 3) lever arms, metres.
    """
    photo_times = trajectory.timestamps_s
    assert photo_times is not None, "a path in time needs times"
    reach_s = _TOGETHER_SHARE * float(np.median(np.diff(photo_times)))
    pairings = []
    for offset_s in _offsets(bursts.middle_s, photo_times, reach_s):
        times = bursts.middle_s + offset_s
        nearest = np.searchsorted(0.5 * (photo_times[1:] + photo_times[:-1]), times)
        burst = np.flatnonzero(np.abs(times - photo_times[nearest]) <= reach_s)
        pairings.append(_fit(bursts, trajectory, tags_in_cam_m, burst, nearest[burst]))
    return sorted(pairings, key=lambda pairing: (pairing.num_spare < _MIN_NUM_SPARE, pairing.variance))


def offsets_that_keep(pairing: BurstPairing, bursts: Bursts, trajectory: Trajectory) -> tuple[float, float]:
    """Return the smallest and the largest offset at which every burst is nearest to its photo.

    If there is no such offset, the first is larger than the second.
    """
    assert trajectory.timestamps_s is not None
    gaps = np.diff(trajectory.timestamps_s)
    before = np.minimum(np.concatenate([[np.inf], gaps]), np.median(gaps)) / 2
    after = np.minimum(np.concatenate([gaps, [np.inf]]), np.median(gaps)) / 2
    photo_times = trajectory.timestamps_s[pairing.photo]
    return (
        float(np.max(photo_times - before[pairing.photo] - bursts.start_s[pairing.burst])),
        float(np.min(photo_times + after[pairing.photo] - bursts.end_s[pairing.burst])),
    )


def curve_of(pairings: list[BurstPairing], bursts: Bursts, trajectory: Trajectory) -> CostCurve:
    """Return the cost curve of all pairings; the cost is constant while the bursts stay nearest to their photos."""
    points: list[tuple[float, float]] = []
    for pairing in pairings:
        earliest_s, latest_s = offsets_that_keep(pairing, bursts, trajectory)
        plateau = {earliest_s, pairing.offset_s, latest_s} if earliest_s < latest_s else {pairing.offset_s}
        points += [(offset_s, float(np.sqrt(pairing.variance))) for offset_s in plateau]
    return CostCurve(*np.array(sorted(points)).T)


def _offsets(burst_times: Array, photo_times: Array, reach_s: float) -> list[float]:
    """Return the offsets that bring most bursts within reach of a photo."""
    differences = np.sort((photo_times[:, None] - burst_times).ravel())
    first = np.searchsorted(differences, differences - reach_s)
    last = np.searchsorted(differences, differences + reach_s, side="right")
    offsets: list[float] = []
    for best in np.argsort(first - last, kind="stable"):
        if last[best] - first[best] < _MIN_PAIRED_SHARE * (last - first).max():
            break
        if all(abs(differences[best] - offset) > 2 * reach_s for offset in offsets):
            offsets.append(float(np.median(differences[first[best] : last[best]])))
    return offsets


def _fit(bursts: Bursts, trajectory: Trajectory, tags_in_cam_m: Array, burst: Indices, photo: Indices) -> BurstPairing:
    assert trajectory.timestamps_s is not None
    pair, link = np.nonzero(np.isfinite(bursts.range_m[burst]))
    anchor = bursts.anchor[link]
    range_m = bursts.range_m[burst[pair], link]
    centers = trajectory.centers[photo[pair]]
    lever_arms = tags_in_cam_m[bursts.tag[link]]
    tag_from_center = np.einsum("nij,nj->ni", trajectory.world_from_cam[photo[pair]], lever_arms)
    without_lever = fit_squares(centers, range_m, anchor, _LOSS_SCALE)
    squares = fit_squares(centers + tag_from_center / without_lever.scale, range_m, anchor, _LOSS_SCALE)
    num_spare = max(float(squares.weights.sum()) - squares.num_unknowns, 1e-3)
    squared_m2 = float(np.sum(squares.weighted_residuals**2))
    variance = max(squared_m2 / max(num_spare, 1.0), MIN_NOISE_M**2)
    num_of_anchor = np.bincount(anchor)
    means = np.bincount(anchor, range_m) / np.maximum(num_of_anchor, 1)
    num_varying = max(len(range_m) - int(np.count_nonzero(num_of_anchor)), 1)
    variation = float(np.sum((range_m - means[anchor]) ** 2)) / num_varying
    offset_s = float(np.median(trajectory.timestamps_s[photo] - bursts.middle_s[burst]))
    chance = float(special.fdtrc(num_varying, num_spare, variation / variance))
    return BurstPairing(offset_s, burst, photo, variance, num_spare, chance)
