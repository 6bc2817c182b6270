"""The words about a map's tests: faults of single ranges, what comes before a cause, and what could stay hidden."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.diagnostics.test_linearized import ANCHORS_M, small_map, with_longer

from rangesfm.arrays import Array
from rangesfm.diagnostics import diagnosis
from rangesfm.diagnostics.diagnosis import (
    Diagnosis,
    _before_causes,
    _evidence,
    _lasting_m,
    _mixed_up,
    _row_of_cause,
    _seen,
    _what_could_hide,
    causes_in_words,
)
from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.diagnostics.linearized import Linearized, linearized
from rangesfm.diagnostics.scale_bound import HiddenMistake
from rangesfm.scale.scale_verdict import DOUBTFUL_ABOVE

# The 120 ranges of the small map are those to A, B and C in turns, 40 of each.
NUM = 120


@pytest.fixture(scope="module")
def problem() -> Linearized:
    return linearized(small_map((0.0, 0.0, 0.0)))


def shown(problem: Linearized, name: str, subject: str = "") -> MistakeTest:
    (row,) = [row for row in _evidence(problem) if (row.name, row.subject) == (name, subject)]
    return row


def with_weights(problem: Linearized, weights: Array, robust_weights: Array) -> Linearized:
    """Return the problem with other weights of its ranges, in the estimate and among neighbours."""
    bins = replace(problem.bins, robust_weight=robust_weights)
    return replace(problem, bins=bins, on_map=replace(problem.on_map, weights=weights))


def weights_of_a(values: Sequence[float]) -> Array:
    """Return weights of 1, but for the first ones to anchor A."""
    weights = np.ones(NUM)
    weights[: 3 * len(values) : 3] = values
    return weights


class TestEvidence:
    """Faults that are no mistake of one size are seen in single ranges."""

    def test_noise_and_lasting_errors_are_told_of_all_ranges_and_the_rest_of_each_anchor(
        self, problem: Linearized
    ) -> None:
        rows = [(row.name, row.subject) for row in _evidence(problem)]
        of_each = [(name, anchor) for anchor in "ABC" for name in ("anchor hardly used", "anchor's outliers")]
        assert rows == [("range noise", ""), ("lasting errors", ""), *of_each]

    @pytest.mark.parametrize(("over_m", "is_seen"), [(-0.001, False), (0.001, True)])
    def test_a_radio_over_a_long_distance_may_scatter_more(
        self, problem: Linearized, over_m: float, is_seen: bool
    ) -> None:
        """A quarter of a metre is usual, and half a centimetre more for each metre."""
        distance_m = problem.gradient.distance_m.mean()
        row = shown(replace(problem, scatter_m=0.25 + 0.005 * distance_m + over_m), "range noise")
        assert row.rejected == is_seen
        assert row.unit == "m"
        far = replace(problem.gradient, distance_m=np.full(60, 70.0))
        row = shown(replace(problem, scatter_m=0.6 + over_m, gradient=far), "range noise")
        assert row.rejected == is_seen
        assert row.words == (
            "the ranges scatter by 0.60 m from one to the next; radios with a clear line of sight stay below 0.60 m"
        )

    def test_errors_that_last_are_those_of_time_place_and_direction(self, problem: Linearized) -> None:
        names = ("white", "time", "place", "view", "drift")
        # Variances of 4, 9, 16 and 36 cm^2 of a bin.
        variances = np.array([900.0, 4.0, 9.0, 36.0, 900.0]) * 1e-4
        covariances = variances[:, None, None] * np.eye(60)
        errors = replace(problem.errors, names=names, stddevs=np.sqrt(variances), covariances_m2=covariances)
        assert _lasting_m(replace(problem, errors=errors)) == pytest.approx(0.07)
        far = replace(problem.gradient, distance_m=np.full(60, 10.0))
        row = shown(replace(problem, errors=errors, gradient=far), "lasting errors")
        said = "the ranges have errors of 0.07 m that last for seconds; "
        said += "radios with a clear line of sight stay below 0.30 m"
        assert row.words == said
        assert not row.rejected
        row = shown(replace(problem, errors=replace(errors, covariances_m2=19.0 * covariances), gradient=far), row.name)
        assert row.rejected
        assert row.unit == "m"

    def test_an_anchor_of_which_few_ranges_fit_the_map_is_hardly_used(self, problem: Linearized) -> None:
        ones = np.ones(NUM)
        # At least 40 % must fit: 16 of 40.
        row = shown(with_weights(problem, weights_of_a([0.05] * 24), ones), "anchor hardly used", "A")
        assert not row.rejected
        row = shown(with_weights(problem, weights_of_a([0.05] * 25), ones), "anchor hardly used", "A")
        assert row.rejected
        assert row.words == "15 of 40 ranges to anchor A fit the map"
        assert row.statistic == pytest.approx(25 / 40)
        assert not shown(with_weights(problem, weights_of_a([0.15] * 25), ones), "anchor hardly used", "A").rejected
        assert not shown(with_weights(problem, weights_of_a([0.05] * 25), ones), "anchor hardly used", "B").rejected

    def test_a_path_that_drifts_uses_the_ranges_that_agree_with_their_neighbours(
        self, problem: Linearized, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        off_map = with_weights(problem, weights_of_a([0.05] * 30), np.ones(NUM))
        assert shown(off_map, "anchor hardly used", "A").rejected
        monkeypatch.setattr(diagnosis, "drifts", lambda _: True)
        assert not shown(off_map, "anchor hardly used", "A").rejected

    def test_an_anchor_may_have_a_third_of_outliers(self, problem: Linearized) -> None:
        ones = np.ones(NUM)
        # At most 35 %: 14 of 40.
        row = shown(with_weights(problem, ones, weights_of_a([0.4] * 14)), "anchor's outliers", "A")
        assert not row.rejected
        row = shown(with_weights(problem, ones, weights_of_a([0.4] * 16)), "anchor's outliers", "A")
        assert row.rejected
        assert row.words == "40 % of the ranges to anchor A are far from those right before and after"
        assert not shown(with_weights(problem, ones, weights_of_a([0.6] * 16)), "anchor's outliers", "A").rejected
        assert not shown(with_weights(problem, ones, weights_of_a([0.4] * 16)), "anchor's outliers", "C").rejected

    @pytest.mark.parametrize(("num", "is_asked"), [(9, False), (10, True)])
    def test_ten_outliers_may_be_ranges_of_another_anchor(self, problem: Linearized, num: int, is_asked: bool) -> None:
        outlying = with_weights(problem, np.ones(NUM), weights_of_a([0.1] * num))
        found = [row.subject for row in _evidence(outlying) if row.name == "anchor mixed up"]
        assert found == (["A"] if is_asked else [])

    def test_a_single_anchor_is_not_mixed_up(self, problem: Linearized) -> None:
        outlying = with_weights(problem, np.ones(NUM), weights_of_a([0.1] * 20))
        on_map = outlying.on_map
        ids: Any = SimpleNamespace(
            observations=SimpleNamespace(log=SimpleNamespace(anchor_ids=("A",))), site=on_map.posed.site
        )
        index = np.where(on_map.problem.anchor_index == 0, 0, 0)
        alone = replace(on_map, posed=ids, problem=replace(on_map.problem, anchor_index=index))
        assert "anchor mixed up" not in {row.name for row in _evidence(replace(outlying, on_map=alone))}


class TestMixedUp:
    """Outliers of one anchor that are as long as the ranges to another one are taken for those."""

    ROWS = np.arange(0, 60, 3)

    def read(self, problem: Linearized, num: int, off_m: float = 0.0) -> MistakeTest:
        """Return the test where ``num`` of twenty outliers to A are the distances to C, but for an error."""
        on_map = problem.on_map
        tags_m = on_map.from_anchor_m + ANCHORS_M[on_map.problem.anchor_index]
        to_c_m = np.linalg.norm(tags_m - ANCHORS_M[2], axis=1)
        range_m = on_map.problem.range_m + 20.0
        rows = self.ROWS[:num]
        range_m[rows] = to_c_m[rows] + off_m
        changed = replace(problem, on_map=replace(on_map, problem=replace(on_map.problem, range_m=range_m)))
        return _mixed_up(changed, 0, self.ROWS)

    def test_half_of_them_must_fit_one_other_anchor(self, problem: Linearized) -> None:
        assert not self.read(problem, 10).rejected
        row = self.read(problem, 11)
        assert row.rejected
        assert (row.name, row.subject) == ("anchor mixed up", "A")
        assert row.size == pytest.approx(0.55)
        assert row.words == "55 % of the outliers among the ranges to anchor A fit anchor C instead"
        assert "two devices have the id A" in row.remedy

    def test_they_fit_as_well_as_ranges_scatter(self, problem: Linearized) -> None:
        # Three times 8 cm, the least scatter, or three times the own one.
        for off_m in (0.23, -0.23):
            assert self.read(problem, 20, off_m).size == 1.0
        for off_m in (0.25, -0.25):
            assert self.read(problem, 20, off_m).size == 0.0
            assert self.read(replace(problem, scatter_m=0.1), 20, off_m).size == 1.0

    def test_ranges_that_fit_their_own_anchor_are_not_mixed_up(self, problem: Linearized) -> None:
        row = _mixed_up(replace(problem, scatter_m=0.1), 0, self.ROWS)
        # They read 0.1 m more than the distance to A, their own delay.
        assert row.size is not None
        assert row.size < 1.0


class TestBeforeCauses:
    """Blocked ranges come before a cause that they look like."""

    @staticmethod
    def cause(problem: Linearized, subject: str, longer_m: Array) -> Any:
        """Return a cause that takes (n,) metres from the ranges."""
        on_map = problem.on_map
        return SimpleNamespace(subject=subject, state=on_map.state, undone=lambda of: with_longer(of, -longer_m))

    def found(
        self, problem: Linearized, rows: Sequence[MistakeTest], subject: str = "A", longer_m: float | Array = 0.1
    ) -> list[MistakeTest]:
        causes = (self.cause(problem, subject, np.broadcast_to(longer_m, NUM)),)
        findings: Any = SimpleNamespace(causes=causes, problem=problem)
        return _before_causes(findings, rows)

    @staticmethod
    def row(name: str, subject: str, found: float, most: float = 0.25) -> MistakeTest:
        return _seen(name, subject, found, most, "", "")

    @pytest.fixture
    def remains(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let all faults of single ranges remain when the cause is undone."""
        names = ("range noise", "anchor's outliers", "anchor hardly used", "lasting errors")
        left = [self.row(name, subject, 1.0) for name in names for subject in ("", "A", "AB")]
        monkeypatch.setattr(diagnosis, "_evidence", lambda _: iter(left))

    @pytest.mark.usefixtures("remains")
    def test_faults_of_the_cause_s_own_anchor_count(self, problem: Linearized) -> None:
        of_a = self.row("anchor's outliers", "A", 0.4)
        assert self.found(problem, [of_a]) == [of_a]
        assert self.found(problem, [of_a], "A x") == [of_a]
        assert self.found(problem, [of_a], "B") == []
        assert self.found(problem, [of_a], "AB") == []
        assert self.found(problem, [of_a], "") == []

    @pytest.mark.usefixtures("remains")
    def test_noise_of_all_ranges_counts_if_the_cause_changes_less(self, problem: Linearized) -> None:
        noise = self.row("range noise", "", 0.3)
        assert self.found(problem, [noise], "B", 0.29) == [noise]
        assert self.found(problem, [noise], "B", 0.31) == []
        # Ranges of which a quarter changes by 0.58 or 0.62 m have changed by half of that in the mean.
        for large_m, expected in ((0.58, [noise]), (0.62, [])):
            longer_m = np.where(np.arange(NUM) % 4 == 0, large_m, 0.0)
            assert self.found(problem, [noise], "B", longer_m) == expected

    @pytest.mark.usefixtures("remains")
    def test_only_faults_of_single_ranges_that_were_seen_count(self, problem: Linearized) -> None:
        assert self.found(problem, [self.row("anchor's outliers", "A", 0.2)]) == []
        assert self.found(problem, [self.row("anchor hardly used", "A", 0.9)]) == []
        assert self.found(problem, [self.row("lasting errors", "", 0.9)]) == []
        nothing: Any = SimpleNamespace(causes=(), problem=problem)
        assert _before_causes(nothing, [self.row("anchor's outliers", "A", 0.4)]) == []

    def test_what_the_cause_explains_does_not_count(self, problem: Linearized) -> None:
        """The ranges of the small map have no noise and no outliers, whatever the cause takes from all of them."""
        assert self.found(problem, [self.row("anchor's outliers", "A", 0.4)]) == []
        assert self.found(problem, [self.row("range noise", "", 0.4)]) == []

    def test_ranges_of_another_anchor_are_never_explained(self, problem: Linearized) -> None:
        mixed_up = self.row("anchor mixed up", "A", 0.9, 0.5)
        assert self.found(problem, [mixed_up]) == [mixed_up]
        assert self.found(problem, [mixed_up], "B") == []


