"""Scale, gravity and the sensor's own numbers by a log and the poses of photos (section 5 of ``model.md``).

What is measured between two photos is a linear function of velocities, of few numbers that all intervals share, and of
the poses. In stretches of neighbouring photos the velocities are eliminated exactly, and what is left is turned (QR)
into as many numbers as are shared, and into others that tell how the map is bent. The former lose nothing of what the
log says of the shared numbers where the errors of a stretch are independent of those of others. Errors of a bent map
are not, and without the latter it would keep the shape by its photos alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError
from rangesfm.measurements.imu.alignment import ImuAlignment
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.imu.motion import MotionErrors, Mounting
from rangesfm.measurements.imu.preintegration import (
    GYRO_BIAS,
    GYRO_SCALE,
    NUM_OF_SENSOR,
    Preintegrated,
    preintegrate,
)
from rangesfm.measurements.imu.sensor import InertialSensor
from rangesfm.measurements.imu.sensor_prior import (
    ARM_STDDEV_M,
    GIVEN_ARM_STDDEV_M,
    GIVEN_TURN_STDDEV_RAD,
    GRAVITY_M_S2,
    GRAVITY_STDDEV,
    SensorPrior,
)
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import regular
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, SIGNIFICANT_STDDEVS, UNDETERMINED
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE
from rangesfm.util.geometry.rotations import logarithms
from rangesfm.util.geometry.trajectory import Trajectory

SCALE, GRAVITY, SENSOR, TURN, ARM = slice(0, 1), slice(1, 4), slice(4, 23), slice(23, 26), slice(26, 29)
"""What all intervals share: logarithm of the scale, gravity, the sensor's numbers, turn and place of the mounting."""
NUM_SHARED = 29
# Largest number of intervals in a stretch; the time for a stretch grows with its cube.
_MAX_NUM_IN_STRETCH = 20

Sizes = Mapping[str, float]
"""Sizes of the errors that decide about weights, by name."""


@dataclass(frozen=True)
class InertialState:
    """Values of all that a log depends on besides the map.

    Attributes:
        scale: metres per unit of the path. velocities_m_s: (n, 3). gravity_m_s2: (3,) in the path's world.
        sensor: (19,). mounting: of the sensor.
        weights: (n,) of the intervals after each photo, robust.
        place_errors_m: (n, 2, 3) most likely errors of the photos' places before and after these intervals.
        reliability: share of the motion at the most likely places that is no error (Fuller, 1987, section 1.1).
    """

    scale: float
    velocities_m_s: Array
    gravity_m_s2: Array
    sensor: Array
    mounting: Mounting
    weights: Array
    place_errors_m: Array
    reliability: float

    @classmethod
    def at_rest(cls, gravity_m_s2: Array, mounting: Mounting, num: int) -> InertialState:
        """Return the state of a perfect sensor at the places of ``num`` photos, metric and without errors."""
        nothing = np.zeros((num, 3)), np.zeros((num, 2, 3))
        return cls(1.0, nothing[0], gravity_m_s2, np.zeros(NUM_OF_SENSOR), mounting, np.ones(num), nothing[1], 1.0)

    @property
    def horizontal(self) -> Array:
        """(3, 2) directions across gravity, by which it may turn."""
        down = self.gravity_m_s2 / np.linalg.norm(self.gravity_m_s2)
        return np.asarray(np.linalg.svd(down[None])[2][1:].T)


