"""Time offsets that cannot be ruled out, and their effect on the scale."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rangesfm.errors import GeometryError
from rangesfm.ranging.clock.search import CostCurve
from rangesfm.ranging.clock.time_offset import Rival, TimeOffset
from rangesfm.ranging.range_log import RangeLog
from rangesfm.survey.survey_run import PathOfModel
from rangesfm.workflows.make_metric_map import scale_by_rivals

VALUE_S, RIVAL_S = 1.0, 4.0


@dataclass
class Scales:
    """A scale stage whose result depends on the time offset alone."""

    by_offset_s: dict[float, float | None]

    def by_rivals(self, probability: float) -> tuple[tuple[str, ...], float]:
        log = RangeLog.from_arrays(["A"] * 3, [1.0] * 3, timestamp_s=[0.0, 1.0, 2.0])
        run: Any = SimpleNamespace(
            inputs=SimpleNamespace(log=log),
            ranges_on=lambda path, offset_s: float(np.mean(offset_s)),
            estimate_scale=self.estimate,
        )
        offset = time_offset(probability, (Rival(RIVAL_S, 1 - probability),))
        unused: Any = None
        return scale_by_rivals(run, PathOfModel("", unused, unused, unused), offset, 2.0)

    def estimate(self, path: Any) -> SimpleNamespace:
        scale = self.by_offset_s[path.observations]
        if scale is None:
            raise GeometryError("no scale")
        return SimpleNamespace(value=scale)


def time_offset(probability: float, rivals: tuple[Rival, ...]) -> TimeOffset:
    curve = CostCurve(np.zeros(0), np.zeros(0))
    return TimeOffset(VALUE_S, 0.01, curve, True, 1e-3, 1e-5, True, 0.0, None, probability, rivals)


def test_a_rival_of_nearly_the_same_scale_is_told_with_its_probability_and_its_scale() -> None:
    said, stddev = Scales({RIVAL_S: 2.04}).by_rivals(probability=0.6)
    assert stddev == pytest.approx(np.sqrt(0.4) * np.log(1.02))
    assert said == ("the time offset may also be +4.00 s (40%), which gives a scale of 2.04 (+2.0%)",)


def test_the_interval_holds_the_scale_of_a_rival_however_unlikely() -> None:
    _, stddev = Scales({RIVAL_S: 2.04}).by_rivals(probability=0.98)
    assert 1.96 * stddev == pytest.approx(np.log(1.02))


def test_a_rival_of_another_scale_is_refused_with_how_far_apart_they_are() -> None:
    with pytest.raises(GeometryError, match=r"\+1.00 s \(60%\) gives 2 m per unit, \+4.00 s \(40%\) gives 2.2 \(\+10"):
        Scales({RIVAL_S: 2.2}).by_rivals(probability=0.6)


def test_beside_an_offset_that_is_nearly_certain_a_rival_of_another_scale_is_a_doubt() -> None:
    (said,), stddev = Scales({RIVAL_S: 2.2}).by_rivals(probability=0.96)
    assert stddev == 0
    assert "+4.00 s (4%), which gives a scale of 2.2 (+10.0%)" in said


def test_a_rival_that_gives_no_scale_is_told() -> None:
    (said,), _ = Scales({RIVAL_S: None}).by_rivals(probability=0.6)
    assert said == "the time offset may also be +4.00 s (40%), which gives no scale"
