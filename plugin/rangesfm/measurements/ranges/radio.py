"""What the log of a radio measures: ranges to anchors, and lengths between anchors that ranged to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.measurements.kind import MapState, Measurements
from rangesfm.measurements.lengths.cost import Lengths
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.anchors.anchor_distances import AnchorDistances
from rangesfm.measurements.ranges.cost import Ranges
from rangesfm.measurements.ranges.errors.noise import shared_stddev
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory

# Standard deviation of the median of normally distributed values over that of their mean: sqrt(pi / 2).
_MEDIAN_OVER_MEAN = 1.2533


def ranges_of_map(
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[AnchorEstimate],
    errors: RangeErrors,
    options: RefineOptions,
) -> Ranges:
    """Return the ranges of a log on a metric map; arguments as for ``refine_with_ranges``."""
    log, times_s = observations.log, trajectory.timestamps_s
    before, after, tags_in_cam_m = observations.before, observations.after, log.lever_arms(tag_in_cam_m)
    interval_s = np.zeros(len(log)) if times_s is None else times_s[after] - times_s[before]
    of_camera = AntennaPlaces(before, after, observations.fraction, interval_s, observations.center_offsets)
    arms_in_cam_m, arms_m = tags_in_cam_m[log.tag_index], observations.tag_from_center
    return Ranges(
        observations,
        of_camera.on_map(trajectory, arms_in_cam_m, arms_m, metric_from_sfm),
        tags_in_cam_m,
        tuple(anchors),
        errors.subset(observations.placed_rows),
        np.zeros((len(log), 0)),
        options,
        metric_from_sfm.scale,
    )


def measured_by_radio(ranges: Ranges, points: NamedPoints) -> Iterator[Measurements]:
    """Yield the ranges of a log to anchors on a metric map, and the lengths between anchors, if there are any."""
    if ranges.takes_part:
        ranges = ranges.begun(MapState(points.state.poses, ranges.blocks))
    yield ranges
    if len((by_radio := _between_anchors(ranges, points)).ends):
        yield by_radio


def _between_anchors(ranges: Ranges, points: NamedPoints) -> Lengths:
    """Return the lengths between anchors that ranged to each other."""
    anchors, used_m = ranges.anchors, ranges.errors.stddev_m
    found = lengths_by_radio(
        ranges.observations.log,
        float(np.median(used_m)) if len(used_m) else 0.0,
        np.array([anchor.prior_bias_m for anchor in anchors]),
        np.array([anchor.prior_bias_stddev_m for anchor in anchors]),
        common_bias_stddev_m=0.0,
    )
    ends = [tuple(anchors[k].anchor_id for k in pair) for pair in found.anchor_pair.tolist()]
    rows = [row for row, pair in enumerate(ends) if all(("anchor", name) in points.state.blocks for name in pair)]
    return Lengths(
        tuple((ends[row][0], ends[row][1]) for row in rows),
        points,
        found.distance_m[rows],
        found.stddev_m[rows],
        {},
        bias_stddev_m=ranges.errors.common_bias_stddev_m,
        loss=ranges.errors.loss,
    )


def lengths_by_radio(
    log: RangeLog, noise_m: float, bias_m: Array, bias_stddev_m: Array, common_bias_stddev_m: float
) -> AnchorDistances:
    """Return one length for each pair of anchors that ranged: the median of their ranges in both directions.

    All ranges of a pair share the error from the same delays and reflections, so that many are hardly better than one.
    A bias belongs to an anchor's ranges with the tag. Ranges between two anchors get the mean of their two biases.

    Args:
        noise_m: standard deviation of a range for which the log gives none.
        bias_m, bias_stddev_m: (num_anchors,) known bias of each anchor's ranges, and its standard deviation.
        common_bias_stddev_m: standard deviation of the bias that all ranges between anchors share.
    """
    rows = np.flatnonzero(log.kind == RangeKind.ANCHOR_ANCHOR)
    ends = np.column_stack([log.peer_index, log.anchor_index])[rows]
    range_m, given = log.range_m[rows], log.range_stddev_m[rows]
    pairs, index = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    index = index.reshape(-1)
    count = np.bincount(index, minlength=len(pairs))
    noise = np.where(np.isfinite(given), given, noise_m)
    medians = np.array([np.median(range_m[index == k]) for k in range(len(pairs))])
    mean_square = np.bincount(index, noise**2, len(pairs)) / count
    shared = np.bincount(index, shared_stddev(log.range_m, log.shared_stddev_m)[rows], len(pairs)) / count
    first, second = pairs.reshape(-1, 2).T
    variance = _MEDIAN_OVER_MEAN**2 * mean_square / count + shared**2 + common_bias_stddev_m**2
    variance += bias_stddev_m[first] ** 2 + bias_stddev_m[second] ** 2
    corrected_m = medians - (bias_m[first] + bias_m[second]) / 2
    return AnchorDistances(pairs.reshape(-1, 2), corrected_m, np.sqrt(variance))


def ranges_of(kinds: Sequence[Measurements]) -> Ranges:
    """Return the ranges among the measurements of a map."""
    return next(kind for kind in kinds if isinstance(kind, Ranges))
