"""Simulated surveys without photos that may contain a mistake, and the scale stage with its tests on them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation
from tests.simulated.path import loop_path
from tests.simulated.surveys import LASTING_S, error_curve, lasting

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.diagnostics.bent_path import bent_to_ranges, estimate_by_bent
from rangesfm.diagnostics.diagnosis import Diagnosis, diagnose_ranges
from rangesfm.diagnostics.finished_map import by_similarity
from rangesfm.diagnostics.linearized import RangesOnMap, ranges_on_map
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import align_points
from rangesfm.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.bending import WalkBending
from rangesfm.ranging.range_log import RangeLog
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.range_equation import RangeProblem, RangeState
from rangesfm.scale.scale_estimate import ScaleEstimate

Array = npt.NDArray[np.float64]

METRES_PER_UNIT = 2.3
DIRECTION_STDDEV_M, CURVE_STDDEV_M, BIAS_STDDEV_M, COMMON_BIAS_STDDEV_M = 0.03, 0.03, 0.01, 0.05
LASTING_STDDEV_M = 0.0018
DRIFT_STDDEV_M, DRIFT_S = 0.01, 60.0
OBSTRUCTED_SHARE, OBSTRUCTED_MEAN_M = 0.04, 0.7
BEND_SHARE = 0.002
# A camera's axes (x right, y down, z forward) in terms of a robot's (x forward, y left, z up).
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
X_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@dataclass(frozen=True)
class Site:
    """A kind of survey; the anchor frame as in ``initialize_scale``."""

    name: str
    path: Callable[[int], CameraPath]
    anchors_m: dict[str, tuple[float, float, float]]
    frame: str
    rate_hz: float
    stddev_m: float
    tag_in_cam_m: tuple[float, float, float]


SITES = (
    Site(
        "hall",
        lambda seed: loop_path(
            120.0, center_m=(10, 7, 1.7), semi_axes_m=(7, 4.5), height_amplitude_m=0.4, num_turns=2.2,
            unsteadiness_m=0.4, seed=seed,
        ),
        {"A1": (0.3, 0.2, 3.9), "A2": (19.6, 0.4, 1.2), "A3": (19.4, 13.6, 4.2), "A4": (0.2, 13.4, 0.9),
         "A5": (9.8, 0.1, 2.6), "A6": (10.1, 13.8, 0.4)},
        "site",
        1.5,
        0.06,
        (0.06, -0.15, -0.04),
    ),
    Site(
        "yard",
        lambda seed: loop_path(
            160.0, center_m=(0, 0, 1.6), semi_axes_m=(12, 9), height_amplitude_m=0.6, num_turns=1.7,
            unsteadiness_m=0.6, seed=seed,
        ),
        {"N": (2.0, 17.0, 4.5), "E": (19.0, 1.5, 0.6), "S": (-3.0, -15.5, 3.2), "W": (-18.0, 2.0, 1.4)},
        "site",
        1.5,
        0.1,
        (0.1, -0.25, 0.02),
    ),
    Site(
        "drone",
        lambda seed: loop_path(
            100.0, center_m=(0, 0, 6), semi_axes_m=(10, 7), height_amplitude_m=2.5, num_turns=2.1,
            unsteadiness_m=1.0, seed=seed,
        ),
        {"B": (4.0, -5.0, 1.0)},
        "unknown",
        8.0,
        0.08,
        (0.02, 0.12, -0.06),
    ),
)  # fmt: skip


@dataclass
class Given:
    """A survey as it is handed over, right or wrong, and the truth; times in seconds of the camera's clock.

    ``needs_search`` is set if the truth is not a valid start for the solution of the scale; ``sfm`` is the model of the
    photos, None without any.
    """

    trajectory: Trajectory
    anchors_m: dict[str, Array]
    frame: str
    tag_in_cam_m: Array
    time_s: Array
    anchor: npt.NDArray[np.int64]
    range_m: Array
    tags_m: Array
    true_anchors_m: dict[str, Array]
    world_from_cam: Array
    true_centers_m: Array
    metres_per_unit: float = METRES_PER_UNIT
    time_offset_s: float = 0.0
    needs_search: bool = False
    sfm: pycolmap.Reconstruction | None = None

    @property
    def ids(self) -> list[str]:
        return list(self.true_anchors_m)

    def is_of(self, name: str) -> npt.NDArray[np.bool_]:
        return np.asarray(self.anchor == self.ids.index(name))


def surveyed(site: Site, seed: int) -> Given:
    """Simulate a clean survey."""
    rng = np.random.default_rng([seed, len(site.name)])
    path = site.path(seed)
    duration = path.end_s - path.start_s
    ids = list(site.anchors_m)
    turn = np.arange(int(duration * site.rate_hz) * len(ids))
    times, anchor = path.start_s + turn / (site.rate_hz * len(ids)), turn % len(ids)
    world_from_cam = path.world_from_cam(times)
    tags = path.centers(times) + world_from_cam @ np.array(site.tag_in_cam_m)
    anchors = {name: np.array(at) for name, at in site.anchors_m.items()}
    given = Given(
        mapped(path, rng), dict(anchors), site.frame, np.array(site.tag_in_cam_m), times, anchor, np.zeros(len(times)),
        tags, anchors, world_from_cam, path.centers(np.arange(path.start_s, path.end_s, 0.5)),
    )  # fmt: skip
    given.range_m = distances(given) + radio_errors(given, site.stddev_m, rng)
    return given


def distances(given: Given) -> Array:
    anchors_m = np.array(list(given.true_anchors_m.values()))
    return np.asarray(np.linalg.norm(given.tags_m - anchors_m[given.anchor], axis=1))


def mapped(path: CameraPath, rng: np.random.Generator) -> Trajectory:
    """Return the path as from a mapper: slightly bent, in a unit and a world of its own."""
    times = np.arange(path.start_s, path.end_s, 0.5)
    centers, rotations = path.centers(times), path.world_from_cam(times)
    knots = np.linspace(times[0], times[-1], 7)
    extent = float(np.linalg.norm(np.std(centers, axis=0)))
    bend = BEND_SHARE * extent * rng.standard_normal((len(knots), 3))
    bent = centers + np.column_stack([np.interp(times, knots, bend[:, k]) for k in range(3)])
    true = Trajectory(
        np.arange(1, len(times) + 1), tuple(f"{k:04d}.jpg" for k in range(len(times))), times, bent, rotations
    )
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return true.transformed(1 / METRES_PER_UNIT, turn, rng.normal(size=3))


def radio_errors(given: Given, stddev_m: float, rng: np.random.Generator) -> Array:
    distance = distances(given)
    errors = stddev_m * rng.standard_normal(len(distance)) + COMMON_BIAS_STDDEV_M * rng.standard_normal()
    errors += CURVE_STDDEV_M * error_curve(distance, rng)
    for k, at in enumerate(given.true_anchors_m.values()):
        rows = np.flatnonzero(given.anchor == k)
        direction = (given.tags_m[rows] - at) / distance[rows, None]
        form = rng.normal(0, DIRECTION_STDDEV_M, (3, 3))
        errors[rows] += np.einsum("ni,ij,nj->n", direction, form, direction) + BIAS_STDDEV_M * rng.standard_normal()
        errors[rows] += LASTING_STDDEV_M * lasting(given.time_s[rows], LASTING_S, rng)
    errors += (rng.random(len(errors)) < OBSTRUCTED_SHARE) * rng.exponential(OBSTRUCTED_MEAN_M, len(errors))
    errors += DRIFT_STDDEV_M * lasting(given.time_s, DRIFT_S, rng)
    return np.asarray(errors)


@dataclass(frozen=True)
class Run:
    """The outcome of one survey; None where the scale was refused."""

    given: Given
    estimate: ScaleEstimate | None
    diagnosis: Diagnosis | None
    on_map: RangesOnMap | None = None
    refusal: str = ""

    @property
    def is_wrong(self) -> bool:
        """Return whether the true scale lies outside the stated interval."""
        if self.estimate is None:
            return False
        low, high = self.estimate.interval_95
        return not low <= self.given.metres_per_unit <= high

    @property
    def doubts(self) -> list[str]:
        """List everything that speaks against the map of a survey without photos."""
        assert self.estimate is not None
        assert self.diagnosis is not None
        of_scale = self.estimate.reasons if self.estimate.verdict != "good" else ()
        return [*self.diagnosis.reasons, *of_scale]

    @property
    def place_in_stddevs(self) -> float:
        """Return how far the middle of the map is displaced, in its stated stddevs; 0 without a place."""
        if self.estimate is None or self.estimate.placement is None:
            return 0.0
        centers_m = self.estimate.metric_from_sfm.apply(self.given.trajectory.centers)
        of_map, _ = by_similarity(self.estimate.placement, centers_m)
        off_m = np.nanmean(centers_m - self.given.true_centers_m, axis=0)
        return float(np.linalg.norm(off_m) / np.sqrt(np.trace(of_map[4:, 4:])))


def run(given: Given, seed: int) -> Run:
    """Run the scale stage and the tests after it, starting near the truth if that is a valid start."""
    log = RangeLog.from_arrays(
        np.array(given.ids)[given.anchor], np.maximum(given.range_m, 0.02), timestamp_s=given.time_s
    )
    observations = associate(log, given.trajectory, given.tag_in_cam_m, time_offset_s=given.time_offset_s)
    anchors = [Anchor(name, None if given.frame == "unknown" else at) for name, at in given.anchors_m.items()]
    options = ScaleOptions(max_relative_stddev=1e3)
    try:
        with nullcontext() if given.needs_search else patch("rangesfm.scale.solution.site_starts", _near_truth(given)):
            estimate = initialize_scale(
                observations, given.trajectory, anchors, anchor_frame=given.frame, options=options, seed=seed
            )
    except GeometryError as error:
        return Run(given, None, None, refusal=str(error))
    assert estimate.problem is not None
    assert estimate.solution is not None
    bending = WalkBending(in_first_camera(given.trajectory))
    on_map = ranges_on_map(estimate.problem, estimate.solution, bending)
    on_map = bent_to_ranges(on_map)
    estimate = estimate_by_bent(estimate, on_map, options)
    return Run(given, estimate, diagnose_ranges(on_map, seed=seed), on_map)


def _near_truth(given: Given) -> Callable[[RangeProblem, int], list[RangeState]]:
    trajectory = given.trajectory
    first_camera = (trajectory.centers - trajectory.centers[0]) @ trajectory.world_from_cam[0]
    is_known = np.isfinite(given.true_centers_m).all(axis=1)

    def starts(problem: RangeProblem, seed: int) -> list[RangeState]:
        anchors_m = np.where(np.isfinite(problem.anchor_mean_m), problem.anchor_mean_m, 0.0)
        placed = align_points(first_camera[is_known], given.true_centers_m[is_known])
        return [RangeState(placed, anchors_m, problem.bias_mean_m.copy())]

    return starts
