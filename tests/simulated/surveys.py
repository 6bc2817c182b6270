"""Simulated surveys: their truth, and what a mapper and a radio make of it.

A ``Truth`` has no errors. From it comes a ``MadeSurvey``, which is handed over and may be given a mistake.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import loop_path
from tests.simulated.radio_errors import drawn_errors, usual_errors
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.colmap.transform import rescale
from rangesfm.demo.simulated_radio import CameraPath, Radio
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.solver.covariance import joint_covariance
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
Place = tuple[float, float, float]

TAG_IN_CAM_M = np.array([0.05, -0.12, -0.03])
RANGE_STDDEV_M = 0.1
METRES_PER_UNIT = 2.3
# As in COLMAP's mapper: points with smaller angles may go behind the horizon, where an adjustment gets stuck.
MIN_TRI_ANGLE_DEG = 1.5
# Of a path without photos: how far it bends as a share of its size.
BEND_SHARE = 0.002
SITE_ANCHORS_M = {"A1": (9.0, 7.0, 3.0), "A2": (-9.0, 6.0, 0.5), "A3": (-8.0, -8.0, 3.5), "A4": (9.0, -7.0, 0.2)}


@dataclass(frozen=True)
class Truth:
    """A survey without errors, in the world of the result: the site, or the first camera's frame.

    Attributes:
        model: with all features. anchors_m: (3,) by id. anchor_frame: as in ``initialize_scale``.
    """

    model: SyntheticModel
    anchors_m: dict[str, Array]
    anchor_frame: str

    @property
    def is_in_first_camera(self) -> bool:
        return self.anchor_frame != "site"

    @property
    def path(self) -> Trajectory:
        model = self.model
        found = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
        return replace(found, centers=model.centers_m, world_from_cam=model.world_from_cam)


@dataclass(frozen=True)
class Kind:
    """A kind of survey.

    Attributes:
        path: of the camera, by seed. interval_s: between two photos.
        anchors_m: positions in the site. anchor_frame: as in ``initialize_scale``.
        rate_hz: of the ranges to each anchor. range_stddev_m: white noise of a usual radio.
        num_observations, depth_range_m: of the photos, as in ``synthetic_model``. pixel_stddev: noise of features.
    """

    name: str
    path: Callable[[int], CameraPath]
    anchors_m: dict[str, Place]
    anchor_frame: str
    interval_s: float = 0.5
    rate_hz: float = 4.0
    num_observations: int = 100
    depth_range_m: tuple[float, float] = (2.0, 20.0)
    pixel_stddev: float = 0.5
    range_stddev_m: float = RANGE_STDDEV_M
    tag_in_cam_m: Place = (0.05, -0.12, -0.03)

    def truth(self, path: CameraPath) -> Truth:
        times = np.arange(path.start_s, path.end_s - 1e-6, self.interval_s)
        return truth_of(path, times, self.anchors_m, self.anchor_frame, self.num_observations, self.depth_range_m)


@dataclass
class MadeSurvey:
    """A survey of n photos and m ranges as it is handed over, right or wrong, and the truth about it.

    Times are seconds of the camera's clock. The truth is in the world of the result.

    Attributes:
        sfm: model of the photos; None: there is their path alone, without points. trajectory: its path.
        anchors_m: as surveyed, by id. anchor_frame: as in ``initialize_scale``.
        time_s, anchor, range_m: (m,) of the log; anchors by their number in ``true_anchors_m``.
        tags_m, world_from_cam: (m, 3) and (m, 3, 3) at the ranges. true_centers_m: (n, 3) of the photos.
        needs_search: whether the truth is no valid start for the solution of the scale.
    """

    sfm: pycolmap.Reconstruction | None
    trajectory: Trajectory
    anchors_m: dict[str, Array]
    anchor_frame: str
    tag_in_cam_m: Array
    time_s: Array
    anchor: npt.NDArray[np.int64]
    range_m: Array
    tags_m: Array
    world_from_cam: Array
    true_anchors_m: dict[str, Array]
    true_centers_m: Array
    metres_per_unit: float
    time_offset_s: float = 0.0
    needs_search: bool = False

    @property
    def ids(self) -> list[str]:
        return list(self.true_anchors_m)

    @property
    def log(self) -> RangeLog:
        return RangeLog.from_arrays(
            np.array(self.ids)[self.anchor], np.maximum(self.range_m, 0.02), timestamp_s=self.time_s
        )

    @property
    def anchors(self) -> tuple[Anchor, ...]:
        is_unknown = self.anchor_frame == "unknown"
        return tuple(Anchor(name, None if is_unknown else at) for name, at in self.anchors_m.items())

    @property
    def model(self) -> pycolmap.Reconstruction:
        return model_of_poses(self.trajectory) if self.sfm is None else self.sfm

    @property
    def from_anchor_m(self) -> Array:
        """(m, 3) from the true anchors to the true tags."""
        return np.asarray(self.tags_m - np.array(list(self.true_anchors_m.values()))[self.anchor])

    @property
    def distances_m(self) -> Array:
        """(m,) true distances."""
        return np.asarray(np.linalg.norm(self.from_anchor_m, axis=1))

    def is_of(self, name: str) -> npt.NDArray[np.bool_]:
        return np.asarray(self.anchor == self.ids.index(name))


HALL = Kind(
    "hall",
    lambda seed: loop_path(
        120.0, center_m=(10, 7, 1.7), semi_axes_m=(7, 4.5), height_amplitude_m=0.4, num_turns=2.2, unsteadiness_m=0.4,
        seed=seed,
    ),
    {"A1": (0.3, 0.2, 3.9), "A2": (19.6, 0.4, 1.2), "A3": (19.4, 13.6, 4.2), "A4": (0.2, 13.4, 0.9),
     "A5": (9.8, 0.1, 2.6), "A6": (10.1, 13.8, 0.4)},
    "site",
    rate_hz=1.5,
    depth_range_m=(1.5, 9.0),
    pixel_stddev=0.7,
    range_stddev_m=0.06,
    tag_in_cam_m=(0.06, -0.15, -0.04),
)  # fmt: skip
YARD = Kind(
    "yard",
    lambda seed: loop_path(
        160.0, center_m=(0, 0, 1.6), semi_axes_m=(12, 9), height_amplitude_m=0.6, num_turns=1.7, unsteadiness_m=0.6,
        seed=seed,
    ),
    {"N": (2.0, 17.0, 4.5), "E": (19.0, 1.5, 0.6), "S": (-3.0, -15.5, 3.2), "W": (-18.0, 2.0, 1.4)},
    "site",
    rate_hz=1.5,
    depth_range_m=(1.5, 9.0),
    pixel_stddev=0.7,
    tag_in_cam_m=(0.1, -0.25, 0.02),
)  # fmt: skip
DRONE = Kind(
    "drone",
    lambda seed: loop_path(
        100.0, center_m=(0, 0, 6), semi_axes_m=(10, 7), height_amplitude_m=2.5, num_turns=2.1, unsteadiness_m=1.0,
        seed=seed,
    ),
    {"B": (4.0, -5.0, 1.0)},
    "unknown",
    rate_hz=8.0,
    range_stddev_m=0.08,
    tag_in_cam_m=(0.02, 0.12, -0.06),
)  # fmt: skip
SITES = (HALL, YARD, DRONE)


# The truth.


def truth_of(
    path: CameraPath,
    times: Array,
    anchors_m: dict[str, Place],
    anchor_frame: str,
    num_observations: int,
    depth_range_m: tuple[float, float] = (2.0, 20.0),
    max_track_length: int | None = 8,
) -> Truth:
    """Return the truth of photos at these times; points as in ``synthetic_model``."""
    centers, world_from_cam = path.centers(times), path.world_from_cam(times)
    origin, rotation = (np.zeros(3), np.eye(3)) if anchor_frame == "site" else (centers[0], world_from_cam[0])
    model = synthetic_model(
        times,
        (centers - origin) @ rotation,
        rotation.T @ world_from_cam,
        num_observations=num_observations,
        max_track_length=max_track_length,
        depth_range_m=depth_range_m,
        metric_from_sfm=IDENTITY,
    )
    drop_flat_points(model.reconstruction)
    return Truth(model, {name: (np.array(at) - origin) @ rotation for name, at in anchors_m.items()}, anchor_frame)


def drop_flat_points(model: pycolmap.Reconstruction) -> None:
    """Delete the points that a mapper would not triangulate."""
    pycolmap.ObservationManager(model).filter_points3D_with_small_triangulation_angle(
        MIN_TRI_ANGLE_DEG, set(model.point3D_ids())
    )


def yard_truth(anchor_frame: str = "site", max_track_length: int | None = None) -> Truth:
    """A walk around a yard, looking at its middle: four anchors in the site's frame, else the first of them alone."""
    path = loop_path(40.0, height_amplitude_m=0.8, unsteadiness_m=0.1, seed=3)
    anchors = SITE_ANCHORS_M if anchor_frame == "site" else {"A1": SITE_ANCHORS_M["A1"]}
    return truth_of(path, np.linspace(0.0, 40.0, 60), anchors, anchor_frame, 80, max_track_length=max_track_length)


