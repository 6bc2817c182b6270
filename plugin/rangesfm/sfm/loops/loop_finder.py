"""Proposal of pairs by a refined map, and the test of those that match against that map."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from scipy.linalg import block_diag
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import MIN_NUM_SHARED, ids_seen_in, overlaps_in
from rangesfm.estimation.vision_information import Loop
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.candidates import Views, predicted_overlaps, propose_pairs
from rangesfm.sfm.loops.relative_errors import RelativeErrors
from rangesfm.sfm.loops.resection import resect
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import Trajectory, pose_of

MAX_CHANCE = 1e-6
"""Probability by chance of a difference between photos and map below which a loop is taken for a wrong one. A survey
has thousands of pairs, of which none should be lost by chance."""


@dataclass(frozen=True)
class LoopFinder:
    """A refined map, with what is needed to find its loops.

    Attributes:
        model: the map, metres.
        path: its keyframes. map_errors: how these err.
        pixel_stddev: standard deviation of a coordinate of a feature.
    """

    model: pycolmap.Reconstruction
    path: Trajectory
    map_errors: MapErrors
    pixel_stddev: float

    @cached_property
    def errors(self) -> RelativeErrors:
        return RelativeErrors.of_keyframes(self.map_errors, self.path.frame_ids, self.path.centers)

    @cached_property
    def views(self) -> Views:
        return Views.in_model(self.model, self.path.frame_ids)

    def propose(self, matched: Mapping[int, Set[int]], *, max_num: int) -> dict[int, list[Pair]]:
        """Return for each photo, by its id, the pairs that are worth matching, the best first.

        Args:
            matched: ids of the photos that each photo was matched with, by its id.
            max_num: largest number of pairs of one photo.
        """
        known = self._known(matched)
        return propose_pairs(self.views, self.errors, known, max_num=max_num, pixel_stddev=self.pixel_stddev)

    def predicted(self, matched: Mapping[int, Set[int]]) -> dict[int, set[int]]:
        """Return for each photo those that it was matched with, or that the map predicts to see the same, by ids.

        They may see it from where its features are not found again.
        """
        known, ids = self._known(matched), self.views.image_ids
        for first, others, _ in predicted_overlaps(self.views, self.errors, known, from_anywhere=True):
            known[int(ids[first])].update(ids[others].tolist())
        return known

    def _known(self, matched: Mapping[int, Set[int]]) -> dict[int, set[int]]:
        """Return for each photo of the map those that it was matched with or shares enough points with, by ids."""
        ids = self.model.reg_image_ids()
        known = {id_: set(matched.get(id_, ())) for id_ in ids}
        shared = overlaps_in(self.model).tocoo()
        enough = (shared.data >= MIN_NUM_SHARED) & (shared.row != shared.col)
        for first, second in zip(shared.row[enough].tolist(), shared.col[enough].tolist(), strict=True):
            known[ids[first]].add(ids[second])
        return known

    def tested(self, verified: Mapping[Pair, Indices], *, seed: int) -> tuple[dict[Pair, Loop], list[Pair]]:
        """Return the loops that fit the map, and the pairs that it contradicts.

        Pairs whose matches have too few points say nothing and are in neither.

        Args:
            verified: matches (m, 2) of features that fit a two-view geometry, by pair.
            seed: of random numbers.
        """
        found = {pair: self._loop_of_pair(pair, matches, seed) for pair, matches in verified.items()}
        told = {pair: loop for pair, loop in found.items() if loop is not None}
        loops = {pair: loop for pair, (loop, chance) in told.items() if chance >= MAX_CHANCE}
        return loops, [pair for pair in told if pair not in loops]

    def _loop_of_pair(self, image_ids: Pair, matches: Indices, seed: int) -> tuple[Loop, float] | None:
        """Return what a pair says, and the probability that photos differ as much from the map by chance.

        None if too few of its verified matches agree on a pose.

        Args:
            matches: (m, 2) indices of features of the two photos.
        """
        ways = [(image_ids, matches), (image_ids[::-1], matches[:, ::-1])]
        seen = [(*way, self._seen(way[0][0], way[1])) for way in ways]
        photos, matches, ids = max(seen, key=lambda way: int((way[2] >= 0).sum()))
        image, ids, places = self.model.image(photos[1]), ids[ids >= 0], matches[ids >= 0, 1]
        points = np.array([self.model.point3D(id_).xyz for id_ in ids.tolist()])
        pixels = np.array([image.points2D[k].xy for k in places.tolist()])
        camera = self.model.camera(image.camera_id)
        if (found := resect(pixels, points, camera, seed)) is None:
            return None
        cam_from_world, fits = found
        before = pose_of(self.model.frame(image.frame_id))
        after = (image.cam_from_world() * before.inverse()).inverse() * cam_from_world
        from_map = after.rotation.matrix().T @ before.rotation.matrix()
        shift = _center(after) - _center(before)
        world_from_cam = cam_from_world.rotation.matrix().T
        row, from_camera = self.views.row_of[photos[1]], points[fits] - _center(cam_from_world)
        by_point = _pixels_by_points(from_camera, world_from_cam[None], self.views.focal_px[row])
        residuals_px = np.asarray(camera.img_from_cam(from_camera @ world_from_cam)) - pixels[fits]
        frames, by_frame, noise = self._dependence(ids[fits], points[fits], by_point, residuals_px, _center(after))

        def covariance(frame: int, by_own: Array) -> Array:
            """Return the (6, 6) covariance of the pose by the points against what depends on another keyframe."""
            return noise + self.errors.covariance(np.append(frames, frame), np.concatenate([by_frame, by_own]))

        held, moved = (int(self.views.frame[self.views.row_of[photo]]) for photo in photos)
        difference = np.concatenate([Rotation.from_matrix(from_map).as_rotvec(), shift])
        squared = difference @ np.linalg.solve(covariance(moved, -np.eye(6)[None]), difference)
        chance = float(chdtrc(len(difference), float(squared)))
        information = np.linalg.inv(covariance(held, -self.errors.carried(held, np.array([moved]))))
        reference, frame = self.path.frame_ids[[held, moved]].tolist()
        from_held, turned = pose_of(self.model.frame(reference)).rotation.matrix().T, after.rotation.matrix().T
        axes = block_diag(turned, from_held)
        apart = self.errors.centers[moved] + shift - self.errors.centers[held]
        loop = Loop(reference, frame, from_held.T @ turned, from_held.T @ apart, axes.T @ information @ axes)
        return loop, chance

    def _seen(self, image_id: int, matches: Indices) -> Indices:
        """Return the (m,) ids of the points behind the first features of matches; -1 where there is none."""
        points = self.model.image(image_id).points2D
        ids = np.array([points[k].point3D_id for k in matches[:, 0].tolist()], dtype=np.uint64)
        return ids.astype(np.int64)  # COLMAP's id of no point is the largest one, 2^64 - 1

    @cached_property
    def _sightings(self) -> tuple[Indices, Indices, Indices]:
        """Return the ids (p,) of the points, ascending, the first sighting (p + 1,) of each, and the view of each."""
        seen = [ids_seen_in(self.model.image(image_id)) for image_id in self.views.image_ids.tolist()]
        ids, view = np.concatenate(seen), np.repeat(np.arange(len(seen)), list(map(len, seen)))
        order = np.argsort(ids, kind="stable")
        known, first = np.unique(ids[order], return_index=True)
        return known, np.append(first, len(ids)), view[order]

    def _dependence(
        self, ids: Indices, points: Array, by_point: Array, residuals_px: Array, center: Array
    ) -> tuple[Indices, Array, Array]:
        """Return how the pose by k points errs.

        Args:
            ids, points: (k,), (k, 3) of the points.
            by_point: (k, 2, 3) derivatives of the placed photo's pixels. residuals_px: (k, 2) their residuals, which
                show how well features are found again from far away.
            center: (3,) origin of the placed rig.

        Returns:
            Keyframes (f,) on whose errors the pose depends, its derivatives (f, 6, 6) by these (turn about the axes of
            the world, shift of the rig's origin), and its covariance (6, 6) that is due to the features alone.
        """
        views, (known, first, view) = self.views, self._sightings
        place = np.searchsorted(known, ids)
        num = first[place + 1] - first[place]
        starts = np.cumsum(num) - num
        point = np.repeat(np.arange(len(ids)), num)
        row = view[np.arange(num.sum()) + np.repeat(first[place] - starts, num)]
        seen = _pixels_by_points(points[point] - views.centers[row], views.world_from_cam[row], views.focal_px[row])
        information = np.add.reduceat(np.swapaxes(seen, 1, 2) @ seen, starts)
        inverse = np.linalg.pinv(information, hermitian=True)
        noise = self.pixel_stddev**2 * (np.eye(2) + by_point @ inverse @ np.swapaxes(by_point, 1, 2))
        by_pose = _pixels_by_pose(by_point, points - center)
        weights = np.linalg.inv(noise)
        weighted = np.swapaxes(by_pose, 1, 2) @ weights
        covariance = np.linalg.inv(np.sum(weighted @ by_pose, axis=0))
        squared = np.einsum("ki,kij,kj", residuals_px, weights, residuals_px)
        variance = max(float(squared) / (residuals_px.size - len(covariance)), 1.0)
        frame = views.frame[row]
        to_pose = (covariance @ weighted @ by_point @ inverse)[point] @ np.swapaxes(seen, 1, 2)
        by_seen = to_pose @ _pixels_by_pose(seen, points[point] - self.errors.centers[frame])
        frames, of_frame = np.unique(frame, return_inverse=True)
        adder = csr_array((np.ones(len(row)), (of_frame, np.arange(len(row)))), shape=(len(frames), len(row)))
        by_frame = (adder @ by_seen.reshape(-1, 36)).reshape(-1, 6, 6)
        return frames, by_frame, variance * covariance


def _center(rig_from_world: pycolmap.Rigid3d) -> Array:
    return np.asarray(-rig_from_world.rotation.matrix().T @ rig_from_world.translation)


def _pixels_by_points(from_camera: Array, world_from_cam: Array, focal_px: Array) -> Array:
    """Return the (n, 2, 3) derivatives of pixels by points (n, 3) from the camera, for a lens without distortion."""
    in_cam = np.einsum("nji,nj->ni", np.broadcast_to(world_from_cam, (len(from_camera), 3, 3)), from_camera)
    slope = np.zeros((len(in_cam), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = 1.0
    slope[:, :, 2] = -in_cam[:, :2] / in_cam[:, 2:]
    slope *= np.broadcast_to(focal_px, (len(in_cam), 2))[:, :, None] / in_cam[:, 2, None, None]
    return np.asarray(slope @ np.swapaxes(world_from_cam, 1, 2))


def _pixels_by_pose(by_point: Array, from_rig: Array) -> Array:
    """Return the (n, 2, 6) derivatives of pixels by a turn of the rig about the axes of the world and its shift."""
    return np.concatenate([by_point @ cross_matrices(from_rig), -by_point], axis=2)
