"""COLMAP models with a known truth and without photos, for everything that comes after mapping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.util.geometry.similarity import Similarity

FloatArray = npt.NDArray[np.float64]

# Rounds of new points for one photo; a photo in which none can be seen twice keeps fewer.
_MAX_ROUNDS = 20


@dataclass(frozen=True)
class SyntheticModel:
    """A model in a world and a unit of its own, and the truth in metres.

    Attributes:
        reconstruction: n registered frames of one PINHOLE camera, points with tracks.
        metric_from_sfm: the model's world to the metric one.
        timestamps_s: camera-clock time by image name.
        centers_m: (n, 3) projection centres in the metric world, in time order.
        world_from_cam: (n, 3, 3) in the metric world.
    """

    reconstruction: pycolmap.Reconstruction
    metric_from_sfm: Similarity
    timestamps_s: dict[str, float]
    centers_m: FloatArray
    world_from_cam: FloatArray


def synthetic_model(
    timestamps_s: FloatArray,
    centers_m: FloatArray,
    world_from_cam: FloatArray,
    *,
    num_observations: int = 200,
    max_track_length: int | None = None,
    depth_range_m: tuple[float, float] = (2.0, 20.0),
    pixel_stddev: float = 0.0,
    metric_from_sfm: Similarity | None = None,
    image_size: tuple[int, int] = (960, 640),
    focal_px: float = 750.0,
    seed: int = 0,
) -> SyntheticModel:
    """Simulate a model of points seen along a known path.

    Args:
        timestamps_s: (n,) strictly increasing.
        centers_m: (n, 3) projection centres.
        world_from_cam: (n, 3, 3).
        num_observations: in each photo; fewer where not enough points are seen twice.
        max_track_length: number of consecutive photos in which a point is seen at most, so that the
            model is only connected from one photo to the next; None: all photos that show the point.
        depth_range_m: of new points in front of the camera.
        pixel_stddev: noise of each pixel coordinate; 0 makes the reprojection exact.
        metric_from_sfm: from the model's world to the metric one; None: a random similarity.
        image_size: width and height, pixels.
        focal_px: focal length; the principal point is the middle.
        seed: of points, noise and similarity.
    """
    rng = np.random.default_rng(seed)
    frames = Frames(timestamps_s, centers_m, world_from_cam, focal_px, image_size)
    points, seen_by = _scatter_points(frames, num_observations, max_track_length, depth_range_m, rng)
    return frames.seeing(points, seen_by, pixel_stddev, metric_from_sfm or random_similarity(rng), rng)


def random_similarity(rng: np.random.Generator) -> Similarity:
    """Draw a similarity with a scale between 1/4 and 4, any rotation, and a translation of some metres."""
    rotation = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    return Similarity(float(4 ** rng.uniform(-1, 1)), rotation, 5 * rng.standard_normal(3))


@dataclass(frozen=True)
class Frames:
    """Poses in metres and the camera that they share."""

    timestamps_s: FloatArray
    centers: FloatArray
    world_from_cam: FloatArray
    focal_px: float
    image_size: tuple[int, int]

    def project(self, points: FloatArray, frames: npt.NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels and (n,) depths of (n, 3) points, each in its own frame."""
        in_cam = np.einsum("nji,nj->ni", self.world_from_cam[frames], points - self.centers[frames])
        depths = in_cam[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = self.focal_px * in_cam[:, :2] / depths[:, None] + np.array(self.image_size) / 2
        return pixels, depths

    def sees(self, points: FloatArray, frames: npt.NDArray[np.int64], min_depth: float) -> npt.NDArray[np.bool_]:
        """(n, m) whether each of n points is in the picture of each of m frames."""
        pairs = np.repeat(points, len(frames), axis=0), np.tile(frames, len(points))
        pixels, depths = self.project(*pairs)
        inside = (depths > min_depth) & np.all((pixels > 0) & (pixels < self.image_size), axis=1)
        return np.asarray(inside.reshape(len(points), len(frames)))

    def random_points(
        self, frame: int, count: int, depth_range_m: tuple[float, float], rng: np.random.Generator
    ) -> FloatArray:
        """(count, 3) points in the picture of one frame, evenly over it and over the logarithm of depth."""
        pixels = rng.random((count, 2)) * self.image_size
        depths = depth_range_m[0] * (depth_range_m[1] / depth_range_m[0]) ** rng.random(count)
        in_cam = np.column_stack([(pixels - np.array(self.image_size) / 2) / self.focal_px, np.ones(count)])
        return np.asarray(self.centers[frame] + (depths[:, None] * in_cam) @ self.world_from_cam[frame].T)

    def seeing(
        self,
        points: FloatArray,
        seen_by: list[npt.NDArray[np.int64]],
        pixel_stddev: float,
        metric_from_sfm: Similarity,
        rng: np.random.Generator,
    ) -> SyntheticModel:
        """Return the model of (p, 3) points, each seen by some frames, in a world of its own."""
        names = [f"frame_{number:05d}.jpg" for number in range(1, len(self.centers) + 1)]
        times = dict(zip(names, np.asarray(self.timestamps_s, dtype=np.float64).tolist(), strict=True))
        found = _reconstruction(self, names, points, seen_by, pixel_stddev, metric_from_sfm.inverse(), rng)
        return SyntheticModel(found, metric_from_sfm, times, self.centers, self.world_from_cam)


def _scatter_points(
    frames: Frames,
    num_observations: int,
    max_track_length: int | None,
    depth_range_m: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[FloatArray, list[npt.NDArray[np.int64]]]:
    """Draw points until each frame sees its number of them.

    Returns:
        (p, 3) points, and for each point the frames that observe it.
    """
    num_frames = len(frames.centers)
    wanted = np.full(num_frames, num_observations)
    points: list[FloatArray] = []
    seen_by: list[npt.NDArray[np.int64]] = []
    for frame in range(num_frames):
        # Earlier frames have their number already, so that each point's track starts here.
        following = np.arange(frame, min(num_frames, frame + (max_track_length or num_frames)))
        for _ in range(_MAX_ROUNDS):
            if wanted[frame] == 0:
                break
            new = frames.random_points(frame, int(wanted[frame]), depth_range_m, rng)
            seen = frames.sees(new, following, 0.5 * depth_range_m[0])
            seen &= np.cumsum(seen, axis=0) <= wanted[following]
            seen[seen.sum(axis=1) < 2] = False
            wanted[following] -= seen.sum(axis=0)
            for point, by in zip(new, seen, strict=True):
                if by.any():
                    points.append(point)
                    seen_by.append(following[by])
    return np.array(points).reshape(-1, 3), seen_by


def _reconstruction(
    frames: Frames,
    names: list[str],
    points: FloatArray,
    seen_by: list[npt.NDArray[np.int64]],
    pixel_stddev: float,
    sfm_from_metric: Similarity,
    rng: np.random.Generator,
) -> pycolmap.Reconstruction:
    """Put everything into COLMAP's structures, and move it to the model's own world."""
    observing = np.concatenate([*seen_by, np.empty(0, dtype=np.int64)])
    observed = np.repeat(np.arange(len(points)), [len(by) for by in seen_by])
    pixels, _ = frames.project(points[observed], observing)
    pixels = pixels + pixel_stddev * rng.standard_normal(pixels.shape)
    (width, height), focal_px = frames.image_size, frames.focal_px
    params = [focal_px, focal_px, width / 2, height / 2]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=params)
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    index_in_image = np.empty(len(observing), dtype=np.int64)
    for frame, name in enumerate(names):
        own = np.flatnonzero(observing == frame)
        index_in_image[own] = np.arange(len(own))
        image = pycolmap.Image(name=name, keypoints=pixels[own], camera_id=camera.camera_id, image_id=frame + 1)
        reconstruction.add_image_with_trivial_frame(image, _cam_from_world(frames, frame, sfm_from_metric))
    moved = sfm_from_metric.apply(points)
    ends = np.cumsum([len(by) for by in seen_by])
    for point, by, end in zip(moved, seen_by, ends, strict=True):
        places = index_in_image[end - len(by) : end]
        elements = [pycolmap.TrackElement(int(frame) + 1, int(place)) for frame, place in zip(by, places, strict=True)]
        reconstruction.add_point3D(point, pycolmap.Track(elements))
    reconstruction.update_point_3d_errors()
    return reconstruction


def _cam_from_world(frames: Frames, frame: int, sfm_from_metric: Similarity) -> pycolmap.Rigid3d:
    cam_from_world = frames.world_from_cam[frame].T @ sfm_from_metric.rotation.T
    center = sfm_from_metric.apply(frames.centers[frame])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world), -cam_from_world @ center)