def expected_drift_m(truth: Truth) -> float:
    """Return the root mean square error of the keyframes of a map by features with a noise of 1 px, to first order."""
    model = pycolmap.Reconstruction(truth.model.reconstruction)
    problem = photos_adjuster(model, hold_first=truth.is_in_first_camera).problem
    equations = NormalEquations.of(problem, model, problem.num_residuals())
    covariance = joint_covariance(equations, firm_frame_ids=equations.columns.frames)
    return float(np.sqrt(np.mean(np.trace(covariance.covariances("frame")[:, 3:, 3:], axis1=1, axis2=2))))


# The map.


def photos_adjuster(model: pycolmap.Reconstruction, *, hold_first: bool) -> pycolmap.CeresBundleAdjuster:
    """Return an adjuster of the features, with a gauge that leaves the rest to other measurements."""
    config = _config_of(model, pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    if hold_first:
        config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    return pycolmap.create_default_ceres_bundle_adjuster(_adjustment_options(), config, model)


def adjusted(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Adjust a model in place by its features alone, as a mapper does, and return it."""
    config = _config_of(model, pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(_adjustment_options(), config, model).solve()
    return model


def _config_of(
    model: pycolmap.Reconstruction, gauge: pycolmap.BundleAdjustmentGauge
) -> pycolmap.BundleAdjustmentConfig:
    config = pycolmap.BundleAdjustmentConfig()
    config.fix_gauge(gauge)
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    return config


def _adjustment_options() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.initial_trust_region_radius = 1, 200, 1e8
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 1e-10
    return options


def mapped(truth: Truth, pixel_stddev: float, seed: int) -> pycolmap.Reconstruction:
    """Return the model as a mapper would: COLMAP's bundle adjustment of features with this noise, without ranges."""
    sfm, rng = pycolmap.Reconstruction(truth.model.reconstruction), np.random.default_rng([seed, 1])
    for image_id in sorted(sfm.reg_image_ids()):
        points = sfm.image(image_id).points2D
        for point, error in zip(points, pixel_stddev * rng.standard_normal((len(points), 2)), strict=True):
            point.xy = point.xy + error
    return adjusted(sfm)


def in_world_of_its_own(rng: np.random.Generator) -> Similarity:
    """Draw the similarity from a true world to the world and the unit of a map."""
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return Similarity(1 / METRES_PER_UNIT, turn, rng.normal(size=3))


def model_of_poses(path: Trajectory) -> pycolmap.Reconstruction:
    """Make a model without points."""
    model = synthetic_model(
        np.arange(float(len(path))), path.centers, path.world_from_cam, num_observations=0, metric_from_sfm=IDENTITY
    ).reconstruction
    for image_id, name in zip(sorted(model.reg_image_ids()), path.image_names, strict=True):
        model.image(image_id).name = name
    return model


def bent(path: CameraPath, rng: np.random.Generator) -> Trajectory:
    """Return a path as from a mapper: slightly bent, in a unit and a world of its own."""
    times = np.arange(path.start_s, path.end_s, 0.5)
    centers, rotations = path.centers(times), path.world_from_cam(times)
    knots = np.linspace(times[0], times[-1], 7)
    extent = float(np.linalg.norm(np.std(centers, axis=0)))
    bend = BEND_SHARE * extent * rng.standard_normal((len(knots), 3))
    moved = centers + np.column_stack([np.interp(times, knots, bend[:, k]) for k in range(3)])
    names = tuple(f"{k:04d}.jpg" for k in range(len(times)))
    of_map = in_world_of_its_own(rng)
    return Trajectory(np.arange(1, len(times) + 1), names, times, moved, rotations).transformed(of_map)


# The ranges, and whole surveys.


def range_log(truth: Truth, seed: int, *, biases_m: Array | None = None, num_each: int = 1) -> RangeLog:
    """Simulate ranges with white noise, taken at the photos.

    Args:
        biases_m: biases of the anchors, in their order; None: no biases.
        num_each: ranges to an anchor at a photo.
    """
    biases = {} if biases_m is None else dict(zip(truth.anchors_m, biases_m.tolist(), strict=True))
    model, radio = truth.model, Radio(range_stddev_m=RANGE_STDDEV_M, range_bias_m=biases)
    times = np.array(list(model.timestamps_s.values()))
    at = np.repeat(np.arange(len(times)), num_each)
    return simulate_ranges_at(
        times[at], model.centers_m[at], model.world_from_cam[at], truth.anchors_m, TAG_IN_CAM_M, radio, seed
    )


def errors_in(
    truth: Truth, at_s: Array, ids: npt.NDArray[np.str_], tag_in_cam_m: Array, rng: np.random.Generator
) -> Array:
    """(m,) errors of ranges at these times to these anchors, of a radio drawn from the population."""
    log, path = RangeLog.from_arrays(ids, np.ones(len(ids)), timestamp_s=at_s), truth.path
    standing_m = np.array([truth.anchors_m[name] for name in log.anchor_ids])
    return drawn_errors(associate(log, path, tag_in_cam_m), path, standing_m, rng)


def in_turn(kind: Kind, path: CameraPath, truth: Truth) -> Array:
    """(m,) times of ranges to one anchor after the other, up to the last photo."""
    num = int((path.end_s - path.start_s) * kind.rate_hz) * len(kind.anchors_m)
    at_s = path.start_s + (np.arange(num) + 0.5) / (kind.rate_hz * len(kind.anchors_m))
    return np.asarray(at_s[at_s < max(truth.model.timestamps_s.values())])


def exactly_ranged(
    truth: Truth, path: CameraPath, at_s: Array, sfm: pycolmap.Reconstruction, tag_in_cam_m: Array
) -> MadeSurvey:
    """Return a survey with this map, whose ranges to the anchors in turn have no errors."""
    start_s, origin, rotation = np.array([path.start_s]), np.zeros(3), np.eye(3)
    if truth.is_in_first_camera:
        origin, rotation = path.centers(start_s)[0], path.world_from_cam(start_s)[0]
    trajectory = trajectory_from_reconstruction(sfm, truth.model.timestamps_s)
    world_from_cam = rotation.T @ path.world_from_cam(at_s)
    survey = MadeSurvey(
        sfm, trajectory, dict(truth.anchors_m), truth.anchor_frame, tag_in_cam_m, at_s,
        np.arange(len(at_s)) % len(truth.anchors_m), np.zeros(len(at_s)),
        (path.centers(at_s) - origin) @ rotation + world_from_cam @ tag_in_cam_m, world_from_cam, truth.anchors_m,
        truth.model.centers_m, align_points(trajectory.centers, truth.model.centers_m).scale,
    )  # fmt: skip
    survey.range_m = survey.distances_m
    return survey


def made(
    truth: Truth, path: CameraPath, at_s: Array, pixel_stddev: float, seed: int, *, with_radio: bool = True,
    tag_in_cam_m: Array = TAG_IN_CAM_M,
) -> MadeSurvey:  # fmt: skip
    """Map the survey from noisy features in a world of its own, and simulate ranges at these times.

    Args:
        with_radio: whether a radio is drawn from the population; else the ranges have white noise alone.
    """
    rng = np.random.default_rng([seed, 5])
    sfm = rescale(mapped(truth, pixel_stddev, seed), in_world_of_its_own(rng))
    survey = exactly_ranged(truth, path, at_s, sfm, tag_in_cam_m)
    # The noise is drawn in any case, so that surveys whose results are stored stay as they were.
    errors_m = RANGE_STDDEV_M * rng.standard_normal(len(at_s))
    if with_radio:
        errors_m = errors_in(truth, at_s, np.array(survey.ids)[survey.anchor], tag_in_cam_m, rng)
    survey.range_m = survey.range_m + errors_m
    return survey


def simulated(kind: Kind, seed: int) -> tuple[Truth, MadeSurvey]:
    """Simulate a survey with photos, and with a radio drawn from the population."""
    path = kind.path(seed)
    truth, step_s = kind.truth(path), 1 / (kind.rate_hz * len(kind.anchors_m))
    at_s = np.arange(path.start_s + step_s / 2, max(truth.model.timestamps_s.values()), step_s)
    arm_m = np.array(kind.tag_in_cam_m)
    return truth, made(truth, path, at_s, kind.pixel_stddev, seed, tag_in_cam_m=arm_m)


def surveyed(kind: Kind, seed: int) -> MadeSurvey:
    """Simulate a survey without photos, whose path bends a little, and with a usual radio."""
    rng, path = np.random.default_rng([seed, len(kind.name)]), kind.path(seed)
    turn = np.arange(int((path.end_s - path.start_s) * kind.rate_hz) * len(kind.anchors_m))
    time_s, anchor = path.start_s + turn / (kind.rate_hz * len(kind.anchors_m)), turn % len(kind.anchors_m)
    tag_in_cam_m, world_from_cam = np.array(kind.tag_in_cam_m), path.world_from_cam(time_s)
    anchors_m = {name: np.array(at) for name, at in kind.anchors_m.items()}
    survey = MadeSurvey(
        None, bent(path, rng), dict(anchors_m), kind.anchor_frame, tag_in_cam_m, time_s, anchor, np.zeros(len(turn)),
        path.centers(time_s) + world_from_cam @ tag_in_cam_m, world_from_cam, anchors_m,
        path.centers(np.arange(path.start_s, path.end_s, 0.5)), METRES_PER_UNIT,
    )  # fmt: skip
    return with_usual_radio(survey, kind, rng)


def surveyed_with_photos(kind: Kind, seed: int) -> MadeSurvey:
    """Simulate a survey with photos, and with a usual radio.

    With one photo a second and few features in it the map of a hall bends by a decimetre.
    """
    path, kind = kind.path(seed), replace(kind, interval_s=1.0, num_observations=30)
    truth = kind.truth(path)
    sfm = rescale(mapped(truth, kind.pixel_stddev, seed), in_world_of_its_own(np.random.default_rng([seed, 5])))
    survey = exactly_ranged(truth, path, in_turn(kind, path, truth), sfm, np.array(kind.tag_in_cam_m))
    return with_usual_radio(survey, kind, np.random.default_rng([seed, len(kind.name)]))


def with_usual_radio(survey: MadeSurvey, kind: Kind, rng: np.random.Generator) -> MadeSurvey:
    errors_m = usual_errors(survey.time_s, survey.anchor, survey.from_anchor_m, kind.range_stddev_m, rng)
    survey.range_m = survey.distances_m + errors_m
    return survey
