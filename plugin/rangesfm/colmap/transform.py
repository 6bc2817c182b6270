"""Carries a model into another world, or to what became of a copy of it."""

from __future__ import annotations

import pycolmap

from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import pose_of


def rescale(reconstruction: pycolmap.Reconstruction, metric_from_sfm: Similarity) -> pycolmap.Reconstruction:
    """A copy of the model in the metric world; poses and points move, the original stays.

    In a rig the distances between its cameras scale along, as COLMAP has them in model units.
    """
    metric = pycolmap.Reconstruction(reconstruction)
    transform(metric, metric_from_sfm)
    return metric


def transform(reconstruction: pycolmap.Reconstruction, new_from_old: Similarity) -> None:
    """As ``rescale``, in place: a solver that works on the model's arrays sees it."""
    rotation = pycolmap.Rotation3d(new_from_old.rotation)
    reconstruction.transform(pycolmap.Sim3d(new_from_old.scale, rotation, new_from_old.translation))


def take_over(reconstruction: pycolmap.Reconstruction, adjusted: pycolmap.Reconstruction) -> None:
    """Give a model, in place, the poses, points and intrinsics of a copy of it that was adjusted."""
    for frame_id in reconstruction.reg_frame_ids():
        pose_of(reconstruction.frame(frame_id)).params[:] = pose_of(adjusted.frame(frame_id)).params
    for point_id, point in reconstruction.points3D.items():
        point.xyz[:] = adjusted.point3D(point_id).xyz
    for camera_id, camera in reconstruction.cameras.items():
        camera.params[:] = adjusted.camera(camera_id).params
