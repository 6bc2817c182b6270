"""Sides of printed tags as measured lengths, with the error of printing and that of the corners in the photos."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.measurements.lengths.tape import Marker
from rangesfm.sfm.tags import sides_of_tags


@pytest.mark.parametrize(("side_px", "stddev_m"), [(40.0, np.hypot(0.002, 0.2 * 0.2 / 40)), (1e6, 0.002)])
def test_the_stddev_of_a_side_is_that_of_printing_and_of_the_corners(side_px: float, stddev_m: float) -> None:
    corners = side_px * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    markers = {f"tag7.{k}": Marker(("a.jpg",), corners[k : k + 1], (0,), 0.3) for k in range(4)}
    sides = sides_of_tags(markers, 0.2, 0.002)
    assert [side.ends for side in sides] == [(f"tag7.{k}", f"tag7.{(k + 1) % 4}") for k in range(4)]
    assert {side.distance_m for side in sides} == {0.2}
    assert [side.stddev_m for side in sides] == pytest.approx([stddev_m] * 4)
