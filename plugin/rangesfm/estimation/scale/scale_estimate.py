"""ScaleEstimate: the result of the scale stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.estimation.scale.scale_verdict import Verdict, judge, judge_map_of_kinds
from rangesfm.measurements.joint_map import JointMap, KindOnMap
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.range_estimate import RangeEstimate
from rangesfm.measurements.ranges.scale.sensitivity import ScaleSensitivity
from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate
from rangesfm.options import ScaleOptions
from rangesfm.solver.posterior import ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.similarity import Similarity


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

    @property
    def observations(self) -> RangeObservations:
        """All ranges of the log, with their status by final weight."""
        return self.ranges.observations

    @property
    def errors(self) -> RangeErrors:
        """Errors of all ranges of the log, as weighted."""
        return self.ranges.errors

    @property
    def noise_stddev_m(self) -> float:
        """Standard deviation of an ordinary range."""
        return self.ranges.noise_stddev_m

    @property
    def anchors(self) -> tuple[AnchorEstimate, ...]:
        """Estimates of the anchors in the order of the log."""
        return self.ranges.anchors

    @property
    def per_anchor(self) -> Mapping[str, float]:
        """Scale from each anchor alone, by id; anchors that do not determine one are missing."""
        return self.ranges.per_anchor

    @property
    def sensitivity(self) -> ScaleSensitivity:
        """Change of the scale per error of the range model."""
        return self.ranges.sensitivity

    @property
    def two_candidate(self) -> TwoCandidate | None:
        """The paper's table; None where too few ranges have candidates."""
        return self.ranges.two_candidate

    @property
    def kinds(self) -> tuple[KindOnMap, ...]:
        """The measurements from which it was computed."""
        return self.on_map.kinds

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
                found = found.with_anchors(sides.applied_to(found.anchors))
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
