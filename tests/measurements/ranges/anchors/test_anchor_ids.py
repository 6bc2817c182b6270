"""Anchors that a file names otherwise than the log are matched by one certain rule, or by none."""

from __future__ import annotations

import pytest

from rangesfm.measurements.ranges.anchors.anchor_ids import ids_in_log


@pytest.mark.parametrize(
    ("listed", "heard", "expected"),
    [
        (["101", "102", "103", "104"], ["1", "2", "3", "4"], {"101": "1", "102": "2", "103": "3", "104": "4"}),
        (["101", "102", "103", "7"], ["1", "2"], {"101": "1", "102": "2", "103": "3"}),
        (["S1", "1001", "1002", "9"], ["1", "2"], {"1001": "1", "1002": "2"}),
        (["A1", "A2", "prism"], ["2", "1"], {"A1": "1", "A2": "2"}),
        (["P101", "P102", "900"], ["A1", "A2"], {"P101": "A1", "P102": "A2"}),
        (["1a40", "1A41"], ["0x1A40", "0x1A41"], {"1a40": "0x1A40", "1A41": "0x1A41"}),
        (["a1", "a2", "a3"], ["A01", "A02"], {"a1": "A01", "a2": "A02", "a3": "A3"}),
        (["01", "02", "03"], ["1", "2"], {"01": "1", "02": "2"}),
    ],
)
def test_one_rule_names_the_anchors(listed: list[str], heard: list[str], expected: dict[str, str]) -> None:
    found = ids_in_log(listed, heard)
    assert found is not None
    assert found[0] == expected


@pytest.mark.parametrize(
    ("listed", "heard"),
    [
        (["101", "102", "111", "112"], ["1", "2"]),  # 100 or 110
        (["A1", "A2", "B1", "B2"], ["1", "2"]),
        (["101", "102"], ["1", "2", "3"]),  # one is missing
        (["1", "102", "103"], ["1", "2", "3"]),  # one has the same id
        (["3", "4", "5"], ["0", "1", "2"]),  # no round number
        (["A", "B"], ["1", "2"]),
        (["A1", "a1"], ["01"]),
        ([], ["1"]),
        (["1"], []),
    ],
)
def test_anchors_that_several_rules_or_none_would_name_are_left_as_they_are(
    listed: list[str], heard: list[str]
) -> None:
    assert ids_in_log(listed, heard) is None
