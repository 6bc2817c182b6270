"""RefinementProblem: all that a refinement keeps to from one solution of the full problem to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from rangesfm import ceres
from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import ResidualErrors
from rangesfm.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.geometry.trajectory import pose_of
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.refine.bundle_adjustment import BundleAdjustment, bundle_adjustment
from rangesfm.refine.calibration import add_calibration
from rangesfm.refine.distances import MeasuredDistances, add_distances
from rangesfm.refine.radio import RadioBlocks, RadioEstimate, RadioRanges, add_radio_priors, add_ranges
from rangesfm.refine.residual_errors import residual_errors


@dataclass(frozen=True)
class AddedBlocks:
    """What came into a problem of the photos: parameter blocks, and where the residuals of the ranges are."""

    blocks: RadioBlocks
    residual_rows: Indices


@dataclass(frozen=True)
class RefinementProblem:
    """What stays the same from one solution to the next; only the model changes, in place.

    Attributes:
        metric: the model. anchors, tags_in_cam_m: as given, which their priors go by.
        ranges: that take part. distances: measured ones, which the map keeps to.
        first_pose_is_fixed: the gauge.
        gravity: which way is up in the first camera; None where its pose is fixed, or nobody knows.
        left_out_ids: 3-D points that take no part.
    """

    metric: pycolmap.Reconstruction
    anchors: tuple[AnchorEstimate, ...]
    ranges: RadioRanges
    tags_in_cam_m: Array
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
            self.options,
            fixed_frame_id=self.first_frame_id if self.first_pose_is_fixed else None,
            max_num_iterations=max_num_iterations,
            num_threads=self.num_threads,
            marker_ids=self.distances.marker_ids.values(),
            left_out_ids=self.left_out_ids - set(self.distances.marker_ids.values()),
        )

    def add_to(self, bundle: BundleAdjustment, errors: RangeErrors, radio: RadioEstimate) -> AddedBlocks:
        """All else that was measured, from an estimate; ``errors`` are those of the ranges that take part."""
        blocks = RadioBlocks.at(radio, self.options)
        residual_rows = add_ranges(bundle, self.ranges, errors, blocks, self.options)
        blocks.others.extend(add_distances(bundle, self.distances, radio.anchors, blocks.positions, errors))
        add_radio_priors(bundle, radio, self.tags_in_cam_m, errors.common_bias_stddev_m, blocks, self.options)
        add_calibration(bundle, self.camera)
        if self.gravity is not None:
            self._add_gravity(bundle, self.gravity)
        return AddedBlocks(blocks, residual_rows)

    def _add_gravity(self, bundle: BundleAdjustment, gravity: Gravity) -> None:
        """What the first camera saw of the vertical; the stddev in the unit of pixels."""
        cost = ceres.direction_cost(
            direction_in_world=UP_IN_SITE,
            direction_in_cam=gravity.up_in_first_camera,
            stddev_rad=gravity.stddev_rad / bundle.pixel_stddev,
        )
        pose = pose_of(bundle.metric.frame(self.first_frame_id)).params
        ceres.add_residual_block(bundle.adjuster, cost, None, [pose])

    def residual_errors(self, added: AddedBlocks, errors: RangeErrors) -> ResidualErrors | None:
        """How the residuals of the ranges err; None where nobody has learnt it."""
        if errors.learned is None:
            return None
        radio = added.blocks.estimate(RadioEstimate(self.anchors, self.tags_in_cam_m))
        return residual_errors(errors, errors.learned, added.residual_rows, self.residuals_m(radio)[self.ranges.rows])

    def residuals_m(self, radio: RadioEstimate) -> Array:
        """(n,) predicted minus measured; NaN without a place."""
        return self.ranges.predicted_m(self.metric, radio) - self.ranges.observations.log.range_m