@dataclass(frozen=True)
class InertialProblem:
    """A log between the photos of a path.

    Attributes:
        log: on the clock of the photos. mounting: of the sensor in the rig, as known before.
        prior: what is known of the sensor's numbers, and of errors of clock and mounting.
        bending: of the path of the n photos, which has times.
        bending_factor: how much larger that is than expected from the photos' residuals (section 3).
        time_offset_s: what was added to the times of the log as it was read.
    """

    log: ImuLog
    mounting: Mounting
    prior: SensorPrior
    bending: MapBending
    bending_factor: float = 1.0
    time_offset_s: float = 0.0
    _bent: dict[bytes, Array] = field(default_factory=dict, repr=False)

    @classmethod
    def of_sensor(cls, sensor: InertialSensor, found: ImuAlignment, bending: MapBending) -> InertialProblem:
        """Return the log of a sensor that is aligned with the photos of a path, given how that is bent."""
        log = replace(found.log, timestamp_s=found.log.timestamp_s + found.time_offset_s)
        turn_rad = float(np.sqrt(np.linalg.eigvalsh(found.rotation_covariance)[-1]))
        prior = SensorPrior(
            max(found.time_offset_stddev_s, log.step_s / np.sqrt(12)),
            turn_rad or GIVEN_TURN_STDDEV_RAD,
            ARM_STDDEV_M if sensor.imu_in_cam_m is None else GIVEN_ARM_STDDEV_M,
        )
        arm = np.zeros(3) if sensor.imu_in_cam_m is None else sensor.imu_in_cam_m
        noise = sensor.log.noise
        prior = prior if noise is None else prior.with_given(noise)
        mounting = Mounting(found.cam_from_imu, arm)
        return cls(log, mounting, prior, bending, time_offset_s=found.time_offset_s)

    @property
    def path(self) -> Trajectory:
        """Of the photos."""
        return self.bending.path

    @property
    def times_s(self) -> Array:
        """(n,) times of the photos."""
        return self.path.times_s

    @property
    def first_state(self) -> InertialState:
        """A state from which the most likely one is found: in it, the mean specific force is against gravity."""
        at = np.clip(np.searchsorted(self.log.timestamp_s, self.times_s), 0, len(self.log) - 1)
        world_from_imu = self.path.world_from_cam @ self.mounting.rig_from_imu
        force = np.einsum("nij,nj->ni", world_from_imu, self.log.accel_m_s2[at]).mean(axis=0)
        gravity = -GRAVITY_M_S2 * force / np.linalg.norm(force)
        return InertialState.at_rest(gravity, self.mounting, len(self.path))

    def likeliest(self, state: InertialState, sizes: Sizes) -> InertialState:
        """Return the most likely state for errors of these sizes, from another one.

        Raises:
            GeometryError: log and photos have no time in common, or do not tell the scale.
        """
        intervals = self.summed_up(state, sizes)
        for step in range(MAX_NUM_ROUNDS):
            before, (state, stddev) = state, self._improved(self.linearized(state, intervals), sizes)
            if step and abs(np.log(state.scale / before.scale)) <= NEGLIGIBLE_STDDEVS * stddev:
                break
        return state

    def at_scale(self, scale: float, state: InertialState, intervals: Preintegrated, sizes: Sizes) -> InertialState:
        """Return the most likely state in which the path has a given scale, from one of another scale."""
        return self._improved(self.linearized(state, intervals), sizes, scale)[0]

    def summed_up(self, state: InertialState, sizes: Sizes) -> Preintegrated:
        """Return the log summed up between the photos, about the sensor's numbers of a state.

        Raises:
            GeometryError: log and photos have no time in common.
        """
        densities = np.array([sizes["gyro_noise"], sizes["accel_noise"]])
        log, times_s = self.log, self.times_s
        found = preintegrate(log.timestamp_s, log.gyro_rad_s, log.accel_m_s2, times_s, state.sensor, densities)
        if not len(found):
            is_apart = times_s[-1] < log.timestamp_s[0] or times_s[0] > log.timestamp_s[-1]
            why = "and the photos have no time in common" if is_apart else "does not tell how the photos turn"
            raise GeometryError(f"the log of the inertial sensor {why}")
        is_clipped = log.is_clipped_between(times_s[found.before], times_s[found.after])
        if is_clipped.all():
            raise GeometryError(
                "the inertial sensor was at the end of its scale between all photos: record with a larger scale"
            )
        return found.subset(np.flatnonzero(~is_clipped))

    def linearized(self, state: InertialState, intervals: Preintegrated) -> LinearMotion:
        """Return the errors of the intervals at a state, with their derivatives."""
        metric = state.scale * (self.path.centers - self.path.centers[0])
        poses, sensor = Poses(self.path.world_from_cam, metric), np.tile(state.sensor, (len(intervals), 1))
        errors = MotionErrors.at(intervals, poses, state.velocities_m_s, state.gravity_m_s2, sensor, state.mounting)

        def by_motion_of_photos(ends: Array, part: slice) -> Array:
            return np.asarray(np.einsum("kiaj,kaj->kia", errors.by_pose[:, :, :, part], ends))

        ends = np.column_stack([intervals.before, intervals.after])
        # Errors of places would pass for motion that the sensor did not feel, and make the map too small. So the
        # derivative by the scale is that at the most likely places, as in the Gauss-Helmert model (Pope, "Some pitfalls
        # to be avoided in the iterative adjustment of nonlinear problems", 1972). What is left of the errors there is
        # of no effect on the scale, but would pass for information.
        grown = by_motion_of_photos(metric[ends], slice(3, 6)).sum(axis=2)
        of_errors = by_motion_of_photos(state.place_errors_m[intervals.before], slice(3, 6)).sum(axis=2)
        by_scale = state.reliability * (grown - of_errors)[:, :, None]
        of_all = [by_scale, errors.by_gravity, errors.by_sensor, errors.by_turn, errors.by_arm]
        rates = self._rates(state)
        late = by_motion_of_photos(rates[ends], slice(0, 6))[:, :, :, None]
        return LinearMotion(self, state, intervals, errors, np.concatenate(of_all, axis=2), grown, late, rates)

    def _rates(self, state: InertialState) -> Array:
        """Return the (n, 6) rates of the photos' poses: rad/s in the rig's own frame, and m/s of its origin."""
        log = self.log
        rates = np.column_stack([np.interp(self.times_s, log.timestamp_s, axis) for axis in log.gyro_rad_s.T])
        in_rig = ((1 - state.sensor[GYRO_SCALE]) * rates - state.sensor[GYRO_BIAS]) @ state.mounting.rig_from_imu.T
        arms = np.cross(in_rig, state.mounting.imu_in_rig_m)
        return np.column_stack([in_rig, state.velocities_m_s - np.einsum("nij,nj->ni", self.path.world_from_cam, arms)])

    def bent_poses(self, photos: Indices, scale: float) -> Array:
        """Return the (6 q, 6 q) covariance of turns (rad) and places (m) of q photos as the photos let the map bend.

        Args:
            scale: metres per unit of the path.
        """
        key, num = photos.tobytes(), len(photos)
        if key not in self._bent:
            by_pose = np.zeros((6 * num, 6 * len(self.path)))
            by_pose[np.arange(6 * num), (6 * photos[:, None] + np.arange(6)).ravel()] = 1.0
            self._bent[key] = self.bending.of_functions(by_pose, frame_is_free=False).formal_m2
        to_metric = self.bending_factor * np.tile(np.repeat([1.0, scale], 3), num)
        return np.asarray(to_metric[:, None] * self._bent[key] * to_metric)

    def off_prior(self, state: InertialState) -> Array:
        """Return the (29,) differences of the shared numbers from what was known of them; 0 where nothing was."""
        off = np.zeros(NUM_SHARED)
        off[SENSOR] = state.sensor
        off[TURN] = logarithms((self.mounting.rig_from_imu.T @ state.mounting.rig_from_imu)[None])[0]
        off[ARM] = state.mounting.imu_in_rig_m - self.mounting.imu_in_rig_m
        return off

    def _improved(self, motion: LinearMotion, sizes: Sizes, scale: float | None = None) -> tuple[InertialState, float]:
        """Return a better state, and the standard deviation of the scale's logarithm.

        Args:
            scale: that of the better state, whose robust weights stay; None: it is estimated with all else.
        """
        state, stretches = motion.state, motion.stretches(sizes)
        priors, off = self._priors(state)
        design = np.vstack([*(each.combination @ each.shared for each in stretches), priors])
        residual = np.concatenate([*(each.combination @ each.residual for each in stretches), off])
        if np.linalg.matrix_rank(design / np.linalg.norm(design, axis=0)) < NUM_SHARED:
            raise GeometryError("the inertial sensor does not tell the scale: too few of its intervals are known")
        if scale is None:
            step = -np.linalg.lstsq(design, residual, rcond=None)[0]
        else:
            grown = np.concatenate([*(each.combination @ each.grown for each in stretches), np.zeros(len(off))])
            step = np.array([scale / state.scale - 1, *np.zeros(NUM_SHARED - 1)])
            step[1:] = -np.linalg.lstsq(design[:, 1:], residual + grown * step[0], rcond=None)[0]
        velocities, weights = state.velocities_m_s.copy(), state.weights.copy()
        place_errors_m = np.zeros_like(state.place_errors_m)
        for each in stretches:
            velocities[each.photos] = state.velocities_m_s[each.photos] + each.velocities(step)
            if scale is None:
                weights[each.before] = each.weights(step)
            place_errors_m[each.before] = each.place_errors_m(step)
        stddev = float(np.sqrt(np.linalg.inv(design.T @ design)[0, 0]))
        strength = state.reliability * stddev
        reliability = max(1 - strength**2 * sum(each.strength_of_errors for each in stretches), strength)
        growth = 1 + float(step[SCALE][0])  # the equations are linear in the scale itself, and not in its logarithm
        # Only the first step has its errors in full; later ones may lead too far.
        if growth < -SIGNIFICANT_STDDEVS * stddev and not state.place_errors_m.any():
            raise GeometryError(
                f"{self.log.name}: by the accelerations the camera moved the other way than by the photos: have they "
                "the other sign? at rest they point up, 9.8 m/s^2"
            )
        if not growth > 0:
            raise GeometryError(
                "the inertial sensor does not tell the scale: the camera moved too evenly; move it to and fro"
            )
        mounting, gravity = state.mounting.turned(step[TURN]), state.gravity_m_s2 + step[GRAVITY]
        found = InertialState(
            state.scale * growth,
            velocities,
            GRAVITY_M_S2 * gravity / np.linalg.norm(gravity),
            state.sensor + step[SENSOR],
            replace(mounting, imu_in_rig_m=mounting.imu_in_rig_m + step[ARM]),
            weights,
            place_errors_m,
            reliability,
        )
        return found, stddev

    def _priors(self, state: InertialState) -> tuple[Array, Array]:
        """Return the (r, 29) derivatives and the (r,) residuals, in standard deviations, of what was known before."""
        stddevs = np.full(NUM_SHARED, np.inf)
        stddevs[SENSOR], stddevs[TURN], stddevs[ARM] = self.prior.of_sensor, self.prior.turn_rad, self.prior.arm_m
        known = np.isfinite(stddevs)
        length = np.zeros((1, NUM_SHARED))
        length[0, GRAVITY] = state.gravity_m_s2 / GRAVITY_M_S2**2 / GRAVITY_STDDEV
        off = self.off_prior(state)[known] / stddevs[known]
        return np.vstack([np.diag(1 / stddevs)[known], length]), np.append(off, 0.0)


