"""The bound on the scale holds with its risk, also if one mistake was not found; and what was given is checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special
from tests.simulated.runs import run
from tests.simulated.surveys import SITES, surveyed

from rangesfm.diagnostics.scale_bound import RISK, scale_bound
from rangesfm.measurements.mistakes import EstimatedMistake, MistakeTest, noncentrality
from rangesfm.measurements.ranges.mistakes.catalogue import anchor_places, wrong_lever_arms
from rangesfm.measurements.ranges.mistakes.find_mistakes import find_mistakes
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.mistakes.thresholds import judged
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import ScaleUncertainty

ONE_PERCENT = ScaleUncertainty(0.0, {"noise": 0.01})


@pytest.fixture(scope="module")
def problem() -> Linearized:
    on_map = run(surveyed(SITES[0], 3), 3).on_map
    assert on_map is not None
    return find_mistakes(on_map).problem


def results_of(problem: Linearized) -> list[EstimatedMistake]:
    return judged(problem, [*anchor_places(problem), *wrong_lever_arms(problem)], 0)


def hidden_mistake(name: str, slope: float, most: float = np.inf) -> MistakeTest:
    """The test of a mistake that changes the scale by ``slope`` where it moves the test by one standard deviation."""
    effect = slope * float(np.sqrt(noncentrality(1)))
    return MistakeTest(name, "", 0.0, 15.0, "", "", effect_on_scale=effect, most_unnoticed=most)


def test_without_a_mistake_the_bound_is_that_of_a_normal_error() -> None:
    bound, limited_by = scale_bound(ONE_PERCENT, [])
    assert bound == pytest.approx(-0.01 * special.ndtri(RISK / 2), rel=1e-6)
    assert limited_by == ""


def test_a_mistake_of_any_size_exceeds_the_bound_unnoticed_no_more_often_than_the_risk() -> None:
    """Draw the two independent normal numbers, of the test and of the scale, for mistakes of many sizes."""
    hidden = hidden_mistake("a step", 0.004)
    bound, limited_by = scale_bound(ONE_PERCENT, [hidden])
    assert limited_by == "a step"
    rng, num = np.random.default_rng(0), 1_000_000
    noise, of_test = 0.01 * rng.standard_normal(num), rng.standard_normal(num)
    risks = [
        np.mean(((of_test + moves) ** 2 < 15.0) & (np.abs(noise + 0.004 * moves) > bound))
        for moves in np.linspace(0.0, 8.0, 9)
    ]
    assert 0.5 * RISK < max(risks) < 1.4 * RISK  # of a million draws, 100 +- 10 exceed it
    assert np.argmax(risks) not in (0, 8)


def test_what_people_would_notice_limits_what_no_test_sees() -> None:
    bound, limited_by = scale_bound(ONE_PERCENT, [hidden_mistake("lever arm", np.inf, 0.02)])
    assert bound == pytest.approx(0.02 - 0.01 * special.ndtri(RISK), rel=1e-6)
    assert limited_by == "lever arm"
    assert scale_bound(ONE_PERCENT, [hidden_mistake("length", np.inf)]) == (np.inf, "length")
    little, _ = scale_bound(ONE_PERCENT, [hidden_mistake("a step", 0.004, 0.002)])
    assert little < bound


def test_redundancy_is_the_share_of_a_mistake_that_the_residuals_show(problem: Linearized) -> None:
    """The residuals themselves are compared: with all unknowns adapting to the mistake, and on a map that is known."""
    inverse = np.linalg.inv(problem.noise.covariance_m2)
    for test in results_of(problem):
        columns, seen, num = test.mistake.columns, test.mistake.seen, len(problem.bins)
        off_m = columns[:num] if seen is None else seen
        made = np.pad(columns, ((0, len(problem.residual) - len(columns)), (0, 0))).T
        of_units = [replace(problem, residual_m=off[:num], prior_residual=off[num:]) for off in made]
        left = np.stack([each.solution.residual for each in of_units], axis=1)
        directions = np.random.default_rng(0).standard_normal((test.mistake.num, 1000))
        shares = np.sum((left @ directions) ** 2, axis=0)
        shares /= np.einsum("ij,ik,kj->j", off_m @ directions, inverse, off_m @ directions)
        assert 0.0 < test.redundancy <= shares.min() * (1 + 1e-9)
        assert shares.min() < test.redundancy + 0.05
        assert shares.max() <= 1.0 + 1e-9


def test_what_two_anchors_alone_are_given_is_untested(problem: Linearized) -> None:
    """Three coordinates of each of two anchors determine the map, and nothing is left to check them."""
    few = np.isin(problem.bins.anchor_index, problem.heard[:2])
    loose = np.where(few[:, None] & few, problem.noise.covariance_m2, 0.0) + 1e8 * np.diag(~few)
    lonely = replace(problem, components=(Component("loose", loose),), sizes={"loose": 1.0})
    places = {test.mistake.subject: test for test in results_of(lonely) if test.mistake.name == "anchor place"}
    assert places
    assert not any(test.is_checked for test in places.values())
    names = [problem.on_map.anchor_ids[k] for k in problem.heard[:2]]
    assert all(places[name].redundancy < 0.01 for name in names)
    with_all = [test for test in results_of(problem) if test.mistake.name == "anchor place"]
    assert all(test.is_checked for test in with_all)