class TestHidden:
    """The worst mistake that nothing would show is named if it does more than a good scale may be off by."""

    @staticmethod
    def hidden(
        key: tuple[str, str] = ("clock offset", ""),
        effect: float = 0.05,
        smallest: float = 0.5,
        unnoticed: float = np.inf,
        *,
        is_in_interval: bool = False,
    ) -> Any:
        hypothesis = SimpleNamespace(
            key=key, most_unnoticed=unnoticed, unit="s", remedy="look", is_in_interval=is_in_interval
        )
        return SimpleNamespace(hypothesis=hypothesis, effect_on_log_scale=effect, smallest_detectable=smallest)

    @staticmethod
    def told(*tests: Any) -> list[str]:
        findings: Any = SimpleNamespace(tests=tests)
        return list(_what_could_hide(findings))

    def test_it_is_told_with_the_smallest_size_that_is_found(self) -> None:
        said = (
            "the ranges cannot show every mistake that matters: an error of 0.5 s (time offset of the clocks) would go "
            "unnoticed and change the scale by 5.0 %; tape a length between two distant points as a check, or look"
        )
        assert self.told(self.hidden()) == [said]
        of_b = self.hidden(("anchor place", "B"), effect=0.06)
        (told,) = self.told(self.hidden(), of_b, self.hidden())
        assert "0.5 s (position of anchor B) would go unnoticed and change the scale by 6.0 %" in told

    def test_a_surveyor_notices_what_is_large(self) -> None:
        # Half of what the test would find is noticed anyway, with half of its effect.
        (told,) = self.told(self.hidden(effect=0.10, unnoticed=0.25))
        assert "0.25 s (time offset of the clocks) would go unnoticed and change the scale by 5.0 %" in told
        (told,) = self.told(self.hidden(effect=0.10, unnoticed=0.25), self.hidden(("step", ""), effect=0.06))
        assert "0.5 s (jump of all ranges) would go unnoticed and change the scale by 6.0 %" in told

    def test_a_small_change_of_the_scale_need_not_be_feared(self) -> None:
        assert self.told(self.hidden(effect=1.01 * DOUBTFUL_ABOVE))
        assert not self.told(self.hidden(effect=0.99 * DOUBTFUL_ABOVE))
        assert not self.told()

    def test_what_the_interval_includes_or_nothing_limits_is_not_told(self) -> None:
        assert not self.told(self.hidden(is_in_interval=True))
        assert not self.told(self.hidden(effect=np.inf))


