"""Distances between surveyed anchors, which hold in any frame."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.measurements.lengths.locate_lengths import surveyed_distances
from rangesfm.measurements.lengths.tape import CONTROL
from rangesfm.measurements.ranges.anchors.anchor import Anchor


def test_each_two_anchors_with_given_positions_have_their_distance() -> None:
    anchors = [
        Anchor("A", np.zeros(3), position_stddev_m=0.03),
        Anchor("B"),
        Anchor("C", np.array([3.0, 4.0, 0.0]), position_stddev_m=0.04),
        Anchor("D", np.array([0.0, 0.0, 2.0])),
    ]
    found = {pair.ends: pair for pair in surveyed_distances(anchors)}
    assert set(found) == {("A", "C"), ("A", "D"), ("C", "D")}
    assert found["A", "C"].distance_m == 5.0
    assert found["A", "C"].stddev_m == pytest.approx(0.05)
    assert found["A", "C"].kind == CONTROL


def test_exact_positions_leave_a_stddev_to_divide_by() -> None:
    (pair,) = surveyed_distances([Anchor("A", np.zeros(3), 0.0), Anchor("B", np.ones(3), 0.0)])
    assert 0 < pair.stddev_m <= 0.001
