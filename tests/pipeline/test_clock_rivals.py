"""Time offsets that cannot be ruled out, and their effect on the scale."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rangesfm.errors import GeometryError
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.pipeline.clock_rivals import scale_by_rivals
from rangesfm.util.geometry.similarity import Similarity

VALUE_S, RIVAL_S = 1.0, 4.0


@dataclass
class Scales:
    """A scale stage whose result depends on the time offset alone."""

    by_offset_s: dict[float, float | None]
    frame: str = "first_camera"

    def by_rivals(self, probability: float, rival_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
        offset = time_offset(probability).beside([(RIVAL_S, 1 - probability)])
        path: Any = SimpleNamespace(centers=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))

        def estimate_at(other: TimeOffset) -> Any:
            assert not other.drift_is_followed, "the drift is that of the offset it was found at"
            scale = self.by_offset_s[other.value_s]
            if scale is None:
                raise GeometryError("no scale")
            return estimate(scale, rival_m, self.frame)

        here = estimate(2.0, (0.0, 0.0, 0.0), self.frame)
        return scale_by_rivals(here, path, offset, estimate_at, "", "give it")


def estimate(scale: float, at_m: tuple[float, float, float], frame: str) -> Any:
    placed = Similarity(scale, np.eye(3), np.array(at_m))
    return SimpleNamespace(value=scale, frame=frame, metric_from_sfm=placed)


def time_offset(probability: float) -> TimeOffset:
    return TimeOffset(VALUE_S, 0.01, drift=1e-3, drift_stddev=1e-5, drift_is_followed=True, probability=probability)


def test_a_rival_of_nearly_the_same_scale_is_told_with_its_probability_and_its_scale() -> None:
    said, stddev = Scales({RIVAL_S: 2.04}).by_rivals(probability=0.6)
    assert stddev == pytest.approx(np.sqrt(0.4) * np.log(1.02))
    assert said == ("the time offset may also be +4.00 s (40%), which gives a scale of 2.04 (+2.0%)",)


def test_in_a_site_a_rival_is_told_with_how_far_it_puts_the_photos_elsewhere() -> None:
    (said,), stddev = Scales({RIVAL_S: 2.0}, "site").by_rivals(0.9, rival_m=(0.0, 3.0, 4.0))
    assert said.endswith("which gives a scale of 2 (+0.0%) and puts photos up to 5 m elsewhere")
    assert stddev == 0


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
