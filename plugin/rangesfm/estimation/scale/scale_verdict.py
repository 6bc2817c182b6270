"""The verdict on a scale, good, doubtful or refused, with reasons and advice in a surveyor's words."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import Doubt, JointMap
from rangesfm.options import ScaleOptions
from rangesfm.solver.posterior import ScaleUncertainty
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95, NOTHING_KNOWN


@dataclass(frozen=True)
class Verdict:
    """The verdict on a scale.

    Attributes:
        verdict: "good" or "doubtful".
        reasons: in words.
        advice: what to do about the faults, in words; what would improve the survey most is part of its plan.
    """

    verdict: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]


def judge(
    doubts: Iterable[Doubt], remarks: Iterable[Doubt], uncertainty: ScaleUncertainty, options: ScaleOptions
) -> Verdict:
    """Return the verdict by the 95 % interval, and by faults that make the interval itself doubtful.

    Args:
        doubts: such faults. remarks: what is to be said without any doubt.

    Raises:
        GeometryError: refused, because the scale is less certain than ``options.max_relative_stddev`` allows.
    """
    half_width, doubts = uncertainty.half_width_95, [*doubts]
    why, advised = [doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts if doubt.advice]
    refuse_unknown(half_width, why, advised, options)
    percent = f"{100 * half_width:.1f}" if half_width >= 1e-3 else f"{100 * half_width:.1g}"
    summary = f"the scale is known to {percent} % (95 % interval)"
    if half_width > DOUBTFUL_ABOVE:
        doubts.insert(0, Doubt(f"{summary}, worse than {100 * DOUBTFUL_ABOVE:g} %"))
    said = [*doubts, *remarks]
    advice = tuple(dict.fromkeys(each.advice for each in said if each.advice))
    reasons = tuple(each.reason for each in said)
    if not doubts:
        return Verdict("good", (summary, *reasons), advice)
    return Verdict("doubtful", reasons, advice)


def judge_map_of_kinds(on_map: JointMap, options: ScaleOptions) -> Verdict:
    """Return the verdict on a map with all that is measured in it, as ``judge``.

    The first kind that is used says what makes the interval doubtful.
    """
    first = next(each for each in on_map.kinds if each.is_used)
    uncertainty = on_map.posterior.uncertainty
    remarks = itertools.chain.from_iterable(each.remarks(on_map) for each in on_map.kinds)
    return judge(first.doubts(uncertainty), remarks, uncertainty, options)


def refuse_unknown(half_width: float, reasons: Sequence[str], advice: Sequence[str], options: ScaleOptions) -> None:
    """Raise GeometryError if a scale is less certain than allowed, with the first reason and the first advice.

    Args:
        half_width: half of the 95 % interval of the scale, relative.
    """
    if half_width > NORMAL_95 * options.max_relative_stddev:
        planned = "plan the survey first (rangesfm plan), to see what would make the scale more certain"
        if half_width > NORMAL_95 * NOTHING_KNOWN:
            known = "the scale is not determined"
        else:
            allowed = 100 * NORMAL_95 * options.max_relative_stddev
            known = (
                f"the scale is only known to {100 * half_width:.1f} % (95 % interval), worse than the {allowed:.3g} % "
                f"allowed ({NORMAL_95} times max_relative_stddev)"
            )
        raise GeometryError(
            f"{known}{''.join(f': {reason}' for reason in reasons[:1])}; next time: {next(iter(advice), planned)}"
        )
