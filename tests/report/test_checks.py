"""Accuracy in figures: the lights change where the verdict does."""

from __future__ import annotations

import math
from typing import Any

import pytest
from tests.result_document import result_document

from rangesfm.report.checks import QualityCheck, quality_checks
from rangesfm.result.summary import ResultSummary
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE


def check_of(name: str, **changes: Any) -> QualityCheck:
    summary = ResultSummary.model_validate(result_document(**{"ranges": {"num": 10}, **changes}))
    (check,) = (check for check in quality_checks(summary) if check.name == name)
    return check


def noise(statistic: float) -> dict[str, Any]:
    unknown = dict.fromkeys(("size", "stddev", "smallest_detectable", "effect_on_scale", "effect_on_place_m"))
    words = {"words": "the ranges scatter", "remedy": "look"}
    test = {"name": "range noise", "subject": "", "statistic": statistic, "threshold": 0.3, "unit": "m"}
    return {"tests": [{**test, **unknown, **words, "rejected": statistic > 0.3}]}


@pytest.mark.parametrize(("share", "light"), [(0.0, "off"), (0.99, "green"), (1.01, "amber")])
def test_the_scale_has_the_limit_of_its_verdict(share: float, light: str) -> None:
    half = share * DOUBTFUL_ABOVE
    check = check_of("Scale", scale={"value": 2.0, "interval_95": [2.0 * math.exp(-half), 2.0 * math.exp(half)]})
    assert check.light == light
    assert check.value == pytest.approx(math.nan if light == "off" else 100 * half, nan_ok=True)
    assert check.limit_in_words == "Doubtful above 4.0\u00a0%."


@pytest.mark.parametrize(("scatter_m", "light"), [(0.29, "green"), (0.31, "amber")])
def test_the_scatter_of_ranges_has_the_limit_of_its_test(scatter_m: float, light: str) -> None:
    check = check_of("Scatter of single ranges", **noise(scatter_m))
    assert (check.light, check.limit, check.value) == (light, 0.3, scatter_m)


def test_what_the_verdict_has_no_limit_for_has_no_light() -> None:
    document = result_document(ranges={"num": 10, "num_used": 9, "rms_m": 5.0}, check_ranges={"num": 1, "rms_m": 9.0})
    checks = {check.name: check for check in quality_checks(ResultSummary.model_validate(document))}
    assert {checks[name].light for name in ("Ranges and map", "Check ranges", "Ranges used", "Clocks")} == {""}
    assert checks["Ranges and map"].limit_in_words == ""
    assert checks["Ranges used"].text == "90.0\u00a0%"


def test_without_check_ranges_there_is_no_check_of_them() -> None:
    document = result_document(check_ranges={"num": 0, "rms_m": None})
    assert "Check ranges" not in {check.name for check in quality_checks(ResultSummary.model_validate(document))}


def test_the_clocks_offset_is_told_with_its_interval_and_whether_it_matters() -> None:
    note = "the camera stands still at every photo"
    check = check_of("Clocks", time_offset={"stddev_s": 0.05, "offset_matters": False, "note": note})
    assert check.value == pytest.approx(0.098)
    assert ">0.098\u00a0s</data>" in check.text
    assert "The camera stands still at every photo." in check.meaning
    assert note not in check_of("Clocks", time_offset={"stddev_s": 0.05, "offset_matters": True, "note": note}).meaning


def test_what_was_not_measured_says_so() -> None:
    check = check_of("Photos", refine=None)
    assert math.isnan(check.value)
    assert check.text == "not measured"
