"""Keeps the map upright, where somebody told which way is up."""

from __future__ import annotations

from rangesfm import ceres
from rangesfm.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.geometry.trajectory import pose_of
from rangesfm.refine.bundle_adjustment import BundleAdjustment


def add_gravity(bundle: BundleAdjustment, gravity: Gravity, first_frame_id: int) -> None:
    """What the first camera saw of the vertical; the stddev in the unit of pixels."""
    cost = ceres.direction_cost(
        direction_in_world=UP_IN_SITE,
        direction_in_cam=gravity.up_in_first_camera,
        stddev_rad=gravity.stddev_rad / bundle.pixel_stddev,
    )
    pose = pose_of(bundle.metric.frame(first_frame_id)).params
    ceres.add_residual_block(bundle.adjuster, cost, None, [pose])