@dataclass(frozen=True)
class LinearMotion:
    """The log summed up in k intervals between photos, linearised at a state.

    Attributes:
        problem, state, intervals, errors: of what, at which, between photos, and predicted minus measured.
        shared: (k, 9, 29) derivatives by what all intervals share; that by the scale is at the most likely places.
        grown: (k, 9) change of the errors as the map grows.
        late: (k, 9, 2, 1) by how much later than said the photos before and after were taken.
        rates: (n, 6) of the photos' poses: rad/s in the rig's own frame, and m/s of its origin.
    """

    problem: InertialProblem
    state: InertialState
    intervals: Preintegrated
    errors: MotionErrors
    shared: Array
    grown: Array
    late: Array
    rates: Array

    def stretches(self, sizes: Sizes) -> list[Stretch]:
        """Return all intervals in stretches of neighbours, given the sizes of the errors."""
        num = len(self.intervals)
        parts = np.array_split(np.arange(num), -(-num // _MAX_NUM_IN_STRETCH))
        return [Stretch.of(rows, self, sizes) for rows in parts]

    def residuals(self, sizes: Sizes, max_num: int) -> Combinations:
        """Return all combinations that depend neither on velocities nor on gravity's direction, of some stretches.

        Args:
            max_num: largest number of combinations, if one stretch has no more; the stretches are evenly chosen.
        """
        stretches = self.stretches(sizes)
        # Of each photo a velocity is eliminated, and all else is left.
        most = max(max_num // max(each.by_velocity.shape[0] - each.by_velocity.shape[1] for each in stretches), 1)
        chosen = np.unique(np.linspace(0, len(stretches) - 1, most).round().astype(np.int64)).tolist()
        parts = [(each, rows) for each in (stretches[k] for k in chosen) for rows in (each.combination, each.bends[0])]
        return self._level(self._of_all(parts))

    def _of_all(self, parts: Iterable[tuple[Stretch, Array]]) -> Array:
        """Return the (c, k, 9) coefficients of (..., 9 m) combinations of stretches, in this order."""
        found = []
        for stretch, rows in parts:
            found.append(np.zeros((len(rows), len(self.intervals), 9)))
            found[-1][:, stretch.rows] = rows.reshape(-1, len(stretch.rows), 9)
        return np.concatenate(found)

    def _level(self, coefficients: Array) -> Combinations:
        """Return those (c, k, 9) combinations of combinations that do not depend on gravity's direction."""
        by_direction = self.errors.by_gravity @ self.state.horizontal
        seen = np.linalg.qr(np.tensordot(coefficients, by_direction, axes=2), mode="complete")[0]
        return Combinations(np.tensordot(seen[:, 2:].T, coefficients, axes=1), self)

    def combined(self, sizes: Sizes, max_num: int, *, keeps_direction: bool) -> Combinations:
        """Return the few combinations of all errors that tell what all intervals share, and how the map is bent.

        Args:
            max_num: about the largest number of combinations; those that tell what is shared are never fewer. Of the
                others, those that tell most of the bending are chosen.
            keeps_direction: whether they depend on gravity's direction; otherwise what does is left out.
        """
        stretches, parts = self.stretches(sizes), []
        for group in np.array_split(np.arange(len(stretches)), min(max(max_num // NUM_SHARED, 1), len(stretches))):
            of_group = [stretches[number] for number in group]
            basis = np.linalg.qr(np.vstack([each.combination @ each.shared for each in of_group]))[0]
            own = block_diag(*(each.combination for each in of_group))
            found = np.zeros((basis.shape[1], len(self.intervals), 9))
            found[:, np.concatenate([each.rows for each in of_group])] = (basis.T @ own).reshape(basis.shape[1], -1, 9)
            parts.append(found)
        shares = np.sort(np.concatenate([each.bends[1] for each in stretches]))[::-1]
        num_left = max_num - sum(len(each) for each in parts)
        least = max([UNDETERMINED, *shares[max(num_left, 0) :][:1]])
        parts.append(self._of_all((each, each.bends[0][each.bends[1] > least]) for each in stretches))
        coefficients = np.concatenate(parts)
        return Combinations(coefficients, self) if keeps_direction else self._level(coefficients)


@dataclass(frozen=True)
class Combinations:
    """c linear combinations of the (k, 9) errors of intervals, which do not depend on velocities.

    Attributes:
        coefficients: (c, k, 9). motion: of the intervals.
    """

    coefficients: Array
    motion: LinearMotion

    def of(self, effects: Array) -> Array:
        """Return (c, ...) combinations of (k, 9, ...) effects."""
        return np.asarray(np.tensordot(self.coefficients, effects, axes=2))

    def covariance(self, of_intervals: Array) -> Array:
        """Return the (c, c) covariance for independent (k, 9, 9) covariances of intervals."""
        spread = np.einsum("cki,kij->ckj", self.coefficients, of_intervals)
        return np.asarray(np.tensordot(spread, self.coefficients, axes=([1, 2], [1, 2])))

    def by_photos(self, effects: Array, num_photos: int) -> Array:
        """Return the (c, n, m) combinations of effects (k, 9, 2, m) of the photos before and after."""
        found = np.zeros((num_photos, len(self.coefficients), effects.shape[3]))
        for side, photo in enumerate((self.motion.intervals.before, self.motion.intervals.after)):
            np.add.at(found, photo, np.einsum("cki,kim->kcm", self.coefficients, effects[:, :, side]))
        return np.swapaxes(found, 0, 1)

    def walk(self, effects: Array, times_s: Array) -> Array:
        """Return the (c, c) covariance of a random walk of 1 per root of a second, from the first interval on.

        Args:
            effects: (k, 9, 3) of the three numbers that walk. times_s: (k,) of the intervals.
        """
        each = np.einsum("cki,kia->kca", self.coefficients, effects)
        later = np.cumsum(each[::-1], axis=0)[::-1][1:]  # a step moves all that comes after it
        return np.asarray(np.einsum("kca,kda,k->cd", later, later, np.diff(times_s), optimize=True))


@dataclass(frozen=True)
class Stretch:
    """Neighbouring intervals whose velocities are eliminated together.

    Attributes:
        rows: (m,) of the intervals. before, after: (m,) photos before and after each. photos: (q,) all of them.
        residual, grown: (9 m,). shared: (9 m, 29). lower: (9 m, 9 m) Cholesky factor of their covariance.
        by_velocity: (9 m, 3 q). of_places: (3 q, 9 m) covariance of the errors of photos' places with these errors.
        strength_of_errors: expected square of what errors of the most likely places would add to the derivative by the
            scale, in standard deviations of the errors, without what velocities explain.
        combination: (r, 9 m) combinations that do not depend on velocities, with a covariance of 1, by which the errors
            depend on what is shared.
        by_pose: (9 m, 6 q). bent: (6 q, 6 q) covariance of the photos' poses by the bending of the map.
    """

    rows: Indices
    before: Indices
    after: Indices
    photos: Indices
    residual: Array
    grown: Array
    shared: Array
    lower: Array
    by_velocity: Array
    of_places: Array
    strength_of_errors: float
    combination: Array
    by_pose: Array
    bent: Array

    @classmethod
    def of(cls, rows: Indices, motion: LinearMotion, sizes: Sizes) -> Stretch:
        """Eliminate the velocities of some of the intervals, given the sizes of the errors."""
        before, after, num = motion.intervals.before[rows], motion.intervals.after[rows], len(rows)
        photos = np.unique([before, after])

        def of_photos(values: Array) -> Array:
            found = np.zeros((num, 9, len(photos), values.shape[3]))
            for side, photo in enumerate((before, after)):
                found[np.arange(num), :, np.searchsorted(photos, photo)] += values[:, :, side]
            return found.reshape(9 * num, -1)

        by_pose = of_photos(motion.errors.by_pose[rows])
        late, places = of_photos(sizes["photo_times"] * motion.late[rows]), np.tile(np.arange(6) >= 3, len(photos))
        bent = motion.problem.bent_poses(photos, motion.state.scale)
        of_poses = bent + np.diag(np.where(places, sizes["pose_places"], sizes["pose_turns"]) ** 2)
        total = by_pose @ of_poses @ by_pose.T + late @ late.T
        blocks = total.reshape(num, 9, num, 9)  # a view
        densities = np.array([sizes["gyro_noise"], sizes["accel_noise"]])
        of_intervals = motion.intervals.subset(rows).covariance(densities)
        blocks[np.arange(num), :, np.arange(num)] += of_intervals / motion.state.weights[before][:, None, None]
        lower = np.asarray(np.linalg.cholesky(regular(total)), dtype=np.float64)
        by_velocity, own = of_photos(motion.errors.by_velocity[rows]), motion.shared[rows].reshape(9 * num, -1)
        whitened = solve_triangular(lower, np.hstack([by_velocity, own]), lower=True)
        basis = np.linalg.qr(whitened[:, : by_velocity.shape[1]])[0]
        left = whitened[:, by_velocity.shape[1] :]
        left = left / np.maximum(np.linalg.norm(left, axis=0), 1e-300)
        turned, strengths, _ = np.linalg.svd(left - basis @ (basis.T @ left), full_matrices=False)
        turned = turned[:, strengths > UNDETERMINED]
        combination = solve_triangular(lower, turned, lower=True, trans=1).T
        # Places err by those of the poses, and where the camera was at another time.
        moved = block_diag(*(sizes["photo_times"] * motion.rates[photos, 3:, None]))
        of_places = of_poses[places] @ by_pose.T + moved @ late.T
        whitened = solve_triangular(lower, np.hstack([by_pose[:, places], of_places.T]), lower=True)
        effects, with_places = np.split(whitened - basis @ (basis.T @ whitened), 2, axis=1)
        left_m2 = of_poses[np.ix_(places, places)] + moved @ moved.T - with_places.T @ with_places
        strength = float(np.einsum("ia,ab,ib->", effects, left_m2, effects, optimize=True))
        residual, grown = motion.errors.residual[rows].ravel(), motion.grown[rows].ravel()
        return cls(
            *(rows, before, after, photos, residual, grown, own, lower, by_velocity, of_places, strength),
            *(combination, by_pose, bent),
        )

    @cached_property
    def bends(self) -> tuple[Array, Array]:
        """(b, 9 m) all other combinations, and the parts (b,) of their variances that are due to the map's bending.

        They do not depend on velocities either, have a covariance of 1, and depend on the bending one by one.
        """
        by_velocity = solve_triangular(self.lower, self.by_velocity, lower=True)
        seen = np.hstack([by_velocity, self.lower.T @ self.combination.T])
        others = np.linalg.qr(seen, mode="complete")[0][:, seen.shape[1] :]
        effects = others.T @ solve_triangular(self.lower, self.by_pose, lower=True)
        shares, turned = np.linalg.eigh(effects @ self.bent @ effects.T)
        return np.asarray(solve_triangular(self.lower, others @ turned, lower=True, trans=1).T), shares

    def _left(self, step: Array) -> Array:
        return self.residual + self.grown * step[SCALE] + self.shared[:, GRAVITY.start :] @ step[GRAVITY.start :]

    def velocities(self, step: Array) -> Array:
        """Return the (q, 3) most likely changes of the velocities after a step (29,) of the shared numbers."""
        whitened = solve_triangular(self.lower, np.column_stack([self.by_velocity, self._left(step)]), lower=True)
        basis, upper = np.linalg.qr(whitened[:, :-1])
        return -np.asarray(solve_triangular(upper, basis.T @ whitened[:, -1])).reshape(-1, 3)

    def place_errors_m(self, step: Array) -> Array:
        """Return the (m, 2, 3) most likely errors of the places of the photos before and after each interval."""
        whitened = solve_triangular(self.lower, self._errors(step), lower=True)
        errors_m = self.of_places @ solve_triangular(self.lower, whitened, lower=True, trans=1)
        ends = np.searchsorted(self.photos, np.column_stack([self.before, self.after]))
        return np.asarray(errors_m.reshape(-1, 3)[ends])

    def _errors(self, step: Array) -> Array:
        return self._left(step) + self.by_velocity @ self.velocities(step).ravel()

    def weights(self, step: Array) -> Array:
        """Return the (m,) robust weights of the intervals after a step."""
        left = self._errors(step).reshape(-1, 9)
        covariance = self.lower @ self.lower.T
        own = covariance.reshape(len(left), 9, len(left), 9)[np.arange(len(left)), :, np.arange(len(left))]
        squared = np.einsum("ki,kij,kj->k", left, np.linalg.inv(own), left)
        return GEMAN_MCCLURE.weights(np.sqrt(squared / max(float(np.median(squared)), 1e-300)))
