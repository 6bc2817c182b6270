"""Where the antenna was at each range, by the poses of the keyframes around it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.observations import RangeObservations


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
        return np.asarray((1 - weight) * before + weight * after + self.offset_in_world_m)

    def subset(self, rows: Indices) -> Antennas:
        """Of some of the ranges."""
        return Antennas(*(getattr(self, field.name)[rows] for field in fields(self)))


def antennas(
    trajectory: Trajectory, observations: RangeObservations, metric_from_sfm: Similarity, tags_in_cam_m: Array
) -> Antennas:
    """Antennas of all ranges.

    Args:
        trajectory, observations: of the unscaled model.
        metric_from_sfm: to the world of the poses that will be asked for.
        tags_in_cam_m: (num_tags, 3), in the order of the log's tags.
    """
    tags_in_cam = tags_in_cam_m[observations.log.tag_index]
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
