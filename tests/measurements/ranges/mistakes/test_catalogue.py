"""Clocks that are off are told with the sign of the offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.measurements.ranges.mistakes.test_linearized import ANCHORS_M, small_map

from rangesfm.measurements.mistakes import Mistake
from rangesfm.measurements.ranges.mistakes import catalogue
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, linearized
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap


def placed_exactly() -> RangesOnMap:
    """Return ranges to anchors whose coordinates are exact, so that a wrong one shows in the ranges alone."""
    on_map = small_map((0.0, 0.0, 0.0), num_tags=2)
    means_m = np.column_stack([ANCHORS_M[:, :2], (2.0, 1.5, 3.0)])
    return on_map.with_problem(replace(on_map.problem, anchor_mean_m=means_m))


@pytest.fixture(scope="module")
def problem() -> Linearized:
    return linearized(placed_exactly())


def all_standing(problem: Linearized) -> dict[tuple[str, str], Mistake]:
    return {each.key: each for of_kind in catalogue.STANDING for each in of_kind(problem)}


@pytest.fixture(scope="module")
def standing(problem: Linearized) -> dict[tuple[str, str], Mistake]:
    return all_standing(problem)


class TestTimes:
    """A radio may warm up, and clocks may differ, by amounts that can be."""

    def test_clocks_that_are_off_are_told_with_the_sign_of_the_offset(
        self, standing: dict[tuple[str, str], Mistake]
    ) -> None:
        offset = standing["clock offset", ""]
        assert offset.words(np.array([-0.15])) == (
            "the time offset between the clocks is wrong: it needs about -0.15 s more"
        )
        assert offset.correction(np.array([-0.15])).time_shift_s == -0.15
        # Otherwise they have no moment in common.
        assert offset.most == pytest.approx(9.75)
        assert offset.unit == "s"
