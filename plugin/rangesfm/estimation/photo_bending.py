"""Bending of a map that its photos allow, as it affects the ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.colmap.pieces import frames_of_parts
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
from rangesfm.solver.normal_equations import HALF_A_REVOLUTION, NormalEquations
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.similarity import similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

# How much more a map is bent than its reprojection errors suggest (median, and stddev of the logarithm): about 1 with
# independent errors of features, as in simulations; 4 in a room of real photos, 8 to 12 in three scenes of others
# (Strecha et al. 2008).
MEDIAN_FACTOR, _SPREAD = 2.0, 0.8
LARGEST_FACTOR = MEDIAN_FACTOR * float(np.exp(NORMAL_95 * _SPREAD))
"""Largest such factor of a map whose lens fits."""
# Share of what a part of a map may be off by in size, turn and place from which it is tied but loosely to the rest: the
# sizes of parts that share six points are tied to 0.01 of themselves, those that share five may have any size.
HELD = 0.1


@dataclass(frozen=True)
class LooseParts:
    """Motions of parts of a map that its photos hardly tie to the rest: m directions, each with an error of its own.

    What photos say of them is next to nothing, so that its size is not that of the map's bending. Before anything is
    measured, a part has any turn, is anywhere within the extent of the map, and its size is right to a factor of e.

    Attributes:
        steps: (n, m) steps of the photos by each motion.
        by_photos, variances: (m,) variances as the photos have them, for a bending as they expect it, and with all that
            is known of a part.
    """

    steps: Array
    by_photos: Array
    variances: Array

    @classmethod
    def of(cls, photos: PhotosAlone, by_steps: Array, extent: float) -> LooseParts:
        """Return the loose ones of the motions of parts.

        Args:
            by_steps: (n, 7 p) derivatives of the motions of p parts relative to the rest by the photos' steps: of the
                logarithm of the size, a turn, and a shift in the path's unit. extent: of the path.
        """
        usual = np.tile([1.0, *[HALF_A_REVOLUTION] * 3, *[extent] * 3], by_steps.shape[1] // 7)
        by_steps = by_steps / usual
        moved = photos.solve(by_steps)
        by_photos, directions = np.linalg.eigh(by_steps.T @ moved)
        # Errors of real features are some times what their residuals suggest.
        variance = (MEDIAN_FACTOR * np.exp(_SPREAD**2)) ** 2 * by_photos
        loose = variance > HELD**2
        variance, by_photos = variance[loose], by_photos[loose]
        return cls(moved @ directions[:, loose] / by_photos, by_photos, variance / (1 + variance))

    def replaced_in(self, photos: PhotosAlone, factor: float) -> PhotosAlone:
        """Return what photos say of the steps with what is known of these parts, over the square of the bending."""
        return photos.with_more(self.steps, self.variances / factor**2 - self.by_photos)


@dataclass(frozen=True)
class PhotoBending:
    """Bending of a map with points, from its bundle adjustment.

    Attributes:
        photos: linearised at the map as it is. path: of the map, in its world.
        parts: (k,) masks of the poses of parts that share few points with others, the largest first.
        is_firm: (k,) True for the poses of the path whose size and place are the map's.
        is_at_optimum: whether the map is at the photos' own minimum.
    """

    photos: PhotosAlone
    path: Trajectory
    parts: tuple[Mask, ...]
    is_firm: Mask
    is_at_optimum: bool

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        gradients = self.shape_by_steps(by_pose, frame_is_free=frame_is_free)
        of_loose = gradients.T @ self.loose.steps
        covariance = gradients.T @ self.photos.solve(gradients) - of_loose * self.loose.by_photos @ of_loose.T
        parts = bending_parts("bending", covariance, MEDIAN_FACTOR, _SPREAD)
        parts += bending_parts("loose_parts", of_loose * self.loose.variances @ of_loose.T, 1.0, 0.0)
        shift_m = np.zeros(len(by_pose)) if self.is_at_optimum else gradients.T @ self.at_minimum
        return Bending(parts, covariance, shift_m)

    @cached_property
    def loose(self) -> LooseParts:
        """Motions of parts that the photos hardly tie to the rest."""
        motions = (_motion_beside(self.path, part, self.parts[0]) for part in self.parts[1:])
        by_pose = np.vstack([np.zeros((0, 6 * len(self.path))), *motions])
        extent = float(np.linalg.norm(np.ptp(self.path.centers, axis=0)))
        return LooseParts.of(self.photos, self._by_steps(by_pose), extent)

    def size_beside(self, part: Mask) -> Array:
        """Return the (1, 6 k) derivatives by the poses of the logarithm of a part's size relative to the largest."""
        return _motion_beside(self.path, part, self.parts[0])[:1]

    @cached_property
    def at_minimum(self) -> Array:
        """(n,) steps to where the photos alone have the map, with what is known of loose parts before."""
        return self.loose.replaced_in(self.photos, MEDIAN_FACTOR * float(np.exp(_SPREAD**2))).at_minimum

    def likely_steps(self, pull: Array, factor: float, *, frame_is_free: bool) -> FrameSteps:
        """Return the steps to where the map is likeliest bent, without a change of its size and its place as a whole.

        Args:
            pull: (6 k,) sum over all observations of their derivatives by the poses, times the inverse covariance of
                what the estimate leaves of them, measured minus predicted.
            factor: learnt bending over that expected from the photos. frame_is_free: as in ``of_functions``.
        """
        gradient = self.shape_by_steps(pull[None], frame_is_free=frame_is_free)
        steps = factor**2 * self.photos_at(factor).solve(gradient)[:, 0] + self.at_minimum
        frame_ids, poses = self.photos.poses
        whole = self.similarity_by_steps(frame_is_free=frame_is_free).T @ steps
        of_frames = self.photos.of_frames(steps) - motions_of_poses(poses.world_from_rig, self.from_first_m) @ whole
        return FrameSteps(frame_ids, of_frames[:, :3], of_frames[:, 3:])

    def photos_at(self, factor: float) -> PhotosAlone:
        """Return what photos, and what is known of loose parts, say of the steps, over the square of the bending."""
        return self.loose.replaced_in(self.photos, factor)

    def shape_by_steps(self, by_pose: Array, *, frame_is_free: bool) -> Array:
        """Return the derivatives (n, c) by the photos' steps of functions without those by scale and place."""
        return self._by_steps(without_similarity(by_pose, self.path, self.is_firm, frame_is_free=frame_is_free))

    def similarity_by_steps(self, *, frame_is_free: bool) -> Array:
        """Return the derivatives (n, 7) by the photos' steps of the map as a whole, about the path's first pose."""
        return self._by_steps(similarity_of(self.path, self.is_firm, frame_is_free=frame_is_free))

    def _by_steps(self, by_pose: Array) -> Array:
        parts = by_pose.reshape(len(by_pose), len(self.path), 6)
        return self.photos.by_steps(self.path.frame_ids, parts[:, :, :3], parts[:, :, 3:])

    @property
    def from_first_m(self) -> Array:
        """(m, 3) centres of the photos' frames, from that of the first pose of the path."""
        frame_ids, poses = self.photos.poses
        return np.asarray(poses.centers - poses.centers[np.searchsorted(frame_ids, self.path.frame_ids[0])])


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
            parts = parts_of_path(trajectory, frames_of_parts(model))
            photos = PhotosAlone(equations, bundle.pixel_stddev)
            return PhotoBending(photos, trajectory, parts, parts[0], is_at_optimum=True)
    except (SolverError, GeometryError, InputError):
        pass
    return WalkBending(trajectory)


def parts_of_path(path: Trajectory, parts: Sequence[Indices]) -> tuple[Mask, ...]:
    """Return (k,) masks of the poses of each part that has any, by the ids of its frames."""
    masks = (np.isin(path.frame_ids, part) for part in parts)
    return tuple(mask for mask in masks if mask.any())


def _motion_beside(path: Trajectory, part: Mask, rest: Mask) -> Array:
    """Return the (7, 6 k) derivatives by the poses of how a part of a path moves relative to the rest.

    They are those of the logarithm of its size, its turn, and its shift about its middle. One pose has no size.
    """
    middle = similarity_motions((path.centers[part].mean(axis=0) - path.centers[0])[None])[0]
    of_rest = similarity_of(path, rest, frame_is_free=True)
    if np.count_nonzero(part) > 1:
        of_part = similarity_of(path, part, frame_is_free=True) - of_rest
        return np.vstack([of_part[:4], middle @ of_part])
    own = np.zeros((7, len(path), 6))
    own[1:4, part, :3], own[4:, part, 3:] = path.world_from_cam[part].swapaxes(0, 1), np.eye(3)[:, None]
    return np.asarray(own.reshape(7, -1) - np.vstack([0 * of_rest[:1], of_rest[1:4], middle @ of_rest]))
