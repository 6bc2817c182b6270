"""Simulated surveys that come back to places: the map a mapper makes of neighbours in time, and all true matches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.simulated.files import write_anchors, write_model
from tests.simulated.model import Frames, synthetic_model
from tests.simulated.path import lap_path, look_at
from tests.simulated.surveys import (
    SITE_ANCHORS_M,
    TAG_IN_CAM_M,
    Truth,
    adjusted,
    drop_flat_points,
    range_log,
)

from rangesfm.colmap.pieces import MIN_NUM_SHARED
from rangesfm.colmap.transform import rescale
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.with_ranges import refine_with_ranges
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.options import CameraOptions
from rangesfm.sfm.database import create_database
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference, write_reference
from rangesfm.util.geometry.similarity import IDENTITY, rmse
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Pair = tuple[int, int]
Matches = npt.NDArray[np.int64]


@dataclass(frozen=True)
class LoopedSurvey:
    """A survey with all its true tracks.

    Attributes:
        survey: its model has every point with all photos that see it, in the metric world, with noisy features.
        max_track_length: photos after one another in which the mapper finds a point; later ones make another point.
    """

    survey: Truth
    max_track_length: int

    @property
    def truth(self) -> pycolmap.Reconstruction:
        return self.survey.model.reconstruction

    def chain(self) -> pycolmap.Reconstruction:
        """Return the map that a mapper makes by neighbours in time alone: COLMAP's adjustment of the cut tracks."""
        chain = self.cut()
        drop_flat_points(chain)
        return adjusted(chain)

    def cut(self) -> pycolmap.Reconstruction:
        """Return the true map with its tracks cut."""
        chain = pycolmap.Reconstruction(self.truth)
        for point_id, point in sorted(self.truth.points3D.items()):
            chain.delete_point3D(point_id)
            seen = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
            for piece in _pieces(seen, self.max_track_length):
                chain.add_point3D(point.xyz, pycolmap.Track([pycolmap.TrackElement(*one) for one in piece]))
        return chain

    @cached_property
    def matches(self) -> dict[Pair, Matches]:
        """Matches of all pairs that have enough of them."""
        return {pair: of for pair, of in matches_in(self.truth).items() if len(of) >= MIN_NUM_SHARED}

    @property
    def neighbours(self) -> dict[Pair, Matches]:
        """Matches of photos that the mapper matches."""
        return {pair: of for pair, of in self.matches.items() if pair[1] - pair[0] < self.max_track_length}


def _pieces(seen: list[Pair], max_length: int) -> Iterable[list[Pair]]:
    cuts = [k for k, ((a, _), (b, _)) in enumerate(pairwise(seen), 1) if b - a > 1]
    for begin, end in pairwise([0, *cuts, len(seen)]):
        for start in range(begin, end, max_length):
            if len(piece := seen[start : min(start + max_length, end)]) > 1:
                yield piece


def matches_in(model: pycolmap.Reconstruction) -> dict[Pair, Matches]:
    """Return features (m, 2) of the same points in two photos, by the photos' ids."""
    found: dict[Pair, list[Pair]] = {}
    for _, point in sorted(model.points3D.items()):
        seen = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for (first, place), (second, other) in combinations(seen, 2):
            found.setdefault((first, second), []).append((place, other))
    return {pair: np.array(of) for pair, of in found.items()}


def write_matches(
    path: Path, model: pycolmap.Reconstruction, matches: dict[Pair, Matches], *, with_descriptors: bool = False
) -> None:
    """Write a database with the features of a model and these matches, which are taken for verified.

    Args:
        with_descriptors: whether to write a random descriptor for each point, by which COLMAP matches its features.
    """
    rng = np.random.default_rng(0)
    of_point = rng.integers(0, 90, (1 + max(model.point3D_ids()), 128), dtype=np.uint8) if with_descriptors else None
    image_ids = sorted(model.reg_image_ids())
    (camera,) = model.cameras.values()
    names = [model.image(image_id).name for image_id in image_ids]
    create_database(path, names, [pycolmap.Camera(camera.todict())], [0] * len(names))
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id in image_ids:
            pixels = np.array([point.xy for point in model.image(image_id).points2D], dtype=np.float32)
            database.write_keypoints(image_id, pixels.reshape(-1, 2))
            if of_point is not None:
                ids = [point.point3D_id for point in model.image(image_id).points2D]
                sift = pycolmap.FeatureExtractorType.SIFT
                database.write_descriptors(image_id, pycolmap.FeatureDescriptors(type=sift, data=of_point[ids]))
        for pair, of_pair in matches.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = of_pair.astype(np.uint32)
            database.write_matches(*pair, of_pair.astype(np.uint32))
            database.write_two_view_geometry(*pair, geometry)


