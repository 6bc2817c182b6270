"""What other likely time offsets of the clocks would change in the scale of a map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.positions.clock import TimedPositions
from rangesfm.measurements.ranges.timed_ranges import TimedRanges
from rangesfm.pipeline.metric_result import Rivals
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.geometry.trajectory import Trajectory

# Two likely time offsets whose scales differ by more than this fraction leave the scale undetermined, ...
_MAX_SPREAD = 0.03
# ... unless all offsets with such different scales together have a probability of at most this.
_HARDLY_LIKELY = 0.05


def by_rivals(run: SurveyRun, path: PathOfModel, estimate: ScaleEstimate) -> Rivals:
    """Return what other likely time offsets would change, of the clock of the ranges and of that of the positions.

    Raises:
        GeometryError: as for ``scale_by_rivals``.
    """
    offset, track, trajectory = path.time_offset, run.inputs.positions.antenna, path.trajectory

    def at_ranges_offset(other: TimeOffset) -> ScaleEstimate:
        observations = run.ranges_on(trajectory, replace(path, time_offset=other).offset_s)
        return run.estimate_scale(replace(path, observations=observations), path.as_walk)

    def at_positions_offset(other: TimeOffset) -> ScaleEstimate:
        antenna = track and replace(track, offset=other)
        positions = replace(run.inputs.positions, antenna=antenna)
        return replace(run, inputs=replace(run.inputs, positions=positions)).estimate_scale(path, path.as_walk)

    found = list[Rivals]()
    if offset.rivals:
        found.append(scale_by_rivals(estimate, trajectory, offset, at_ranges_offset, "", TimedRanges.remedy))
    if track is not None and (search := track.offset) is not None and search.rivals:
        remedy = TimedPositions.remedy
        found.append(scale_by_rivals(estimate, trajectory, search, at_positions_offset, " of the positions", remedy))
    return Rivals(sum((each.doubts for each in found), ()), math.hypot(*(each.stddev for each in found)))


def scale_by_rivals(
    estimate: ScaleEstimate,
    path: Trajectory,
    offset: TimeOffset,
    estimate_at: Callable[[TimeOffset], ScaleEstimate],
    whose: str,
    remedy: str,
) -> Rivals:
    """Estimate the scale for every other likely time offset of a clock.

    Args:
        estimate: at this offset. path: of the unscaled model. offset: with its rivals.
        estimate_at: returns the estimate at another offset, or raises GeometryError.
        whose: the clock is, in words. remedy: what the user can do.

    Returns:
        Doubts in words, and the relative stddev of the scale that comes from the choice among the offsets: the larger
        of their stddev by their probabilities, and that whose 95 % interval holds the scales of all. Offsets with very
        different scales are left out of it; they are hardly likely, or there is an error.

    Raises:
        GeometryError: a very different scale follows from other offsets, and they are not unlikely.
    """
    doubts, far_apart, far_probability, variance, farthest = list[str](), list[str](), 0.0, 0.0, 0.0
    for rival in offset.rivals:
        said = f"{rival.value_s:+.2f} s ({rival.probability:.0%})"
        try:
            other = estimate_at(rival)
        except GeometryError:
            doubts.append(f"the time offset{whose} may also be {said}, which gives no scale")
            continue
        change = other.value / estimate.value - 1
        doubt = f"the time offset{whose} may also be {said}, which gives a scale of {other.value:.6g} ({change:+.1%})"
        if "site" == estimate.frame == other.frame:
            apart_m = other.metric_from_sfm.apply(path.centers) - estimate.metric_from_sfm.apply(path.centers)
            doubt += f" and puts photos up to {np.linalg.norm(apart_m, axis=1).max():.2g} m elsewhere"
        doubts.append(doubt)
        if abs(change) > _MAX_SPREAD:
            far_apart.append(f"{said} gives {other.value:.6g} ({change:+.1%})")
            far_probability += rival.probability
        else:
            apart = abs(float(np.log1p(change)))
            variance, farthest = variance + rival.probability * apart**2, max(farthest, apart)
    if far_probability > _HARDLY_LIKELY:
        raise GeometryError(
            f"the motion does not determine the time offset{whose}, nor the scale that depends on it: "
            f"{offset.value_s:+.2f} s ({offset.probability:.0%}) gives {estimate.value:.6g} m per unit, "
            f"{', '.join(far_apart)}: {remedy}"
        )
    return Rivals(tuple(doubts), max(float(np.sqrt(variance)), farthest / NORMAL_95))
