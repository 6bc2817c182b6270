"""Names of errors in words: those of every kind, and names that only a later version knows."""

from __future__ import annotations

import pytest

from rangesfm.measurements.kinds_in_words import KINDS_IN_WORDS, component_words
from rangesfm.solver.bending import BENDS
from rangesfm.survey.kinds_in_map import KINDS


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("common_bias", "constant error of all ranges"),
        ("clocks", "time offset between the clocks"),
        ("positions_warp", "errors of the positions that belong to a place"),
        ("positions_30s", "errors of the known positions that last for 30 s"),
        ("tape", "errors of the measured lengths"),
        ("gyro_bias", "zero of the gyroscope"),
        ("bending", BENDS["bending"]),
        ("error_of_2030", "error_of_2030"),
    ],
)
def test_an_error_is_told_in_the_words_of_its_kind_or_by_its_name(name: str, words: str) -> None:
    assert component_words([name]) == {name: words}


def test_every_kind_has_its_words_in_the_order_of_the_table_of_kinds() -> None:
    assert [row.words for row in KINDS] == list(KINDS_IN_WORDS)
