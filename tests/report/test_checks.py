"""Quality checks: the values at which each light changes."""

from __future__ import annotations

from typing import Any

import pytest
from tests.result_document import result_document

from rangesfm.report.checks import QualityCheck, quality_checks
from rangesfm.result.summary import ResultSummary


def check_of(name: str, **changes: Any) -> QualityCheck:
    summary = ResultSummary.model_validate(result_document(**changes))
    (check,) = (check for check in quality_checks(summary) if check.name == name)
    return check


def light_of(name: str, **changes: Any) -> str:
    return check_of(name, **changes).light


@pytest.mark.parametrize(("value", "light"), [(0.0, "green"), (1.0, "green"), (1.1, "amber"), (2.1, "red")])
def test_smaller_is_better_up_to_and_with_each_limit(value: float, light: str) -> None:
    assert QualityCheck("n", "m", value, "px", green_limit=1.0, amber_limit=2.0, decimals=1).light == light


@pytest.mark.parametrize(("value", "light"), [(90.0, "green"), (70.0, "green"), (50.0, "amber"), (39.0, "red")])
def test_larger_is_better_where_it_says_so(value: float, light: str) -> None:
    check = QualityCheck("n", "m", value, "%", green_limit=70.0, amber_limit=40.0, decimals=1, larger_is_better=True)
    assert check.light == light


def test_the_larger_stddev_of_the_scale_counts() -> None:
    assert (
        light_of("Scale uncertainty", scale={"value": 2.0, "stddev_formal": 0.001, "stddev_empirical": None}) == "green"
    )
    both = {"value": 2.0, "stddev_formal": 0.001, "stddev_empirical": 0.2}
    assert light_of("Scale uncertainty", scale=both) == "red"


def test_one_anchor_cannot_agree_with_others() -> None:
    assert light_of("Anchor agreement", scale={"value": 1.0, "per_anchor": {"A": 1.0}}) == "off"
    assert light_of("Anchor agreement", scale={"value": 1.0, "per_anchor": {"A": 1.0, "B": 0.9}}) == "red"


def test_no_check_ranges_is_no_good_check() -> None:
    assert light_of("Check ranges", check_ranges={"num": 0, "rms_m": None}) == "off"
    assert light_of("Check ranges", check_ranges={"num": 10, "rms_m": 0.1}) == "green"


def test_an_offset_that_does_not_matter_is_no_fault_however_uncertain() -> None:
    note = "the camera stands still at every photo"
    assert light_of("Clock offset", time_offset={"stddev_s": 0.6, "offset_matters": True}) == "red"
    check = check_of("Clock offset", time_offset={"stddev_s": 0.6, "offset_matters": False, "note": note})
    assert check.light == "green"
    assert check.no_matter == "The camera stands still at every photo."


def test_nothing_measured_means_no_light() -> None:
    unknown = {"stddev_formal": None, "stddev_empirical": None}
    document = result_document(scale=unknown, time_offset={"stddev_s": None})
    assert {check.light for check in quality_checks(ResultSummary.model_validate(document))} == {"off"}


def test_the_gauge_shows_the_limits_to_scale_and_the_value_on_it() -> None:
    smaller = QualityCheck("n", "m", 1.5, "px", green_limit=1.0, amber_limit=2.0, decimals=1)
    assert [color for color, _ in smaller.zones] == ["green", "amber", "red"]
    assert [width for _, width in smaller.zones] == pytest.approx([100 / 3] * 3)
    assert smaller.needle_percent == pytest.approx(50.0)
    assert smaller.text == "1.5\u00a0px"
    assert smaller.limits == "green ≤ 1\u00a0px · amber ≤ 2\u00a0px"
    larger = QualityCheck("n", "m", 120.0, "%", green_limit=70.0, amber_limit=40.0, decimals=1, larger_is_better=True)
    assert larger.zones == [("red", 40.0), ("amber", 30.0), ("green", 30.0)]
    assert larger.needle_percent == 100.0
