"""What is said of measured lengths."""

from __future__ import annotations

from tests.studies.erring_surveys import SITES, run, surveyed

from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.trust.lengths import trust_in_lengths


def test_of_a_tape_between_points_that_are_not_in_the_map_nothing_is_said() -> None:
    estimate = run(surveyed(SITES[2], 3), 3).estimate
    assert estimate is not None
    assert estimate.lengths is None
    elsewhere = Tape((TapedDistance(("door", "window"), 2.0, 0.01, "control", 2),))
    found = trust_in_lengths(estimate, elsewhere)
    assert (found.tests, found.reasons) == ((), ())
