"""Statements about measured lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.known import known
from tests.simulated.runs import run
from tests.simulated.surveys import SITES, surveyed

from rangesfm.diagnostics.length_tests import diagnose_lengths
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.inference.bending import WalkBending
from rangesfm.scale.scale_by_lengths import LengthScale, lengths_between_points


def test_of_a_tape_between_points_that_are_not_in_the_map_nothing_is_said() -> None:
    estimate = run(surveyed(SITES[2], 3), 3).estimate
    assert estimate is not None
    elsewhere = Tape((TapedDistance(("door", "window"), 2.0, 0.01, "control", 2),))
    found = diagnose_lengths(estimate.find(LengthScale), estimate, elsewhere)
    assert (found.tests, found.reasons) == ((), ())


def test_what_a_length_could_do_unfound_is_what_the_scale_does_when_it_is_so_much_longer() -> None:
    estimate = known(run(surveyed(SITES[2], 3), 3).estimate)
    lengths_m, stddevs_m = np.array([2.0, 3.0, 4.0]), np.array([0.01, 0.01, 0.02])
    names, still = tuple(f"{k}.jpg" for k in range(20)), np.tile(np.eye(3), (20, 1, 1))
    centers = np.random.default_rng(0).standard_normal((20, 3))
    path = Trajectory(np.arange(20), names, np.arange(20.0), centers, still)

    def by(distances: LocatedDistances) -> LengthScale:
        lengths = known(lengths_between_points(distances, path, WalkBending(path)))
        return lengths.tested(lengths.start, ())

    located = LocatedDistances.of(lengths_m, stddevs_m, model_length=lengths_m / 2)
    tape = Tape(tuple(TapedDistance((f"{k}a", f"{k}b"), float(lengths_m[k]), 0.01, "control", k) for k in range(3)))
    scale = by(located)
    found = {test.subject: test for test in diagnose_lengths(scale, estimate, tape).tests}
    for k, step_m in enumerate(1e-4 * np.eye(3)):
        longer = by(replace(located, distance_m=lengths_m + step_m))
        test = found[f"{k}a to {k}b"]
        by_metre = abs(longer.alone.scale.value / scale.alone.scale.value - 1) / 1e-4
        assert test.effect_on_scale == pytest.approx(by_metre * known(test.smallest_detectable), rel=0.02)
        assert test.size == pytest.approx(0.0, abs=1e-6)
