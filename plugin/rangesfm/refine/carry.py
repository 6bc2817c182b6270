"""Carries a model along with corrected keyframes: its points are triangulated anew."""

from __future__ import annotations

import numpy as np
import pycolmap
from scipy import sparse
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.trajectory import pose_of
from rangesfm.refine.vision_information import (
    Observations,
    Poses,
    project,
    ray_residuals,
    robust_root_weights,
)

_NUM_ROUNDS = 5


def carry_model(
    metric: pycolmap.Reconstruction,
    frame_ids: Indices,
    observations: Observations,
    before: Poses,
    after: Poses,
    local_scale: Array,
) -> None:
    """Move frames and points of a model, in place: a solver that works on its arrays sees it.

    Args:
        frame_ids: (n,) of the poses. observations: of the model's points in them.
        before, after: poses of the frames as the model has them, and as it shall.
        local_scale: (n,) by how much the map grows around each frame.
    """
    points = _triangulated(observations, after, _carried(observations, before, after, local_scale))
    quaternions = Rotation.from_matrix(np.swapaxes(after.world_from_rig, 1, 2)).as_quat()
    translations = -np.einsum("nji,nj->ni", after.world_from_rig, after.centers)
    moved = np.any(after.centers != before.centers, axis=1) | np.any(
        after.world_from_rig != before.world_from_rig, axis=(1, 2)
    )
    for k in np.flatnonzero(moved):
        pose_of(metric.frame(int(frame_ids[k]))).params[:] = [*quaternions[k], *translations[k]]
    for point_id, point in zip(observations.point_ids, points, strict=True):
        metric.point3D(int(point_id)).xyz[:] = point


def _carried(observations: Observations, before: Poses, after: Poses, local_scale: Array) -> Array:
    """(p, 3) points, each moved rigidly and in scale with the first keyframe that sees it."""
    points = observations.points.copy()
    seen, first = np.unique(observations.point, return_index=True)
    frame = observations.frame[first]
    in_rig = np.einsum("nji,nj->ni", before.world_from_rig[frame], points[seen] - before.centers[frame])
    in_rig *= local_scale[frame][:, None]
    points[seen] = after.centers[frame] + np.einsum("nij,nj->ni", after.world_from_rig[frame], in_rig)
    return points


def _triangulated(observations: Observations, poses: Poses, start: Array) -> Array:
    """(p, 3) points that fit the rays best, by damped Gauss-Newton steps that are taken where they help."""
    n, num_points = len(observations.frame), len(start)
    adder = sparse.csr_array((np.ones(n), (observations.point, np.arange(n))), shape=(num_points, n))
    points, cost = start, _costs(observations, poses, start, adder)
    for _ in range(_NUM_ROUNDS):
        _, in_cam, derivative = project(observations, poses, points)
        residuals = np.nan_to_num(ray_residuals(observations, in_cam), posinf=0.0)
        root = robust_root_weights(residuals)
        to_rig = np.nan_to_num(derivative) @ observations.cam_from_rig_rotation
        to_point = root[:, None, None] * to_rig @ np.swapaxes(poses.world_from_rig[observations.frame], 1, 2)
        normal = (adder @ np.einsum("nai,naj->nij", to_point, to_point).reshape(n, 9)).reshape(-1, 3, 3)
        gradient = adder @ np.einsum("nai,na->ni", to_point, root[:, None] * residuals)
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-200
        trial = points - np.linalg.solve(normal + ridge * np.eye(3), gradient[:, :, None])[:, :, 0]
        trial_cost = _costs(observations, poses, trial, adder)
        better = trial_cost < cost
        points = np.where(better[:, None], trial, points)
        cost = np.where(better, trial_cost, cost)
    return points


def _costs(observations: Observations, poses: Poses, points: Array, adder: sparse.csr_array) -> Array:
    """(p,) robust cost of each point; infinite for one behind a camera that sees it."""
    residuals = ray_residuals(observations, project(observations, poses, points)[1])
    return np.asarray(adder @ np.log1p(np.sum(residuals**2, axis=1)))
