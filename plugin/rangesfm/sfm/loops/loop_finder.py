"""Proposal of pairs by a refined map, and the test of those that match against that map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from itertools import compress

import numpy as np
import pycolmap
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import MIN_NUM_SHARED, ids_seen_in, overlaps_in
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.candidates import Views, predicted_overlaps, propose_pairs
from rangesfm.sfm.loops.relative_errors import RelativeErrors
from rangesfm.sfm.loops.resection import MAX_CHANCE, Loop, resection_options
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import Trajectory, pose_of


@dataclass(frozen=True)
class LoopFinder:
    """A refined map, with what is needed to find its loops.

    Attributes:
        model: the map, metres.
        path: its keyframes.
        errors: of these keyframes.
        pixel_stddev: standard deviation of a coordinate of a feature.
        seed: of random numbers.
    """

    model: pycolmap.Reconstruction
    path: Trajectory
    errors: RelativeErrors
    pixel_stddev: float
    seed: int

    @classmethod
    def in_refined_map(
        cls,
        model: pycolmap.Reconstruction,
        trajectory: Trajectory,
        errors: MapErrors,
        pixel_stddev: float,
        seed: int,
    ) -> LoopFinder:
        """Return the finder of loops in a refined map; ``trajectory`` has its keyframes, also in another world."""
        path = trajectory.as_in(model)
        return cls(model, path, RelativeErrors.of_keyframes(errors, path.frame_ids, path.centers), pixel_stddev, seed)

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

    def tested(self, verified: Mapping[Pair, Indices]) -> tuple[list[Loop], list[Pair]]:
        """Return the loops that fit the map, and the pairs that it contradicts.

        Pairs whose matches have too few points say nothing and are in neither.

        Args:
            verified: matches (m, 2) of features that fit a two-view geometry, by pair.
        """
        found = (self._loop_of_pair(pair, matches) for pair, matches in verified.items())
        loops = [loop for loop in found if loop is not None]
        fits = [loop.chance(self.errors) >= MAX_CHANCE for loop in loops]
        return list(compress(loops, fits)), [loop.image_ids for loop, is_right in zip(loops, fits) if not is_right]

    def relative_poses(self, loops: Sequence[Loop]) -> LoopPoses:
        """Return what loops say, for the keyframe graph, by ids of frames."""
        held, moved = (
            self.path.frame_ids[np.array(of, dtype=np.int64)] for of in zip(*((one.held, one.moved) for one in loops))
        )
        from_held, from_moved = (
            np.array([pose_of(self.model.frame(id_)).rotation.matrix().T for id_ in ids.tolist()])
            for ids in (held, moved)
        )
        turned = Rotation.from_rotvec([loop.turn for loop in loops]).as_matrix() @ from_moved
        apart = [self.errors.centers[loop.moved] + loop.shift - self.errors.centers[loop.held] for loop in loops]
        axes = np.zeros((len(loops), 6, 6))
        axes[:, :3, :3], axes[:, 3:, 3:] = turned, from_held
        information = np.linalg.inv([loop.covariance(self.errors) for loop in loops])
        return LoopPoses(
            held,
            moved,
            np.swapaxes(from_held, 1, 2) @ turned,
            np.einsum("lji,lj->li", from_held, np.array(apart)),
            np.swapaxes(axes, 1, 2) @ information @ axes,
        )

    def _loop_of_pair(self, image_ids: tuple[int, int], matches: Indices) -> Loop | None:
        """Return what the verified matches of a pair say; None if too few of them agree on a pose.

        Args:
            image_ids: of the pair, smaller first.
            matches: (m, 2) indices of features of the two photos.
        """
        ways = [(image_ids, matches), (image_ids[::-1], matches[:, ::-1])]
        seen = [(*way, self._seen(way[0][0], way[1])) for way in ways]
        (held, moved), matches, ids = max(seen, key=lambda way: int((way[2] >= 0).sum()))
        image, ids, places = self.model.image(moved), ids[ids >= 0], matches[ids >= 0, 1]
        if len(ids) < MIN_NUM_SHARED:
            return None
        points = np.array([self.model.point3D(id_).xyz for id_ in ids.tolist()])
        pixels = np.array([image.points2D[k].xy for k in places.tolist()])
        camera = self.model.camera(image.camera_id)
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, resection_options(self.seed))
        if found is None or int(found["num_inliers"]) < MIN_NUM_SHARED:
            return None
        fits = np.asarray(found["inlier_mask"])
        before = pose_of(self.model.frame(image.frame_id))
        cam_from_rig = image.cam_from_world() * before.inverse()
        after = cam_from_rig.inverse() * found["cam_from_world"]
        turn = Rotation.from_matrix(after.rotation.matrix().T @ before.rotation.matrix()).as_rotvec()
        row = self.views.row_of[moved]
        world_from_cam = found["cam_from_world"].rotation.matrix().T
        center = -world_from_cam @ found["cam_from_world"].translation
        by_point = _pixels_by_points(points[fits] - center, world_from_cam[None], self.views.focal_px[row])
        shift = _center(after) - _center(before)
        in_cam = (points[fits] - center) @ world_from_cam
        residuals_px = np.asarray(camera.img_from_cam(in_cam)) - pixels[fits]
        frames, by_frame, noise = self._dependence(ids[fits], points[fits], by_point, residuals_px, _center(after))
        return Loop(image_ids, self._frame_of(held), self._frame_of(moved), turn, shift, frames, by_frame, noise)

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

    def _frame_of(self, image_id: int) -> int:
        return int(self.views.frame[self.views.row_of[image_id]])

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
            As the attributes ``frames``, ``by_frame`` and ``noise`` of a loop, all of first order.
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
