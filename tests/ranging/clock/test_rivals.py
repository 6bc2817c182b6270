"""The time offsets of the clocks that are likely."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.errors import GeometryError
from rangesfm.ranging.clock.search import CostCurve
from rangesfm.ranging.clock.time_offset import Rival, TimeOffset, likely_offsets


def test_offsets_come_with_their_probabilities_the_likeliest_first_and_without_the_unlikely() -> None:
    likely = likely_offsets([1.0, 2.0, 3.0], [np.log(0.2), np.log(0.8), np.log(0.001)])
    assert [number for number, _ in likely] == [1, 0]
    assert [probability for _, probability in likely] == pytest.approx([0.8, 0.2])


def test_three_offsets_are_an_answer_and_four_are_none() -> None:
    assert len(likely_offsets([1.0, 2.0, 3.0], [0.0] * 3)) == 3
    with pytest.raises(GeometryError, match=r"4 time offsets, such as \+1.00 s \(25%\), \+2.00 s"):
        likely_offsets([1.0, 2.0, 3.0, 4.0], [0.0] * 4)


def test_an_impossible_offset_is_no_rival() -> None:
    assert likely_offsets([1.0, 2.0], [0.0, -np.inf]) == [(0, 1.0)]


def test_a_drift_is_that_of_the_offset_it_was_found_at_and_of_no_rival() -> None:
    curve = CostCurve(np.zeros(1), np.zeros(1))
    rival = Rival(-7.0, 0.1)
    offset = TimeOffset(5.0, 0.01, curve, True, 1e-3, 1e-5, True, 100.0, None, 0.9, (rival,))
    times_s = np.array([0.0, 100.0, 200.0])
    np.testing.assert_allclose(offset.at(times_s), [4.9, 5.0, 5.1])
    np.testing.assert_array_equal(offset.of_rival(rival).at(times_s), -7.0)
    assert offset.of_rival(rival).probability == 0.1
    assert offset.of_rival(rival).rivals == ()
