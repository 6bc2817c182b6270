"""Kinds of measurement that contradict each other are named with the scale by each, and feet where these explain it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.inertial import CONSTANT
from tests.simulated.path import loop_path
from tests.simulated.runs import inputs_of, run_stages
from tests.simulated.surveys import SITE_ANCHORS_M, Array, MadeSurvey, Truth, made, truth_of
from tests.studies.known_positions import antenna_track
from tests.studies.measured_distances import marks_in

from rangesfm.demo.simulated_imu import simulate_imu
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.imu.sensor import InertialSensor
from rangesfm.measurements.lengths.tape import CONTROL, Tape, TapedDistance
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.util.geometry.moments import ByPhoto

FEET = 1 / 0.3048
PATH = loop_path(40.0, height_amplitude_m=0.8, unsteadiness_m=0.1, seed=3)
OF_KINDS = re.compile(
    r"by the (?P<large>[a-z ]+) the map is (?P<percent>[\d.]+) % larger than by the (?P<small>[a-z ]+) "
    r"\((?P<by_large>[\d.]+) and (?P<by_small>[\d.]+) m per unit of the model\); their errors together explain "
    r"[\d.]+ % \(1 stddev\)(?P<unit>, and .* would explain it)?: "
)
NAMES = {"ranges": "ranges", "lengths": "measured lengths", "positions": "known positions", "points": "known positions",
         "imu": "inertial sensor"}  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """A survey with photos, and what else is measured of it."""

    truth: Truth
    survey: MadeSurvey

    def by(self, factors: dict[str, float]) -> MetricResult:
        """Return the map, which is only scaled, by some kinds, whose numbers are so many times too large."""
        survey, rng = replace(self.survey, anchor_frame="unknown"), np.random.default_rng(8)
        survey.range_m = survey.range_m * factors.get("ranges", 1.0)
        tape, positions = Tape(), SurveyedPositions()
        if (factor := factors.get("lengths")) is not None:
            tape = self._tape(factor, rng)
        if (factor := factors.get("positions")) is not None:
            at_m = survey.true_centers_m + 0.1 * rng.standard_normal(survey.true_centers_m.shape)
            moments = ByPhoto(survey.trajectory.image_names)
            positions = SurveyedPositions(antenna=antenna_track(factor * at_m, 0.1, moments))
        if (factor := factors.get("points")) is not None:
            markers, true_m = marks_in(self.truth, rng)
            points = (ControlPoint(name, factor * at, 0.01, "control", 0) for name, at in true_m.items())
            positions = SurveyedPositions(ControlPoints(tuple(points), markers))
        inputs = inputs_of(survey if "ranges" in factors else None, tape, positions)
        if "imu" in factors:
            inputs = replace(inputs, others={"imu": _sensor()})
        return run_stages(survey, 3, inputs, is_refined=False)

    def _tape(self, factor: float, rng: np.random.Generator) -> Tape:
        names, true_m = self.survey.trajectory.image_names, self.survey.true_centers_m

        def taped(first: int, last: int) -> TapedDistance:
            length_m = np.linalg.norm(true_m[first] - true_m[last]) + 0.01 * rng.standard_normal()
            return TapedDistance((names[first], names[last]), factor * float(length_m), 0.02, CONTROL, 0)

        return Tape(tuple(taped(*ends) for ends in ((0, 25), (5, 40), (12, 33), (20, 50))))


def _sensor() -> InertialSensor:
    def turns(times_s: Array) -> Rotation:
        return Rotation.from_matrix(PATH.world_from_cam(times_s))

    times_s = np.arange(0.0, 39.9, 0.01)
    log = simulate_imu(turns, PATH.centers, times_s, 100.0, CONSTANT, np.random.default_rng(1))
    return InertialSensor(ImuLog(times_s, log.gyro_rad_s, log.accel_m_s2, "imu.csv"))


@pytest.fixture(scope="module")
def measured() -> Measured:
    truth = truth_of(PATH, np.linspace(0.0, 40.0, 60), SITE_ANCHORS_M, "site", 80, max_track_length=8)
    return Measured(truth, made(truth, PATH, np.arange(0.1, 39.9, 0.05), 0.5, 3, with_radio=False))


@pytest.mark.parametrize(
    "kinds",
    [
        {"ranges": 1.0, "lengths": FEET},
        {"ranges": FEET, "lengths": 1.0},
        {"ranges": 1.3, "positions": 1.0},
        {"ranges": FEET, "imu": 1.0},
        {"positions": 1.0, "lengths": 1.3},
        {"points": 1.0, "lengths": FEET},
        {"points": 1.0, "ranges": FEET},
        {"lengths": FEET, "imu": 1.0},
    ],
    ids=lambda kinds: "-".join(f"{kind}_{factor:.2g}" for kind, factor in kinds.items()),
)
def test_kinds_that_contradict_each_other_are_named_with_the_scale_by_each(
    kinds: dict[str, float], measured: Measured
) -> None:
    estimate = measured.by(kinds).estimate
    assert estimate.verdict == "doubtful"
    said = OF_KINDS.match(estimate.reasons[0])
    assert said, estimate.reasons
    small, large = sorted(kinds, key=kinds.__getitem__)
    assert (said["large"], said["small"]) == (NAMES[large], NAMES[small])
    assert float(said["by_small"]) == pytest.approx(measured.survey.metres_per_unit, rel=0.1)
    assert float(said["by_large"]) == pytest.approx(kinds[large] * measured.survey.metres_per_unit, rel=0.1)
    if kinds[large] < 2:
        assert not said["unit"]
        return
    assert f"the {NAMES[large]} in feet" in said["unit"]
    assert "inertial sensor in metres" not in said["unit"]


def test_kinds_that_agree_are_not_named(measured: Measured) -> None:
    estimate = measured.by({"positions": 1.0, "lengths": 1.0}).estimate
    assert not any(OF_KINDS.match(reason) for reason in estimate.reasons)
    assert set(estimate.by_kind) == {"positions", "lengths"}
