"""How firmly the photos of a map hold it together, as the ranges on it see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import PhotosAlone
from rangesfm.ceres.linear_solver import inverse_is_affordable
from rangesfm.colmap.point_observations import overlaps_in
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.errors.bending import (
    BendingOfCells,
    MapBending,
    WalkBending,
    averaged,
    component_of,
    without_similarity,
)
from rangesfm.ranging.errors.range_bins import Cells
from rangesfm.refine.bundle_adjustment import BundleAdjustment, bundle_adjustment
from rangesfm.refine.vision_information import misplaced_points, model_observations, model_poses

MAX_NUM_IMAGES = 1500
"""Of photos that all see the same an inverse takes a minute, of twice as many ten."""
# By how much a map is bent further than its reprojection errors let expect: about 1 where features err each on its own,
# as simulated ones do, 8 to 12 on three scenes of real stills (Strecha et al. 2008), with little between.
_FACTOR, _SPREAD = 2.0, 0.8


@dataclass(frozen=True)
class PhotoBending:
    """Of a map with points: what its bundle adjustment leaves open.

    Attributes:
        photos: at the map as it is. frame_ids: of the path.
        path: in the model's world, which is the first camera's frame. world_from_model: rotation to the map's world.
        metres_per_unit: of the map's world, by the model's unit.
        is_at_optimum: whether the photos have the map where they want it.
    """

    photos: PhotosAlone
    frame_ids: Indices
    path: Trajectory
    world_from_model: Array
    metres_per_unit: float
    is_at_optimum: bool

    def of_cells(self, cells: Cells, by_pose: csr_array, *, frame_is_free: bool) -> BendingOfCells:
        functions = without_similarity(averaged(cells, by_pose, len(self.path)), self.path, frame_is_free=frame_is_free)
        parts = functions.reshape(len(cells), -1, 6)
        by_center = parts[:, :, 3:] @ self.world_from_model.T / self.metres_per_unit
        covariance, shift_m = self.photos.of_functions(self.frame_ids, parts[:, :, :3], by_center)
        found = component_of("bending", covariance, _FACTOR, _SPREAD)
        shift_m = np.zeros(len(cells)) if self.is_at_optimum else shift_m
        return BendingOfCells(() if found is None else (found,), covariance, shift_m)


def bending_of_model(
    model: pycolmap.Reconstruction,
    trajectory: Trajectory,
    camera: CameraOptions,
    options: RefineOptions,
    num_threads: int,
) -> MapBending:
    """Of a map as a mapper left it: by its photos, or by chance where it has no points or too many photos.

    Args:
        trajectory: in the model's world.
    """
    path = in_first_camera(trajectory)
    try:
        frame_ids = np.array(sorted(model.reg_frame_ids()), dtype=np.int64)
        rays = model_observations(model, frame_ids)
        misplaced = rays.point_ids[misplaced_points(rays, model_poses(model, frame_ids))]
        bundle = bundle_adjustment(
            model, camera, options, fixed_frame_id=None, num_threads=num_threads, left_out_ids=misplaced.tolist()
        )
        return by_photos(bundle, trajectory, 1.0, is_at_optimum=True)
    except (SolverError, GeometryError, InputError):
        return WalkBending(path)


def by_photos(
    bundle: BundleAdjustment, trajectory: Trajectory, metres_per_unit: float, *, is_at_optimum: bool
) -> PhotoBending:
    """Of a bundle adjustment of photos alone.

    Args:
        trajectory: in the world of the map.
        metres_per_unit: of that world, by the unit of the model that ranges are related to.

    Raises:
        GeometryError: the photos leave more open than where the map is and how large, or are too many.
    """
    metric = bundle.metric
    if metric.num_reg_images() > MAX_NUM_IMAGES and not inverse_is_affordable(overlaps_in(metric), MAX_NUM_IMAGES):
        raise GeometryError("too many photos")
    return PhotoBending(
        PhotosAlone(bundle.adjuster.problem, metric, bundle.pixel_stddev),
        trajectory.frame_ids,
        in_first_camera(trajectory, metres_per_unit),
        trajectory.world_from_cam[0],
        metres_per_unit,
        is_at_optimum,
    )
