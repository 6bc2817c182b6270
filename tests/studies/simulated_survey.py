"""Simulated surveys of known truth for the studies of the refinement: one noisy run, and the bound on its error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.known_errors import known_errors
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import lap_path, loop_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.ceres.covariance import JointCovariance, joint_covariance
from rangesfm.ceres.normal_equations import NormalEquations
from rangesfm.colmap.transform import rescale
from rangesfm.costs import add_residual_block, joint_prior_cost, range_cost
from rangesfm.demo.simulated_radio import CameraPath, Radio
from rangesfm.estimation.refine_summary import RefineSummary
from rangesfm.estimation.with_ranges import refine_with_ranges
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.geometry.trajectory import Trajectory, pose_of, trajectory_from_reconstruction
from rangesfm.options import CameraOptions, RangeModelOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.noise import bias_whitening
from rangesfm.ranging.range_log import RangeLog
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.scale_estimate import ScaleEstimate

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = np.array([0.05, -0.12, -0.03])
RANGE_MODEL = RangeModelOptions()
# As in COLMAP's mapper: points with smaller angles may go behind the horizon, where an adjustment gets stuck.
MIN_TRI_ANGLE_DEG = 1.5
SITE_ANCHORS_M = {"A1": (9.0, 7.0, 3.0), "A2": (-9.0, 6.0, 0.5), "A3": (-8.0, -8.0, 3.5), "A4": (9.0, -7.0, 0.2)}


@dataclass(frozen=True)
class Survey:
    """A survey without noise, and what is measured in it.

    Attributes:
        model: the truth, in the world of the result: the site, or the first camera's frame.
        anchors_m: (3,) true positions in that world, by id.
        anchor_frame: as in ``initialize_scale``.
        range_stddev_m: stddev of the ranges, of which there is one to each anchor at each keyframe.
    """

    model: SyntheticModel
    anchors_m: dict[str, Array]
    anchor_frame: str
    range_stddev_m: float

    @property
    def is_in_first_camera(self) -> bool:
        return self.anchor_frame != "site"


@dataclass(frozen=True)
class Case:
    """A survey to study, and the noise of its features in pixels."""

    name: str
    survey: Callable[[], Survey]
    pixel_stddev: float


def lap_survey(
    *,
    num_observations: int,
    anchor_m: tuple[float, float, float],
    anchor_frame: str = "first_camera",
    num_keyframes: int = 600,
    range_stddev_m: float = 0.1,
) -> Survey:
    """A rover's lap around a soccer field: forward camera, tracks of at most 8 keyframes, no loop closure, one anchor.

    Args:
        num_observations: features in a keyframe.
        anchor_m: position with the origin in the middle of the field, z up.
        num_keyframes: fewer than 600 give a part of the lap.
    """
    path = lap_path(300.0, share=0.98 * num_keyframes / 600)
    times = np.linspace(0.0, 300.0, num_keyframes)
    return truth_of(
        path,
        times,
        {"A1": anchor_m},
        anchor_frame,
        range_stddev_m,
        num_observations=num_observations,
        depth_range_m=(6.0, 40.0),
    )


def yard_survey(
    *, anchor_frame: str = "site", range_stddev_m: float = 0.1, max_track_length: int | None = None
) -> Survey:
    """A walk around a yard, looking at its middle: four anchors in the site's frame, else the first of them alone."""
    path = loop_path(40.0, height_amplitude_m=0.8, unsteadiness_m=0.1, seed=3)
    anchors = SITE_ANCHORS_M if anchor_frame == "site" else {"A1": SITE_ANCHORS_M["A1"]}
    times = np.linspace(0.0, 40.0, 60)
    return truth_of(
        path, times, anchors, anchor_frame, range_stddev_m, num_observations=80, max_track_length=max_track_length
    )


def truth_of(
    path: CameraPath,
    times: Array,
    anchors_m: dict[str, tuple[float, float, float]],
    anchor_frame: str,
    range_stddev_m: float = 0.1,
    *,
    num_observations: int,
    max_track_length: int | None = 8,
    depth_range_m: tuple[float, float] = (2.0, 20.0),
) -> Survey:
    """Return a survey without noise, in the world of the result."""
    centers, world_from_cam = path.centers(times), path.world_from_cam(times)
    rotation, origin = (np.eye(3), np.zeros(3)) if anchor_frame == "site" else (world_from_cam[0], centers[0])
    model = synthetic_model(
        times,
        (centers - origin) @ rotation,
        rotation.T @ world_from_cam,
        num_observations=num_observations,
        max_track_length=max_track_length,
        depth_range_m=depth_range_m,
        metric_from_sfm=IDENTITY,
    )
    points = model.reconstruction
    pycolmap.ObservationManager(points).filter_points3D_with_small_triangulation_angle(
        MIN_TRI_ANGLE_DEG, set(points.point3D_ids())
    )
    anchors = {name: (np.array(at) - origin) @ rotation for name, at in anchors_m.items()}
    return Survey(model, anchors, anchor_frame, range_stddev_m)


