"""ScaleEstimate: the result of the scale stage, with its verdict in a surveyor's words."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import JointMap
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.scale.range_estimate import RangeEstimate
from rangesfm.options import ScaleOptions
from rangesfm.solver.posterior import ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95, NOTHING_KNOWN
from rangesfm.util.geometry.similarity import Similarity


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


@dataclass(frozen=True)
class ScaleEstimate:
    """The scale, its frame and its uncertainty.

    Attributes:
        metric_from_sfm: similarity from the world of the unscaled model to the metric world, before a refinement.
        value: scale of the delivered map, in metres per SfM unit, to which the uncertainty refers.
        frame: the metric world: "site" or "first_camera".
        method: "robust", "two-candidate", or without ranges the first kind of measurement, such as "positions".
        uncertainty: relative standard deviations of the scale; infinite with two-candidate, which does not tell.
        verdict: "good" or "doubtful" (a refused scale is a GeometryError).
        reasons: why, in words.
        advice: what to do about it, in words; for a finished survey also what would improve the next one most.
        ranges: what is said of the ranges of the log, which may be none.
        on_map: what the estimate was computed from; without any kinds with two-candidate, which uses none of them.
        placement: (7, 7) covariance of the logarithm of the scale, a turn (rad) and a shift (m) of the map about the
            first camera, from all error components; None in the first camera's frame.
        remarks: those of the reasons that a refinement does not change.
        by_kind: scale by each kind of measurement alone, such as "ranges"; empty where one gave place and scale.
    """

    metric_from_sfm: Similarity
    value: float
    frame: str
    method: str
    uncertainty: ScaleUncertainty
    verdict: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]
    ranges: RangeEstimate
    on_map: JointMap
    placement: Array | None = None
    by_kind: Mapping[str, ScaleByKind] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def where_bent(self, options: ScaleOptions) -> ScaleEstimate:
        """Return the estimate of a map that is not refined where measurements bend it, anchors on their likelier sides.

        Raises:
            GeometryError: refused, as the scale is less certain than ``options.max_relative_stddev``.
        """
        found, on_map = self, self.on_map
        for each in on_map.kinds:
            for bent in each.bent(on_map):
                known = bent.posterior
                found = found.judged(
                    judge(bent.doubts, bent.remarks, known.uncertainty, options),
                    metric_from_sfm=bent.placed,
                    value=bent.placed.scale,
                    uncertainty=known.uncertainty,
                    placement=known.placement,
                    ranges=bent.kind.of_log(found.ranges),
                )
            for sides in each.sides(on_map):
                found = found.with_anchors(sides.applied_to(found.ranges.anchors))
        return found

    def with_anchors(self, anchors: tuple[AnchorEstimate, ...]) -> ScaleEstimate:
        """Return the estimate with others of the anchors."""
        return replace(self, ranges=replace(self.ranges, anchors=anchors))

    def remarked(self, remarks: tuple[str, ...]) -> ScaleEstimate:
        """Return the estimate with more remarks."""
        return replace(self, reasons=(*self.reasons, *remarks), remarks=(*self.remarks, *remarks))

    def judged(self, judged: Verdict, **changes: Any) -> ScaleEstimate:
        """Return the estimate with a verdict and other changes; remarks stay among the reasons."""
        reasons = (*judged.reasons, *self.remarks)
        return replace(self, verdict=judged.verdict, reasons=reasons, advice=judged.advice, **changes)

    def at_rest(self, on_map: JointMap, options: ScaleOptions) -> ScaleEstimate:
        """Return the estimate by a refined map, which is moved to this scale.

        Everything that is no judgement stays as it was before the refinement.

        Raises:
            GeometryError: refused, as the scale is less certain than ``options.max_relative_stddev``.
        """
        known = on_map.posterior
        return self.judged(
            judge_map_of_kinds(on_map, options),
            ranges=on_map.of_log(self.ranges),
            value=on_map.scale.value,
            uncertainty=known.uncertainty,
            placement=known.placement,
        )

    @property
    def stddev_formal(self) -> float:
        """Standard deviation in metres per SfM unit, as if all ranges erred independently."""
        return self.value * self.uncertainty.formal

    @property
    def stddev_empirical(self) -> float:
        """Standard deviation in metres per SfM unit, with all error components."""
        return self.value * self.uncertainty.empirical

    @property
    def interval_95(self) -> tuple[float, float]:
        """Bounds of the scale with 95 % probability, in metres per SfM unit."""
        low, high = self.uncertainty.interval_95
        return self.value * float(np.exp(low)), self.value * float(np.exp(high))

    def __repr__(self) -> str:
        """Return the scale with its interval and its verdict on one line."""
        low, high = self.interval_95
        return f"<scale {self.value:.6g} m per SfM unit, 95 % interval {low:.6g} to {high:.6g}, {self.verdict}>"
