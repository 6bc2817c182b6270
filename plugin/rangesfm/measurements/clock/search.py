"""Search for the offset between two clocks, from the motion that both have measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangesfm.errors import GeometryError
from rangesfm.measurements.clock.fit import SEPARATION_S, Observed, OffsetFit, fit_clocks, refine_offset
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.progress import SILENT, Progress
from rangesfm.util.geometry.numerics import NORMAL_95, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import MIN_COST_GAP
from rangesfm.util.geometry.trajectory import MIN_NUM_KEYFRAMES, Trajectory

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
MAX_NUM_CANDIDATES = 12
"""Largest number of offsets of the scan from which the search begins."""
# Numbers of observations that suffice to compare candidates, and for the final estimate.
_NUM_PER_CANDIDATE = 3000
_NUM_OF_FINAL = 40000
# An offset with a larger standard deviation is refused.
_MOST_UNCERTAIN_S = 0.5


def require_enough(trajectory: Trajectory, num: int, kind: type[Observed]) -> None:
    """Raise GeometryError if there are too few photos to compare with, or no observation."""
    if len(trajectory) < MIN_NUM_KEYFRAMES or not num:
        raise GeometryError(
            f"{len(trajectory)} photos and {num} {kind.name} are too few to find the time offset: {kind.remedy}"
        )


def offset_of_motion(observed: Observed, *, seed: int = 0, progress: Progress = SILENT) -> TimeOffset:
    """Estimate the offset from motion: scan all offsets, refine the best few, and find out which of them are likely.

    Args:
        observed: what the offset is found from.
        seed: seed of the choice of observations where there are more than needed.
        progress: receives the number of candidates that have been examined.

    Raises:
        GeometryError: the motion does not determine the offset, not even up to a few alternatives.
    """
    # All offsets use observations in the same random order, so that different offsets are compared by the same ones.
    mixed = observed.take(np.random.default_rng(seed).permutation(len(observed.times_s)))
    candidates = observed.scan(observed.start_weights).peaks(SEPARATION_S, MAX_NUM_CANDIDATES)
    fits: list[OffsetFit] = []
    for num_done, offset_s in enumerate(candidates):
        progress.update(num_done, len(candidates))
        near = mixed.first_on_path(offset_s, _NUM_PER_CANDIDATE)
        if len(near.times_s):
            best = max((fit for fit in fits if fit.is_testable), key=lambda fit: fit.score, default=None)
            fits.append(refine_offset(near, offset_s, best))
    progress.update(len(candidates), len(candidates))
    (best, probability), *rivals = _likely_fits(fits, observed)
    final, found = fit_clocks(mixed.first_on_path(best.offset_s, _NUM_OF_FINAL), best.offset_s)
    is_certain = bool(found.stddev_s * np.sqrt(np.mean(final.rates**2)) < final.residual_stddev)
    said = f"(about {final.offset_s:+.2f} s, within {NORMAL_95 * found.stddev_s:.2g} s, 95 %)"
    if not is_certain and not found.stddev_s < _MOST_UNCERTAIN_S:
        raise GeometryError(f"the motion is too even to tell the time offset {said}: {observed.remedy}")
    uneven = f"the motion is too even to tell the time offset well {said}: {observed.remedy} if you know it better"
    found = replace(
        found,
        curve=final.observed.scan(final.weights_of_each).around(final.offset_s),
        note="; ".join(filter(None, (found.note, "" if is_certain else uneven))),
        probability=probability,
        is_certain=is_certain,
    )
    return found.beside((fit.offset_s, probability) for fit, probability in rivals)


def _likely_fits(fits: Sequence[OffsetFit], observed: Observed) -> list[tuple[OffsetFit, float]]:
    """Return the fits that cannot be ruled out, with their probabilities, the most likely first.

    Args:
        observed: all that was observed.

    Raises:
        GeometryError: there are too many of them, or the best explains nothing.
    """
    name, remedy, log_s = observed.name, observed.remedy, float(np.ptp(observed.times_s))
    num_on_path = np.array([np.count_nonzero(observed.on_path(fit.offset_s)) for fit in fits])
    order = [k for k in np.argsort([-fit.score for fit in fits] * num_on_path) if fits[k].is_testable]
    if not order:
        raise GeometryError(
            f"too few {name} along the camera's path to find the time offset (the log lasts {log_s:.4g} s, the photos "
            f"{observed.path.span_s:.4g} s): {remedy}"
        )
    best, most = fits[order[0]], num_on_path[order[0]]
    same_s = max(SEPARATION_S, SIGNIFICANT_STDDEVS * min(best.timed().stddev_s, 1.0))
    shorter_s, longer_s = sorted([log_s, observed.path.span_s])
    difference = max(1.0 - shorter_s / longer_s, _LEAST_DIFFERENCE)
    # Two durations of which nothing is known differ by less than a small share with twice that probability.
    prior_of_the_others = _PRIOR_OF_THE_OTHERS * min(2.0 * difference, 1.0)
    distinct: list[OffsetFit] = []
    log_likelihoods: list[float] = []
    for number in order:
        fit, covers = fits[number], num_on_path[number] >= _COVERING_SHARE * most
        if all(abs(fit.offset_s - other.offset_s) > same_s for other in distinct):
            distinct.append(fit)
            log_likelihoods.append(-_log_odds(best, fit) + np.log(1.0 if covers else prior_of_the_others))
    likely = likely_offsets([fit.offset_s for fit in distinct], log_likelihoods, remedy)
    found = [(distinct[k], probability) for k, probability in likely]
    if not found[0][0].explains():
        raise GeometryError(
            f"at no time offset do the {name} follow the camera's path (it hardly moves, its photos are "
            f"too far apart, or the log belongs to other photos): {remedy}"
        )
    return found


def likely_offsets(offsets_s: Sequence[float], log_likelihoods: npt.ArrayLike, remedy: str) -> list[tuple[int, float]]:
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


def _log_odds(fit: OffsetFit, rival: OffsetFit) -> float:
    """Return the logarithm of the likelihood ratio of two fits, for the number of observations with independent errors.

    What both put on the path has the same noise, so that its residuals are compared in one unit. A unit for each, from
    some hundred residuals, differs by chance by more than the residuals do.
    """
    num = min(fit.num_independent, rival.num_independent)
    mine = np.repeat(fit.observed.on_path(rival.offset_s), fit.num_each)
    theirs = np.repeat(rival.observed.on_path(fit.offset_s), rival.num_each)
    shared = float(min(mine.mean(), theirs.mean()))
    if shared < _MIN_SHARED:
        return num * (fit.score - rival.score)
    stddev = min(fit.residual_stddev, rival.residual_stddev)
    return num * shared * float(rival.losses(stddev)[theirs].mean() - fit.losses(stddev)[mine].mean())
