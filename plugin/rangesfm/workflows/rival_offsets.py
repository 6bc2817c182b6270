"""What the offsets of the clocks that cannot be ruled out would do to the scale."""

from __future__ import annotations

from rangesfm.distances.ends import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.clock.estimate import TimeOffset
from rangesfm.ranging.clock.rivals import REMEDY, Rival
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.workflows.placed_ranges import ranges_on_path
from rangesfm.workflows.survey_stages import estimate_scale

# Scales further apart than this are no answer, unless one of the offsets is nearly certain.
_MAX_SPREAD = 0.03
_NEARLY_CERTAIN = 0.95


def doubts_by_rivals(
    survey: Survey,
    inputs: RangingInputs,
    trajectory: Trajectory,
    distances: LocatedDistances | None,
    offset: TimeOffset,
    scale: float,
) -> tuple[str, ...]:
    """Solve the scale for every rival of an offset; its doubts in words, none if there is no rival.

    Args:
        distances: as the scale was estimated with.
        scale: at the offset, metres per SfM unit.

    Raises:
        GeometryError: the offset is not certain, and another scale follows from a rival.
    """
    doubts, far_apart = [], []
    for rival in offset.rivals:
        said = f"{rival.value_s:+.2f} s ({rival.probability:.0%})"
        other = _scale_of(rival, survey, inputs, trajectory, distances, offset)
        if other is None:
            doubts.append(f"the time offset may also be {said}, which gives no scale")
            continue
        change = other / scale - 1
        doubts.append(f"the time offset may also be {said}, which gives a scale of {other:.6g} ({change:+.1%})")
        if abs(change) > _MAX_SPREAD:
            far_apart.append(f"{said} gives {other:.6g} ({change:+.1%})")
    if far_apart and offset.probability < _NEARLY_CERTAIN:
        raise GeometryError(
            "the motion leaves the time offset open, and the scale with it: "
            f"{offset.value_s:+.2f} s ({offset.probability:.0%}) gives {scale:.6g} m per unit, "
            f"{', '.join(far_apart)}: {REMEDY}"
        )
    return tuple(doubts)


def _scale_of(
    rival: Rival,
    survey: Survey,
    inputs: RangingInputs,
    trajectory: Trajectory,
    distances: LocatedDistances | None,
    offset: TimeOffset,
) -> float | None:
    assert inputs.log.timestamp_s is not None, "clocks belong to a log with times"
    offsets_s = offset.of_rival(rival).at(inputs.log.timestamp_s)
    try:
        observations = ranges_on_path(survey, inputs, trajectory, offsets_s)
        return estimate_scale(survey, inputs, observations, trajectory, inputs.anchor_frame, distances).value
    except GeometryError:
        return None
