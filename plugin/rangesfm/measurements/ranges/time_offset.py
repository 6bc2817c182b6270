"""Estimation of the offset between the clocks of camera and radio."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import special

from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.clock.fit import OffsetFit
from rangesfm.measurements.clock.offset import OffsetCurve, TimeOffset
from rangesfm.measurements.clock.path_samples import PathSamples, moving_path, standing_path
from rangesfm.measurements.clock.search import likely_offsets, offset_of_motion, require_enough
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.noise import MIN_NOISE_M
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.measurements.ranges.timed_ranges import TimedRanges
from rangesfm.options import RangesOptions
from rangesfm.progress import SILENT, Progress
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import RobustLoss
from rangesfm.util.geometry.trajectory import Trajectory, is_too_long, keyframes_around
from rangesfm.util.processes.threads import with_one_blas_thread

# Times that are no further apart than this fraction of the median time between photos belong together: ranges to a
# burst, and a burst to a photo.
_TOGETHER_SHARE = 0.25
# A burst with fewer ranges than this fraction of the median number is ignored.
_MIN_SIZE_SHARE = 0.25
# With fewer bursts than this fraction of the photos, the log is not one of bursts.
_MIN_BURST_SHARE = 0.5
# An offset that pairs fewer bursts than this fraction of the largest possible number is not tried.
_MIN_PAIRED_SHARE = 0.75
# Medians of bursts are nearly Gaussian, and there are few of them, so that the loss is wide.
_LOSS = RobustLoss(5.0, is_bounded=False)
# Smallest number of medians beyond the unknowns for a pairing to be tested.
_MIN_NUM_SPARE = 4.0
# The offset does not matter if this fraction of the ranges in bursts stays at the same photos.
_MIN_SAME_SHARE = 0.95


@with_one_blas_thread
def estimate_time_offset(
    log: RangeLog,
    trajectory: Trajectory,
    tag_in_cam_m: npt.ArrayLike,
    *,
    association: RangesOptions = RangesOptions(),
    seed: int = 0,
    progress: Progress = SILENT,
) -> TimeOffset:
    """Find the offset at which the ranges follow the camera's path.

    Neither the anchors nor the scale of the path need to be known. At every offset the ranges are compared with the
    path, with the anchors and the scale that fit best. The clocks may differ by years.

    Args:
        log: ranges with timestamps, to one anchor or more.
        trajectory: keyframes with times, in any unit of length.
        tag_in_cam_m: (3,) lever arm, the antenna in the camera (rig) frame, metres; or (num_tags, 3) in the order of
            ``log.tag_ids``.
        association: options of the association of ranges with the path.
        seed: seed of the choice of ranges where there are more than needed.
        progress: receives the number of candidates that have been examined.

    Raises:
        InputError: log or photos have no times, or the log has more tags than lever arms.
        GeometryError: the motion does not determine the offset, not even up to a few alternatives.
    """
    if isinstance(log.moments, ByPhoto):
        raise InputError("the log has no timestamps, so that no time offset can be found", log.source)
    if trajectory.timestamps_s is None:
        raise InputError("the photos have no times, so that no time offset can be found: give image times")
    require_enough(trajectory, len(log), TimedRanges)
    tags, rows = log.lever_arms(tag_in_cam_m), log.own_order[log.kind[log.own_order] == RangeKind.TAG_ANCHOR]
    max_gap_s = association.max_interpolation_gap_s
    if is_too_long(float(np.median(np.diff(trajectory.timestamps_s))), max_gap_s):
        found = _offset_of_bursts(log, rows, trajectory, tags, association)
        if found is not None:
            return found
    path = moving_path(trajectory, tags, max_gap_s, TimedRanges.remedy)
    ranges = TimedRanges(log.timestamp_s[rows], path, log.range_m[rows], log.anchor_index[rows], log.tag_index[rows])
    return offset_of_motion(ranges, seed=seed, progress=progress)


def _offset_of_bursts(
    log: RangeLog, rows: Indices, trajectory: Trajectory, tags_in_cam_m: Array, association: RangesOptions
) -> TimeOffset | None:
    """Return the offset that centres each burst of ranges, in a stop-and-go survey, on its photo.

    None if the log does not pause between photos, or the camera did not stand still at them.

    Args:
        rows: of the ranges between a tag and an anchor.
    """
    times_s, photos_s = log.timestamp_s, trajectory.timestamps_s
    assert photos_s is not None, "a path in time needs times"
    together_s = _TOGETHER_SHARE * float(np.median(np.diff(photos_s)))
    bursts = _cut_at_pauses(rows, times_s, together_s)
    if len(bursts) < _MIN_BURST_SHARE * len(photos_s):
        return None
    start_s, end_s = np.array([times_s[own[[0, -1]]] for own in bursts]).T
    middle_s = 0.5 * (start_s + end_s)

    medians = _medians(log, bursts, middle_s, standing_path(trajectory, tags_in_cam_m, together_s))
    fits = [medians.fit(offset_s, medians.fit(offset_s)) for offset_s in _offsets(middle_s, photos_s, together_s)]
    # Medians are nearly Gaussian, independent and few: they are compared by their variance.
    num_spare = np.array([max(float(fit.weights.sum()) - fit.num_unknowns, 1e-3) for fit in fits])
    squared_m2 = [float(np.sum(fit.weighted_residuals**2)) for fit in fits]
    variances = np.maximum(squared_m2 / np.maximum(num_spare, 1.0), MIN_NOISE_M**2)
    order = [k for k in np.argsort(variances, kind="stable") if num_spare[k] >= _MIN_NUM_SPARE]
    if not order or not _explains(fits[order[0]], variances[order[0]], num_spare[order[0]]):
        raise GeometryError(
            f"at no time offset do the {len(bursts)} bursts of ranges fit the {len(photos_s)} photos better than by "
            f"chance: {TimedRanges.remedy}"
        )
    odds = 0.5 * np.minimum(num_spare, num_spare[order[0]]) * np.log(variances[order[0]] / variances)
    likely = likely_offsets([fits[k].offset_s for k in order], odds[order], TimedRanges.remedy)
    best = fits[order[0]]

    earliest_s, latest_s = _same_photos(best, start_s, end_s, photos_s)
    if earliest_s >= latest_s:
        return None
    value_s = float(np.clip(best.offset_s, earliest_s, latest_s))
    num_in_bursts = sum(len(bursts[k]) for k in np.flatnonzero(np.isin(middle_s, best.observed.times_s)))
    num_staying = _num_at_same_photo(log, trajectory, association, value_s, earliest_s, latest_s)
    if num_staying < _MIN_SAME_SHARE * num_in_bursts:
        return None
    curve = [
        (offset_s, 1.0, float(np.mean(fit.observed.deviations**2)), variance)
        for fit, variance in zip(fits, variances, strict=True)
        for offset_s in (fit.offset_s, *_same_photos(fit, start_s, end_s, photos_s))
    ]
    found = TimeOffset(
        value_s=value_s,
        stddev_s=(latest_s - earliest_s) / np.sqrt(12),
        curve=OffsetCurve(*np.array(sorted(curve)).T),
        offset_matters=False,
        reference_s=float(np.mean(middle_s)),
        note=f"the camera stands still at every photo: any time offset from {earliest_s:+.2f} s to {latest_s:+.2f} s "
        f"gives the same result; {value_s:+.2f} s centres the ranges on the photos",
        probability=likely[0][1],
    )
    return found.beside((fits[order[k]].offset_s, probability) for k, probability in likely[1:])


def _cut_at_pauses(rows: Indices, times_s: Array, pause_s: float) -> list[Indices]:
    """Return the rows of each burst between longer pauses, without bursts that are much smaller than most."""
    rows = rows[np.argsort(times_s[rows], kind="stable")]
    bursts = np.split(rows, np.flatnonzero(np.diff(times_s[rows]) > pause_s) + 1)
    least = _MIN_SIZE_SHARE * float(np.median([len(own) for own in bursts]))
    return [own for own in bursts if len(own) >= least]


def _medians(log: RangeLog, bursts: list[Indices], middle_s: Array, path: PathSamples) -> TimedRanges:
    """Return the medians of the ranges of each burst between the same anchor and tag, at the middle of the burst."""
    rows, burst = np.concatenate(bursts), np.repeat(np.arange(len(bursts)), [len(own) for own in bursts])
    links, link = np.unique(np.stack([burst, log.anchor_index[rows], log.tag_index[rows]]), axis=1, return_inverse=True)
    medians_m = np.array([np.median(log.range_m[rows[own]]) for own in rows_by_key(link.ravel())])
    return TimedRanges(middle_s[links[0]], path, medians_m, links[1], links[2], _LOSS)


def _explains(fit: OffsetFit, variance_m2: float, num_spare: float) -> bool:
    """Return whether the path explains medians significantly better than no motion at all (F test)."""
    deviations = fit.observed.deviations
    num_varying = max(len(deviations) - len(np.unique(fit.observed.alike)), 1)
    ratio = float(np.sum(deviations**2)) / num_varying / variance_m2
    return bool(special.fdtrc(num_varying, num_spare, ratio) < special.ndtr(-SIGNIFICANT_STDDEVS))


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
    # Each is centred on all pairs within reach of it.
    return [float(np.median(differences[np.abs(differences - offset) <= reach_s])) for offset in offsets]


def _same_photos(fit: OffsetFit, start_s: Array, end_s: Array, photos_s: Array) -> tuple[float, float]:
    """Return the smallest and the largest offset at which the bursts of a fit stay nearest to their photos.

    If there is no such offset, the first is larger than the second.

    Args:
        start_s, end_s: (b,) of all bursts. photos_s: (k,).
    """
    gaps_s = np.diff(photos_s)
    gaps_s = np.minimum(np.concatenate([[np.inf], gaps_s, [np.inf]]), np.median(gaps_s))
    first_s, last_s = photos_s - 0.5 * gaps_s[:-1], photos_s + 0.5 * gaps_s[1:]
    used = np.isin(0.5 * (start_s + end_s), fit.observed.times_s)
    photo = keyframes_around(0.5 * (start_s + end_s)[used] + fit.offset_s, photos_s).nearest
    return float(np.max(first_s[photo] - start_s[used])), float(np.min(last_s[photo] - end_s[used]))


def _num_at_same_photo(log: RangeLog, trajectory: Trajectory, association: RangesOptions, *offsets_s: float) -> int:
    """Return the number of ranges that are associated with the same photo at all of the offsets."""
    photos = []
    for offset_s in offsets_s:
        places = associate(log, trajectory, np.zeros(3), time_offset_s=offset_s, options=association)
        photos.append(np.where(places.status == RangeStatus.USED, places.before, -1))
    return int(np.count_nonzero(np.all([photo == photos[0] for photo in photos], axis=0) & (photos[0] >= 0)))
