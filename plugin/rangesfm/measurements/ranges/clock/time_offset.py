"""Estimation of the offset between the clocks of camera and radio, from the motion that both have measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.ranges.association import associate, is_too_long
from rangesfm.measurements.ranges.clock.bursts import Bursts, curve_of, find_bursts, offsets_that_keep, pair_bursts
from rangesfm.measurements.ranges.clock.fit import SEPARATION_S, Observed, OffsetFit, fit_clocks, refine_offset
from rangesfm.measurements.ranges.clock.offset import TimeOffset
from rangesfm.measurements.ranges.clock.search import PathSamples, moving_path
from rangesfm.measurements.ranges.clock.timed_ranges import TimedRanges
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.options import RangesOptions
from rangesfm.progress import SILENT, Progress
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import NORMAL_95, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import MIN_COST_GAP
from rangesfm.util.geometry.trajectory import MIN_NUM_KEYFRAMES, Trajectory
from rangesfm.util.processes.threads import with_one_blas_thread

# With more likely offsets than this the estimate fails.
_MAX_NUM_LIKELY = 3
# Log and photos usually cover the same time. An offset that puts fewer observations on the path than this fraction of
# the best offset's number gets this prior probability, relative to the others; less where both last equally long, which
# they do by chance only if they were not begun and ended together.
_COVERING_SHARE = 0.7
_PRIOR_OF_THE_OTHERS = 0.05
_LEAST_DIFFERENCE = 0.02  # of the durations, as a share, below which it says no more
# Two offsets with a smaller fraction of observations in common are compared by all that each puts on the path.
_MIN_SHARED = 0.25
# Largest number of candidates from the scan.
_MAX_NUM_CANDIDATES = 12
# Numbers of observations that suffice to compare candidates, and for the final estimate.
_NUM_PER_CANDIDATE = 3000
_NUM_OF_FINAL = 40000
# The offset does not matter if this fraction of the ranges in bursts stays at the same photos.
_MIN_SAME_SHARE = 0.95
# An offset with a larger standard deviation is refused.
_MOST_UNCERTAIN_S = 0.5
# To find the offset, poses are also interpolated across gaps up to this many times the median gap between photos.
_MAX_GAPS = 1.5


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
    tags = log.lever_arms(tag_in_cam_m)
    ranges = TimedRanges(log.timestamp_s, log.range_m, log.anchor_index, log.tag_index)
    ranges = ranges.take(log.own_order[log.kind[log.own_order] == RangeKind.TAG_ANCHOR])
    if is_too_long(float(np.median(np.diff(trajectory.timestamps_s))), association):
        bursts = find_bursts(ranges, trajectory.timestamps_s)
        if bursts is not None:
            found = _offset_of_bursts(bursts, log, trajectory, tags, association)
            if found is not None:
                return found
    path = path_to_search(trajectory, tags, association)
    return offset_of_motion(ranges, path, seed=seed, progress=progress)


def require_enough(trajectory: Trajectory, num: int, kind: type[Observed]) -> None:
    """Raise GeometryError if there are too few photos to compare with, or no observation."""
    if len(trajectory) < MIN_NUM_KEYFRAMES or not num:
        raise GeometryError(
            f"{len(trajectory)} photos and {num} {kind.name} are too few to find the time offset: {kind.remedy}"
        )


def path_to_search(trajectory: Trajectory, antennas_in_cam_m: Array, association: RangesOptions) -> PathSamples:
    """Sample the path of keyframes with times, also across longer gaps than those in which observations are used.

    Args:
        antennas_in_cam_m: (num, 3) lever arms, metres.
    """
    assert trajectory.timestamps_s is not None, "a path in time needs times"
    gap_s = max(_MAX_GAPS * float(np.median(np.diff(trajectory.timestamps_s))), association.max_interpolation_gap_s)
    return moving_path(trajectory, antennas_in_cam_m, association.model_copy(update={"max_interpolation_gap_s": gap_s}))


def offset_of_motion(observed: Observed, path: PathSamples, *, seed: int, progress: Progress) -> TimeOffset:
    """Estimate the offset from motion: scan all offsets, refine the best few, and find out which of them are likely.

    Args:
        observed: what the offset is found from. path: to search.
        seed, progress: as for ``estimate_time_offset``.

    Raises:
        GeometryError: the motion does not determine the offset, not even up to a few alternatives.
    """
    name, remedy, times_s = observed.name, observed.remedy, observed.times_s
    if np.count_nonzero(path.is_known) < 2:
        raise GeometryError(f"no part of the path can be compared with the log to find the time offset: {remedy}")
    # All offsets use observations in the same random order, so that different offsets are compared by the same ones.
    mixed = observed.take(np.random.default_rng(seed).permutation(len(times_s)))
    candidates = observed.scan(path, observed.start_weights).peaks(SEPARATION_S, _MAX_NUM_CANDIDATES)
    fits: list[OffsetFit] = []
    for num_done, offset_s in enumerate(candidates):
        progress.update(num_done, len(candidates))
        near = mixed.on_path(path, offset_s, _NUM_PER_CANDIDATE)
        if len(near.times_s):
            best = max((fit for fit in fits if fit.is_testable), key=lambda fit: fit.score, default=None)
            fits.append(refine_offset(near, path, offset_s, best))
    progress.update(len(candidates), len(candidates))
    if not any(fit.is_testable for fit in fits):
        log_s, photos_s = np.ptp(times_s), path.step_s * (len(path.is_known) - 1)
        raise GeometryError(
            f"too few {name} along the camera's path to find the time offset (the log lasts {log_s:.4g} s, the photos "
            f"{photos_s:.4g} s): {remedy}"
        )
    (best, probability), *rivals = _likely_fits(fits, times_s, path, remedy)
    if not best.explains():
        raise GeometryError(
            f"at no time offset do the {name} follow the camera's path (it hardly moves, its photos are "
            f"too far apart, or the log belongs to other photos): {remedy}"
        )
    near = mixed.on_path(path, best.offset_s, _NUM_OF_FINAL)
    final, found = fit_clocks(near, path, best.offset_s)
    is_certain = bool(found.stddev_s * np.sqrt(np.mean(final.rates**2)) < final.residual_stddev_m)
    said = f"(about {final.offset_s:+.2f} s, within {NORMAL_95 * found.stddev_s:.2g} s, 95 %)"
    if not is_certain and not found.stddev_s < _MOST_UNCERTAIN_S:
        raise GeometryError(f"the motion is too even to tell the time offset {said}: {remedy}")
    uneven = f"the motion is too even to tell the time offset well {said}: {remedy} if you know it better"
    found = replace(
        found,
        curve=final.observed.scan(path, final.weights).around(final.offset_s),
        note="; ".join(filter(None, (found.note, "" if is_certain else uneven))),
        probability=probability,
        is_certain=is_certain,
    )
    return found.beside((fit.offset_s, probability) for fit, probability in rivals)


def _offset_of_bursts(
    bursts: Bursts, log: RangeLog, trajectory: Trajectory, tags_in_cam_m: Array, association: RangesOptions
) -> TimeOffset | None:
    """Return the offset that centres each burst on its photo, or None if the camera did not stand still in them."""
    pairings = pair_bursts(bursts, trajectory, tags_in_cam_m)
    best = pairings[0]
    if not best.explains():
        raise GeometryError(
            f"at no time offset do the {len(bursts.start_s)} bursts of ranges fit the {len(trajectory)} photos "
            f"better than by chance: {TimedRanges.remedy}"
        )
    likely = likely_offsets([each.offset_s for each in pairings], [-best.log_odds(each) for each in pairings])
    earliest_s, latest_s = offsets_that_keep(best, bursts, trajectory)
    if earliest_s >= latest_s:
        return None
    value_s = float(np.clip(best.offset_s, earliest_s, latest_s))
    num_in_bursts = int(bursts.num_ranges[best.burst].sum())
    num_staying = _num_at_same_photo(log, trajectory, association, value_s, earliest_s, latest_s)
    if num_staying < _MIN_SAME_SHARE * num_in_bursts:
        return None
    found = TimeOffset(
        value_s=value_s,
        stddev_s=(latest_s - earliest_s) / np.sqrt(12),
        curve=curve_of(pairings, bursts, trajectory),
        offset_matters=False,
        reference_s=float(np.mean(bursts.middle_s)),
        note=f"the camera stands still at every photo: any time offset from {earliest_s:+.2f} s to {latest_s:+.2f} s "
        f"gives the same result; {value_s:+.2f} s centres the ranges on the photos",
        probability=likely[0][1],
    )
    return found.beside((pairings[number].offset_s, probability) for number, probability in likely[1:])


def _num_at_same_photo(log: RangeLog, trajectory: Trajectory, association: RangesOptions, *offsets_s: float) -> int:
    """Return the number of ranges that are associated with the same photo at all of the offsets."""
    photos = []
    for offset_s in offsets_s:
        places = associate(log, trajectory, np.zeros(3), time_offset_s=offset_s, options=association)
        photos.append(np.where(places.status == RangeStatus.USED, places.before, -1))
    return int(np.count_nonzero(np.all([photo == photos[0] for photo in photos], axis=0) & (photos[0] >= 0)))


def likely_offsets(
    offsets_s: Sequence[float], log_likelihoods: Sequence[float], remedy: str = TimedRanges.remedy
) -> list[tuple[int, float]]:
    """Return the indices and probabilities of the offsets that cannot be ruled out, the most likely first.

    Raises:
        GeometryError: there are too many of them.
    """
    behind = np.max(log_likelihoods) - np.asarray(log_likelihoods)
    weights, likely = np.exp(-behind), np.flatnonzero(behind < MIN_COST_GAP)
    likely = likely[np.argsort(-weights[likely], kind="stable")]
    probabilities = weights[likely] / weights[likely].sum()
    if len(likely) > _MAX_NUM_LIKELY:
        some = ", ".join(f"{offsets_s[k]:+.2f} s ({share:.0%})" for k, share in zip(likely[:3], probabilities))
        raise GeometryError(f"the motion does not distinguish {len(likely)} time offsets, such as {some}: {remedy}")
    return list(zip(likely.tolist(), probabilities.tolist()))


def _likely_fits(
    fits: list[OffsetFit], times_s: Array, path: PathSamples, remedy: str
) -> list[tuple[OffsetFit, float]]:
    """Return the fits that cannot be ruled out, with their probabilities, the most likely first.

    Args:
        fits: fits of which at least one is testable.
        times_s: (n,) times of the whole log. remedy: what the user can do about too many of them.

    Raises:
        GeometryError: there are too many of them.
    """
    num_on_path = np.array([np.count_nonzero(path.knows(times_s + fit.offset_s)) for fit in fits])
    order = [k for k in np.argsort([-fit.score for fit in fits] * num_on_path) if fits[k].is_testable]
    best, most = fits[order[0]], num_on_path[order[0]]
    same_s = max(SEPARATION_S, SIGNIFICANT_STDDEVS * min(best.timed().stddev_s, 1.0))
    log_s, path_s = float(np.ptp(times_s)), path.step_s * (len(path) - 1)
    difference = max(1.0 - min(log_s, path_s) / max(log_s, path_s), _LEAST_DIFFERENCE)
    # Two durations of which nothing is known differ by less than a small share with twice that probability.
    prior_of_the_others = _PRIOR_OF_THE_OTHERS * min(2.0 * difference, 1.0)
    distinct: list[OffsetFit] = []
    log_likelihoods: list[float] = []
    for number in order:
        fit, covers = fits[number], num_on_path[number] >= _COVERING_SHARE * most
        if all(abs(fit.offset_s - other.offset_s) > same_s for other in distinct):
            distinct.append(fit)
            log_likelihoods.append(-_log_odds(best, fit, path) + np.log(1.0 if covers else prior_of_the_others))
    likely = likely_offsets([fit.offset_s for fit in distinct], log_likelihoods, remedy)
    return [(distinct[number], probability) for number, probability in likely]


def _log_odds(fit: OffsetFit, rival: OffsetFit, path: PathSamples) -> float:
    """Return the logarithm of the likelihood ratio of two fits, for the number of observations with independent errors.

    What both put on the path has the same noise, so that its residuals are compared in one unit. A unit for each, from
    some hundred residuals, differs by chance by more than the residuals do.
    """
    num = min(fit.num_independent, rival.num_independent)
    mine = path.knows(fit.times_s + rival.offset_s)
    theirs = path.knows(rival.times_s + fit.offset_s)
    shared = float(min(mine.mean(), theirs.mean()))
    if shared < _MIN_SHARED:
        return num * (fit.score - rival.score)
    stddev_m = min(fit.residual_stddev_m, rival.residual_stddev_m)
    return num * shared * float(rival.losses(stddev_m)[theirs].mean() - fit.losses(stddev_m)[mine].mean())
