"""Statements about measured lengths."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from tests.known import known
from tests.studies.erring_surveys import SITES, run, surveyed

from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.diagnostics.length_tests import against_other, diagnose_lengths
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.scale.linear_map import noncentrality
from rangesfm.scale.scale_by_lengths import LengthScale, ScaleByKind, scale_by_lengths


def test_of_a_tape_between_points_that_are_not_in_the_map_nothing_is_said() -> None:
    estimate = run(surveyed(SITES[2], 3), 3).estimate
    assert estimate is not None
    assert estimate.lengths is None
    elsewhere = Tape((TapedDistance(("door", "window"), 2.0, 0.01, "control", 2),))
    found = diagnose_lengths(estimate, elsewhere)
    assert (found.tests, found.reasons) == ((), ())


def test_what_a_length_could_do_unfound_is_what_the_scale_does_when_it_is_so_much_longer() -> None:
    estimate = known(run(surveyed(SITES[2], 3), 3).estimate)
    lengths_m, stddevs_m = np.array([2.0, 3.0, 4.0]), np.array([0.01, 0.01, 0.02])
    centers = np.random.default_rng(0).standard_normal((20, 3))
    located = LocatedDistances.of(lengths_m, stddevs_m, model_length=lengths_m / 2)
    tape = Tape(tuple(TapedDistance((f"{k}a", f"{k}b"), float(lengths_m[k]), 0.01, "control", k) for k in range(3)))
    scale = known(scale_by_lengths(located, centers))
    found = {test.subject: test for test in diagnose_lengths(replace(estimate, lengths=scale), tape).tests}
    for k, step_m in enumerate(1e-4 * np.eye(3)):
        longer = known(scale_by_lengths(replace(located, distance_m=lengths_m + step_m), centers))
        test = found[f"{k}a to {k}b"]
        by_metre = abs(longer.value / scale.value - 1) / 1e-4
        assert test.effect_on_scale == pytest.approx(by_metre * known(test.smallest_detectable), rel=0.02)
        assert test.size == pytest.approx(0.0, abs=1e-6)


# Four lengths: one that agrees, one of which nothing is known, one that is too long and one that is left out.
SCALE = LengthScale(
    value=2.0,
    components={"tape": 0.01},
    rows=np.array([3, 1, 0, 2]),
    is_kept=np.array([True, True, True, False]),
    too_long_m=np.array([0.01, 0.0, 0.06, -0.2]),
    stddev_m=np.array([0.01, np.inf, 0.015, 0.02]),
    redundancy=np.array([0.6, 0.0, 0.8, 0.9]),
    threshold=np.array([9.0, 9.0, 9.5, 10.0]),
    by_metre=np.array([-0.2, 0.3, 0.4, 0.0]),
)
TAPE = Tape(
    tuple(
        TapedDistance((f"{name}1", f"{name}2"), length_m, 0.01, "control", 2, is_printed)
        for name, length_m, is_printed in (
            ("long", 3.0, True),
            ("alone", 2.5, False),
            ("out", 4.0, False),
            ("right", 2.0, True),
        )
    )
)


def estimate_of(by_kind: dict[str, ScaleByKind] | None = None, lengths: LengthScale | None = SCALE) -> Any:
    return SimpleNamespace(lengths=lengths, by_kind=by_kind or {})


def test_each_length_has_a_row_with_what_all_else_gives_for_it() -> None:
    """Sides of printed tags are only shown if they are wrong; what exceeds its threshold most comes first."""
    out, long, alone = diagnose_lengths(estimate_of(), TAPE).tests
    assert [row.subject for row in (out, long, alone)] == ["out1 to out2", "long1 to long2", "alone1 to alone2"]
    assert out.words == "the length from out1 to out2 is given as 4.000 m, but all else gives 4.200 m (-0.200 m)"
    assert out.statistic == pytest.approx(100.0)
    assert (out.threshold, out.redundancy) == (10.0, 0.9)
    assert (long.name, long.unit, long.size, long.stddev, long.is_checked) == ("length", "m", 0.06, 0.015, True)
    assert long.statistic == pytest.approx(16.0)
    assert long.smallest_detectable == pytest.approx(np.sqrt(noncentrality(1)) * 0.015)
    assert long.effect_on_scale == pytest.approx(0.4 * np.sqrt(noncentrality(1)) * 0.015)
    assert (alone.statistic, alone.is_checked, alone.size) == (0.0, False, None)
    assert (alone.stddev, alone.smallest_detectable, alone.effect_on_scale) == (None, None, None)
    assert alone.words.endswith("is given as 2.500 m, but all else gives 2.500 m (0.000 m)")


def test_an_effect_on_the_scale_has_no_sign() -> None:
    printed = replace(TAPE, distances=tuple(replace(one, is_printed=False) for one in TAPE.distances))
    right = next(row for row in diagnose_lengths(estimate_of(), printed).tests if row.subject == "right1 to right2")
    assert right.effect_on_scale == pytest.approx(0.2 * np.sqrt(noncentrality(1)) * 0.01)
    assert right.statistic == pytest.approx(1.0)
    assert not right.rejected


def test_lengths_that_are_left_out_or_contradict_the_others_are_said() -> None:
    left_out, either = diagnose_lengths(estimate_of(), TAPE).reasons
    out, long, _ = diagnose_lengths(estimate_of(), TAPE).tests
    again = "look whether it was mistyped, or measure it again"
    assert left_out == f"probably {out.words} (10 stddevs): {again}; it is left out"
    assert either == f"either {long.words}: {again}"
    both = replace(SCALE, is_kept=np.ones(4, dtype=bool))
    (either,) = diagnose_lengths(estimate_of(lengths=both), TAPE).reasons
    assert either == f"either {long.words}; or {out.words}: {again}"
    none = replace(SCALE, is_kept=np.ones(4, dtype=bool), too_long_m=np.zeros(4))
    assert diagnose_lengths(estimate_of(lengths=none), TAPE).reasons == ()


def test_without_lengths_or_without_a_tape_nothing_is_tested() -> None:
    assert diagnose_lengths(estimate_of(lengths=None), TAPE).tests == ()
    assert diagnose_lengths(estimate_of(), None).tests == ()


def compared(by_lengths: float, stddev: float = 0.006, other: str = "ranges") -> MistakeTest:
    """The scale by lengths against one of 2 by another kind, with a relative standard deviation of 0.8 %."""
    scales = {"lengths": ScaleByKind(by_lengths, stddev * by_lengths), other: ScaleByKind(2.0, 0.016)}
    (row,) = against_other(estimate_of(scales), "lengths", other, "calibrate")
    return row


@pytest.mark.parametrize(("off", "is_rejected"), [(0.0232, False), (0.0234, True), (-0.0232, False), (-0.0234, True)])
def test_two_kinds_of_measurement_differ_beyond_what_their_errors_explain(off: float, is_rejected: bool) -> None:
    """Together they have 1 %, and a normal error exceeds 2.326 of that in 2 % of the cases."""
    row = compared(2.0 * np.exp(off))
    assert row.rejected == is_rejected
    assert row.statistic == pytest.approx((off / 0.01) ** 2)
    assert row.threshold == pytest.approx(stats.chi2.isf(0.02, 1))
    assert row.size == pytest.approx(off)
    assert row.stddev == pytest.approx(0.01)
    assert row.smallest_detectable == pytest.approx(0.01 * np.sqrt(noncentrality(1)))
    assert row.effect_on_scale == row.smallest_detectable
    assert (row.name, row.subject, row.unit, row.remedy) == ("lengths against ranges", "", "1", "calibrate")


def test_the_difference_of_two_kinds_is_said_in_percent() -> None:
    assert compared(2.1).words == (
        "by the measured lengths the map is +5.0 % larger than by the ranges; their errors together explain 1.0 % "
        "(1 stddev)"
    )
    assert compared(1.9, other="positions").words.startswith(
        "by the measured lengths the map is -5.0 % larger than by the known positions; their"
    )


def test_a_kind_that_determines_no_scale_contradicts_none() -> None:
    row = compared(2.1, stddev=np.inf)
    assert (row.statistic, row.stddev, row.smallest_detectable) == (0.0, None, None)
    assert list(against_other(estimate_of({"lengths": ScaleByKind(2.0, 0.1)}), "lengths", "ranges", "")) == []
    assert list(against_other(estimate_of({"ranges": ScaleByKind(2.0, 0.1)}), "lengths", "ranges", "")) == []


def test_lengths_are_compared_with_ranges_and_with_positions_and_the_sharper_bounds_what_hides() -> None:
    scales = {
        "lengths": ScaleByKind(2.1, 0.006 * 2.1),
        "ranges": ScaleByKind(2.0, 0.008 * 2.0),
        "positions": ScaleByKind(2.1, 0.0008 * 2.1),
    }
    found = diagnose_lengths(estimate_of(scales), TAPE)
    of_ranges, of_positions = found.tests[-2:]
    assert [of_ranges.name, of_positions.name] == ["lengths against ranges", "lengths against positions"]
    assert found.reasons[2:] == (f"{of_ranges.words}: measure a length again, and calibrate the radio",)
    assert found.hidden[-1].words == "lengths"
    assert found.hidden[-1].slope == pytest.approx(np.hypot(0.006, 0.0008))
    # Without another kind, the length that nothing checks may hide anything.
    assert diagnose_lengths(estimate_of(), TAPE).hidden[-1].slope == np.inf
    assert len(diagnose_lengths(estimate_of(), TAPE).hidden) == 4
    contradicted = {**scales, "positions": ScaleByKind(1.9, 0.001)}
    assert (
        diagnose_lengths(estimate_of(contradicted), TAPE)
        .reasons[-1]
        .endswith(": measure a length again, and look at the units of both")
    )