def write_survey(looped: LoopedSurvey, folder: Path) -> None:
    """Write a survey with one anchor: a model whose loops are open, ranges at its photos, and all else that is known.

    The files are ``sparse``, ``database.db`` with the matches of neighbours in time, ``images.csv``, ``uwb.csv``,
    ``anchors.csv`` and ``reference.csv``, the truth.
    """
    truth = looped.survey.model
    write_model(looped.chain(), folder / "sparse", truth.timestamps_s, folder / "images.csv")
    write_ranges_csv(range_log(looped.survey, 1, num_each=4), folder / "uwb.csv")
    write_anchors(folder / "anchors.csv", looped.survey.anchors_m)
    write_matches(folder / "database.db", looped.truth, looped.neighbours, with_descriptors=True)
    reference = Reference(truth.centers_m, ByPhoto(tuple(truth.timestamps_s)), world_from_cam=truth.world_from_cam)
    write_reference(reference, folder / "reference.csv")


@dataclass(frozen=True)
class ScaledMap:
    """A simulated map after the scale stage, ready to be refined.

    Attributes:
        scaled: the map, in metres. trajectory, estimate: as the refinement needs them.
    """

    survey: Truth
    scaled: pycolmap.Reconstruction
    trajectory: Trajectory
    estimate: ScaleEstimate

    @classmethod
    def of(cls, survey: Truth, sfm: pycolmap.Reconstruction, log: RangeLog) -> ScaledMap:
        trajectory = trajectory_from_reconstruction(sfm, survey.model.timestamps_s)
        observations = associate(log, trajectory, TAG_IN_CAM_M)
        anchors = [Anchor(name, position) for name, position in survey.anchors_m.items()]
        estimate = initialize_scale(observations, trajectory, anchors, anchor_frame=survey.anchor_frame)
        return cls(survey, rescale(sfm, estimate.metric_from_sfm), trajectory, estimate)

    def refined_by_default(self, refined: pycolmap.Reconstruction | None = None) -> pycolmap.Reconstruction:
        """Refine the scaled map, or a refined one again, with the errors of ranges that the scale stage found."""
        estimate = self.estimate
        again, _ = refine_with_ranges(
            self.scaled if refined is None else refined,
            self.trajectory,
            estimate.ranges.observations,
            estimate.metric_from_sfm,
            estimate.ranges.anchors,
            estimate.ranges.errors,
            tag_in_cam_m=TAG_IN_CAM_M,
            first_pose_is_fixed=self.survey.is_in_first_camera,
            camera=CameraOptions(refine_intrinsics=False),
            is_refined=refined is not None,
            num_threads=1,
        )
        return again

    def error_m(self, model: pycolmap.Reconstruction) -> float:
        """Return the root mean square error of the keyframes, without alignment."""
        truth = self.survey.model
        return rmse(trajectory_from_reconstruction(model, truth.timestamps_s).centers - truth.centers_m)


def two_laps(
    num_keyframes: int,
    *,
    size_m: tuple[float, float],
    num_observations: int = 60,
    pixel_stddev: float = 0.5,
) -> LoopedSurvey:
    """Two laps of a rover around a field, looking ahead, with one anchor that is known in the first camera's frame.

    Args:
        num_keyframes: of both laps together.
        size_m: of the field.
        num_observations: features in a keyframe.
        pixel_stddev: of a coordinate of a feature.
    """
    times = np.arange(num_keyframes, dtype=np.float64)
    path = lap_path(times[-1], size_m=size_m, corner_radius_m=min(8.0, 0.2 * min(size_m)), share=2.0)
    centers, turns = path.centers(times), path.world_from_cam(times)
    model = synthetic_model(
        times,
        (centers - centers[0]) @ turns[0],
        turns[0].T @ turns,
        num_observations=num_observations,
        depth_range_m=(4.0, 25.0),
        pixel_stddev=pixel_stddev,
        metric_from_sfm=IDENTITY,
    )
    anchor = (np.array([0.1 * size_m[0], -0.4 * size_m[1], 4.0]) - centers[0]) @ turns[0]
    return LoopedSurvey(Truth(model, {"A1": anchor}, "first_camera"), 8)


def bent_laps() -> LoopedSurvey:
    """Return laps that bend by some decimetres, which their ranges hardly see."""
    return two_laps(80, size_m=(32.0, 20.0), num_observations=100, pixel_stddev=1.0)


@dataclass(frozen=True)
class RepeatingSurvey:
    """A walk along two aisles whose shelves are exactly alike.

    Attributes:
        looped: the survey. Its true matches tie each aisle to itself and to the way between them.
        alike: matches of photos in one aisle with photos in the other, which show the same and are not.
    """

    looped: LoopedSurvey
    alike: dict[Pair, Matches]


