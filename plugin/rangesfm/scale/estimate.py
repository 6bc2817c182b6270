"""ScaleEstimate: what the scale stage found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangesfm.geometry import Similarity
from rangesfm.ranging.anchors import AnchorEstimate
from rangesfm.ranging.observations import RangeObservations
from rangesfm.scale.two_candidate import TwoCandidate

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ScaleUncertainty:
    """Relative stddevs of the scale, by where they come from.

    Attributes:
        formal: from the Jacobian, as if every range erred on its own (Cramer-Rao).
        bootstrap: resampling blocks of time, so that correlated errors count.
        jackknife: leaving out one anchor at a time; None with fewer than three.
        range_model: what an unmodelled offset and short-range error of usual size would do.
    """

    formal: float
    bootstrap: float
    jackknife: float | None
    range_model: float

    @property
    def empirical(self) -> float:
        """The honest one: the larger resampling figure, and the range model beside it."""
        return float(np.hypot(max(self.bootstrap, self.jackknife or 0.0), self.range_model))


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
        per_anchor: scale from each anchor alone; anchors that do not determine one are missing.
        two_candidate: the paper's table; None where no range has candidates.
        anchors: in the order of the log.
        observations: all ranges, with status by their final weight.
        range_stddev_m: (n,) noise of each range as weighted; NaN without a place.
        correlation_inflation: by how much the errors' correlation in time widens the formal stddev.
        noise_stddev_m: stddev of a range away from all special cases.
        resampled_scales: (k,) the robust scale from blocks of time drawn anew, metres per SfM unit.
    """

    metric_from_sfm: Similarity
    frame: str
    method: str
    uncertainty: ScaleUncertainty
    verdict: str
    reasons: tuple[str, ...]
    per_anchor: dict[str, float]
    two_candidate: TwoCandidate | None
    anchors: tuple[AnchorEstimate, ...]
    observations: RangeObservations
    range_stddev_m: Array
    correlation_inflation: float
    noise_stddev_m: float
    resampled_scales: Array

    @property
    def value(self) -> float:
        """Metres per SfM unit."""
        return self.metric_from_sfm.scale

    @property
    def stddev_formal(self) -> float:
        """Metres per SfM unit, as if every range erred on its own."""
        return self.value * self.uncertainty.formal

    @property
    def stddev_empirical(self) -> float:
        """Metres per SfM unit, by resampling and by what the range model leaves out."""
        return self.value * self.uncertainty.empirical
