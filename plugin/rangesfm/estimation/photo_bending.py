"""Bending of a map that its photos allow, as it affects the ranges."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Mask
from rangesfm.colmap.pieces import frames_of_largest_part
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.estimation.vision_information import misplaced_points, model_rays
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bending import (
    Bending,
    FrameSteps,
    MapBending,
    WalkBending,
    bending_parts,
    motions_of_poses,
    similarity_of,
    without_similarity,
)
from rangesfm.solver.bundle_adjustment import bundle_adjustment
from rangesfm.solver.covariance import PhotosAlone
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.trajectory import Trajectory

# How much more a map is bent than its reprojection errors suggest (median, and stddev of the logarithm): about 1 with
# independent errors of features, as in simulations; 4 in a room of real photos, 8 to 12 in three scenes of others
# (Strecha et al. 2008).
MEDIAN_FACTOR, _SPREAD = 2.0, 0.8
LARGEST_FACTOR = MEDIAN_FACTOR * float(np.exp(NORMAL_95 * _SPREAD))
"""Largest such factor of a map whose lens fits."""
# Standard deviation of the scale of one part of a map relative to another from which the photos do not hold them
# together: parts of a map that share six points are held to 0.01, those that share five may have any scale.
_HELD = 0.1


@dataclass(frozen=True)
class PhotoBending:
    """Bending of a map with points, from its bundle adjustment.

    Attributes:
        photos: linearised at the map as it is. path: of the map, in its world.
        is_firm: (k,) True for the poses of the path that the photos hold together; the map's size and place are theirs.
        is_at_optimum: whether the map is at the photos' own minimum.
    """

    photos: PhotosAlone
    path: Trajectory
    is_firm: Mask
    is_at_optimum: bool

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        gradients = self.shape_by_steps(by_pose, frame_is_free=frame_is_free)
        covariance = gradients.T @ self.photos.solve(gradients)
        shift_m = np.zeros(len(by_pose)) if self.is_at_optimum else gradients.T @ self.photos.at_minimum
        return Bending(bending_parts("bending", covariance, MEDIAN_FACTOR, _SPREAD), covariance, shift_m)

    def likely_steps(self, pull: Array, factor: float, *, frame_is_free: bool) -> FrameSteps:
        """Return the steps to where the map is likeliest bent, without a change of its size and its place as a whole.

        Args:
            pull: (6 k,) sum over all observations of their derivatives by the poses, times the inverse covariance of
                what the estimate leaves of them, measured minus predicted.
            factor: learnt bending over that expected from the photos. frame_is_free: as in ``of_functions``.
        """
        gradient = self.shape_by_steps(pull[None], frame_is_free=frame_is_free)
        steps = factor**2 * self.photos.solve(gradient)[:, 0] + self.photos.at_minimum
        frame_ids, poses = self.photos.poses
        whole = self.similarity_by_steps(frame_is_free=frame_is_free).T @ steps
        of_frames = self.photos.of_frames(steps) - motions_of_poses(poses.world_from_rig, self.from_first_m) @ whole
        return FrameSteps(frame_ids, of_frames[:, :3], of_frames[:, 3:])

    def shape_by_steps(self, by_pose: Array, *, frame_is_free: bool) -> Array:
        """Return the derivatives (n, c) by the photos' steps of functions without those by scale and place."""
        return self._by_steps(without_similarity(by_pose, self.path, self.is_firm, frame_is_free=frame_is_free))

    def similarity_by_steps(self, *, frame_is_free: bool) -> Array:
        """Return the derivatives (n, 7) by the photos' steps of the map as a whole, about the path's first pose."""
        return self._by_steps(similarity_of(self.path, self.is_firm, frame_is_free=frame_is_free))

    def _by_steps(self, by_pose: Array) -> Array:
        parts = by_pose.reshape(len(by_pose), -1, 6)
        return self.photos.by_steps(self.path.frame_ids, parts[:, :, :3], parts[:, :, 3:])

    @property
    def from_first_m(self) -> Array:
        """(m, 3) centres of the photos' frames, from that of the first pose of the path."""
        frame_ids, poses = self.photos.poses
        return np.asarray(poses.centers - poses.centers[np.searchsorted(frame_ids, self.path.frame_ids[0])])

    def hold_together(self, image_names: Collection[str]) -> bool:
        """Return whether the photos determine the scale of a part of the map relative to the rest.

        Args:
            image_names: photos of the part, of which the path has two or more, and two or more of the rest.
        """
        is_part = np.isin(self.path.image_names, list(image_names))
        by_pose = np.zeros((len(self.path), 6))
        for part, sign in ((is_part, 1.0), (~is_part, -1.0)):  # derivatives of the logarithms of both sizes
            off = self.path.centers[part] - self.path.centers[part].mean(axis=0)
            by_pose[part, 3:] = sign * off / np.sum(off**2)
        covariance = self.of_functions(by_pose.reshape(1, -1), frame_is_free=True).formal_m2
        return bool(covariance[0, 0] < _HELD**2)


def bending_of_model(
    model: pycolmap.Reconstruction,
    trajectory: Trajectory,
    camera: CameraOptions,
    options: RefineOptions,
    num_threads: int,
) -> MapBending:
    """Return the bending of a mapper's model, from its photos; a random walk if it has no points or too many photos.

    Args:
        trajectory: of the model, in its world.
    """
    try:
        frame_ids = np.array(sorted(model.reg_frame_ids()), dtype=np.int64)
        rays = model_rays(model, frame_ids)
        misplaced = rays.point_ids[misplaced_points(rays, model_poses(model, frame_ids))]
        bundle = bundle_adjustment(model, camera, options, num_threads=num_threads, left_out_ids=misplaced.tolist())
        if bundle.has_covariance:
            equations = NormalEquations.of(bundle.adjuster.problem, model, bundle.num_reprojections)
            is_firm = np.isin(trajectory.frame_ids, frames_of_largest_part(model))
            return PhotoBending(PhotosAlone(equations, bundle.pixel_stddev), trajectory, is_firm, is_at_optimum=True)
    except (SolverError, GeometryError, InputError):
        pass
    return WalkBending(trajectory)
