"""Range bins: averages of ranges to one anchor in one stretch of time, few enough to compute their joint covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.kind import by_all_poses
from rangesfm.measurements.ranges.errors.noise import MIN_NUM_OF_SCATTER
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.util.geometry.robust_statistics import robust_stddev
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import OnPath

_SHORTEST_S = 0.5
_LONGER = 1.25
_MIN_NOISINESS, _MAX_NOISINESS = 0.5, 3.0
# Robust weight below which a range takes no part. A bin of such ranges alone would have a variance so large that
# rounding hides the variances of all others.
_NO_WEIGHT = 1e-8


@dataclass(frozen=True)
class RangeBins:
    """c averages of n ranges.

    Attributes:
        of_range: (n,) bin of each range; any one for a range with weight 0.
        robust_weight: (n,) robust weights, by which ranges are averaged; 0 for a range that takes no part.
        worth: (c,) sum of the robust weights in each bin, an equivalent number of ranges.
        anchor_index, tag_index: (c,).
        time_s: (c,) mean time since the first range; without times, photos since the first.
        distance_m: (c,) mean distance from anchor to tag.
        from_anchor: (c, 3) unit vectors from anchor to tag. in_cam: (c, 3) the same in the camera's frame.
        noisiness: (c,) noise of the bin's anchor relative to all anchors.
    """

    of_range: Indices
    robust_weight: Array
    worth: Array
    anchor_index: Indices
    tag_index: Indices
    time_s: Array
    distance_m: Array
    from_anchor: Array
    in_cam: Array
    noisiness: Array

    def __len__(self) -> int:
        return len(self.worth)

    @cached_property
    def averages(self) -> csr_array:
        """(c, n) weights of the ranges in the bins, with a sum of 1 in each bin."""
        share = self.robust_weight / np.maximum(self.worth, 1e-12)[self.of_range]
        return csr_array((share, (self.of_range, np.arange(len(share)))), shape=(len(self), len(share)))

    def mean(self, values: Array) -> Array:
        """Return the (c, ...) weighted means of (n, ...) values of the ranges."""
        means = self.averages @ values.reshape(len(values), -1)
        return np.asarray(means.reshape(len(self), *values.shape[1:]))

    def by_pose(self, by_range: csr_array, num_poses: int) -> Array:
        """Return the (c, 6 k) means of (n, 6 k') derivatives by poses; the last of the k poses may have no ranges."""
        means = self.averages @ by_range
        return np.pad(means.toarray(), ((0, 0), (0, 6 * num_poses - means.shape[1])))

    def total(self, values: Array) -> Array:
        """Return the (c,) sums of (n,) values of the ranges."""
        return np.bincount(self.of_range, values, len(self)).astype(np.float64)


def range_bins(
    anchor_index: Indices,
    tag_index: Indices,
    time_s: Array,
    from_anchor_m: Array,
    cam_from_world: Array,
    robust_weight: Array,
    noise_of_anchor: Array,
    max_num: int = MAX_NUM_OBSERVATIONS,
) -> RangeBins:
    """Average ranges in bins, with stretches of time long enough that there are at most ``max_num`` bins.

    Args:
        anchor_index, tag_index, time_s: (n,). from_anchor_m: (n, 3) from anchor to tag.
        cam_from_world: (n, 3, 3) rotations. robust_weight: (n,). noise_of_anchor: (m,) relative noise.
    """
    since = time_s - time_s.min()
    distance = np.linalg.norm(from_anchor_m, axis=1)
    towards = from_anchor_m / np.maximum(distance, 1e-9)[:, None]
    takes_part = robust_weight >= _NO_WEIGHT
    if not takes_part.any():
        robust_weight, takes_part = np.full_like(robust_weight, _NO_WEIGHT), ~takes_part
    robust_weight = np.where(takes_part, robust_weight, 0.0)
    rows, of_range = np.flatnonzero(takes_part), np.zeros(len(since), dtype=np.int64)
    of_range[rows] = _labels(anchor_index[rows], tag_index[rows], since[rows], max_num)
    first = rows[np.unique(of_range[rows], return_index=True)[1]]
    begun = RangeBins(
        of_range=of_range,
        robust_weight=robust_weight,
        worth=np.bincount(of_range, robust_weight).astype(np.float64),
        anchor_index=anchor_index[first],
        tag_index=tag_index[first],
        time_s=since[first],
        distance_m=distance[first],
        from_anchor=towards[first],
        in_cam=towards[first],
        noisiness=noise_of_anchor[anchor_index[first]],
    )
    return replace(
        begun,
        time_s=begun.mean(since),
        distance_m=begun.mean(distance),
        from_anchor=_unit(begun.mean(towards)),
        in_cam=_unit(begun.mean(np.einsum("nij,nj->ni", cam_from_world, towards))),
    )


def by_poses(
    gradient: RangeGradient, metric_from_path: Similarity, world_from_cam: Array, arms_m: Array, on_path: OnPath
) -> csr_array:
    """Return (n, 6 k) derivatives of the distances by k poses: turns in their own frames, shifts in the path's world.

    Args:
        world_from_cam: (n, 3, 3) rotations into the metric world. arms_m: (n, 3) lever arms in its axes.
    """
    num_poses = int(max(on_path.before.max(), on_path.after.max())) + 1
    by_shift = metric_from_path.scale * gradient.by_tag @ metric_from_path.rotation
    arms_in_cam_m, in_cam = (np.einsum("nji,nj->ni", world_from_cam, of) for of in (arms_m, gradient.by_tag))
    by_turn = np.cross(arms_in_cam_m, in_cam)
    share = np.column_stack([1 - on_path.fraction, on_path.fraction])
    values = share[:, None, :, None] * np.hstack([by_turn, by_shift])[:, None, None]
    return by_all_poses(np.column_stack([on_path.before, on_path.after]), values, num_poses)


def noisiness(anchor_index: Indices, residuals_m: Array, num_anchors: int) -> Array:
    """Return the (m,) scatter of each anchor's ranges relative to all anchors."""
    scatter = np.full(num_anchors, np.nan)
    for k in range(num_anchors):
        own = residuals_m[anchor_index == k]
        if len(own) >= MIN_NUM_OF_SCATTER:
            scatter[k] = robust_stddev(own - np.median(own))
    if np.isnan(scatter).all():
        return np.ones(num_anchors)
    relative = scatter / np.sqrt(np.nanmedian(scatter**2))
    return np.asarray(np.clip(np.nan_to_num(relative, nan=1.0), _MIN_NOISINESS, _MAX_NOISINESS))


def _labels(anchor_index: Indices, tag_index: Indices, since_s: Array, max_num: int) -> Indices:
    """Return (n,) bin numbers from 0, for the shortest stretches of time that do not make too many bins."""
    link = anchor_index * (int(tag_index.max()) + 2) + tag_index + 1
    length_s = _SHORTEST_S
    while True:
        stretch = np.floor(since_s / length_s).astype(np.int64)
        values, labels = np.unique(link * (int(stretch.max()) + 1) + stretch, return_inverse=True)
        if len(values) <= max(max_num, 2 * len(np.unique(link))):
            return np.asarray(labels, dtype=np.int64)
        length_s *= _LONGER


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None])