def two_aisles() -> RepeatingSurvey:
    """Simulate a walk along an aisle, over to the next one and back, looking at the shelves, with four anchors.

    The aisles are 4 m long with 10 keyframes in each, and 3 m apart. Features have a noise of half a pixel.
    """
    rng, num_keyframes, length_m, apart_m = np.random.default_rng(0), 10, 4.0, 3.0
    along, over = np.linspace(0.0, length_m, num_keyframes), np.arange(0.4, apart_m - 0.2, 0.4)
    x = np.concatenate([along, np.full(len(over), length_m), along[::-1]])
    y = -np.concatenate([0 * along, over, np.full(num_keyframes, apart_m)])
    height = 1.6 + 0.1 * np.sin(np.arange(len(x)))
    centers = np.column_stack([x, y, height])
    centers[-num_keyframes:, 2] = centers[:num_keyframes, 2][::-1]
    sway = 0.1 * np.sin(0.7 * x)
    turns = look_at(centers, centers + np.column_stack([sway, np.ones(len(x)), 0 * x]))
    num = 60 * num_keyframes
    shelf = rng.uniform([-2.0, 1.4, 0.0], [length_m + 2.0, 1.9, 3.0], (num, 3))
    clutter = rng.uniform([length_m - 1.5, -apart_m - 1, 0], [length_m + 2, 3.5, 3], (num // 2, 3))
    points = np.concatenate([shelf, shelf - [0.0, apart_m, 0.0], clutter])
    numbers = np.arange(float(len(x)))
    frames = Frames(numbers, centers, turns, 500.0, (960, 640))
    sees = _sees(frames, points)
    in_first, in_second = numbers < num_keyframes, numbers >= len(x) - num_keyframes
    sees[:num] &= ~in_second
    sees[num : 2 * num] &= ~in_first
    keep = sees.sum(axis=1) > 1
    looped = _walk(frames, points[keep], sees[keep], 0.5, rng)
    model = looped.truth
    of_point = dict(zip(np.flatnonzero(keep).tolist(), sorted(model.point3D_ids()), strict=True))
    alike: dict[Pair, list[Pair]] = {}
    for k in range(num):
        if k in of_point and num + k in of_point:
            one, other = (model.point3D(of_point[row]).track.elements for row in (k, num + k))
            for first in one:
                for second in other:
                    if in_first[first.image_id - 1] and in_second[second.image_id - 1]:
                        pair = first.image_id, second.image_id
                        alike.setdefault(pair, []).append((first.point2D_idx, second.point2D_idx))
    enough = {pair: np.array(of) for pair, of in alike.items() if len(of) >= MIN_NUM_SHARED}
    return RepeatingSurvey(looped, enough)


def around_a_room() -> LoopedSurvey:
    """Simulate a walk of 60 keyframes, once around a round room and some way further, looking at its wall.

    Neighbours hold the whole map together, so that a mapper makes one model of them. Features have a noise of 1 pixel.
    """
    rng, num_keyframes = np.random.default_rng(0), 60
    angle, around = np.linspace(0.0, 2.6 * np.pi, num_keyframes), rng.uniform(0.0, 2.0 * np.pi, 1500)
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(num_keyframes)])
    centers = 4.0 * outward + np.array([0.0, 0.0, 1.6])
    centers[:, 2] += 0.1 * np.sin(np.arange(num_keyframes))
    to_wall = rng.uniform(6.0, 7.0, len(around))
    points = np.column_stack([to_wall * np.cos(around), to_wall * np.sin(around), rng.uniform(0.0, 3.0, len(around))])
    frames = Frames(np.arange(float(num_keyframes)), centers, look_at(centers, centers + outward), 500.0, (960, 640))
    sees = _sees(frames, points)
    keep = sees.sum(axis=1) > 1
    return _walk(frames, points[keep], sees[keep], 1.0, rng)


def _sees(frames: Frames, points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return whether each photo of a walk sees each of the points (p, photos), which are not far away."""
    depth = np.einsum("fi,pfi->pf", frames.world_from_cam[:, :, 2], points[:, None] - frames.centers)
    return np.asarray(frames.sees(points, np.arange(len(frames.centers)), 0.5) & (depth < 3.5))


def _walk(
    frames: Frames,
    points: npt.NDArray[np.float64],
    sees: npt.NDArray[np.bool_],
    pixel_stddev: float,
    rng: np.random.Generator,
) -> LoopedSurvey:
    """Return the survey of a walk with four anchors, by which photos see each point (p, photos)."""
    made = frames.seeing(points, [np.flatnonzero(row) for row in sees], pixel_stddev, IDENTITY, rng)
    return LoopedSurvey(Truth(made, {name: np.array(at) for name, at in SITE_ANCHORS_M.items()}, "site"), 8)