class TestCauses:
    """The likeliest cause is told with its statistic, beside those that look alike."""

    @staticmethod
    def cause(words: str, remedy: str, gain: float, statistic: float | None = None) -> Any:
        test = None if statistic is None else SimpleNamespace(statistic=statistic)
        return SimpleNamespace(
            words=words, remedy=remedy, gain=gain, test=test, name="swapped", subject="A, B", penalty=7.0
        )

    def test_one_cause_is_probable(self) -> None:
        assert causes_in_words([self.cause("it slipped", "fix it", 100.0)]) == (
            "probably it slipped (10 stddevs): fix it"
        )

    def test_its_statistic_is_that_of_its_test_or_of_the_errors_that_it_leaves(self) -> None:
        assert "(12 stddevs)" in causes_in_words([self.cause("", "", 100.0, 144.0)])
        assert "(10 stddevs)" in causes_in_words([self.cause("", "", 100.0, 64.0)])

    def test_causes_that_look_alike_are_all_told_and_equal_remedies_once(self) -> None:
        causes = [self.cause(words, remedy, 100.0) for words, remedy in (("a", "x"), ("b", "y"), ("c", "x"))]
        assert causes_in_words(causes) == "either a, or b, or c (10 stddevs; the ranges do not tell which): x; or y"

    def test_an_alternative_has_the_row_of_its_gain(self) -> None:
        row = _row_of_cause(self.cause("swapped", "look", 100.0))
        assert (row.name, row.subject, row.statistic, row.threshold) == ("swapped", "A, B", 100.0, 7.0)
        assert (row.words, row.remedy) == ("swapped", "look")


def test_tests_of_something_else_come_first_and_their_reasons_last() -> None:
    def of(name: str) -> Diagnosis:
        row = MistakeTest(name, "", 0.0, 1.0, "", "")
        return Diagnosis((row,), (name,), hidden=(HiddenMistake(name, 0.1, 9.0, 1, 0.1),))

    both = of("ranges").with_more(of("points"))
    assert [row.name for row in both.tests] == ["points", "ranges"]
    assert both.reasons == ("ranges", "points")
    assert len(both.hidden) == 2
