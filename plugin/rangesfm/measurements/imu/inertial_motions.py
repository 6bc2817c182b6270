"""What an inertial sensor measured between photos, as measurements of a map that may bend (section 2 of the model)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from rangesfm import solver
from rangesfm.arrays import Array, Indices
from rangesfm.measurements.imu.inertial_fit import InertialProblem, InertialState
from rangesfm.measurements.imu.motion import MotionErrors, Mounting
from rangesfm.measurements.imu.preintegration import ACCEL_CROSS, BIASES, SCALES, Preintegrated
from rangesfm.measurements.imu.preintegration import CLOCK as LATE
from rangesfm.measurements.imu.sensor_prior import GRAVITY_M_S2, GRAVITY_STDDEV, SensorPrior
from rangesfm.measurements.kind import (
    LEAST_SQUARES,
    Block,
    ByBlock,
    Linearization,
    MapState,
    Measurements,
    Weights,
)
from rangesfm.measurements.prior import Prior
from rangesfm.options import RefineOptions
from rangesfm.solver.bundle_adjustment import BundleAdjustment
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.robust_statistics import RobustLoss, factor_of_stddevs
from rangesfm.util.geometry.rotations import left_jacobians, logarithms

GRAVITY: Block = ("gravity", "imu")
SCALE_ERRORS: Block = ("scale_errors", "imu")
CROSS_AXES: Block = ("cross_axes", "imu")
CLOCK: Block = ("clock", "imu")
MOUNTING: Block = ("mounting", "imu")


@dataclass(frozen=True)
class InertialMotions(Measurements):
    """Motions of the sensor in k intervals between photos.

    Blocks are the sensor's velocity (3,) at each of these photos, gravity (3,), biases (6,) of gyroscope
    and accelerometer in each stretch of time, shares (6,) by which their axes read too much, shares (6,) by which
    those of the accelerometer read of others, by how much later than
    assumed it measured (1,), and its mounting (6,), a rotation vector in its own frame and its place in the rig.

    Attributes:
        intervals: the motions, summed up about numbers of the sensor near the true ones.
        root_information: (k, 9, 9) inverse roots of the covariances of their errors.
        stretch: (k,) number of the stretch of time of each, from 0.
        walk_stddev: (s - 1, 6) standard deviations of the biases' change from each of s stretches to the next.
        mounting: as known before. prior: of the sensor's numbers; no standard deviation is 0.
        start: start values of the blocks.
        loss: of the length of an error, in standard deviations.
        factor: of the standard deviations, as residuals of a map that may bend show it, where these are larger.
    """

    kind: ClassVar[str] = "inertial"

    intervals: Preintegrated
    root_information: Array
    stretch: Indices
    walk_stddev: Array
    mounting: Mounting
    prior: SensorPrior
    start: Mapping[Block, Array]
    loss: RobustLoss
    factor: float = 1.0

    @property
    def blocks(self) -> Mapping[Block, Array]:
        return self.start

    @property
    def _biases(self) -> tuple[Block, ...]:
        return tuple(bias_block(k) for k in range(len(self.walk_stddev) + 1))

    def priors(self) -> Iterator[Measurements]:
        """Yield what is known of the blocks."""
        stddevs, known = self.prior.of_sensor, self.prior
        yield Prior.of_one(self._biases[0], np.zeros(6), stddevs[BIASES])
        yield Prior.of_one(SCALE_ERRORS, np.zeros(6), stddevs[SCALES])
        yield Prior.of_one(CROSS_AXES, np.zeros(6), stddevs[ACCEL_CROSS])
        yield Prior.of_one(CLOCK, np.zeros(1), known.clock_s)
        place = np.concatenate([np.zeros(3), self.mounting.imu_in_rig_m])
        yield Prior.of_one(MOUNTING, place, np.repeat([known.turn_rad, known.arm_m], 3))
        yield GravityLength()
        if len(self.walk_stddev):
            yield Prior.of_walk(self._biases, self.walk_stddev)

    @property
    def _root_information(self) -> Array:
        return self.root_information / max(self.factor, 1.0)

    @property
    def weights(self) -> Weights:
        return Weights(self._root_information, np.ones(len(self.intervals)), self.loss)

    def linearize(self, state: MapState) -> Linearization:
        at, num, blocks = self.intervals, len(self.intervals), state.blocks
        photos, velocities = np.union1d(at.before, at.after), np.zeros((len(state.poses), 3))
        names = tuple(velocity_block(photo) for photo in photos.tolist())
        velocities[photos] = [blocks[name] for name in names]
        biases, mounting = np.array([blocks[name] for name in self._biases]), blocks[MOUNTING]
        of_all = np.tile(np.concatenate([blocks[name] for name in (SCALE_ERRORS, CROSS_AXES, CLOCK)]), (num, 1))
        found = MotionErrors.at(
            at,
            state.poses,
            velocities,
            blocks[GRAVITY],
            np.column_stack([biases[self.stretch], of_all]),
            Mounting(self.mounting.rig_from_imu, mounting[3:]).turned(mounting[:3]),
        )
        by_mounting = np.concatenate([found.by_turn @ left_jacobians(-mounting[:3]), found.by_arm], axis=2)
        all_of_one = np.zeros(num, dtype=np.int64)
        by_block = (
            ByBlock(names, np.searchsorted(photos, at.before), found.by_velocity[:, :, 0]),
            ByBlock(names, np.searchsorted(photos, at.after), found.by_velocity[:, :, 1]),
            ByBlock((GRAVITY,), all_of_one, found.by_gravity),
            ByBlock(self._biases, self.stretch, found.by_sensor[:, :, BIASES]),
            ByBlock((SCALE_ERRORS,), all_of_one, found.by_sensor[:, :, SCALES]),
            ByBlock((CROSS_AXES,), all_of_one, found.by_sensor[:, :, ACCEL_CROSS]),
            ByBlock((CLOCK,), all_of_one, found.by_sensor[:, :, LATE]),
            ByBlock((MOUNTING,), all_of_one, by_mounting),
        )
        return Linearization(found.residual, np.column_stack([at.before, at.after]), found.by_pose, by_block)

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        at, roots = self.intervals, self._root_information
        for k, (before, after) in enumerate(zip(at.before.tolist(), at.after.tolist(), strict=True)):
            cost = solver.inertial_cost(
                interval_s=at.interval_s[k],
                turn=at.turn[k],
                speed=at.speed[k],
                shift=at.shift[k],
                at=at.at[k],
                by_sensor=at.by_sensor[k],
                whitening=roots[k],
                rig_from_imu=self.mounting.rig_from_imu,
                share=adjustment.pixel_stddev**2,
                loss_scale=self.loss.width,
            )
            velocities = [blocks[velocity_block(photo)] for photo in (before, after)]
            biases = blocks[bias_block(int(self.stretch[k]))]
            further = [blocks[GRAVITY], biases, *(blocks[name] for name in (SCALE_ERRORS, CROSS_AXES, CLOCK, MOUNTING))]
            solver.add_residual_block(
                adjustment.adjuster, cost, None, [poses[before], poses[after], *velocities, *further]
            )

    def at_blocks(self, blocks: Mapping[Block, Array]) -> InertialMotions:
        return replace(self, start={name: blocks[name] for name in self.start})

    def like(self, other: InertialMotions) -> InertialMotions:
        return replace(self, factor=other.factor)

    def under(self, loss: RobustLoss) -> InertialMotions:
        return replace(self, loss=loss)

    def with_noise_of(self, residual: Array, num_absorbed: float) -> InertialMotions:
        return replace(self, factor=self._shown(residual, num_absorbed))

    def _shown(self, residual: Array, num_absorbed: float) -> float:
        return factor_of_stddevs(np.einsum("gij,gj->gi", self.root_information, residual), num_absorbed)

    def change(self, other: InertialMotions) -> float:
        return float(abs(np.log(max(self.factor, 1.0) / max(other.factor, 1.0))))

    def log_likelihood(self, residual: Array) -> float:
        return -residual.size * float(np.log(max(self._shown(residual, 0.0), 1e-300)))


@dataclass(frozen=True)
class GravityLength(Measurements):
    """Length of gravity, of which the direction is unknown."""

    kind: ClassVar[str] = "gravity_length"

    @property
    def weights(self) -> Weights:
        return Weights(np.full((1, 1, 1), 1 / (GRAVITY_STDDEV * GRAVITY_M_S2)), np.ones(1), LEAST_SQUARES)

    def linearize(self, state: MapState) -> Linearization:
        length, down = _length_and_direction(state.blocks[GRAVITY])
        by_block = ByBlock((GRAVITY,), np.zeros(1, dtype=np.int64), down[None, None])
        return Linearization.without_poses(np.array([[length - GRAVITY_M_S2]]), (by_block,))

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        """Add the cost along the present direction, which turns by little in a bundle adjustment."""
        _, down = _length_and_direction(blocks[GRAVITY])
        root = adjustment.pixel_stddev * self.weights.root_information[0] * down
        cost = solver.joint_prior_cost(mean=GRAVITY_M_S2 * down[None], whitening=root)
        solver.add_residual_block(adjustment.adjuster, cost, None, [blocks[GRAVITY]])


def _length_and_direction(vector: Array) -> tuple[float, Array]:
    length = float(np.linalg.norm(vector))
    return length, vector / length


def motions_on_map(
    problem: InertialProblem,
    state: InertialState,
    intervals: Preintegrated,
    covariance: Array,
    poses: Poses,
    options: RefineOptions,
) -> InertialMotions:
    """Return the motions of a log with the noise that they show on a map as it is given, which may bend.

    Biases are constant in stretches of time in which they walk by less than the white noise of their mean.

    Args:
        problem: the log on the path. state: to start from, in the metric world.
        intervals: the log summed up between the photos. covariance: (k, 9, 9) of their errors.
        poses: of the map, in the metric world. options: of the fit.
    """
    photo = intervals.before
    prior, before, now, times_s = problem.prior, problem.mounting, state.mounting, problem.times_s[photo]
    longest_s = min(noise.median / walk.median for noise, walk in zip(prior.noise, prior.walk, strict=True))
    _, stretch = np.unique((times_s - times_s[0]) // longest_s, return_inverse=True)
    middles_s = np.bincount(stretch, times_s) / np.bincount(stretch)
    photos = np.union1d(photo, intervals.after).tolist()
    start = {velocity_block(k): state.velocities_m_s[k] for k in photos}
    start |= {bias_block(k): state.sensor[BIASES] for k in range(len(middles_s))}
    start |= {
        GRAVITY: state.gravity_m_s2,
        SCALE_ERRORS: state.sensor[SCALES],
        CROSS_AXES: state.sensor[ACCEL_CROSS],
        CLOCK: state.sensor[LATE],
    }
    turn = logarithms((before.rig_from_imu.T @ now.rig_from_imu)[None])[0]
    start[MOUNTING] = np.concatenate([turn, now.imu_in_rig_m])
    motions = InertialMotions(
        intervals,
        np.linalg.inv(np.linalg.cholesky(covariance)),
        stretch,
        np.sqrt(np.diff(middles_s))[:, None] * np.repeat([walk.median for walk in prior.walk], 3),
        before,
        prior,
        start,
        RobustLoss(options.range_loss_scale, is_bounded=True),
    )
    return motions.with_noise_of(motions.linearize(MapState(poses, start)).residual, 0.0)


def velocity_block(photo: int) -> Block:
    """Return the name of the sensor's velocity at a photo, given its index."""
    return "velocity", str(photo)


def bias_block(stretch: int) -> Block:
    """Return the name of the biases in a stretch of time."""
    return "imu_biases", str(stretch)
