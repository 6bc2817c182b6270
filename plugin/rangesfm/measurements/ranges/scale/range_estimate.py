"""What the scale stage says of the ranges of a log, besides the scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.sensitivity import NOT_KNOWN, ScaleSensitivity
from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate
from rangesfm.options import RangeModelOptions


@dataclass(frozen=True)
class RangeEstimate:
    """What an estimate of the scale says of the n ranges of a log, which may be none.

    Attributes:
        observations: all ranges of the log, with their status by final weight.
        errors: of all n ranges, as weighted; their inflation widens the formal standard deviation.
        noise_stddev_m: standard deviation of an ordinary range.
        median_off_m: median of the absolute differences of ranges and map; NaN if no range took part.
        anchors: estimates in the order of the log.
        per_anchor: scale from each anchor alone, by id; anchors that do not determine one are missing.
        sensitivity: change of the scale per error of the range model.
        two_candidate: the paper's table; None where too few ranges have candidates.
        shared_errors_m: (n, k) errors that the log's ranges share, for k independent standard deviations: what other
            kinds of measurement may correct. k is 0 where there are only ranges.
    """

    observations: RangeObservations
    errors: RangeErrors
    noise_stddev_m: float = np.nan
    median_off_m: float = np.nan
    anchors: tuple[AnchorEstimate, ...] = ()
    per_anchor: Mapping[str, float] = field(default_factory=dict)
    sensitivity: ScaleSensitivity = NOT_KNOWN
    two_candidate: TwoCandidate | None = None
    shared_errors_m: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def begun(cls, observations: RangeObservations, range_model: RangeModelOptions) -> RangeEstimate:
        """Return what is known of a log before its ranges are used."""
        return cls(observations, RangeErrors.begin(observations, observations.placed_rows, range_model))
