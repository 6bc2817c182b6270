"""RefinementProblem: all that a refinement keeps to from one solution of the full problem to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm import ceres
from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import ResidualErrors
from rangesfm.colmap.calibrated_cameras import cameras_as_given
from rangesfm.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.geometry.trajectory import pose_of
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.errors.components import BENDS
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.refine.bundle_adjustment import BundleAdjustment, bundle_adjustment
from rangesfm.refine.distances import MeasuredDistances, add_distances
from rangesfm.refine.radio import AddedRadio, RadioEstimate, RadioRanges, add_radio_priors, add_ranges, radio_blocks

_PARAMETER_STEP = 1e-6


@dataclass(frozen=True)
class RefinementProblem:
    """What stays the same from one solution to the next; only the model changes, in place.

    Attributes:
        metric: the model.
        ranges: that take part. radio: anchors and tags as given, which their priors go by.
        distances: measured ones, which the map keeps to.
        first_pose_is_fixed: the gauge.
        gravity: which way is up in the first camera; None where its pose is fixed, or nobody knows.
        left_out_ids: 3-D points that take no part.
    """

    metric: pycolmap.Reconstruction
    ranges: RadioRanges
    radio: RadioEstimate
    distances: MeasuredDistances
    camera: CameraOptions
    options: RefineOptions
    first_pose_is_fixed: bool
    gravity: Gravity | None
    num_threads: int
    left_out_ids: frozenset[int] = frozenset()

    @property
    def frame_ids(self) -> Indices:
        """Those of the trajectory, then those without a time."""
        timed = self.ranges.trajectory.frame_ids
        return np.concatenate([timed, np.setdiff1d(np.array(self.metric.reg_frame_ids(), dtype=np.int64), timed)])

    @property
    def first_frame_id(self) -> int:
        return int(self.ranges.trajectory.frame_ids[0])

    def of_photos(self, max_num_iterations: int) -> BundleAdjustment:
        """The bundle adjustment without anything else."""
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
        """All else that was measured, from an estimate; ``errors`` are those of the ranges that take part."""
        blocks = radio_blocks(radio, self.metric, self.ranges.trajectory, self.options)
        rows = add_ranges(bundle, self.ranges, errors, blocks)
        others = add_distances(bundle, self.distances, radio.anchors, blocks.anchors, errors)
        add_radio_priors(bundle, radio, self.radio.tags_in_cam_m, errors.common_bias_stddev_m, blocks, self.options)
        add_calibration(bundle, self.camera)
        if self.gravity is not None:  # what the first camera saw of the vertical; the stddev in the unit of pixels
            cost = ceres.direction_cost(
                direction_in_world=UP_IN_SITE,
                direction_in_cam=self.gravity.up_in_first_camera,
                stddev_rad=self.gravity.stddev_rad / bundle.pixel_stddev,
            )
            pose = pose_of(self.metric.frame(self.first_frame_id)).params
            ceres.add_residual_block(bundle.adjuster, cost, None, [pose])
        return AddedRadio(blocks, others, rows)

    def residual_errors(self, added: AddedRadio, errors: RangeErrors, bending_factor: float) -> ResidualErrors | None:
        """How the residuals of the k ranges that took part err; the scale's uncertainty counts the same errors.

        None where nobody has learnt what they get wrong together.

        Args:
            bending_factor: by how much the photos' residuals err more, which are the unit here.
        """
        if errors.learned is None:
            return None
        learned = errors.learned.without(*BENDS)  # the photos' own residuals err as well
        scaled = self.residuals_m(added.estimate(self.radio))[self.ranges.rows] / errors.stddev_m
        in_residuals = np.sqrt(errors.weight) * errors.loss.slopes(scaled) / errors.stddev_m
        covariance_m2, has_cell = learned.covariance_m2, np.flatnonzero(learned.of_range >= 0)
        places = (has_cell, learned.of_range[has_cell])
        of_cells = csr_array((in_residuals[has_cell], places), shape=(len(scaled), len(covariance_m2)))
        return ResidualErrors(added.residual_rows, of_cells, covariance_m2 / bending_factor**2, bending_factor**-2)

    def residuals_m(self, radio: RadioEstimate) -> Array:
        """(n,) predicted minus measured; NaN without a place."""
        return self.ranges.predicted_m(self.metric, radio) - self.ranges.observations.log.range_m


def add_calibration(bundle: BundleAdjustment, options: CameraOptions) -> None:
    """Draw each camera of a given model to its parameters, where the adjustment refines it at all."""
    metric, problem = bundle.metric, bundle.adjuster.problem
    images = [metric.image(image_id) for image_id in metric.reg_image_ids()]
    as_given = cameras_as_given(options, ((image.name, metric.camera(image.camera_id)) for image in images))
    for camera_id, (table, given) in as_given.items():
        params = metric.camera(camera_id).params
        if problem.has_parameter_block(params) and not problem.is_parameter_block_constant(params):
            stddev = parameter_stddevs(given, table.calibration_stddev_px(given.mean_focal_length()))
            ceres.add_normal_prior(bundle.adjuster, params, given.params, stddev / bundle.pixel_stddev)


def parameter_stddevs(camera: pycolmap.Camera, focal_length_stddev_px: float) -> Array:
    """(n,) of each parameter: at the photo's edge it moves a feature as far as the focal length's own stddev does.

    A calibration that is off somewhere near the edge leaves open by which of its parameters.
    """
    edge = np.array([[0.5 * camera.width / camera.mean_focal_length(), 0.0, 1.0]])
    edge[0, 1] = 0.5 * camera.height / camera.mean_focal_length()
    shifts_px = np.array([_shift_px(camera, edge, index) for index in range(len(camera.params))])
    of_focal_lengths = np.linalg.norm(shifts_px[list(camera.focal_length_idxs())])
    smallest = 1e-12 * of_focal_lengths  # one that moves nothing is as good as free
    stddevs: Array = focal_length_stddev_px * of_focal_lengths / np.maximum(shifts_px, smallest)
    stddevs[list(camera.focal_length_idxs())] = focal_length_stddev_px
    return stddevs


def _shift_px(camera: pycolmap.Camera, points_in_cam: Array, index: int) -> float:
    """How far a parameter moves the image of a point, pixels per unit."""
    other = pycolmap.Camera(camera.todict())
    other.params[index] += _PARAMETER_STEP * max(1.0, abs(camera.params[index]))
    step = other.params[index] - camera.params[index]
    found = [np.asarray(one.img_from_cam(points_in_cam)) for one in (camera, other)]
    return float(np.linalg.norm(found[1] - found[0]) / abs(step))
