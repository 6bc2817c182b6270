"""An inertial sensor on a map as a whole: its scale, the upward direction, and their errors (sections 4 to 7)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.measurements.imu.inertial_fit import (
    ARM,
    GRAVITY,
    SCALE,
    SENSOR,
    TURN,
    Combinations,
    InertialProblem,
    InertialState,
    LinearMotion,
    Sizes,
)
from rangesfm.measurements.imu.inertial_motions import motions_on_map
from rangesfm.measurements.imu.preintegration import (
    ACCEL,
    ACCEL_BIAS,
    ACCEL_CROSS,
    ACCEL_SCALE,
    CLOCK,
    GYRO,
    GYRO_BIAS,
    GYRO_SCALE,
    Preintegrated,
)
from rangesfm.measurements.imu.sensor_prior import GRAVITY_M_S2, GRAVITY_STDDEV, PHOTO_TIMES, POSE_PLACES, POSE_TURNS
from rangesfm.measurements.imu.words import IMU, IMU_WORDS
from rangesfm.measurements.joint_map import JointMap, KindOnMap, fit_kinds
from rangesfm.measurements.kind import Doubt, Measurements
from rangesfm.measurements.mistakes import Mistake, MistakeTests, estimated
from rangesfm.measurements.points import NamedPoints
from rangesfm.options import RefineOptions
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS, Component
from rangesfm.solver.posterior import JointProblem, Observations, ScaleByKind, ScaleUncertainty, joined
from rangesfm.util.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NUM_REWEIGHTINGS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import first_camera_from

# Observations from which the sizes of errors are learnt before there are other kinds.
_NUM_OBSERVATIONS = MAX_NUM_OBSERVATIONS // 3
# Sites lean less than this, radians: floors, tripods and motion capture are levelled to a degree.
_LEANS_RAD = float(np.radians(3.0))
# Relative change of the sizes of errors from which weights do not matter.
_SAME_SIZE = 0.1


@dataclass(frozen=True)
class InertialScale(KindOnMap):
    """A log on the path of a map, whose scale and upward direction it tells.

    Attributes:
        problem: the log on the path.
        state: the most likely one. sizes: of the errors with which it was found. intervals: the log summed up there.
    """

    problem: InertialProblem
    state: InertialState
    sizes: Sizes
    intervals: Preintegrated

    kind, words = IMU, IMU_WORDS.words
    remedy = "measure a length, and look at what the notes say of the sensor's alignment"
    may_be_in_other_unit = False  # gravity shows it

    @property
    def start(self) -> Similarity:
        """The placement by the log alone, in the first camera's frame."""
        return first_camera_from(self.problem.path, self.state.scale)

    @cached_property
    def alone(self) -> JointMap:
        """The map by the log alone."""
        return fit_kinds((self,), self.start, self.problem.bending)

    @cached_property
    def upward(self) -> Gravity:
        """The upward direction in the first camera, as exactly as the errors let the log and the map tell it."""
        combinations = self._motion(self.state.scale).combined(self.sizes, _NUM_OBSERVATIONS, keeps_direction=True)
        observed = self._observations(combinations)
        across = combinations.of(combinations.motion.errors.by_gravity @ self.state.horizontal)
        problem = replace(joined([observed], self.problem.bending), sizes=self.alone.problem.sizes)
        # The direction is that of the most likely state; how far off it may be is known as for a mistake in it.
        [found] = estimated(problem, [Mistake("direction of gravity", -across)])
        stddev = float(np.linalg.norm(found.stddevs)) / np.sqrt(2) / GRAVITY_M_S2
        down = self.problem.path.world_from_cam[0].T @ self.state.gravity_m_s2
        return Gravity(-down / np.linalg.norm(down), stddev)

    def observed(self, placed: Similarity, *, in_site: bool, max_num: int) -> Observations:
        """Linearise about the scale of a placement; what depends on gravity's direction is left out."""
        del in_site
        return self._observations(self._motion(placed.scale).combined(self.sizes, max_num, keeps_direction=False))

    def tests(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> MistakeTests:
        """Return the tests of scale and vertical against other kinds, and whether log and photos are of one motion."""
        found = super().tests(on_map, by_kind)
        return replace(found, reasons=(*found.reasons, *self._misfits(on_map.problem), *self._leaning(on_map)))

    def _leaning(self, on_map: JointMap) -> Iterator[str]:
        """Yield that the site in which others place the map is not upright."""
        placement = on_map.posterior.placement
        if placement is None:
            return
        upward = on_map.estimate.rotation @ self.problem.path.world_from_cam[0] @ self.upward.up_in_first_camera
        angle = float(np.arccos(np.clip(upward @ UP_IN_SITE, -1.0, 1.0)))
        stddev = float(np.sqrt(np.linalg.eigvalsh(placement[1:3, 1:3])[-1] + self.upward.stddev_rad**2))
        if angle > SIGNIFICANT_STDDEVS * stddev and angle > _LEANS_RAD:
            yield (
                f"the z axis of the site leans by {np.degrees(angle):.0f} degrees from the vertical of the inertial "
                "sensor: expected coordinates with z up"
            )

    def _misfits(self, problem: JointProblem) -> Iterator[str]:
        """Yield what errs far more than such sensors and photos do."""
        usual = {each.name: each for each in problem.components if each.spread > 0}
        for name in self.sizes:
            factor = problem.sizes[name] / usual[name].median
            if np.log(factor) > SIGNIFICANT_STDDEVS * usual[name].spread:
                yield (
                    f"the {IMU_WORDS.errors[name]} would be {factor:.0f} times the usual: "
                    "do the accelerations belong to this motion? "
                    "the sensor has to be fixed to the camera, with the axes of the gyroscope for the accelerometer"
                )

    def doubts(self, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
        """Yield that the motion does not show the scale."""
        if uncertainty.half_width_95 > DOUBTFUL_ABOVE and not any(self._misfits(self.alone.problem)):
            yield Doubt(
                "the camera moved too evenly for the inertial sensor to show the scale",
                "move it to and fro and turn it about all axes, for half a minute or longer",
            )

    def measurements(self, on_map: JointMap, points: NamedPoints, options: RefineOptions) -> Iterator[Measurements]:
        """Yield the motions between the photos of a map that may bend."""
        state, placed, sizes = self.state, on_map.estimate, on_map.problem.sizes
        in_world = replace(
            state,
            velocities_m_s=state.velocities_m_s @ placed.rotation.T,
            gravity_m_s2=placed.rotation @ state.gravity_m_s2,
        )
        late = sizes["photo_times"] * self.problem.linearized(state, self.intervals).late[..., 0]
        densities = np.array([sizes["gyro_noise"], sizes["accel_noise"]])
        covariance = self.intervals.covariance(densities) + late @ np.swapaxes(late, 1, 2)
        yield motions_on_map(self.problem, in_world, self.intervals, covariance, points.state.poses, options)

    def entry(self, on_map: JointMap) -> Mapping[str, object]:
        """Return what ``ImuEntry`` has."""
        log, state, step_s = self.problem.log, self.state, self.problem.log.step_s
        offset_s = self.problem.time_offset_s + float(state.sensor[CLOCK][0])
        learnt = on_map.problem.sizes
        found = {
            "num": len(log),
            "num_used": min(round(float(self.intervals.interval_s.sum()) / step_s), len(log)),
            "time_offset": {"value_s": offset_s, "stddev_s": self.problem.prior.clock_s},
            "rotation_imu_to_cam_xyzw": Rotation.from_matrix(state.mounting.rig_from_imu).as_quat(canonical=True),
            "gravity_in_world": on_map.estimate.rotation @ state.gravity_m_s2,
            "up_stddev_deg": np.degrees(self.upward.stddev_rad),
            "accel_scale_factors": 1 / (1 - state.sensor[ACCEL_SCALE]),
            "accel_bias_m_s2": state.sensor[ACCEL_BIAS],
            "gyro_bias_rad_s": state.sensor[GYRO_BIAS],
            "accel_noise": learnt["accel_noise"],
            "gyro_noise": learnt["gyro_noise"],
        }
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in found.items()}

    @property
    def residuals(self) -> Observations:
        """All that the log says of some stretches of photos, which shows the sizes of errors best."""
        return self._observations(self._motion(self.state.scale).residuals(self.sizes, MAX_NUM_OBSERVATIONS))

    def _motion(self, scale: float) -> LinearMotion:
        state = self.problem.at_scale(scale, self.state, self.intervals, self.sizes)
        return self.problem.linearized(state, self.intervals)

    def _observations(self, made: Combinations) -> Observations:
        """Return the observations that are made of all errors."""
        problem, motion, state = self.problem, made.motion, made.motion.state
        by_pose = made.by_photos(motion.errors.by_pose, len(problem.path))
        of_shared = made.of(motion.shared)
        components = tuple(self._components(made, by_pose, of_shared))
        known = [each.alike for each in components if each.spread == 0]
        assumed = [self.sizes[each.name] ** 2 * each.alike for each in components if each.name in self.sizes]
        covariance = np.asarray(np.sum([*known, *assumed], axis=0))
        return Observations(
            kind=IMU,
            columns=Columns.of_whole(1),
            design=of_shared[:, SCALE],
            # Constant errors of the sensor are about what was known of it before.
            residual_m=made.of(motion.errors.residual) - of_shared @ problem.off_prior(state),
            by_pose=(by_pose * np.repeat([1.0, state.scale], 3)).reshape(len(by_pose), -1),
            components=components,
            alone_m2=covariance,
            is_used=np.ones(len(by_pose), dtype=bool),
        )

    def _components(self, made: Combinations, by_pose: Array, of_shared: Array) -> Iterator[Component]:
        """Yield the errors of observations, those of one standard deviation where it is learnt.

        Args:
            by_pose: (c, n, 6) derivatives by poses, shifts in metres. of_shared: (c, 29) by what is shared.
        """
        motion, prior, num = made.motion, self.problem.prior, len(by_pose)
        times_s = self.problem.times_s[motion.intervals.before]
        for name, sensor, of_bias in (("gyro", GYRO, GYRO_BIAS), ("accel", ACCEL, ACCEL_BIAS)):
            noise, walk = prior.noise[sensor], prior.walk[sensor]
            white = made.covariance(motion.intervals.unit_covariance[sensor])
            yield Component(f"{name}_noise", white, noise.median, noise.spread)
            walked = made.walk(motion.errors.by_sensor[:, :, of_bias], times_s)
            yield Component(f"{name}_bias_walk", walked, walk.median, walk.spread)
        late = made.by_photos(motion.late, len(self.problem.path))[:, :, 0]
        turns, places = (by_pose[:, :, part].reshape(num, -1) for part in (slice(0, 3), slice(3, 6)))
        for name, by_noise, size in (
            ("photo_times", late, PHOTO_TIMES),
            ("pose_turns", turns, POSE_TURNS),
            ("pose_places", places, POSE_PLACES),
        ):
            yield Component(name, by_noise @ by_noise.T, size.median, size.spread)
        yield Component("log_gaps", made.covariance(motion.intervals.of_gaps))
        of_sensor = of_shared[:, SENSOR]
        down = of_shared[:, GRAVITY] @ motion.state.gravity_m_s2
        for name, columns, stddev in (
            ("gyro_bias", of_sensor[:, GYRO_BIAS], prior.gyro_bias_rad_s),
            ("accel_bias", of_sensor[:, ACCEL_BIAS], prior.accel_bias_m_s2),
            ("gyro_scale", of_sensor[:, GYRO_SCALE], prior.gyro_scale),
            ("accel_scale", of_sensor[:, ACCEL_SCALE], prior.accel_scale),
            ("accel_cross", of_sensor[:, ACCEL_CROSS], prior.accel_cross),
            ("imu_clock", of_sensor[:, CLOCK], prior.clock_s),
            ("imu_turn", of_shared[:, TURN], prior.turn_rad),
            ("imu_place", of_shared[:, ARM], prior.arm_m),
            ("gravity", down[:, None], GRAVITY_STDDEV),
        ):
            yield Component(name, stddev**2 * columns @ columns.T)


def scale_by_sensor(problem: InertialProblem) -> InertialScale:
    """Fit a log to the path of a map, with the sizes of the errors that it shows.

    Raises:
        GeometryError: log and photos have no time in common, or do not tell the scale.
    """
    gyro, accel = problem.prior.noise
    sizes = {
        "gyro_noise": gyro.median, "accel_noise": accel.median, "photo_times": PHOTO_TIMES.median,
        "pose_turns": POSE_TURNS.median, "pose_places": POSE_PLACES.median,
    }  # fmt: skip
    state = problem.first_state
    for _ in range(NUM_REWEIGHTINGS):
        state = problem.likeliest(state, sizes)
        found = InertialScale(problem, state, sizes, problem.summed_up(state, sizes))
        learnt, before = joined([found.residuals], problem.bending).learnt(), sizes
        sizes = {name: learnt.sizes[name] for name in sizes}
        problem = replace(problem, bending_factor=learnt.bending_factor)
        if max(abs(np.log(sizes[name] / before[name])) for name in sizes) < _SAME_SIZE:
            break
    return found
