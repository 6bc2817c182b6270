"""Mistakes that begin or end at some time: which times are tried, what changes then, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.diagnostics.test_linearized import ANCHORS_M, slopes, small_map
from tests.known import known

from rangesfm.arrays import Array, Mask
from rangesfm.diagnostics import timed_hypotheses
from rangesfm.diagnostics.hypothesis import Correction, Effect, Hypothesis, corrected
from rangesfm.diagnostics.linearized import Linearized, linearized
from rangesfm.diagnostics.timed_hypotheses import _changes, _shares_after, _when, _windows

# The 120 ranges of the small map, in 20 bins of each anchor, begin at 5 s and last for 9.75 s.
NUM, NUM_BINS, BEGIN_S, LASTS_S = 120, 60, 5.0, 9.75


@pytest.fixture(scope="module")
def problem() -> Linearized:
    return linearized(small_map((0.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def of_kind(problem: Linearized) -> dict[str, list[Hypothesis]]:
    """All mistakes with a time, by name."""
    found: dict[str, list[Hypothesis]] = {}
    for each in (h for hypotheses in timed_hypotheses.SCANNING for h in hypotheses(problem)):
        found.setdefault(each.name, []).append(each)
    return found


def instant(problem: Linearized, num_bins: int) -> Linearized:
    """Return a problem whose ranges are bins of their own, a second apart, of the anchors A and B in turns."""
    bins = replace(
        problem.bins,
        of_range=np.arange(num_bins),
        robust_weight=np.ones(num_bins),
        worth=np.ones(num_bins),
        anchor_index=np.arange(num_bins) % 2,
    )
    ranges = problem.on_map.problem.subset(np.arange(num_bins) % NUM)
    on_map = replace(
        problem.on_map,
        problem=replace(ranges, anchor_index=np.arange(num_bins) % 2),
        time_s=np.arange(num_bins, dtype=np.float64),
    )
    return replace(problem, bins=bins, on_map=on_map, residual_m=np.zeros(num_bins))


class TestSharesAfter:
    """A bin may be later than some time with a part of its weight."""

    def shares(self, times: list[float]) -> Array:
        class Bins(SimpleNamespace):
            def __len__(self) -> int:
                return 2

        # The first bin has the weights 1, 1 and 2 at 0, 1 and 2 s, the second 1 and 3 at 0 and 3 s.
        bins = Bins(
            of_range=np.array([0, 0, 0, 1, 1]),
            robust_weight=np.array([1.0, 1.0, 2.0, 1.0, 3.0]),
            worth=np.array([4.0, 4.0]),
        )
        problem: Any = SimpleNamespace(bins=bins, on_map=SimpleNamespace(time_s=np.array([0.0, 1.0, 2.0, 0.0, 3.0])))
        return _shares_after(problem, np.array(times))

    def test_it_is_the_weight_of_the_later_ranges(self) -> None:
        np.testing.assert_allclose(
            self.shares([-1.0, 0.5, 1.5, 2.5]), [[1.0, 1.0], [0.75, 0.75], [0.5, 0.75], [0.0, 0.75]]
        )

    def test_a_range_at_the_very_time_is_not_later(self) -> None:
        np.testing.assert_allclose(self.shares([0.0, 1.0, 3.0]), [[0.75, 0.75], [0.5, 0.75], [0.0, 0.0]])


class TestTimes:
    """Changes are tried away from the ends of the survey, where enough is measured on both sides."""

    @staticmethod
    def tried(
        problem: Linearized, anchor: int | None, least: int, around: float | None = None
    ) -> list[tuple[float, Mask, Array, Hypothesis]]:
        """Return for each change its time, the later ranges, the later shares of the bins, and what was made."""
        found: list[tuple[float, Mask, Array]] = []

        def change(_: str, later: Callable[[], Mask], after: Array) -> Hypothesis:
            start: float = later.args[2]  # type: ignore[attr-defined]
            found.append((start, later(), after))
            none = Effect(np.zeros((len(after), 1)), np.zeros((0, 1)))
            return Hypothesis("change", none, str, "", lambda _: Correction(), 1.0)

        made = list(_changes(problem, anchor, least, change, around))
        return [(*each, h) for each, h in zip(found, made, strict=True)]

    def test_they_are_in_the_middle_ten_twelfths_of_the_survey(self, problem: Linearized) -> None:
        times = [time for time, *_ in self.tried(problem, None, 1)]
        assert len(times) == 32
        assert times == sorted(times)
        assert times[0] == pytest.approx(BEGIN_S + LASTS_S / 12, abs=0.13)
        assert times[-1] == pytest.approx(BEGIN_S + LASTS_S * 11 / 12, abs=0.13)

    def test_a_twelfth_of_the_survey_is_before_the_first_and_after_the_last(self, problem: Linearized) -> None:
        times = [time for time, *_ in self.tried(instant(problem, 121), None, 0)]
        np.testing.assert_allclose(times, np.linspace(10.0, 110.0, 32))

    def test_each_separates_what_is_earlier_from_what_is_later(self, problem: Linearized) -> None:
        for time, later, after, _ in self.tried(problem, None, 1):
            np.testing.assert_array_equal(later, problem.on_map.time_s > time)
            np.testing.assert_allclose(after, problem.bins.mean(later.astype(np.float64)))

    def test_a_change_of_one_anchor_is_one_of_its_own_ranges(self, problem: Linearized) -> None:
        for time, later, after, _ in self.tried(problem, 1, 1):
            is_of = problem.on_map.problem.anchor_index == 1
            np.testing.assert_array_equal(later, is_of & (problem.on_map.time_s > time))
            np.testing.assert_allclose(after, problem.bins.mean(later.astype(np.float64)))

    @pytest.mark.parametrize("anchor", [None, 1])
    def test_it_needs_some_bins_of_its_own_on_both_sides(self, problem: Linearized, anchor: int | None) -> None:
        small = instant(problem, 48)
        num = 48 if anchor is None else 24
        every = [float(after.sum()) for _, _, after, _ in self.tried(small, anchor, 0)]
        for least in (num // 4, num // 3):
            found = [float(after.sum()) for _, _, after, _ in self.tried(small, anchor, least)]
            assert found == [each for each in every if each >= least and num - each >= least]
            assert min(found) == least
            assert max(found) == num - least

    def test_the_best_time_is_refined_between_its_neighbours(self, problem: Linearized) -> None:
        tried = self.tried(problem, None, 1)
        times = [time for time, *_ in tried]
        # The middle one, and the first and the last, which have a neighbour on one side only.
        for at, low, high in ((15, 14, 16), (0, 0, 1), (31, 30, 31)):
            finer = [time for time, *_ in self.tried(problem, None, 1, around=times[at])]
            assert len(finer) == 17
            np.testing.assert_allclose(finer, np.linspace(times[low], times[high], 17))
        refine = tried[15][3].refine_time
        assert refine is not None
        assert len(list(refine())) == 17

    def test_a_time_is_told_from_the_first_range(self, problem: Linearized) -> None:
        assert _when(problem, 12.0) == "7 s after the first range"
        assert _when(problem, 12.0, 14.0) == "from 7 to 9 s after the first range"
        assert _when(replace(problem, by_time=None), 12.0, 14.0) == "from 7 to 9 m along the path"


def test_stretches_last_for_a_quarter_an_eighth_or_a_sixteenth_of_the_survey(problem: Linearized) -> None:
    windows = list(_windows(problem))
    # Each begins half its length after the one before: 2 / share - 1 fit into the survey.
    assert len(windows) == 7 + 15 + 31
    row = 0
    for share, num in ((1 / 4, 7), (1 / 8, 15), (1 / 16, 31)):
        of_share = windows[row : row + num]
        starts, ends = (np.array([window[k] for window in of_share]) for k in (0, 1))
        # Ranges come by threes four times a second, so that a quantile is off by so much.
        np.testing.assert_allclose(starts, BEGIN_S + LASTS_S * share / 2 * np.arange(num), atol=0.25)
        np.testing.assert_allclose(ends - starts, LASTS_S * share, atol=0.25)
        assert ends[-1] == BEGIN_S + LASTS_S
        row += num
    for start, end, share_inside in windows:
        inside = (problem.on_map.time_s > start) & (problem.on_map.time_s <= end)
        np.testing.assert_allclose(share_inside, problem.bins.mean(inside.astype(np.float64)), atol=1e-12)


def test_every_kind_of_mistake_with_a_time_is_tried(of_kind: dict[str, list[Hypothesis]]) -> None:
    assert list(of_kind) == [
        *("anchor moved", "map break", "tag slipped", "anchor step", "step", "anchor stretch", "stretch", "clock jump"),
    ]
    for name in ("anchor moved", "anchor step", "anchor stretch"):
        assert {each.subject for each in of_kind[name]} == set("ABC")
    for name in ("map break", "tag slipped", "step", "stretch", "clock jump"):
        assert {each.subject for each in of_kind[name]} == {""}
    assert {name for name, found in of_kind.items() if all(each.is_linear for each in found)} == {
        *("anchor step", "step", "anchor stretch", "stretch", "clock jump"),
    }
    # What is left out where it is adopted are the ranges that it changes.
    for name in ("anchor moved", "map break", "tag slipped", "anchor stretch", "stretch"):
        first = of_kind[name][0]
        assert first.adoption is not None
        size = np.full(first.num, 0.5)
        changed = known(first.correction(size).longer_m) != 0
        assert 0 < np.count_nonzero(changed) < NUM
        np.testing.assert_array_equal(known(first.adoption(size).left_out), changed)


def test_a_correction_takes_from_the_residuals_what_the_change_has_added(
    problem: Linearized, of_kind: dict[str, list[Hypothesis]]
) -> None:
    for found in of_kind.values():
        each = found[len(found) // 2]

        def residual_m(size: Array, each: Hypothesis = each) -> Array:
            return problem.bins.mean(corrected(problem.on_map, each.correction(size)).residual_m)

        # A bin's ranges differ in their direction by as much as the tag has moved between them.
        np.testing.assert_allclose(each.effect.columns, -slopes(residual_m, each.num), atol=0.07, err_msg=each.name)
        assert np.abs(each.effect.columns).max() > 0.5
        assert not each.effect.priors.any()


class TestMoves:
    """Anchors, the tag and the map may be elsewhere after some time."""

    SIZE_M = np.array([0.3, -0.4, 1.2])

    def test_a_large_move_of_an_anchor_is_corrected_exactly(
        self, problem: Linearized, of_kind: dict[str, list[Hypothesis]]
    ) -> None:
        moved = next(each for each in of_kind["anchor moved"] if each.subject == "B")
        longer_m = known(moved.correction(self.SIZE_M).longer_m)
        tags_m = problem.on_map.from_anchor_m + ANCHORS_M[problem.on_map.problem.anchor_index]
        grown_m = np.linalg.norm(tags_m - (ANCHORS_M[1] + self.SIZE_M), axis=1) - np.linalg.norm(
            tags_m - ANCHORS_M[1], axis=1
        )
        changed = longer_m != 0
        np.testing.assert_allclose(longer_m[changed], grown_m[changed])
        assert set(problem.on_map.problem.anchor_index[changed]) == {1}

    def test_what_moved_is_told(self, of_kind: dict[str, list[Hypothesis]]) -> None:
        told = {name: of_kind[name][0].words(self.SIZE_M) for name in ("anchor moved", "map break", "tag slipped")}
        assert told == {
            "anchor moved": "anchor A was moved 4 s after the first range, by about 1.30 m "
            "(+0.30, -0.40, +1.20 m in x, y, z)",
            # Where the map should be is back from where it is.
            "map break": "the map breaks 1 s after the first range: its later part lies about 1.30 m from where it "
            "should (-0.30, +0.40, -1.20 m in x, y, z)",
            "tag slipped": "the tag slipped 1 s after the first range: since then it sits about 1.30 m elsewhere on "
            "the camera (+0.30, -0.40, +1.20 m along the camera's x, y, z)",
        }

    def test_what_moved_stays_within_reach(self, problem: Linearized, of_kind: dict[str, list[Hypothesis]]) -> None:
        on_map = problem.on_map
        tags_m = on_map.from_anchor_m + ANCHORS_M[on_map.problem.anchor_index]
        assert of_kind["anchor moved"][0].most == pytest.approx(2 * on_map.problem.range_m[::3].max())
        assert of_kind["map break"][0].most == pytest.approx(float(np.linalg.norm(np.ptp(tags_m, axis=0))))
        # Twice the lever arm (0.1, -0.2, 0.05), and an error of its measurement.
        assert of_kind["tag slipped"][0].most == pytest.approx(0.2 + 2 * np.sqrt(0.0525))
        unnoticed_m = [of_kind[name][0].most_unnoticed for name in ("anchor moved", "map break", "tag slipped")]
        assert unnoticed_m == [1.0, 1.0, 0.2]

    def test_a_move_of_three_numbers_needs_three_bins_for_each_before_and_after(
        self, problem: Linearized, of_kind: dict[str, list[Hypothesis]]
    ) -> None:
        for name, of_number in (("anchor moved", 3), ("anchor step", 1)):
            for each in of_kind[name]:
                changed = known(each.correction(np.full(each.num, 0.5)).longer_m) != 0
                num_later = problem.bins.mean(changed.astype(np.float64)).sum()
                assert 3 * of_number <= num_later <= 20 - 3 * of_number

    @pytest.mark.parametrize(("num", "is_tried"), [(17, False), (18, True)])
    def test_a_move_needs_nine_bins_on_each_side(self, problem: Linearized, num: int, is_tried: bool) -> None:
        small = instant(problem, num)
        found = timed_hypotheses._elsewhere(small, None, "map break", 1.0, lambda: np.eye(3), np.zeros((num, 3)))
        assert bool(list(found)) == is_tried

    @pytest.mark.parametrize(("num", "is_tried"), [(5, False), (6, True)])
    def test_a_step_needs_three_bins_on_each_side(self, problem: Linearized, num: int, is_tried: bool) -> None:
        small = instant(problem, num)
        assert bool(list(timed_hypotheses._steps(small, None))) == is_tried
        by_time = np.ones(num)
        assert bool(list(timed_hypotheses.clock_jumps(replace(small, by_time=by_time)))) == is_tried


class TestSteps:
    """Ranges may read longer or shorter from some time on, or for some time."""

    def test_steps_are_told_with_their_time_and_anchor(self, of_kind: dict[str, list[Hypothesis]]) -> None:
        of_a, of_all = of_kind["anchor step"][0], of_kind["step"][0]
        assert of_a.words(np.array([0.5])) == (
            "the ranges to anchor A jumped 1 s after the first range: since then they read about 0.50 m longer"
        )
        assert of_all.words(np.array([-0.5])) == (
            "the ranges jumped 1 s after the first range: since then they read about 0.50 m shorter"
        )

    def test_stretches_are_told_with_their_times(self, of_kind: dict[str, list[Hypothesis]]) -> None:
        of_a, of_all = of_kind["anchor stretch"][1], of_kind["stretch"][1]
        assert of_a.words(np.array([0.5])) == (
            "the ranges to anchor A read about 0.50 m too long from 1 to 4 s after the first range"
        )
        assert of_all.words(np.array([-0.5])) == (
            "the ranges read about 0.50 m too short from 1 to 4 s after the first range"
        )

    def test_no_range_is_too_long_by_more_than_itself(
        self, problem: Linearized, of_kind: dict[str, list[Hypothesis]]
    ) -> None:
        range_m = problem.on_map.problem.range_m
        for name in ("step", "stretch"):
            assert {each.most for each in of_kind[name]} == {range_m.max()}
            of_c = next(each for each in of_kind[f"anchor {name}"] if each.subject == "C")
            assert of_c.most == range_m[2::3].max()

    def test_all_ranges_of_a_stretch_are_longer(
        self, problem: Linearized, of_kind: dict[str, list[Hypothesis]]
    ) -> None:
        time_s, is_of_c = problem.on_map.time_s, problem.on_map.problem.anchor_index == 2
        windows = list(_windows(problem))
        for each, (start, end, _) in zip(of_kind["stretch"], windows, strict=False):
            longer_m = known(each.correction(np.array([0.5])).longer_m)
            np.testing.assert_array_equal(longer_m, np.where((time_s > start) & (time_s <= end), 0.5, 0.0))
        of_c = next(each for each in of_kind["anchor stretch"] if each.subject == "C")
        longer_m = known(of_c.correction(np.array([0.5])).longer_m)
        start, end, _ = windows[0]
        np.testing.assert_array_equal(longer_m, np.where(is_of_c & (time_s > start) & (time_s <= end), 0.5, 0.0))

    def test_stretches_of_fewer_than_three_bins_are_not_tried(self, problem: Linearized) -> None:
        # A quarter of 13 ranges, of which the first is at the beginning, are three; of 9 they are two.
        of_three = list(timed_hypotheses.stretches(instant(problem, 13)))
        assert len(of_three) == 7
        assert {each.subject for each in of_three} == {""}
        for each in of_three:
            assert np.count_nonzero(known(each.correction(np.array([0.5])).longer_m)) == 3
        assert not list(timed_hypotheses.stretches(instant(problem, 9)))

    def test_of_a_single_anchor_only_all_ranges_are_tried(self, problem: Linearized) -> None:
        bins = replace(problem.bins, anchor_index=np.zeros(NUM_BINS, dtype=np.int64))
        ranges = replace(problem.on_map.problem, anchor_index=np.zeros(NUM, dtype=np.int64))
        of_one = replace(problem, bins=bins, on_map=replace(problem.on_map, problem=ranges))
        for kind in (timed_hypotheses.steps, timed_hypotheses.stretches):
            assert {each.subject for each in kind(of_one)} == {""}


def test_a_clock_that_jumps_moves_the_later_ranges(problem: Linearized, of_kind: dict[str, list[Hypothesis]]) -> None:
    first = of_kind["clock jump"][0]
    assert first.words(np.array([-0.25])) == "the clocks' offset jumped 1 s after the first range, by about -0.25 s"
    assert first.most == pytest.approx(LASTS_S)
    assert first.unit == "s"
    shift_s = np.asarray(first.correction(np.array([-0.25])).time_shift_s)
    changed = shift_s != 0
    assert problem.on_map.time_s[~changed].max() < problem.on_map.time_s[changed].min()
    np.testing.assert_array_equal(shift_s[changed], -0.25)
    assert not list(timed_hypotheses.clock_jumps(replace(problem, by_time=None)))
