"""A planned inertial sensor brings what a run with it would state, and the plan says how to bring more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.planning.plans import FIVE_ANCHORS_M, loop, planned
from tests.simulated.inertial import CAM_FROM_IMU, Motion, by_drone, by_hand, imu_log, photos

from rangesfm.demo.simulated_imu import PHONE
from rangesfm.errors import GeometryError
from rangesfm.measurements.imu.inertial_fit import InertialProblem
from rangesfm.measurements.imu.inertial_scale import scale_by_sensor
from rangesfm.measurements.imu.planned_sensor import PlannedSensor
from rangesfm.measurements.imu.sensor import InertialSensor
from rangesfm.measurements.imu.sensor_prior import NOISE
from rangesfm.measurements.imu.words import IMU
from rangesfm.planning.expected import PlannedBending, expect
from rangesfm.planning.plan_file import read_plan
from rangesfm.planning.survey_plan import plan_survey
from rangesfm.solver.bending import WalkBending

LEVEL = """[path]
waypoints = [[2, 2, 1.6], [10, 2, 1.6], [10, 6, 1.6], [2, 6, 1.6], [2, 2, 1.6]]
speed_m_per_s = 0.5
num_rounds = 2
"""


@pytest.mark.parametrize(("motion", "seed"), [(by_hand(1), 1), (by_drone(3), 3)], ids=["hand", "drone"])
def test_where_errors_have_the_same_sizes_a_plan_states_what_a_run_states(motion: Motion, seed: int) -> None:
    path, log = photos(motion, noise_rad=5e-4, bend=0.002, seed=seed), imu_log(motion, grade=PHONE, seed=seed)
    sensor = InertialSensor(log).on_path(path)
    assert sensor.alignment is not None
    problem = InertialProblem.of_sensor(sensor, sensor.alignment, WalkBending(path))
    run = scale_by_sensor(problem)
    turns = motion.world_from_imu(path.times_s).as_matrix() @ CAM_FROM_IMU.T
    true = replace(path, centers=motion.places_m(path.times_s), world_from_cam=turns)
    on_map = PlannedSensor().on_map(PlannedBending(WalkBending(true), {}))
    alike = replace(replace(on_map, sizes=run.sizes).alone.problem, sizes=run.alone.problem.sizes)
    assert alike.posterior().uncertainty.empirical == pytest.approx(run.alone.posterior.uncertainty.empirical, rel=0.15)


def test_a_level_camera_leaves_scale_factors_open_and_tilting_it_gains_what_the_plan_promises(tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(LEVEL + "[imu]\n")
    survey = read_plan(tmp_path / "plan.toml")
    plan = plan_survey(survey)
    assert plan.expected.frame == "first_camera"
    assert plan.place is None
    assert plan.verdict == "doubtful"
    assert (
        max(plan.expected.uncertainty.components, key=plan.expected.uncertainty.components.__getitem__) == "accel_scale"
    )
    assert plan.expected.up_stddev_deg is not None
    assert any(line.startswith("vertical: ") for line in plan.lines)
    tilted = next(advice for advice in plan.advice_for_scale if advice.kind == "tilted camera")
    assert tilted.scale_stddev < 0.6 * plan.expected.uncertainty.empirical
    assert expect(tilted.planned).uncertainty.empirical == pytest.approx(tilted.scale_stddev, rel=0.15)
    better = expect(replace(tilted.planned, others={IMU: PlannedSensor(grade="tactical")}))
    assert better.uncertainty.empirical < expect(tilted.planned).uncertainty.empirical


def test_beside_a_radio_a_sensor_brings_what_is_advised_and_levels_the_map() -> None:
    survey = planned(FIVE_ANCHORS_M[:3], "site", loop(40.0, 50))
    before = plan_survey(survey)
    advised = next(advice for advice in before.advice_for_scale if advice.kind == "inertial sensor")
    plan = plan_survey(replace(survey, others={IMU: PlannedSensor()}))
    assert plan.expected.uncertainty.empirical == pytest.approx(advised.scale_stddev, rel=0.15)
    assert {*plan.by_kind} == {"ranges", "imu"}
    assert plan.by_kind["ranges"].uncertainty.empirical == pytest.approx(before.expected.uncertainty.empirical)
    assert plan.expected.uncertainty.empirical < min(alone.uncertainty.empirical for alone in plan.by_kind.values())
    assert np.isnan(plan.by_kind["imu"].worst_keyframe_m)
    assert plan.place is not None
    assert before.place is not None
    assert plan.place.tilt_stddev_deg < 0.5 * before.place.tilt_stddev_deg
    assert not any(advice.kind == "inertial sensor" for advice in plan.advice)
    # Phones differ, so that one whose noise is known to be that of most brings more.
    gyro, accel = NOISE
    known = replace(survey, others={IMU: PlannedSensor(gyro_noise=gyro.median, accel_noise=accel.median)})
    assert expect(known).uncertainty.empirical < plan.expected.uncertainty.empirical


def test_a_sensor_with_few_photos_is_refused_alone_and_left_out_beside_a_radio() -> None:
    few = replace(planned(FIVE_ANCHORS_M, "site", loop(60.0, 8)), others={IMU: PlannedSensor()})
    assert any("inertial sensor is not used: 8 photos" in note for note in expect(few).notes)
    with pytest.raises(GeometryError, match="8 photos do not tell"):
        expect(replace(few, anchors=()))
