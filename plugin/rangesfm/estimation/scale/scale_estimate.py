"""ScaleEstimate: the result of the scale stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from rangesfm.arrays import Array
from rangesfm.estimation.scale.scale_verdict import Verdict, judge_map_of_kinds
from rangesfm.measurements.joint_map import JointMap, KindOnMap
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.ranges.scale.sensitivity import NOT_KNOWN, ScaleSensitivity
from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate
from rangesfm.options import ScaleOptions
from rangesfm.solver.posterior import ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.similarity import Similarity

_Kind = TypeVar("_Kind", bound=KindOnMap)


@dataclass(frozen=True)
class ScaleEstimate:
    """The scale, its frame and its uncertainty.

    Attributes:
        metric_from_sfm: similarity from the world of the unscaled model to the metric world.
        frame: the metric world: "site" or "first_camera".
        method: "robust", "two-candidate", or without ranges the first kind of measurement, such as "positions".
        uncertainty: relative standard deviations of the scale; infinite with two-candidate, which does not tell.
        verdict: "good" or "doubtful" (a refused scale is a GeometryError).
        reasons: why, in words.
        advice: what to do about it, in words; for a finished survey also what would improve the next one most.
        sensitivity: change of the scale per error of the range model.
        per_anchor: scale from each anchor alone, by id; anchors that do not determine one are missing.
        two_candidate: the paper's table; None where too few ranges have candidates.
        anchors: estimates in the order of the log.
        observations: all ranges, with their status by final weight.
        errors: of all n ranges of the log, as weighted; their inflation widens the formal standard deviation.
        noise_stddev_m: standard deviation of an ordinary range.
        on_map: what the estimate was computed from; None with two-candidate.
        placement: (7, 7) covariance of the logarithm of the scale, a turn (rad) and a shift (m) of the map about the
            first camera, from all error components; None in the first camera's frame.
        shared_errors_m: (n, k) errors that the log's ranges share, for k independent standard deviations: what other
            kinds of measurement may correct. k is 0 where there are only ranges.
        remarks: those of the reasons that a refinement does not change.
        refined_value: scale of the refined map, to which the uncertainty then refers; None without a refinement.
        by_kind: scale by each kind of measurement alone, such as "ranges"; empty where one gave place and scale.
    """

    metric_from_sfm: Similarity
    frame: str
    method: str
    uncertainty: ScaleUncertainty
    verdict: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]
    observations: RangeObservations
    errors: RangeErrors
    sensitivity: ScaleSensitivity = NOT_KNOWN
    per_anchor: Mapping[str, float] = field(default_factory=dict)
    two_candidate: TwoCandidate | None = None
    anchors: tuple[AnchorEstimate, ...] = ()
    noise_stddev_m: float = np.nan
    on_map: JointMap | None = None
    placement: Array | None = None
    by_kind: Mapping[str, ScaleByKind] = field(default_factory=dict)
    shared_errors_m: Array = field(default_factory=lambda: np.zeros((0, 0)))
    remarks: tuple[str, ...] = ()
    refined_value: float | None = None

    def find(self, kind: type[_Kind]) -> _Kind | None:
        """Return the measurements of a kind that took part, or were tested; None without any."""
        return None if self.on_map is None else self.on_map.find(kind)

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
        known, found = on_map.posterior, self
        if (ranges := on_map.find(RangeScale)) is not None:
            learned = ranges.learnt(on_map).spread(ranges.posed.rows, len(self.observations.log))
            found = replace(
                self,
                errors=replace(self.errors, learned=learned),
                noise_stddev_m=ranges.solution.noise_stddev_m,
            )
        return found.judged(
            judge_map_of_kinds(on_map, options),
            refined_value=on_map.scale.value,
            uncertainty=known.uncertainty,
            placement=known.placement,
        )

    @property
    def value(self) -> float:
        """Scale of the delivered map, in metres per SfM unit."""
        return self.metric_from_sfm.scale if self.refined_value is None else self.refined_value

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