def unit_pixel_errors(survey: Survey, seed: int) -> Array:
    """(num_observations, 2) errors of stddev 1."""
    num = sum(len(survey.model.reconstruction.image(i).points2D) for i in _image_ids(survey))
    return np.random.default_rng([seed, 1]).standard_normal((num, 2))


def mapped(survey: Survey, pixel_errors: Array) -> pycolmap.Reconstruction:
    """Return the model as a mapper would: COLMAP's bundle adjustment of features with these errors, without ranges."""
    sfm = _with_noisy_features(survey, pixel_errors)
    config = pycolmap.BundleAdjustmentConfig()
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for image_id in _image_ids(survey):
        config.add_image(image_id)
    pycolmap.create_default_ceres_bundle_adjuster(_adjustment_options(), config, sfm).solve()
    return sfm


def _with_noisy_features(survey: Survey, pixel_errors: Array) -> pycolmap.Reconstruction:
    """Return the true model with noisy features."""
    model = pycolmap.Reconstruction(survey.model.reconstruction)
    remaining = iter(pixel_errors)
    for image_id in _image_ids(survey):
        for point, error in zip(model.image(image_id).points2D, remaining, strict=False):
            point.xy = point.xy + error
    return model


def _adjustment_options() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.initial_trust_region_radius = 1, 200, 1e8
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 1e-10
    return options


def _image_ids(survey: Survey) -> list[int]:
    return sorted(survey.model.reconstruction.reg_image_ids())


def range_log(
    survey: Survey, seed: int, *, biases_m: Array | None = None, obstructed_share: float = 0.0, num_each: int = 1
) -> RangeLog:
    """Simulate ranges to each anchor at each keyframe.

    Args:
        biases_m: biases of the anchors, in their order; None: no biases.
        obstructed_share: share of the ranges that are 1 m too long on average.
        num_each: ranges to an anchor at a keyframe.
    """
    biases = {} if biases_m is None else dict(zip(survey.anchors_m, biases_m.tolist(), strict=True))
    model = survey.model
    radio = Radio(range_stddev_m=survey.range_stddev_m, range_bias_m=biases, obstructed_share=obstructed_share)
    times = np.array(list(model.timestamps_s.values()))
    at = np.repeat(np.arange(len(times)), num_each)
    return simulate_ranges_at(
        times[at], model.centers_m[at], model.world_from_cam[at], survey.anchors_m, TAG_IN_CAM_M, radio, seed
    ).log


def drawn_biases(survey: Survey, seed: int) -> Array:
    """Draw (num_anchors,) biases from the prior that the stages assume: a part for each anchor, and a common part."""
    rng = np.random.default_rng([seed, 2])
    own = RANGE_MODEL.range_bias_stddev_m * rng.standard_normal(len(survey.anchors_m))
    drawn: Array = own + RANGE_MODEL.common_bias_stddev_m * rng.standard_normal()
    return drawn


@dataclass(frozen=True)
class Result:
    """One run of the stages after the mapping.

    Attributes:
        scaled, refined: paths in the truth's world.
    """

    scaled: Trajectory
    refined: Trajectory
    summary: RefineSummary


def run_stages(
    survey: Survey, sfm: pycolmap.Reconstruction, log: RangeLog, *, range_stddev_m: float | None = None
) -> Result:
    """Run scale and refinement with their defaults.

    Args:
        range_stddev_m: the stddev that the refinement assumes for all ranges; None: it estimates their noise.
    """
    times = survey.model.timestamps_s
    trajectory = trajectory_from_reconstruction(sfm, times)
    observations: RangeObservations = associate(log, trajectory, TAG_IN_CAM_M)
    anchors = [Anchor(name, position) for name, position in survey.anchors_m.items()]
    estimate: ScaleEstimate = initialize_scale(
        observations, trajectory, anchors, anchor_frame=survey.anchor_frame, range_model=RANGE_MODEL
    )
    errors = estimate.errors
    if range_stddev_m is not None:
        errors = known_errors(
            estimate.observations, range_stddev_m, common_bias_stddev_m=RANGE_MODEL.common_bias_stddev_m
        )
    scaled = rescale(sfm, estimate.metric_from_sfm)
    refined, summary = refine_with_ranges(
        scaled,
        trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        estimate.anchors,
        errors,
        tag_in_cam_m=TAG_IN_CAM_M,
        first_pose_is_fixed=survey.is_in_first_camera,
        camera=CameraOptions(refine_intrinsics=False),
        num_threads=1,
    )
    paths = [trajectory_from_reconstruction(one, times) for one in (scaled, refined)]
    return Result(paths[0], paths[1], summary)


