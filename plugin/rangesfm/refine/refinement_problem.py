"""RefinementProblem: what stays the same in a refinement from one solution of the full problem to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.optimize import approx_fprime
from scipy.sparse import csr_array

from rangesfm import ceres
from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import ResidualErrors
from rangesfm.colmap.calibrated_cameras import cameras_as_given
from rangesfm.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.geometry.numerics import ROUNDING
from rangesfm.geometry.trajectory import pose_of
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.errors.components import BENDS
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.refine.bundle_adjustment import BundleAdjustment, bundle_adjustment
from rangesfm.refine.distances import MeasuredDistances, add_distances, errors_beyond_features
from rangesfm.refine.positions import HeldPositions, add_positions
from rangesfm.refine.radio import (
    AddedRadio,
    RadioEstimate,
    RadioRanges,
    add_radio_priors,
    add_range_residuals,
    radio_blocks,
)


@dataclass(frozen=True)
class RefinementProblem:
    """The fixed input of a refinement; only the model changes, in place.

    Attributes:
        metric: the model.
        ranges: those that take part. radio: anchors and tags as given, the means of their priors.
        distances: measured ones, which are fitted too. positions: known ones, too.
        first_pose_is_fixed: the gauge.
        gravity: the upward direction in the first camera; None if unknown, or if that camera's pose is fixed.
        is_refined: whether the model was refined with its ranges before, which pull it from the photos' optimum.
        left_out_ids: 3-D points that do not take part.
    """

    metric: pycolmap.Reconstruction
    ranges: RadioRanges
    radio: RadioEstimate
    distances: MeasuredDistances
    positions: HeldPositions
    camera: CameraOptions
    options: RefineOptions
    first_pose_is_fixed: bool
    gravity: Gravity | None
    num_threads: int
    is_refined: bool
    left_out_ids: frozenset[int] = frozenset()

    @property
    def frame_ids(self) -> Indices:
        """Ids of the frames of the trajectory, then of those without a time."""
        timed = self.ranges.trajectory.frame_ids
        return np.concatenate([timed, np.setdiff1d(np.array(self.metric.reg_frame_ids(), dtype=np.int64), timed)])

    @property
    def held_frame(self) -> int | None:
        """Index of the frame that is held while only ranges place the map; None where surveyed anchors do."""
        is_placed = any(np.isfinite(anchor.prior_position_stddev_m) for anchor in self.radio.anchors)
        return 0 if self.first_pose_is_fixed or not is_placed else None

    @property
    def first_frame_id(self) -> int:
        return int(self.ranges.trajectory.frame_ids[0])

    def of_photos(self, max_num_iterations: int) -> BundleAdjustment:
        """Set up the bundle adjustment of the photos alone."""
        return bundle_adjustment(
            self.metric,
            self.camera,
            self.options.changed(max_num_iterations=max_num_iterations),
            fixed_frame_id=self.first_frame_id if self.first_pose_is_fixed else None,
            num_threads=self.num_threads,
            marker_ids=self.distances.marker_ids.values(),
            left_out_ids=self.left_out_ids - set(self.distances.marker_ids.values()),
        )

    def add_to(self, bundle: BundleAdjustment, errors: RangeErrors, radio: RadioEstimate) -> AddedRadio:
        """Add all other measurements, starting from an estimate; ``errors`` are of the ranges that take part."""
        blocks = radio_blocks(radio, self.metric, self.ranges.trajectory, self.options)
        rows = add_range_residuals(bundle, self.ranges, errors, blocks)
        markers = {**self.distances.tape.markers, **self.positions.markers}
        of_marks = errors_beyond_features(bundle, markers, self.distances.marker_ids)
        others = add_distances(bundle, self.distances, radio.anchors, blocks.anchors, errors, of_marks)
        others += add_positions(
            bundle,
            self.positions,
            self.distances.marker_ids,
            of_marks,
            lever_arm_stddev_m=self.options.lever_arm_stddev_m,
            loss_scale=self.options.range_loss_scale,
        )
        prior_rows = add_radio_priors(
            bundle, radio, self.radio.tags_in_cam_m, errors.common_bias_stddev_m, blocks, self.options
        )
        add_calibration(bundle, self.camera)
        if self.gravity is not None:  # measured upward direction in the first camera; its stddev is scaled to pixels
            cost = ceres.direction_cost(
                direction_in_world=UP_IN_SITE,
                direction_in_cam=self.gravity.up_in_first_camera,
                stddev_rad=self.gravity.stddev_rad / bundle.pixel_stddev,
            )
            pose = pose_of(self.metric.frame(self.first_frame_id)).params
            ceres.add_residual_block(bundle.adjuster, cost, None, [pose])
        return AddedRadio(blocks, others, rows, prior_rows)

    def residual_errors(self, added: AddedRadio, errors: RangeErrors, bending_factor: float) -> ResidualErrors | None:
        """Return the errors of the k ranges' residuals, as in the scale's uncertainty; None if they were not learnt.

        Args:
            bending_factor: factor of the errors of the photos' residuals, which are the unit here.
        """
        if errors.learned is None:
            return None
        learned = errors.learned.without(*BENDS)  # bending is already in the errors of the photos' residuals
        scaled = self.residuals_m(added.estimate(self.radio))[self.ranges.rows] / errors.stddev_m
        in_residuals = np.sqrt(errors.worth) * errors.loss.slopes(scaled) / errors.stddev_m
        covariance_m2, has_bin = learned.covariance_m2, np.flatnonzero(learned.of_range >= 0)
        places = (has_bin, learned.of_range[has_bin])
        of_bins = csr_array((in_residuals[has_bin], places), shape=(len(scaled), len(covariance_m2)))
        return ResidualErrors(
            added.residual_rows,
            of_bins,
            covariance_m2 / bending_factor**2,
            added.shared_prior_rows,
            bending_factor**-2,
        )

    def residuals_m(self, radio: RadioEstimate) -> Array:
        """Return the (n,) residuals, predicted minus measured, metres, shared errors included; NaN without a place."""
        predicted_m = self.ranges.predicted_m(self.metric, radio) + self.ranges.shared_m(radio)
        return predicted_m - self.ranges.observations.log.range_m


def add_calibration(bundle: BundleAdjustment, options: CameraOptions) -> None:
    """Add priors for the parameters of each camera that was given calibrated, if the adjustment refines it."""
    metric, problem = bundle.metric, bundle.adjuster.problem
    images = [metric.image(image_id) for image_id in metric.reg_image_ids()]
    as_given = cameras_as_given(options, ((image.name, metric.camera(image.camera_id)) for image in images))
    for camera_id, (table, given) in as_given.items():
        params = metric.camera(camera_id).params
        if problem.has_parameter_block(params) and not problem.is_parameter_block_constant(params):
            stddev = parameter_stddevs(given, table.calibration_stddev_px(given.mean_focal_length()))
            ceres.add_normal_prior(bundle.adjuster, params, given.params, stddev / bundle.pixel_stddev)


def parameter_stddevs(camera: pycolmap.Camera, focal_length_stddev_px: float) -> Array:
    """Return the (n,) standard deviations of a camera's parameters, given that of the focal length.

    One standard deviation of any parameter moves a feature at the photo's edge equally far, because an error of the
    calibration seen there does not tell which parameter is wrong.
    """
    focal_length = camera.mean_focal_length()
    edge = np.array([[0.5 * camera.width / focal_length, 0.5 * camera.height / focal_length, 1.0]])

    def image_of_edge(params: Array) -> Array:
        other = pycolmap.Camera(camera.todict())
        other.params[:] = params
        return np.ravel(other.img_from_cam(edge))

    shifts_px = np.linalg.norm(approx_fprime(camera.params, image_of_edge, 1e-6), axis=0)
    of_focal_lengths = np.linalg.norm(shifts_px[list(camera.focal_length_idxs())])
    smallest = ROUNDING * of_focal_lengths  # a parameter without any effect gets a very large stddev
    stddevs: Array = focal_length_stddev_px * of_focal_lengths / np.maximum(shifts_px, smallest)
    stddevs[list(camera.focal_length_idxs())] = focal_length_stddev_px
    return stddevs
