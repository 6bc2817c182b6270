"""Where the antenna was at each range, by the poses of the keyframes around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.observations import RangeObservations

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Antennas:
    """The antenna of n ranges: ``(1 - weight) * p_before + weight * p_after + offset``, ``p = c + R tag_in_cam``.

    Attributes:
        before, after: (n,) keyframes of the trajectory; -1 without a place.
        weight: (n,) in [0, 1].
        tag_in_cam_m: (n, 3).
        offset_in_world_m: (n, 3) what the curved path has beyond the straight line; it stays as the map bends.
    """

    before: Indices
    after: Indices
    weight: Array
    tag_in_cam_m: Array
    offset_in_world_m: Array

    def positions(self, centers: Array, world_from_cam: Array) -> Array:
        """(n, 3) in the world of (k, 3) centres and (k, 3, 3) rotations."""
        before, after = (
            centers[ends] + np.einsum("nij,nj->ni", world_from_cam[ends], self.tag_in_cam_m)
            for ends in (self.before, self.after)
        )
        weight = self.weight[:, None]
        positions: Array = (1 - weight) * before + weight * after + self.offset_in_world_m
        return positions

    def subset(self, rows: Indices) -> Antennas:
        """Of some of the ranges."""
        return Antennas(
            self.before[rows],
            self.after[rows],
            self.weight[rows],
            self.tag_in_cam_m[rows],
            self.offset_in_world_m[rows],
        )


def antennas(
    trajectory: Trajectory, observations: RangeObservations, metric_from_sfm: Similarity, tag_in_cam_m: npt.ArrayLike
) -> Antennas:
    """Antennas of all ranges.

    Args:
        trajectory, observations: of the unscaled model.
        metric_from_sfm: to the world of the poses that will be asked for.
        tag_in_cam_m: (3,) or (num_tags, 3), in the order of the log's tags.

    Raises:
        ValueError: tag_in_cam_m of another shape.
    """
    tags_in_cam = tags_in_cam_of_ranges(observations.log, tag_in_cam_m)
    turns, weight = trajectory.world_from_cam, observations.weight[:, None]
    before, after = (
        np.einsum("nij,nj->ni", turns[ends], tags_in_cam) for ends in (observations.before, observations.after)
    )
    on_line = (1 - weight) * before + weight * after
    beyond = metric_from_sfm.scale * observations.center_offsets + observations.tag_from_center - on_line
    return Antennas(
        observations.before,
        observations.after,
        observations.weight,
        tags_in_cam,
        beyond @ metric_from_sfm.rotation.T,
    )


def tags_in_cam_of_ranges(log: RangeLog, tag_in_cam_m: npt.ArrayLike) -> Array:
    """(n, 3) antenna that took each range, in the camera frame: of one tag (3,), or of each of the log's (num_tags, 3).

    Raises:
        ValueError: of another shape.
    """
    return tags_in_cam(log, tag_in_cam_m)[log.tag_index]


def tags_in_cam(log: RangeLog, tag_in_cam_m: npt.ArrayLike) -> Array:
    """(num_tags, 3) in the order of the log's tags, where all may have been given as one (3,).

    Raises:
        ValueError: of another shape.
    """
    tags, num_tags = np.asarray(tag_in_cam_m, dtype=np.float64), len(log.tag_ids)
    if tags.shape not in ((3,), (num_tags, 3)):
        raise ValueError(f"tag_in_cam_m is {tags.shape}, expected (3,) or ({num_tags}, 3): one for each tag")
    return np.broadcast_to(tags, (num_tags, 3))


def antenna_positions(metric: pycolmap.Reconstruction, trajectory: Trajectory, antennas: Antennas) -> Array:
    """(n, 3) in the world of a metric model with the trajectory's keyframes."""
    times = (
        None
        if trajectory.timestamps_s is None
        else dict(zip(trajectory.image_names, trajectory.timestamps_s, strict=True))
    )
    now = trajectory_from_reconstruction(metric, times)
    return antennas.positions(now.centers, now.world_from_cam)


def predicted_ranges(
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[Array],
    biases: Sequence[float],
) -> Array:
    """(n,) ranges that a metric model predicts, interpolated as the residuals are; NaN without a place.

    Arguments as for ``refine_with_ranges``.
    """
    at = antenna_positions(metric, trajectory, antennas(trajectory, observations, metric_from_sfm, tag_in_cam_m))
    index = observations.log.anchor_index
    predicted = np.linalg.norm(at - np.array(anchors)[index], axis=1) + np.array(biases)[index]
    return np.where(observations.before >= 0, predicted, np.nan)
