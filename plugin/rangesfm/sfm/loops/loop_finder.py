"""Proposal of pairs by a refined map, and the test of those that match against that map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from scipy.linalg import block_diag
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import MIN_NUM_SHARED, ids_seen_in, overlaps_in
from rangesfm.estimation.vision_information import Loop
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.candidates import MIN_OVERLAP, Views, best_apart
from rangesfm.sfm.loops.resection import resect
from rangesfm.util.geometry.map_errors import MapErrors, Part
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
    def views(self) -> Views:
        return Views.in_model(self.model, self.path.frame_ids)

    def propose(self, matched: Mapping[int, Set[int]], *, max_num: int) -> dict[int, list[Pair]]:
        """Return for each photo, by its id, its pairs that tell most about the map, the best first.

        A pair tells what each of its features does: the logarithm of the error of the prediction over that of the
        feature. Of photos that know each other only one is paired with the same photo, since they tell the same. Where
        the map is already known to the precision of a feature, no pair is worth its time.

        Args:
            matched: ids of the photos that each photo was matched with, by its id.
            max_num: largest number of pairs of one photo.
        """
        known, ids = self._known(matched), self.views.image_ids
        choices: dict[int, list[Pair]] = {}
        for first, others, overlap in self._overlaps(known, from_anywhere=False):
            worth = overlap * np.log(np.maximum(self._unknown_px(first, others) / self.pixel_stddev, 1.0))
            id_, best = int(ids[first]), ids[best_apart(others, worth, ids, known, max_num)].tolist()
            choices[id_] = [(min(id_, other), max(id_, other)) for other in best]
        return choices

    def predicted(self, matched: Mapping[int, Set[int]]) -> dict[int, set[int]]:
        """Return for each photo those that it was matched with, or that the map predicts to see the same, by ids.

        They may see it from where its features are not found again.
        """
        known, ids = self._known(matched), self.views.image_ids
        for first, others, _ in self._overlaps(known, from_anywhere=True):
            known[int(ids[first])].update(ids[others].tolist())
        return known

    def _overlaps(self, known: Mapping[int, Set[int]], *, from_anywhere: bool) -> Iterator[tuple[int, Indices, Array]]:
        """Yield for each photo the others that the map predicts to see enough of its points, with their shares.

        Args:
            known: ids of the photos that each photo is not to be paired with, by its id.
            from_anywhere: as for ``Views.overlaps``.

        Yields:
            The row of a photo in ``views``, the rows (k,) of the others, and the (k,) shares of its points in these.
        """
        views = self.views
        centers_m2 = self.map_errors.centers_m2(self.path.frame_ids)
        tree, stddev_m = KDTree(views.targets), np.sqrt(np.trace(centers_m2, axis1=1, axis2=2) / 3)[views.frame]
        reach_m = np.median(np.linalg.norm(views.points - views.centers[:, None], axis=2), axis=1) + 2 * stddev_m
        for first, near in enumerate(tree.query_ball_point(views.targets, reach_m, return_sorted=True)):
            knows = known.get(int(views.image_ids[first]), set())
            others = np.array([k for k in near if k != first and int(views.image_ids[k]) not in knows], dtype=np.int64)
            if not len(others):
                continue
            margin_m = np.hypot(stddev_m[first], stddev_m[others])
            overlap = views.overlaps(first, others, margin_m, from_anywhere=from_anywhere)
            yield first, others[overlap >= MIN_OVERLAP], overlap[overlap >= MIN_OVERLAP]

    def _unknown_px(self, first: int, others: Indices) -> Array:
        """Return the (k,) standard deviations with which the map predicts, in k photos, the target of one photo."""
        views, errors, target = self.views, self.map_errors.parts["frame"], self.views.targets[first]
        frame = views.frame[np.append(first, others)]
        rows = np.array([errors.row_of[frame_id] for frame_id in self.path.frame_ids[frame].tolist()])
        by_pose = _by_pose(np.tile(np.eye(3), (len(rows), 1, 1)), target - self.path.centers[frame])
        held, moved = rows[0], rows[1:]
        by_held, by_moved = by_pose[0], by_pose[1:]
        by_mode = by_moved @ errors.modes[moved] - by_held @ errors.modes[held]
        rests = by_moved @ errors.rests[moved] * by_moved + by_held @ errors.rests[held] * by_held
        variance = np.sum(by_mode**2, axis=(1, 2)) + np.sum(rests, axis=(1, 2))
        distance = np.linalg.norm(target - views.centers[others], axis=1)
        return np.asarray(views.focal_px[others].mean(axis=1) / distance * np.sqrt(variance / 3))

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
        shift = after.tgt_origin_in_src() - before.tgt_origin_in_src()
        world_from_cam = cam_from_world.rotation.matrix().T
        row, from_camera = self.views.row_of[photos[1]], points[fits] - cam_from_world.tgt_origin_in_src()
        by_point = _pixels_by_points(from_camera, world_from_cam[None], self.views.focal_px[row])
        residuals_px = np.asarray(camera.img_from_cam(from_camera @ world_from_cam)) - pixels[fits]
        by_part, noise = self._dependence(ids[fits], points[fits], by_point, residuals_px, after.tgt_origin_in_src())

        def covariance(frame_id: int, by_own: Array) -> Array:
            """Return the (6, 6) covariance of the pose by the points against what depends on another keyframe."""
            part: Part = ("frame", frame_id)
            return noise + self.map_errors.propagated({**by_part, part: by_part.get(part, 0.0) - by_own})

        held, moved = (int(self.views.frame[self.views.row_of[photo]]) for photo in photos)
        reference, frame = self.path.frame_ids[[held, moved]].tolist()
        difference = np.concatenate([Rotation.from_matrix(from_map).as_rotvec(), shift])
        squared = difference @ np.linalg.solve(covariance(frame, np.eye(6)), difference)
        chance = float(chdtrc(len(difference), float(squared)))
        carried = np.eye(6)  # how the placed keyframe errs if it keeps its place relative to the other one
        carried[3:] = _by_pose(np.eye(3)[None], (self.path.centers[moved] - self.path.centers[held])[None])[0]
        information = np.linalg.inv(covariance(reference, carried))
        from_held, turned = pose_of(self.model.frame(reference)).rotation.matrix().T, after.rotation.matrix().T
        axes = block_diag(turned, from_held)
        apart = self.path.centers[moved] + shift - self.path.centers[held]
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
    ) -> tuple[dict[Part, Array], Array]:
        """Return how the pose by k points errs.

        Args:
            ids, points: (k,), (k, 3) of the points.
            by_point: (k, 2, 3) derivatives of the placed photo's pixels. residuals_px: (k, 2) their residuals, which
                show how well features are found again from far away.
            center: (3,) origin of the placed rig.

        Returns:
            Derivatives (6, 6) of the pose, a turn about the axes of the world and a shift of the rig's origin, by the
            keyframes that see the points, and its covariance (6, 6) that is due to the features alone.
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
        by_pose = -_by_pose(by_point, points - center)
        weights = np.linalg.inv(noise)
        weighted = np.swapaxes(by_pose, 1, 2) @ weights
        covariance = np.linalg.inv(np.sum(weighted @ by_pose, axis=0))
        squared = np.einsum("ki,kij,kj", residuals_px, weights, residuals_px)
        variance = max(float(squared) / (residuals_px.size - len(covariance)), 1.0)
        frame = views.frame[row]
        to_pose = (covariance @ weighted @ by_point @ inverse)[point] @ np.swapaxes(seen, 1, 2)
        by_seen = to_pose @ -_by_pose(seen, points[point] - self.path.centers[frame])
        frames, of_frame = np.unique(frame, return_inverse=True)
        adder = csr_array((np.ones(len(row)), (of_frame, np.arange(len(row)))), shape=(len(frames), len(row)))
        by_frame = (adder @ by_seen.reshape(-1, 36)).reshape(-1, 6, 6)
        ids_of_frames = self.path.frame_ids[frames].tolist()
        return {("frame", id_): by for id_, by in zip(ids_of_frames, by_frame, strict=True)}, variance * covariance


def _pixels_by_points(from_camera: Array, world_from_cam: Array, focal_px: Array) -> Array:
    """Return the (n, 2, 3) derivatives of pixels by points (n, 3) from the camera, for a lens without distortion."""
    in_cam = np.einsum("nji,nj->ni", np.broadcast_to(world_from_cam, (len(from_camera), 3, 3)), from_camera)
    slope = np.zeros((len(in_cam), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = 1.0
    slope[:, :, 2] = -in_cam[:, :2] / in_cam[:, 2:]
    slope *= np.broadcast_to(focal_px, (len(in_cam), 2))[:, :, None] / in_cam[:, 2, None, None]
    return np.asarray(slope @ np.swapaxes(world_from_cam, 1, 2))


def _by_pose(by_point: Array, arm: Array) -> Array:
    """Return the (n, d, 6) derivatives of what depends on points by a pose: a turn about the world's axes and a shift.

    Args:
        by_point: (n, d, 3) derivatives by points that keep their places relative to a rig.
        arm: (n, 3) from the origin of the rig to each point.
    """
    return np.concatenate([-by_point @ cross_matrices(arm), by_point], axis=2)
