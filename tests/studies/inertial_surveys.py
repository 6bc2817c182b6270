"""Check scale and vertical by photos and an inertial sensor alone on simulated surveys, and mistakes in its log.

Run: python -m tests.studies.inertial_surveys [--num_seeds 10] [--num_mistakes 20] [--seed 0]

Surveys: by hand, by drone, by an even walk round a room whose photos err by 5 mm each, and by a rover that hardly
accelerates; sensors of a phone's and of tactical grade, each with an accelerometer whose axes are off by 3 % (1
stddev). Time offset and rotation are found; the rover's, which turns about one axis, is given. Gravity is that of
another place on the earth in each. The photos' path bends by 0.2 % of its size. A mistake is drawn at random and put
into a survey by hand with a phone; it is named if the message, a warning or a doubt has its word.

Prints for each kind of survey in how many the true scale is in its 95 % interval, the median half width, that of a plan
(`rangesfm plan`, whose maps bend as usual, and not as little as these), the root mean square of the errors of scale and
vertical in stated standard deviations, and in how many the verdict says that the motion does not show the scale. Exit
status 1 if fewer than 93 % of all are covered, if a rover is not told whose scale is known to no better than 4 %, or if
fewer than nine in ten mistakes are named.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from tests.simulated.files import write_rows
from tests.simulated.inertial import (
    CAM_FROM_IMU,
    TACTICAL,
    Motion,
    Walk,
    by_drone,
    by_hand,
    by_rover,
    by_walk,
    imu_log,
    photos,
)

from rangesfm.arrays import Array
from rangesfm.demo.simulated_imu import GRAVITY_M_S2, PHONE, Grade
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.imu import sensor_prior
from rangesfm.measurements.imu.formats import CANONICAL_COLUMNS, read_imu
from rangesfm.measurements.imu.inertial_fit import InertialProblem
from rangesfm.measurements.imu.inertial_scale import InertialScale, scale_by_sensor
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.imu.planned_sensor import PlannedSensor
from rangesfm.measurements.imu.sensor import InertialSensor
from rangesfm.measurements.imu.sensor_prior import GRAVITY_STDDEV
from rangesfm.planning.expected import PlannedBending
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.similarity import align_points
from rangesfm.util.geometry.trajectory import Trajectory

MOTIONS: dict[str, Callable[[int], Motion]] = {
    "hand": by_hand,
    "drone": by_drone,
    "walk": by_walk,
    "rover": by_rover,
}
GRADES = {"phone": PHONE, "tactical": TACTICAL}
OFFSET_S, BEND = 1.7, 0.002
EVENLY = "moved too evenly"


class Found(NamedTuple):
    """What a survey gave: errors of scale and vertical in stddevs, half the interval, what is told, half as planned."""

    scale: float
    vertical: float
    half_width: float
    told: str
    planned: float = np.nan


def made(motion: Motion, grade: Grade, seed: int) -> tuple[ImuLog, Trajectory]:
    path = photos(motion, noise_rad=5e-4, noise_m=0.005 * isinstance(motion, Walk), bend=BEND, seed=seed)
    gravity_m_s2 = sensor_prior.GRAVITY_M_S2 * (1 + GRAVITY_STDDEV * np.random.default_rng((seed, 9)).normal())
    return imu_log(motion, offset_s=OFFSET_S, grade=grade, gravity_m_s2=gravity_m_s2, seed=seed), path


def located(sensor: InertialSensor, path: Trajectory) -> tuple[InertialScale, str]:
    """Return the sensor on the map, as a run finds it, and the warnings."""
    aligned = sensor.on_path(path)
    assert aligned.alignment is not None
    bending = WalkBending(path)
    found = scale_by_sensor(InertialProblem.of_sensor(aligned, aligned.alignment, bending))
    return found, "; ".join(aligned.alignment.mistakes)


def surveyed(motion: Motion, of_grade: str, seed: int) -> Found:
    log, path = made(motion, GRADES[of_grade], seed)
    try:
        given = CAM_FROM_IMU if motion.amplitudes_rad[:2].max() < 0.05 else None
        found, told = located(InertialSensor(log, cam_from_imu=given), path)
    except GeometryError as error:
        return Found(np.nan, np.nan, np.inf, str(error))
    known = found.alone
    true = align_points(path.centers, motion.places_m(path.times_s)).scale
    off = float(np.log(known.scale.value / true)) / known.posterior.uncertainty.empirical
    upward = Rotation.from_rotvec([0.3, -1.0, 2.0]).apply([0.0, 0.0, 1.0])  # as ``photos`` turned the world
    away = found.upward.up_in_first_camera - path.world_from_cam[0].T @ upward
    doubts = told_by(found)
    tilt = float(np.linalg.norm(away)) / np.sqrt(2) / found.upward.stddev_rad
    turns = motion.world_from_imu(path.times_s).as_matrix() @ CAM_FROM_IMU.T
    path = replace(path, centers=motion.places_m(path.times_s), world_from_cam=turns)
    sensor = PlannedSensor(grade=of_grade)  # type: ignore[arg-type]
    planned = sensor.on_map(PlannedBending(WalkBending(path), sensor.sizes)).alone
    widths = known.posterior.uncertainty.half_width_95, planned.posterior.uncertainty.half_width_95
    return Found(off, tilt, widths[0], "; ".join([told, *doubts]), widths[1])


def told_by(found: InertialScale) -> list[str]:
    """Return what the verdict says of a map by the sensor alone."""
    known = found.alone
    return [*(doubt.reason for doubt in found.doubts(known.posterior.uncertainty)), *found.tests(known, {}).reasons]


class Mistake(NamedTuple):
    """A mistake: a word by which it is named, and what it does to the log (n, 6), or what is given with it.

    The change has the upward direction (n, 3) in the sensor's axes, too.
    """

    name: str
    word: str
    change: Callable[[Array, Array], Array] = lambda values, up: values
    given: dict[str, Any] = {}  # noqa: RUF012 (it is never changed)


def _columns(*order: int) -> Callable[[Array, Array], Array]:
    return lambda values, up: values[:, order]


def _signs(*signs: float) -> Callable[[Array, Array], Array]:
    return lambda values, up: values * np.array(signs)


def _slipped(values: Array, up: Array) -> Array:
    del up
    turned = Rotation.from_euler("y", 40, degrees=True)
    half = len(values) // 2
    after = np.hstack([turned.apply(values[half:, part]) for part in (slice(3), slice(3, 6))])
    return np.vstack([values[:half], after])


def _without_gravity(values: Array, up: Array) -> Array:
    return np.hstack([values[:, :3], values[:, 3:] - GRAVITY_M_S2 * up])


MISTAKES = (
    Mistake("two axes of the accelerometer swapped", "of the gyroscope", _columns(0, 1, 2, 4, 3, 5)),
    Mistake("axes of the accelerometer in another order", "of the gyroscope", _columns(0, 1, 2, 4, 5, 3)),
    Mistake("two axes of the gyroscope swapped", "mirror", _columns(1, 0, 2, 3, 4, 5)),
    Mistake("two axes of both swapped", "mirror", _columns(1, 0, 2, 4, 3, 5)),
    Mistake("an axis of the gyroscope reversed", "mirror", _signs(1, -1, 1, 1, 1, 1)),
    Mistake("an axis of the accelerometer reversed", "of the gyroscope", _signs(1, 1, 1, 1, 1, -1)),
    Mistake("the accelerometer reversed", "other sign", _signs(1, 1, 1, -1, -1, -1)),
    Mistake("g for m/s2", " g", _signs(1, 1, 1, *[1 / 9.80665] * 3)),
    Mistake("degrees for radians", "degrees a second", _signs(*[180 / np.pi] * 3, 1, 1, 1)),
    Mistake("gyroscope and accelerometer swapped", "accelerometer's median length", _columns(3, 4, 5, 0, 1, 2)),
    Mistake("gravity taken out", "gravity", _without_gravity),
    Mistake("the sensor slipped", "fixed to the camera", _slipped),
    Mistake(
        "a rotation by 90 deg more",
        "rotation",
        given={"cam_from_imu": CAM_FROM_IMU @ Rotation.from_euler("z", 90, degrees=True).as_matrix()},
    ),
    Mistake("the inverse of the rotation", "inverse", given={"cam_from_imu": CAM_FROM_IMU.T}),
    Mistake("a clock off by half a second", "time_offset", given={"time_offset_s": OFFSET_S + 0.5}),
    Mistake("the time offset with the other sign", "other sign", given={"time_offset_s": -OFFSET_S}),
    Mistake("the log of another day", "of this survey"),
    Mistake("the log of another sensor", "of this survey"),
)


def named(mistake: Mistake, seed: int, folder: Path) -> tuple[bool, str]:
    """Return whether a mistake in a survey by hand was named, and what was told."""
    motion = MOTIONS["hand"](seed)
    log, path = made(motion, PHONE, seed)
    if "another" in mistake.name and "log" in mistake.name:
        log, _ = made(MOTIONS["hand"](seed + 1000), PHONE, seed)
    up = motion.world_from_imu(log.timestamp_s + OFFSET_S).inv().apply([0.0, 0.0, 1.0])
    values = mistake.change(np.column_stack([log.gyro_rad_s, log.accel_m_s2]), up)
    write_rows(folder / "imu.csv", ",".join(CANONICAL_COLUMNS), np.column_stack([log.timestamp_s, values]).tolist())
    try:
        read = read_imu(folder / "imu.csv")
        said = "; ".join((*read.notes, *read.doubts))
        found, told = located(replace(InertialSensor(read), **mistake.given), path)
        said = "; ".join(filter(None, [said, told, *told_by(found)]))
    except (GeometryError, InputError) as error:
        said = str(error)
    return mistake.word in said, said


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_seeds", type=int, default=10)
    parser.add_argument("--num_mistakes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    all_covered, rovers_told, seeds = [], [], itertools.count(args.seed)
    for name, motion in MOTIONS.items():
        for of_grade in GRADES:
            own = [next(seeds) for _ in range(args.num_seeds)]  # else all sorts would have the same errors of gravity
            found = [surveyed(motion(seed), of_grade, seed) for seed in own]
            known = [each for each in found if np.isfinite(each.half_width)]
            errors = np.array([[each.scale, each.vertical] for each in known]).reshape(-1, 2)
            covered = np.abs(errors[:, 0]) <= 1.96
            told = [EVENLY in each.told for each in found]
            all_covered += covered.tolist()
            if name == "rover":
                rovers_told += [is_told or each.half_width <= 0.04 for is_told, each in zip(told, found, strict=True)]
            rms_scale, rms_tilt = np.sqrt(np.mean(errors**2, axis=0)) if len(errors) else (np.nan, np.nan)
            half, planned = 100 * np.median(
                [[each.half_width, each.planned] for each in known] or [[np.nan] * 2], axis=0
            )
            print(
                f"{name:6} {of_grade:9} covered {covered.sum()} of {len(known)}, half width {half:.2g} % (planned "
                f"{planned:.2g} %), errors in stddevs {rms_scale:.2f} (scale) {rms_tilt:.2f} (vertical), told "
                f"{sum(told)} of {len(found)}",
                flush=True,
            )
            for each in found:
                if not np.isfinite(each.half_width):
                    print(f"       refused: {each.told}", flush=True)
    share = float(np.mean(all_covered))
    print(
        f"all: covered {100 * share:.0f} % of {len(all_covered)}; told {sum(rovers_told)} of {len(rovers_told)} rovers"
    )
    rng, num_named = np.random.default_rng(args.seed), 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(args.num_mistakes):
            mistake = MISTAKES[rng.integers(len(MISTAKES))]
            is_named, said = named(mistake, args.seed + k, Path(folder))
            num_named += is_named
            print(f"{'named' if is_named else 'MISSED':6} {mistake.name}: {said}", flush=True)
    print(f"mistakes: {num_named} of {args.num_mistakes} named")
    return int(share < 0.93 or not all(rovers_told) or num_named < 0.9 * args.num_mistakes)


if __name__ == "__main__":
    sys.exit(main())
