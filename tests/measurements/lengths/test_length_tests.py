"""Statements about measured lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.known import known

from rangesfm.measurements.lengths.length_scale import LengthScale, lengths_between_points
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.lengths.tape import TapedDistance
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.trajectory import Trajectory


def test_what_a_length_could_do_unfound_is_what_the_scale_does_when_it_is_so_much_longer() -> None:
    lengths_m, stddevs_m = np.array([2.0, 3.0, 4.0]), np.array([0.01, 0.01, 0.02])
    names, still = tuple(f"{k}.jpg" for k in range(20)), np.tile(np.eye(3), (20, 1, 1))
    centers = np.random.default_rng(0).standard_normal((20, 3))
    path = Trajectory(np.arange(20), names, np.arange(20.0), centers, still)

    def by(distances: LocatedDistances) -> LengthScale:
        lengths = known(lengths_between_points(distances, WalkBending(path), taped=taped))
        return lengths.tested(lengths.start, ())

    located = LocatedDistances.between_points(lengths_m, stddevs_m, lengths_m / 2)
    taped = tuple(TapedDistance((f"{k}a", f"{k}b"), float(lengths_m[k]), 0.01, "control", k) for k in range(3))
    scale = by(located)
    found = {test.subject: test for test in scale.tests(scale.alone, {}).tests}
    for k, step_m in enumerate(1e-4 * np.eye(3)):
        longer = by(replace(located, distance_m=lengths_m + step_m))
        test = found[f"{k}a to {k}b"]
        by_metre = abs(longer.alone.scale.value / scale.alone.scale.value - 1) / 1e-4
        assert test.effect_on_scale == pytest.approx(by_metre * test.smallest_detectable, rel=0.02)
        assert test.size == pytest.approx(0.0, abs=1e-6)
