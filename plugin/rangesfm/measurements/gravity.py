"""The upward direction in the first camera, as a measurement of the map's tilt in the site."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rangesfm import solver
from rangesfm.arrays import Array
from rangesfm.measurements.kind import LEAST_SQUARES, Block, Linearization, MapState, Measurements, Weights
from rangesfm.solver.bundle_adjustment import BundleAdjustment
from rangesfm.util.geometry.gravity import UP_IN_SITE, Gravity


@dataclass(frozen=True)
class UpwardDirection(Measurements):
    """The direction, known in the frame of the first keyframe's camera."""

    kind: ClassVar[str] = "gravity"

    gravity: Gravity

    @property
    def weights(self) -> Weights:
        return Weights(np.eye(3)[None] / self.gravity.stddev_rad, np.ones(1), LEAST_SQUARES)

    def linearize(self, state: MapState) -> Linearization:
        rotation, stddev = state.poses.world_from_rig[0], self.gravity.stddev_rad
        by_pose = np.zeros((1, 3, 1, 6))
        # A turn in the rig's own frame is a turn of the world about the rotated axes.
        by_pose[0, :, 0, :3] = stddev * self.gravity.jacobian(rotation, rotation)
        residual = stddev * self.gravity.residuals(rotation)
        return Linearization(residual[None], np.zeros((1, 1), dtype=np.int64), by_pose, ())

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        cost = solver.direction_cost(
            direction_in_world=UP_IN_SITE,
            direction_in_cam=self.gravity.up_in_first_camera,
            stddev_rad=self.gravity.stddev_rad / adjustment.pixel_stddev,
        )
        solver.add_residual_block(adjustment.adjuster, cost, None, [poses[0]])
