"""The scale estimate by the robust weights alone, from which it is moved to that by the best weights."""

from __future__ import annotations

from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.util.geometry.similarity import Similarity


def metric_from_sfm_by_robust_weights(estimate: ScaleEstimate) -> Similarity:
    ranges = find_kind(estimate.kinds, RangeScale)
    assert ranges is not None
    return ranges.start
