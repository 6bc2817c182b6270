"""A given calibration of the camera in the refinement: what it says counts for as much as it is certain."""

from __future__ import annotations

import numpy as np
import pycolmap

from rangesfm import ceres
from rangesfm.arrays import Array
from rangesfm.colmap.calibration import Size, calibrated_cameras
from rangesfm.options import CameraOptions
from rangesfm.refine.bundle_adjustment import BundleAdjustment

_STEP = 1e-6


def add_calibration(bundle: BundleAdjustment, options: CameraOptions) -> None:
    """Draw each camera of a given model to its parameters, where the adjustment refines it at all."""
    metric, problem = bundle.metric, bundle.adjuster.problem
    of_camera: dict[int, CameraOptions] = {}
    sizes: dict[int, list[Size]] = {}  # of each table's photos
    for image_id in metric.reg_image_ids():
        image = metric.image(image_id)
        table = of_camera.setdefault(image.camera_id, options.of_photo(image.name))
        camera = metric.camera(image.camera_id)
        sizes.setdefault(id(table), []).append((camera.width, camera.height))
    for camera_id, table in of_camera.items():
        camera = metric.camera(camera_id)
        if table.model is None or table.params is None or not problem.has_parameter_block(camera.params):
            continue
        given = calibrated_cameras(table.model, table.params, sizes[id(table)]).get((camera.width, camera.height))
        if given is None or camera.model != given.model or problem.is_parameter_block_constant(camera.params):
            continue
        stddev = parameter_stddevs(given, table.calibration_stddev_px(given.mean_focal_length()))
        ceres.add_normal_prior(bundle.adjuster, camera.params, given.params, stddev / bundle.pixel_stddev)


def parameter_stddevs(camera: pycolmap.Camera, focal_length_stddev_px: float) -> Array:
    """(n,) of each parameter: at the photo's edge it moves a feature as far as the focal length's own stddev does.

    A calibration that is off somewhere near the edge leaves open by which of its parameters.
    """
    edge = np.array([[0.5 * camera.width / camera.mean_focal_length(), 0.0, 1.0]])
    edge[0, 1] = 0.5 * camera.height / camera.mean_focal_length()
    shifts_px = np.array([_shift_px(camera, edge, index) for index in range(len(camera.params))])
    of_focal_lengths = np.linalg.norm(shifts_px[list(camera.focal_length_idxs())])
    smallest = 1e-12 * of_focal_lengths  # one that moves nothing is as good as free
    stddevs: Array = focal_length_stddev_px * of_focal_lengths / np.maximum(shifts_px, smallest)
    stddevs[list(camera.focal_length_idxs())] = focal_length_stddev_px
    return stddevs


def _shift_px(camera: pycolmap.Camera, points_in_cam: Array, index: int) -> float:
    """How far a parameter moves the image of a point, pixels per unit."""
    other = pycolmap.Camera(camera.todict())
    other.params[index] += _STEP * max(1.0, abs(camera.params[index]))
    step = other.params[index] - camera.params[index]
    found = [np.asarray(one.img_from_cam(points_in_cam)) for one in (camera, other)]
    return float(np.linalg.norm(found[1] - found[0]) / abs(step))
