"""Range errors with known values, in the form in which the scale stage finds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.measurements.kind import MapState
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.radio import ranges_of_map
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.options import RangeModelOptions, RefineOptions
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]


def known_errors(
    observations: RangeObservations,
    stddev_m: float | Array,
    *,
    is_estimated: bool = False,
    inflation: float = 1.0,
    common_bias_stddev_m: float = RangeModelOptions().common_bias_stddev_m,
) -> RangeErrors:
    """Return errors of all ranges of the log that have a place.

    Args:
        stddev_m: of every range, or (n,) of each, including the part that short ranges share.
        is_estimated: whether the refinement is to estimate the noise anew.
    """
    rows, num = observations.placed_rows, len(observations.log)
    options = RangeModelOptions(common_bias_stddev_m=common_bias_stddev_m)
    begun = RangeErrors.begin(observations, rows, options)
    stddev = np.broadcast_to(stddev_m, num)[rows]
    noise = np.sqrt(np.maximum(stddev**2 - begun.shared_m**2, 1e-6))
    found = replace(
        begun,
        stddev_m=stddev,
        given_m=np.full(len(rows), np.nan) if is_estimated else noise,
        inflation=inflation,
    )
    return found.spread(rows, num)


def predicted_by_model(
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[AnchorEstimate],
) -> Array:
    """Return the (n,) ranges predicted by a metric model, NaN without a place; arguments as for a refinement."""
    errors, options = known_errors(observations, 0.1), RefineOptions()
    ranges = ranges_of_map(trajectory, observations, metric_from_sfm, tag_in_cam_m, anchors, errors, options)
    return ranges.predicted_m(MapState(model_poses(metric, trajectory.frame_ids), ranges.blocks))
