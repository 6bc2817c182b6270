"""Ranges as they would be without a mistake."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.studies.erring_surveys import SITES, run, surveyed

from rangesfm.diagnostics.hypothesis import Correction, corrected


@pytest.mark.parametrize(("shift_s", "expected"), [(0.4, (0.4, 10.4, 20.4)), (-0.4, (-0.4, 9.6, 19.6))])
def test_a_range_of_another_time_was_taken_beside_the_one_that_is_nearest_to_it(
    shift_s: float, expected: tuple[float, ...]
) -> None:
    on_map = run(surveyed(SITES[2], 3), 3).on_map
    assert on_map is not None
    # The camera is 10 units farther each second, and moves at 1 unit a second at each range.
    num = len(on_map.time_s)
    centers = np.outer(10.0 * np.arange(num), [1.0, 0, 0])
    on_map = replace(
        on_map,
        problem=replace(on_map.problem, centers=centers),
        time_s=np.arange(num, dtype=np.float64),
        velocity=np.tile([1.0, 0, 0], (num, 1)),
    )
    found = corrected(on_map, Correction(time_shift_s=np.full(num, shift_s)))
    np.testing.assert_allclose(found.problem.centers[:3, 0], expected, atol=1e-9)
