"""The scale estimate by the robust weights alone, from which it is moved to that by the best weights."""

from __future__ import annotations

from rangesfm.geometry.similarity import Similarity
from rangesfm.scale.scale_by_ranges import RangeScale
from rangesfm.scale.scale_estimate import ScaleEstimate


def metric_from_sfm_by_robust_weights(estimate: ScaleEstimate) -> Similarity:
    ranges = estimate.find(RangeScale)
    assert ranges is not None
    return ranges.placed
