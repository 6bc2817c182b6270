"""RangesOnMap: the ranges of a survey on a map, with all that a mistake could have changed of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.observations import RangeObservations
from rangesfm.scale.range_equation import RangeProblem, RangeState


@dataclass(frozen=True)
class RangesOnMap:
    """n ranges that took part in an estimate, and its state.

    Attributes:
        problem: with stddevs of 1, so that its residuals and Jacobians are in metres.
        state: the estimate.
        given_m: (m, 3) positions of the anchors as somebody gave them; NaN where nobody did.
        world_from_cam: (n, 3, 3) in the metric world.
        velocity_m_per_s: (n, 3) of the camera; None where ranges have no times.
        time_s: (n,) on the radio's clock; where the log names photos, the way along the path in metres.
        tag_index: (n,). tag_ids, anchor_ids: by index.
        rows: (n,) of the log.
        weights: (n,) robust weights by which the estimate took them.
    """

    problem: RangeProblem
    state: RangeState
    given_m: Array
    world_from_cam: Array
    velocity_m_per_s: Array | None
    time_s: Array
    tag_index: Indices
    tag_ids: tuple[str, ...]
    anchor_ids: tuple[str, ...]
    rows: Indices
    weights: Array


def ranges_on_map(
    observations: RangeObservations,
    trajectory: Trajectory,
    metric_from_sfm: Similarity,
    anchors: Sequence[AnchorEstimate],
    errors: RangeErrors,
    weights: Array,
    *,
    frame_is_free: bool,
    refined: Trajectory | None = None,
    gravity: Gravity | None = None,
) -> RangesOnMap:
    """Of a scaled map, or of a refined one.

    Args:
        observations: on the unscaled path. trajectory: that path.
        anchors: as estimated with the map. weights: (N,) of all ranges of the log.
        refined: the same keyframes in the refined map.
        gravity: as somebody told it.
    """
    log = observations.log
    rows = observations.placed_rows
    rows = rows[np.isfinite(errors.stddev_m[rows])]
    before, after, weight = observations.before[rows], observations.after[rows], observations.weight[rows]
    nearest = np.where(weight < 0.5, before, after)
    turned = observations.tag_from_center[rows] @ metric_from_sfm.rotation.T
    if refined is None:
        path = trajectory.transformed(metric_from_sfm.scale, metric_from_sfm.rotation, metric_from_sfm.translation)
        centers = metric_from_sfm.apply(observations.centers[rows])
    else:
        path = refined
        offsets = metric_from_sfm.scale * observations.center_offsets[rows] @ metric_from_sfm.rotation.T
        centers = (1 - weight)[:, None] * path.centers[before] + weight[:, None] * path.centers[after] + offsets
        turns = path.world_from_cam @ np.swapaxes(metric_from_sfm.rotation @ trajectory.world_from_cam, 1, 2)
        turned = np.einsum("nij,nj->ni", turns[nearest], turned)
    first = path.centers[0]
    num = len(rows)
    problem = RangeProblem(
        centers=centers - first,
        tag_from_center=turned,
        anchor_index=log.anchor_index[rows],
        range_m=log.range_m[rows],
        stddev_m=np.ones(num),
        anchor_mean_m=np.array(
            [np.full(3, np.nan) if a.prior_position_m is None else a.prior_position_m for a in anchors]
        ).reshape(-1, 3),
        anchor_stddev_m=np.array([a.prior_position_stddev_m for a in anchors]),
        bias_mean_m=np.array([a.prior_bias_m for a in anchors]),
        bias_stddev_m=np.array([a.prior_bias_stddev_m for a in anchors]),
        common_bias_stddev_m=errors.common_bias_stddev_m,
        frame_is_free=frame_is_free,
        gravity=replace(gravity, up_in_first_camera=path.world_from_cam[0] @ gravity.up_in_first_camera)
        if gravity is not None and frame_is_free
        else None,
    )
    state = RangeState(
        Similarity(1.0, np.eye(3), first),
        np.array([a.position_m for a in anchors]).reshape(-1, 3),
        np.array([a.range_bias_m for a in anchors]),
    )
    return RangesOnMap(
        problem=problem,
        state=state,
        given_m=problem.anchor_mean_m,
        world_from_cam=path.world_from_cam[nearest],
        velocity_m_per_s=_velocities(path, nearest) if log.timestamp_s is not None else None,
        time_s=log.timestamp_s[rows] if log.timestamp_s is not None else _way(path)[nearest],
        tag_index=log.tag_index[rows],
        tag_ids=log.tag_ids,
        anchor_ids=log.anchor_ids,
        rows=rows,
        weights=weights[rows],
    )


def _velocities(path: Trajectory, keyframe: Indices) -> Array | None:
    times = path.timestamps_s
    if times is None or len(times) < 2 or (np.diff(times) <= 0).any():  # two cameras at once have no one way
        return None
    return np.asarray(np.gradient(path.centers, times, axis=0)[keyframe])


def _way(path: Trajectory) -> Array:
    """(k,) from the first keyframe to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path.centers, axis=0), axis=1))])
