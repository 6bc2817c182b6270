"""Changes of whole models: transformation into another world, joining, removal of photos, update from a copy."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
import pycolmap

from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import pose_of


def rescale(reconstruction: pycolmap.Reconstruction, metric_from_sfm: Similarity) -> pycolmap.Reconstruction:
    """Return a copy of the model in the metric world, with transformed poses and points.

    The distances between the cameras of a rig scale along, because COLMAP stores them in model units.
    """
    metric = pycolmap.Reconstruction(reconstruction)
    transform(metric, metric_from_sfm)
    return metric


def transform(reconstruction: pycolmap.Reconstruction, new_from_old: Similarity) -> None:
    """Transform a model in place, so that a solver that works on the model's arrays sees the change."""
    rotation = pycolmap.Rotation3d(new_from_old.rotation)
    reconstruction.transform(pycolmap.Sim3d(new_from_old.scale, rotation, new_from_old.translation))


def joined_model(
    models: Sequence[pycolmap.Reconstruction], *, is_of_one_database: bool = False
) -> pycolmap.Reconstruction:
    """Return one model with the registered photos and the points of several models.

    Ids of photos, frames, rigs and cameras are kept where they are free, so that models from one database keep that
    database's ids. A rig that is equal in two models, with all its cameras, becomes one rig. Points get new ids.

    Args:
        models: models in one world and unit. Each photo is in one of them only.
        is_of_one_database: whether rigs and cameras of one id are the same, even if their models differ in what they
            found of them. Then those of the first model are taken.
    """
    joined = pycolmap.Reconstruction()
    for model in models:
        _add_model(joined, model, is_of_one_database=is_of_one_database)
    joined.update_point_3d_errors()
    return joined


def without_photos(model: pycolmap.Reconstruction, image_names: Collection[str]) -> pycolmap.Reconstruction:
    """Return a copy of a model without the frames of these photos, or the model itself if it has none of them."""
    unwanted = {image.frame_id for image in model.images.values() if image.has_pose and image.name in image_names}
    if not unwanted:
        return model
    rest = pycolmap.Reconstruction(model)
    for frame_id in sorted(unwanted):
        rest.deregister_frame(frame_id)
    return rest


def _add_model(joined: pycolmap.Reconstruction, model: pycolmap.Reconstruction, *, is_of_one_database: bool) -> None:
    rig_ids, camera_ids = _add_rigs(joined, model, is_of_one_database=is_of_one_database)
    image_ids = _free_ids(model.reg_image_ids(), joined.images)
    for old_id, new_id in _free_ids(model.reg_frame_ids(), joined.frames).items():
        frame, copy, images = model.frame(old_id), pycolmap.Frame(), []
        copy.frame_id, copy.rig_id = new_id, rig_ids[frame.rig_id]
        for image in sorted((model.image(data_id.id) for data_id in frame.image_ids), key=lambda i: i.image_id):
            pixels = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
            images.append(pycolmap.Image(image.name, pixels, camera_ids[image.camera_id], image_ids[image.image_id]))
            images[-1].frame_id = new_id
            copy.add_data_id(images[-1].data_id)
        copy.rig_from_world = pose_of(frame)
        joined.add_frame(copy)
        for image in images:
            joined.add_image(image)
        joined.register_frame(new_id)
    for _, point in sorted(model.points3D.items()):
        seen = point.track.elements
        track = [pycolmap.TrackElement(image_ids[element.image_id], element.point2D_idx) for element in seen]
        joined.add_point3D(point.xyz, pycolmap.Track(track), point.color)


def _add_rigs(
    joined: pycolmap.Reconstruction, model: pycolmap.Reconstruction, *, is_of_one_database: bool
) -> tuple[dict[int, int], dict[int, int]]:
    """Add rigs and cameras; return their new ids, by their ids in the model."""
    same = {
        rig_id
        for rig_id in model.rigs
        if joined.exists_rig(rig_id)
        and (is_of_one_database or _description(joined, rig_id) == _description(model, rig_id))
    }
    cameras_of = {rig_id: _camera_ids(rig) for rig_id, rig in model.rigs.items()}
    shared = {camera_id for rig_id in same for camera_id in cameras_of[rig_id]}
    camera_ids = _free_ids(set(model.cameras) - shared, joined.cameras) | {id_: id_ for id_ in shared}
    rig_ids = _free_ids(set(model.rigs) - same, joined.rigs) | {id_: id_ for id_ in same}
    for old_id in sorted(set(model.rigs) - same):
        for camera_id in cameras_of[old_id]:
            camera = pycolmap.Camera(model.camera(camera_id).todict())
            camera.camera_id = camera_ids[camera_id]
            joined.add_camera(camera)
        rig, copy = model.rig(old_id), pycolmap.Rig()
        copy.rig_id = rig_ids[old_id]
        copy.add_ref_sensor(_camera_sensor(camera_ids[rig.ref_sensor_id.id]))
        for sensor, pose in rig.non_ref_sensors.items():
            copy.add_sensor(_camera_sensor(camera_ids[sensor.id]), pose)
        joined.add_rig(copy)
    return rig_ids, camera_ids


def _free_ids(wanted: Iterable[int], taken: Iterable[int]) -> dict[int, int]:
    """Return a new id for each wanted id: the same id if it is free, else one above all ids in use."""
    wanted, taken = sorted(wanted), set(taken)
    next_id = max([*wanted, *taken], default=0) + 1
    ids: dict[int, int] = {}
    for id_ in wanted:
        ids[id_] = id_
        if id_ in taken:
            ids[id_], next_id = next_id, next_id + 1
    return ids


def _camera_ids(rig: pycolmap.Rig) -> list[int]:
    return sorted(sensor.id for sensor in rig.sensor_ids())


def _description(model: pycolmap.Reconstruction, rig_id: int) -> Any:
    """Return plain values that are equal for equal rigs."""
    rig = model.rig(rig_id)
    others = {
        sensor.id: None if pose is None else pose.matrix().tolist() for sensor, pose in rig.non_ref_sensors.items()
    }
    cameras = [
        (camera.camera_id, camera.model, camera.width, camera.height, camera.params.tolist())
        for camera in map(model.camera, _camera_ids(rig))
    ]
    return rig.ref_sensor_id.id, others, cameras


def _camera_sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
