"""ScaleEstimate: what the scale stage found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.scale.lengths import LengthScale
from rangesfm.scale.problem import ScaleProblem
from rangesfm.scale.solution import Solution
from rangesfm.scale.two_candidate import TwoCandidate

NORMAL_95 = 1.96


@dataclass(frozen=True)
class ScaleUncertainty:
    """Relative stddevs of the scale, by where they come from.

    Attributes:
        formal: from the Jacobian, as if every range erred on its own (Cramer-Rao).
        components: what each component of the ranges' errors does, by its name.
        lean: how far the middle of the interval is from the estimate: of the scale's logarithm.
    """

    formal: float
    components: dict[str, float]
    lean: float = 0.0

    @property
    def empirical(self) -> float:
        """The honest one: all components together, and never less than the formal one."""
        return max(float(np.linalg.norm(list(self.components.values()))), self.formal)

    def beside(self, name: str, stddev: float) -> ScaleUncertainty:
        """With more of a component."""
        return replace(
            self, components={**self.components, name: float(np.hypot(self.components.get(name, 0), stddev))}
        )

    @property
    def interval_95(self) -> tuple[float, float]:
        """Return the ends of the interval that holds the logarithm of the true scale over the estimate."""
        return self.lean - self.half_width_95, self.lean + self.half_width_95

    @property
    def half_width_95(self) -> float:
        """Return half the width of that interval."""
        return NORMAL_95 * self.empirical


@dataclass(frozen=True)
class ScaleByKind:
    """The scale by ranges alone, or by measured lengths alone, metres per SfM unit.

    Attributes:
        stddev: by all that they get wrong; inf where they do not determine it.
    """

    value: float
    stddev: float


@dataclass(frozen=True)
class CutoffTest:
    """The scale from ranges of at least some length, short ones weighing as much as others.

    Attributes:
        min_range_m: what is left out is shorter.
        scale: metres per SfM unit.
        stddev: metres per SfM unit, widened by the errors' correlation; not of the range model.
    """

    min_range_m: float
    scale: float
    stddev: float


@dataclass(frozen=True)
class ScaleSensitivity:
    """By how many percent the scale would change; where a bias is estimated, by what is left of it.

    Attributes:
        common_bias_per_cm: if all ranges were a centimetre longer.
        short_range_per_cm: if the ranges of the shorter half were.
        anchor_bias_per_cm: if those of one anchor were, by id.
        range_slope_per_percent: if all ranges were one percent longer.
        lever_arm_per_cm: if the tag sat a centimetre further along x, y, z of the camera.
    """

    common_bias_per_cm: float
    short_range_per_cm: float
    anchor_bias_per_cm: dict[str, float]
    range_slope_per_percent: float
    lever_arm_per_cm: tuple[float, float, float]


@dataclass(frozen=True)
class ScaleEstimate:
    """The scale, its frame, and how far to trust it.

    Attributes:
        metric_from_sfm: world of the unscaled model to the metric world.
        frame: "site" or "first_camera": the metric world.
        method: "robust" or "two-candidate".
        uncertainty: relative stddevs.
        verdict: "good" or "doubtful" (a refusal is a GeometryError).
        reasons: why, in words.
        advice: what to do about it, in words; of a finished survey too what would gain most next time.
        cutoff_test: whether the scale moves as short ranges are left out.
        sensitivity: to what the range model may have wrong.
        per_anchor: scale from each anchor alone; anchors that do not determine one are missing.
        two_candidate: the paper's table; None where no range has candidates.
        anchors: in the order of the log.
        observations: all ranges, with status by their final weight.
        errors: of all n ranges of the log, as weighted; their inflation widens the formal stddev.
        noise_stddev_m: stddev of a range away from all special cases.
        problem, solution: from which all of this was found; None where there were no ranges.
        placement: (7, 7) covariance of the logarithm of the scale, of a turn (rad) and of a shift (m) of the map about
            where the first camera is, by what the ranges get wrong; None where the frame is the first camera's.
        lengths: what measured lengths say by themselves; None: there are none between points of the map.
        remarks: reasons among these that no refinement changes.
        refined_value: scale of the map that was refined, which the uncertainty is then of; None of one that was not.
        by_kind: "ranges" and "lengths", as far as there are any, where lengths took part.
    """

    metric_from_sfm: Similarity
    frame: str
    method: str
    uncertainty: ScaleUncertainty
    verdict: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]
    cutoff_test: tuple[CutoffTest, ...]
    sensitivity: ScaleSensitivity
    per_anchor: dict[str, float]
    two_candidate: TwoCandidate | None
    anchors: tuple[AnchorEstimate, ...]
    observations: RangeObservations
    errors: RangeErrors
    noise_stddev_m: float
    problem: ScaleProblem | None = None
    solution: Solution | None = None
    placement: Array | None = None
    lengths: LengthScale | None = None
    by_kind: Mapping[str, ScaleByKind] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    refined_value: float | None = None

    @property
    def value(self) -> float:
        """Metres per SfM unit, of the map that is delivered."""
        return self.metric_from_sfm.scale if self.refined_value is None else self.refined_value

    @property
    def stddev_formal(self) -> float:
        """Metres per SfM unit, as if every range erred on its own."""
        return self.value * self.uncertainty.formal

    @property
    def stddev_empirical(self) -> float:
        """Metres per SfM unit, by all that ranges get wrong."""
        return self.value * self.uncertainty.empirical

    @property
    def interval_95(self) -> tuple[float, float]:
        """Metres per SfM unit between which the scale is with 95 % probability."""
        low, high = self.uncertainty.interval_95
        return self.value * float(np.exp(low)), self.value * float(np.exp(high))
