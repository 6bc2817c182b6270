"""Photos of a planned survey: how far the map will bend, before and after the ranges straighten it.

Points are scattered in front of the camera. They go into the keyframe graph of the refinement, where the points are
eliminated and the remaining information connects neighbouring keyframes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import IDENTITY, similarity_motions
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.option_model import KeyMeta, Options
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.association import lever_arms
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.refine.keyframe_graph import KeyframeGraph, linear_functions
from rangesfm.refine.radio import antennas
from rangesfm.refine.vision_information import Observations, Poses, VisionInformation, vision_information
from rangesfm.scale.scale_problem import ScaleProblem
from rangesfm.scale.solution import Solution

MAX_NUM_PHOTOS = 2000
"""Largest number of photos; more would take minutes, and with fewer photos the path bends in the same way."""
# Height of a photo over its width.
_HEIGHT = 2 / 3
# Number of points in the computation, where each may stand for several; smallest number per photo; number of times that
# a point which no other photo sees is drawn again.
_NUM_COMPUTED, _LEAST_COMPUTED, _NUM_ROUNDS = 20_000, 40, 5
# A point is found again later if it is seen from a direction within 30 degrees, at a distance within a factor of 2.
_SAME_LOOK, _SAME_SIZE = np.cos(np.deg2rad(30.0)), 2.0
# Number of keyframes for which the bending is computed; it is interpolated between them.
_NUM_BENT = 40
# Motions with a singular value below this fraction of the largest do not move the keyframes, like the rotation about a
# straight path.
_NO_MOTION = 1e-6


def ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError("are not ascending")
    return ends


_Distance = Annotated[float, Field(ge=0.01, le=1e4)]


class PlannedPhotos(Options, table="photos"):
    """Field of view and features of the camera; without this table the map is assumed to be rigid."""

    field_of_view_deg: Annotated[float, Field(ge=5, le=170)] = 65.0
    """Horizontal field of view."""
    seen_m: Annotated[
        Annotated[tuple[_Distance, _Distance], Field(strict=False), AfterValidator(ascending)],
        KeyMeta(expected="a list of 2 distances, the larger one last"),
    ] = (1.5, 8.0)
    """Distances of the nearest and the farthest points that the camera sees, in metres."""
    num_points: Annotated[int, Field(ge=8, le=100_000)] = 200
    """Number of points of the map in each photo."""
    num_photos_of_point: Annotated[int, Field(ge=2, le=1000)] = 8
    """Largest number of successive photos in which a point is found."""
    closes_loops: bool = False
    """True if a point is found again later, from about the same direction and distance."""
    feature_stddev: Annotated[float, Field(ge=1e-6, le=0.1)] = 0.0005
    """Standard deviation of each coordinate of a feature, as a fraction of a photo's width."""

    @property
    def _half_width(self) -> float:
        """Half the width of what a photo shows, at a depth of 1."""
        return float(np.tan(np.deg2rad(self.field_of_view_deg / 2)))

    def information(self, path: Trajectory) -> VisionInformation:
        """Return the information of the photos about the keyframes' poses, given the path.

        Raises:
            GeometryError: no two photos see the same point.
        """
        observations = self.observations(path)
        if not len(observations.point):
            raise GeometryError("[photos] no two photos see the same point: expected a larger seen_m or photo_rate_hz")
        return vision_information(observations, Poses(path.world_from_cam, path.centers))

    def observations(self, path: Trajectory) -> Observations:
        """Simulate observations, without errors, of points that fill each photo of a path.

        The points are uniform over the photo and over the logarithm of depth. They are few, so that each may stand for
        several.
        """
        rng = np.random.default_rng(0)
        num = min(self.num_points, max(_NUM_COMPUTED // len(path), _LEAST_COMPUTED))
        wanted = np.full(len(path), num)
        points: list[Array] = []
        seen_by: list[Indices] = []
        for frame in range(len(path)):
            for _ in range(_NUM_ROUNDS):
                if not wanted[frame]:
                    break
                new = self._scattered(path, frame, int(wanted[frame]), rng)
                for point, by in zip(new, self._photos_of(path, frame, new), strict=True):
                    by = by[wanted[by] > 0]
                    if len(by) > 1 and by[0] == frame:
                        wanted[by] -= 1
                        points.append(point)
                        seen_by.append(by)
        return self._as_rays(path, np.array(points).reshape(-1, 3), seen_by, self.num_points / num)

    def _scattered(self, path: Trajectory, frame: int, num: int, rng: np.random.Generator) -> Array:
        near, far = self.seen_m
        depths = near * (far / near) ** rng.random(num)
        across = self._half_width * rng.uniform(-1, 1, (num, 2)) * [1.0, _HEIGHT]
        in_cam = depths[:, None] * np.column_stack([across, np.ones(num)])
        return np.asarray(path.centers[frame] + in_cam @ path.world_from_cam[frame].T)

    def _photos_of(self, path: Trajectory, frame: int, points: Array) -> Iterator[Indices]:
        """Yield, for each of the points (k, 3) first seen in photo ``frame``, the photos that find it, in order."""
        photos = np.arange(frame, len(path) if self.closes_loops else min(frame + self.num_photos_of_point, len(path)))
        off = points[:, None] - path.centers[photos]
        in_cam = np.einsum("nji,knj->kni", path.world_from_cam[photos], off)
        depth, distance = in_cam[:, :, 2], np.linalg.norm(off, axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.abs(in_cam[:, :, :2] / depth[:, :, None])
        found = (depth > 0) & (at[:, :, 0] < self._half_width) & (at[:, :, 1] < _HEIGHT * self._half_width)
        looks_alike = np.einsum("kni,ki->kn", off, off[:, 0]) > _SAME_LOOK * distance * distance[:, :1]
        looks_alike &= np.abs(np.log(distance / distance[:, :1])) < np.log(_SAME_SIZE)
        is_first_run = np.logical_and.accumulate(found, axis=1)
        found &= is_first_run | (looks_alike if self.closes_loops else False)
        for row in found:
            yield photos[row & _in_runs(row, self.num_photos_of_point)]

    def _as_rays(self, path: Trajectory, points: Array, seen_by: list[Indices], num_alike: float) -> Observations:
        point = np.repeat(np.arange(len(points)), [len(by) for by in seen_by])
        frame = np.concatenate([*seen_by, np.zeros(0, dtype=np.int64)]).astype(np.int64)
        in_cam = np.einsum("nji,nj->ni", path.world_from_cam[frame], points[point] - path.centers[frame])
        root_information = np.sqrt(num_alike) / (self.feature_stddev * 2 * self._half_width)
        return Observations(
            frame,
            point,
            in_cam[:, :2] / in_cam[:, 2:],
            np.full(len(frame), root_information),
            np.tile(np.eye(3), (len(frame), 1, 1)),
            np.zeros((len(frame), 3)),
            points,
            np.arange(len(points)),
        )


def _in_runs(found: npt.NDArray[np.bool_], longest: int) -> npt.NDArray[np.bool_]:
    """Return which photos are among the first ``longest`` of an uninterrupted run of photos that find a point."""
    index = np.arange(len(found))
    since = index - np.maximum.accumulate(np.where(found, -1, index))
    return since <= longest


@dataclass(frozen=True)
class PlannedMap:
    """The map that photos and ranges will determine, linearized at the true values.

    Attributes:
        path: path of the n keyframes in the site frame.
        vision: information of the photos about the path.
        posed: the scale problem of the run.
        observations: its ranges.
        tag_in_cam_m: (3,) lever arm of the tag.
    """

    path: Trajectory
    vision: VisionInformation
    posed: ScaleProblem
    observations: RangeObservations
    tag_in_cam_m: tuple[float, float, float]

    def bend_m(self, solution: Solution) -> float:
        """Return the standard deviation by which the map bends before the refinement, metres.

        It is that of each coordinate of a keyframe, relative to the best-fitting similarity.
        """
        by_photos, _ = linear_functions(replace(self._graph(solution, 0.0), held_frame=None), self._gradients)
        bent = _without(self._motions)
        return float(np.sqrt(np.trace(bent @ by_photos @ bent) / len(by_photos)))

    def bends_m(self, solution: Solution, learned: LearnedErrors, num_alike: float) -> Array:
        """Return the standard deviations of the keyframes' positions (n,) after the refinement, metres.

        Errors of the ranges that move or scale the map as a whole are left out. The covariance is that of the run,
        (J^T W J)^-1 J^T W S W J (J^T W J)^-1, with the covariance S of the ranges. It contains all errors of the
        photos, and the errors of the ranges as far as they bend the map.

        Args:
            solution: solution with the range errors that a bending map sees.
            learned: error model of the ranges.
            num_alike: number of ranges that each simulated one stands for.
        """
        graph = self._graph(solution, num_alike)
        by_photos, by_metre = linear_functions(graph, self._gradients)
        by_bin = np.stack([learned.bins.total(column) for column in by_metre.T], axis=1)
        by_ranges = by_bin.T @ learned.covariance_m2 @ by_bin
        # In the first camera's frame, the map as a whole can only change its scale.
        bent = _without(self._motions if graph.held_frame is None else self._motions[:, :, :1])
        variances = np.diag(by_photos + bent @ by_ranges @ bent).reshape(-1, 3).sum(axis=1)
        return np.asarray(np.interp(np.arange(len(self.path)), self._some, np.sqrt(np.maximum(variances, 0.0))))

    @property
    def _some(self) -> Indices:
        """Indices of the k keyframes for which the bending is computed."""
        some: Indices = np.unique(np.linspace(0, len(self.path) - 1, _NUM_BENT).round().astype(np.int64))
        return some

    @property
    def _motions(self) -> Array:
        """Derivatives (k, 3, 7) of these keyframes' centres by a similarity about the first camera."""
        return similarity_motions(self.path.centers[self._some] - self.path.centers[0])

    @property
    def _gradients(self) -> Array:
        """Derivatives (6 n, 3 k) of these keyframes' centres by all n poses."""
        gradients = np.zeros((len(self.path), 6, len(self._some), 3))
        for column, frame in enumerate(self._some):
            gradients[frame, 3:, column] = np.eye(3)
        return gradients.reshape(6 * len(self.path), -1)

    def _graph(self, solution: Solution, num_alike: float) -> KeyframeGraph:
        """Return the keyframe graph of the refinement in the site frame.

        If the result is in the first camera's frame, only the held keyframe differs.
        """
        posed, ranges, log = self.posed, self.posed.ranges, self.observations.log
        in_site = (solution.fit.state.metric_from_model @ posed.first_camera_from_sfm).inverse()
        anchors = tuple(
            AnchorEstimate(anchor_id, at, 0.0, at if np.isfinite(stddev_m) else None, stddev_m, 0.0, 0.0, bias_stddev_m)
            for anchor_id, at, stddev_m, bias_stddev_m in zip(
                log.anchor_ids,
                in_site.apply(solution.fit.state.anchors_m),
                ranges.anchor_stddev_m.tolist(),
                ranges.bias_stddev_m.tolist(),
                strict=True,
            )
        )
        tags_in_cam_m = lever_arms(log, self.tag_in_cam_m)
        return KeyframeGraph(
            vision=self.vision,
            antennas=antennas(self.path, self.observations, IDENTITY, tags_in_cam_m).subset(posed.rows),
            range_m=log.range_m[posed.rows],
            errors=replace(solution.errors, share=num_alike * solution.errors.share),
            anchors=anchors,
            held_frame=None if ranges.frame_is_free else 0,
            gravity=None,
        )


def _without(motions: Array) -> Array:
    """Return the projector (3 k, 3 k) onto the displacements that the motions (k, 3, m) do not explain."""
    left, sizes, _ = np.linalg.svd(motions.reshape(-1, motions.shape[2]), full_matrices=False)
    basis = left[:, sizes > _NO_MOTION * sizes.max()]
    return np.asarray(np.eye(len(basis)) - basis @ basis.T)
