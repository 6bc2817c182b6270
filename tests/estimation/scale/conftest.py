"""Surveys without photos: a path in a unit of its own, anchors, ranges, and the truth about them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.path import loop_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.demo.simulated_radio import Radio
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.lengths.length_scale import LengthScale, lengths_between_points
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]

FIVE_ANCHORS_M = {
    "A": (6.0, 0.0, 2.5),
    "B": (-6.0, 1.0, 0.4),
    "C": (0.5, 6.0, 3.0),
    "D": (1.0, -6.0, 0.2),
    "E": (5.0, 5.0, 1.0),
}


@dataclass(frozen=True)
class Survey:
    """n keyframes, and ranges taken at each of them.

    Attributes:
        trajectory: the unscaled path, as from a mapper.
        site_from_sfm: the true similarity, which a scale stage is to find.
        times, centers_m, world_from_cam: the true path in the site frame.
        anchors_m: true positions in the site frame.
        tag_in_cam_m: lever arm.
        log: the ranges, at the times of the keyframes.
    """

    trajectory: Trajectory
    site_from_sfm: Similarity
    times: Array
    centers_m: Array
    world_from_cam: Array
    anchors_m: dict[str, Array]
    tag_in_cam_m: Array
    log: RangeLog

    @property
    def distance_m(self) -> Array:
        """The true distance of each range in the log."""
        keyframe = np.searchsorted(self.times, self.log.timestamp_s)
        anchors = np.array([self.anchors_m[name] for name in self.log.anchor_ids])[self.log.anchor_index]
        tags = self.centers_m[keyframe] + self.world_from_cam[keyframe] @ self.tag_in_cam_m
        return np.asarray(np.linalg.norm(tags - anchors, axis=1))

    def frame_from_site(self, frame: str) -> Similarity:
        """Return the transform from the site to a frame, "site" or "first_camera"."""
        first_camera = Similarity(1.0, self.world_from_cam[0], self.centers_m[0])
        return IDENTITY if frame == "site" else first_camera.inverse()

    def truth(self, frame: str) -> Similarity:
        """Return the true ``metric_from_sfm``."""
        return self.frame_from_site(frame) @ self.site_from_sfm

    def anchors(self, frame: str, known: Collection[str]) -> list[Anchor]:
        """Return all anchors; the known ones have their positions in this frame."""
        from_site = self.frame_from_site(frame)
        return [Anchor(name, from_site.apply(at) if name in known else None) for name, at in self.anchors_m.items()]

    def observations(self, log: RangeLog | None = None) -> RangeObservations:
        return associate(log or self.log, self.trajectory, self.tag_in_cam_m)

    def scale(
        self,
        frame: str,
        known: Collection[str] = (),
        log: RangeLog | None = None,
        lengths: LocatedDistances | None = None,
        **options: Any,
    ) -> ScaleEstimate:
        """Run the scale stage on this survey's ranges, or on another log, with lengths between points."""
        anchors, others = self.anchors(frame, known), [] if lengths is None else lengths_among(lengths, self.trajectory)
        observations = self.observations(log)
        return initialize_scale(observations, self.trajectory, anchors, anchor_frame=frame, others=others, **options)

    def log_with(self, range_m: Array) -> RangeLog:
        """Return the same log with other ranges."""
        return replace(self.log, range_m=range_m)

    def relative_error(self, estimate: ScaleEstimate) -> float:
        return estimate.value / self.site_from_sfm.scale - 1


def lengths_among(distances: LocatedDistances, path: Trajectory) -> list[LengthScale]:
    """Return the lengths between points among measured distances, if there are any, for ``initialize_scale``."""
    found = lengths_between_points(distances, WalkBending(path))
    return [] if found is None else [found]


class MakeSurvey(Protocol):
    def __call__(
        self,
        *,
        scale: float = 2.0,
        centers_m: Array | None = None,
        num_keyframes: int = 40,
        anchors_m: dict[str, tuple[float, float, float]] | None = None,
        tag_in_cam_m: tuple[float, float, float] = ...,
        radio: Radio = ...,
        num_epochs: int = 1,
        seed: int = 0,
    ) -> Survey: ...


@pytest.fixture(scope="session")
def make_survey() -> MakeSurvey:
    """Return a function that makes a survey.

    The path is a loop of 40 s, or given by its centres; each keyframe has ``num_epochs`` ranges to each anchor.
    """
    return _make_survey


def _make_survey(
    *,
    scale: float = 2.0,
    centers_m: Array | None = None,
    num_keyframes: int = 40,
    anchors_m: dict[str, tuple[float, float, float]] | None = None,
    tag_in_cam_m: tuple[float, float, float] = (0.05, -0.12, -0.03),
    radio: Radio = Radio(),  # noqa: B008 (frozen)
    num_epochs: int = 1,
    seed: int = 0,
) -> Survey:
    anchors_m = anchors_m or FIVE_ANCHORS_M
    rng = np.random.default_rng(seed)
    path = loop_path(40.0, unsteadiness_m=0.1, seed=3)
    num_keyframes = num_keyframes if centers_m is None else len(centers_m)
    times = np.linspace(0.0, 40.0, num_keyframes)
    centers = path.centers(times) if centers_m is None else centers_m
    world_from_cam = path.world_from_cam(times)
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    site_from_sfm = Similarity(scale, rotation, 10 * rng.normal(size=3))
    inverse = site_from_sfm.inverse()
    names = tuple(f"{number:04d}.jpg" for number in range(num_keyframes))
    site_path = Trajectory(np.arange(1, num_keyframes + 1), names, times, centers, world_from_cam)
    poses = np.repeat(np.arange(num_keyframes), num_epochs)
    return Survey(
        site_path.transformed(inverse),
        site_from_sfm,
        times,
        centers,
        world_from_cam,
        {name: np.array(position) for name, position in anchors_m.items()},
        np.array(tag_in_cam_m),
        simulate_ranges_at(times[poses], centers[poses], world_from_cam[poses], anchors_m, tag_in_cam_m, radio, seed),
    )