def rmse_bound_m(survey: Survey, pixel_stddev: float, *, with_ranges: bool = True) -> float:
    """Return the Cramer-Rao bound on the root mean square error of the keyframes' centres.

    It follows from the information that features, ranges and the biases' prior give on poses, points, biases and
    unknown anchors, at the truth. Without ranges it is that of the map which moves least, which has about the true
    scale.
    """
    truth = pycolmap.Reconstruction(survey.model.reconstruction)
    covariance = covariance_at_truth(survey, truth, pixel_stddev, with_ranges=with_ranges)
    return float(np.sqrt(np.mean(np.trace(covariance.centers, axis1=1, axis2=2))))


def covariance_at_truth(
    survey: Survey, truth: pycolmap.Reconstruction, pixel_stddev: float, *, with_ranges: bool = True
) -> JointCovariance:
    """Return the covariance of a model that has the truth's poses, as ``rmse_bound_m`` needs it."""
    adjuster, anchors, biases = photos_adjuster(survey, truth), _anchor_blocks(survey), _bias_blocks(survey)
    num_reprojections = adjuster.problem.num_residuals()
    if with_ranges:
        _add_ranges(adjuster, truth, survey, true_ranges_m(survey), anchors, biases, pixel_stddev)
    equations = NormalEquations.of(adjuster.problem, truth, num_reprojections, anchors, biases)
    return joint_covariance(equations, anchors=anchors, others=biases, residual_stddev=pixel_stddev)


def true_ranges_m(survey: Survey) -> dict[str, Array]:
    """(num_keyframes,) ranges without noise, by anchor."""
    model = survey.model
    antenna = model.centers_m + model.world_from_cam @ TAG_IN_CAM_M
    return {name: np.linalg.norm(antenna - anchor, axis=1) for name, anchor in survey.anchors_m.items()}


def photos_adjuster(survey: Survey, model: pycolmap.Reconstruction) -> pycolmap.CeresBundleAdjuster:
    """Return an adjuster of the features, with a gauge that leaves the rest to the ranges."""
    config = pycolmap.BundleAdjustmentConfig()
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    for image_id in _image_ids(survey):
        config.add_image(image_id)
    if survey.is_in_first_camera:
        config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    return pycolmap.create_default_ceres_bundle_adjuster(_adjustment_options(), config, model)


def _anchor_blocks(survey: Survey) -> list[Array]:
    return [position.copy() for position in survey.anchors_m.values()]


def _bias_blocks(survey: Survey) -> list[Array]:
    return [np.zeros(1) for _ in survey.anchors_m]


def _add_ranges(
    adjuster: pycolmap.CeresBundleAdjuster,
    model: pycolmap.Reconstruction,
    survey: Survey,
    ranges_m: dict[str, Array],
    anchors: list[Array],
    biases: list[Array],
    pixel_stddev: float,
) -> None:
    """Add range residuals, in pixels as the features' residuals are.

    Args:
        ranges_m: (num_keyframes,) by anchor.
    """
    poses = [pose_of(model.frame(frame_id)).params for frame_id in sorted(model.reg_frame_ids())]
    stddev = survey.range_stddev_m / pixel_stddev
    for name, anchor, bias in zip(survey.anchors_m, anchors, biases, strict=True):
        for pose, range_m in zip(poses, ranges_m[name], strict=True):
            cost = range_cost(range_m=range_m, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=stddev)
            add_residual_block(adjuster, cost, None, [pose, anchor, bias])
        if survey.anchor_frame != "unknown":
            adjuster.problem.set_parameter_block_constant(anchor)
    own_stddev_m = np.full(len(biases), RANGE_MODEL.range_bias_stddev_m)
    whitening = pixel_stddev * bias_whitening(own_stddev_m, RANGE_MODEL.common_bias_stddev_m)
    prior = joint_prior_cost(mean=np.zeros(len(biases)), whitening=whitening)
    add_residual_block(adjuster, prior, None, biases)
