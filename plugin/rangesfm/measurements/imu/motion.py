"""What a map predicts of an inertial sensor between its photos, with all derivatives (section 2 of ``model.md``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.imu.preintegration import SHIFT, SPEED, TURN, Preintegrated
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.rotations import cross_matrices, exponentials, left_jacobians, logarithms


@dataclass(frozen=True)
class Mounting:
    """Where the sensor is in the rig.

    Attributes:
        rig_from_imu: (3, 3) rotation.
        imu_in_rig_m: (3,) its origin in the rig's frame, which never scales with the map.
    """

    rig_from_imu: Array
    imu_in_rig_m: Array

    def turned(self, turn: Array) -> Mounting:
        """Return the mounting after a turn (3,), a rotation vector in the sensor's frame."""
        return Mounting(self.rig_from_imu @ exponentials(turn), self.imu_in_rig_m)


@dataclass(frozen=True)
class MotionErrors:
    """Errors of k intervals: predicted minus measured turn (rad), speed (m/s) and shift (m) in the sensor's frame.

    Attributes:
        residual: (k, 9).
        by_pose: (k, 9, 2, 6) derivatives by turn of the rig in its own frame and shift, of the photos before and after.
        by_velocity: (k, 9, 2, 3) by the sensor's velocity in the world at either photo, m/s.
        by_gravity: (k, 9, 3) by gravity in the world, m/s^2.
        by_sensor: (k, 9, 19) by the sensor's numbers (see ``Preintegrated``).
        by_turn, by_arm: (k, 9, 3) by a turn of the mounting in the sensor's frame, and by its place.
    """

    residual: Array
    by_pose: Array
    by_velocity: Array
    by_gravity: Array
    by_sensor: Array
    by_turn: Array
    by_arm: Array

    @classmethod
    def at(
        cls,
        measured: Preintegrated,
        poses: Poses,
        velocities_m_s: Array,
        gravity_m_s2: Array,
        sensor: Array,
        mounting: Mounting,
    ) -> MotionErrors:
        """Return the errors at a state of a metric map.

        Args:
            velocities_m_s: (n, 3) of the sensor at the n photos. gravity_m_s2: (3,). sensor: (k, 19).
        """
        before, after, num = measured.before, measured.after, len(measured)
        dt = measured.interval_s[:, None]
        rig_from_imu, arm = mounting.rig_from_imu, mounting.imu_in_rig_m
        to_rig = rig_from_imu.T
        first, last = poses.world_from_rig[before], poses.world_from_rig[after]
        from_world = to_rig @ np.swapaxes(first, 1, 2)  # into the sensor's frame at the photo before
        turned = from_world @ last @ rig_from_imu
        arms = poses.world_from_rig @ arm
        places = poses.centers + arms
        start = velocities_m_s[before]
        faster = velocities_m_s[after] - start - gravity_m_s2 * dt
        farther = places[after] - places[before] - start * dt - gravity_m_s2 * dt**2 / 2
        speed, shift = (np.einsum("kij,kj->ki", from_world, of) for of in (faster, farther))
        turn_measured, speed_measured, shift_measured = measured.corrected(sensor)
        off = np.swapaxes(turn_measured, 1, 2) @ turned
        angles = logarithms(off)
        residual = np.column_stack([angles, speed - speed_measured, shift - shift_measured])
        spread = np.linalg.inv(left_jacobians(-angles))

        by_turn = np.zeros((num, 9, 3))
        by_first = -spread @ np.swapaxes(turned, 1, 2)
        by_turn[:, TURN], by_turn[:, SPEED], by_turn[:, SHIFT] = by_first + spread, *map(cross_matrices, (speed, shift))
        by_arm = np.zeros((num, 9, 3))
        by_arm[:, SHIFT] = from_world @ (last - first)
        by_pose = np.zeros((num, 9, 2, 6))
        by_pose[:, TURN, 0, :3], by_pose[:, TURN, 1, :3] = by_first @ to_rig, spread @ to_rig
        by_pose[:, SPEED, 0, :3] = by_turn[:, SPEED] @ to_rig
        by_pose[:, SHIFT, 0, :3] = by_turn[:, SHIFT] @ to_rig + to_rig @ cross_matrices(arm)
        by_pose[:, SHIFT, 1, :3] = -from_world @ last @ cross_matrices(arm)
        by_pose[:, SHIFT, 0, 3:], by_pose[:, SHIFT, 1, 3:] = -from_world, from_world
        by_velocity = np.zeros((num, 9, 2, 3))
        by_velocity[:, SPEED, 0], by_velocity[:, SPEED, 1] = -from_world, from_world
        by_velocity[:, SHIFT, 0] = -from_world * dt[:, :, None]
        by_gravity = np.zeros((num, 9, 3))
        by_gravity[:, SPEED], by_gravity[:, SHIFT] = -from_world * dt[:, :, None], -from_world * dt[:, :, None] ** 2 / 2
        by_sensor = -measured.by_sensor
        corrections = np.einsum("kij,kj->ki", measured.by_sensor[:, TURN], sensor - measured.at)
        by_sensor[:, TURN] = spread @ np.swapaxes(off, 1, 2) @ left_jacobians(-corrections) @ by_sensor[:, TURN]
        return cls(residual, by_pose, by_velocity, by_gravity, by_sensor, by_turn, by_arm)
