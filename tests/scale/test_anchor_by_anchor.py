"""The result of a scale stage for each anchor: its estimate, its mirror place, and the scale by its ranges alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known
from tests.scale.test_solution import ANCHORS_M, BENT, FLAT, errors_of, fit_of, found, measured, problem_of, state_of

from rangesfm.scale import anchor_by_anchor
from rangesfm.scale.anchor_by_anchor import anchor_estimates, scale_per_anchor
from rangesfm.scale.range_equation import RangeProblem, RangeState
from rangesfm.scale.solution import Solution

Array = npt.NDArray[np.float64]

IDS = ("A", "B", "C", "D", "E")
TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


def biased(own_stddev_m: list[float], off_m: list[float], common_stddev_m: float) -> float:
    """Return the common bias for biases that are off their prior means of 0.1, 0.2, ... by so much."""
    num = len(off_m)
    mean_m = np.linspace(0.1, 0.1 * num, num)
    problem = replace(
        problem_of(anchors_m=ANCHORS_M[:num]),
        bias_mean_m=mean_m,
        bias_stddev_m=np.array(own_stddev_m),
        common_bias_stddev_m=common_stddev_m,
    )
    return anchor_by_anchor._common_bias(problem, replace(state_of(1.0), bias_m=mean_m + off_m))


@pytest.mark.parametrize("common_stddev_m", [0.05, 0.5, 3.0])
def test_the_common_bias_is_the_conditional_mean_given_the_biases_of_the_anchors(common_stddev_m: float) -> None:
    own, off = np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.1, -0.2])
    covariance = np.diag(own**2) + common_stddev_m**2
    expected = common_stddev_m**2 * np.linalg.solve(covariance, off).sum()
    assert biased(own.tolist(), off.tolist(), common_stddev_m) == pytest.approx(expected)
    # An anchor whose bias is fixed says nothing about it.
    assert biased([*own, 0.0], [*off, 0.0], common_stddev_m) == pytest.approx(expected)
    assert biased([0.0, *own], [0.0, *off], common_stddev_m) == pytest.approx(expected)


def test_there_is_no_common_bias_if_no_bias_is_free_or_none_is_shared() -> None:
    assert biased([0.0, 0.0], [0.0, 0.0], 0.5) == 0.0
    assert biased([0.1, 0.2], [0.3, 0.1], 0.0) == 0.0


def stretched(scales: list[float], *, frame_is_free: bool) -> Solution:
    """Return a map at 2 m per unit, where the ranges of each anchor fit the path at another scale.

    The path is stretched about its middle in a site, and about the first camera otherwise.
    """
    centers = BENT - BENT[0]
    problem = problem_of(centers, frame_is_free=frame_is_free)
    place = np.array([1.0, -2.0, 0.5]) if frame_is_free else np.zeros(3)
    state = state_of(2.0, TURN if frame_is_free else np.eye(3), place)
    held = state.metric_from_model.apply(centers.mean(axis=0) if frame_is_free else np.zeros(3))
    tags = state.metric_from_model.apply(centers)
    tags = held + (np.array(scales) / 2.0)[problem.anchor_index][:, None] * (tags - held)
    range_m = np.linalg.norm(tags - ANCHORS_M[problem.anchor_index], axis=1)
    return found(replace(problem, range_m=range_m), state)


@pytest.mark.parametrize("frame_is_free", [True, False])
def test_each_anchor_alone_stretches_the_path_about_a_fixed_place(frame_is_free: bool) -> None:
    scales = [2.0, 2.1, 1.9, 2.2, 2.05]
    of_anchors = scale_per_anchor(stretched(scales, frame_is_free=frame_is_free), IDS)
    assert of_anchors == pytest.approx(dict(zip(IDS, scales, strict=True)), rel=1e-6)


def test_an_anchor_alone_needs_eight_ranges() -> None:
    solution = stretched([2.0] * 5, frame_is_free=False)
    rows = np.flatnonzero((solution.problem.anchor_index != 1) | (np.arange(40) > 5))
    few = replace(solution, problem=solution.problem.subset(rows))
    assert np.bincount(few.problem.anchor_index).tolist() == [8, 7, 8, 8, 8]
    assert list(scale_per_anchor(few, IDS)) == ["A", "C", "D", "E"]


def test_an_unknown_anchor_is_estimated_along_with_its_scale() -> None:
    problem = measured(problem_of(BENT, ANCHORS_M[:1], frame_is_free=False), state_of(2.0))
    unknown = replace(problem, anchor_mean_m=np.full((1, 3), np.nan), anchor_stddev_m=np.array([np.inf]))
    start = replace(state_of(2.1), anchors_m=ANCHORS_M[:1] + 0.3, bias_m=np.zeros(1))
    assert scale_per_anchor(found(unknown, start), ("A",)) == pytest.approx({"A": 2.0}, rel=1e-4)


@pytest.mark.parametrize(("stddev", "has_scale"), [(0.49, True), (0.51, False)])
@pytest.mark.parametrize("inflation", [1.0, 3.0])
def test_an_anchor_has_no_scale_of_its_own_if_that_is_uncertain_by_a_factor(
    stddev: float, has_scale: bool, inflation: float
) -> None:
    """Straight away from the anchor, the logarithm's variance is that of a range over the sum of squared distances."""
    along = np.linspace(0.5, 2.0, 10)
    problem = problem_of(along[:, None] * [-1.0, 0.0, 0.0], np.array([[9.0, 0.0, 0.0]]), frame_is_free=False)
    noise_m = stddev / inflation * 2.0 * float(np.sqrt(np.sum(along**2)))
    problem = replace(problem, range_m=9.0 + 2.0 * along, stddev_m=np.full(10, noise_m))
    state = replace(state_of(2.0), anchors_m=problem.anchor_mean_m, bias_m=np.zeros(1))
    of_anchors = scale_per_anchor(found(problem, state, inflation=inflation), ("A",))
    assert of_anchors == pytest.approx({"A": 2.0} if has_scale else {})


def two_unknown(centers: Array = BENT) -> tuple[RangeProblem, RangeState]:
    """Return a map with anchors A, B and C known, D unknown and E not heard, and biases."""
    problem = problem_of(centers)
    problem = replace(
        problem,
        anchor_mean_m=np.where(np.arange(5)[:, None] == 3, np.nan, ANCHORS_M),
        anchor_stddev_m=np.array([0.0, 0.2, 0.0, np.inf, 0.3]),
        bias_mean_m=np.array([0.0, 0.1, 0.2, 0.3, 0.4]),
        bias_stddev_m=np.array([0.1, 0.1, 0.1, 0.1, 0.0]),
        common_bias_stddev_m=1e6,
    )
    # All biases are 0.05 m more than expected, so that this is the common bias.
    state = replace(state_of(2.0), anchors_m=ANCHORS_M + 0.01, bias_m=np.array([0.05, 0.15, 0.25, 0.35, 7.0]))
    problem = problem.subset(np.flatnonzero(problem.anchor_index != 4))
    return measured(problem, state), state


def test_estimates_of_anchors_hold_their_places_biases_and_priors() -> None:
    problem, state = two_unknown()
    solution = Solution(problem, fit_of(problem, state), errors_of(problem, inflation=2.0), 0.1)
    # Columns: 7 of the map, 3 of each of the anchors B, D and E, and 4 of biases.
    covariance = np.diag(np.arange(1.0, 21.0))
    covariance[10, 11] = covariance[11, 10] = 0.5
    a, b, c, d, e = anchor_estimates(solution, IDS, covariance)
    assert [each.anchor_id for each in (a, b, c, d, e)] == list(IDS)
    for k, each in enumerate((a, b, c, d)):
        np.testing.assert_allclose(each.position_m, ANCHORS_M[k] + 0.01)
        assert each.range_bias_m == pytest.approx(0.05 + 0.1 * k)
        assert each.prior_bias_m == pytest.approx(0.1 * k)
        assert each.prior_bias_stddev_m == pytest.approx(0.2)
    assert [each.mirror_position_m for each in (a, b, c, e)] == [None] * 4
    # The one that is not heard is where the survey has it, with the bias that all share.
    np.testing.assert_array_equal(e.position_m, ANCHORS_M[4])
    assert (e.range_bias_m, e.prior_bias_m, e.prior_bias_stddev_m) == pytest.approx((0.45, 0.4, 0.0))
    np.testing.assert_array_equal(known(b.prior_position_m), ANCHORS_M[1])
    assert d.prior_position_m is None
    assert [each.prior_position_stddev_m for each in (a, b, c, d, e)] == [0.0, 0.2, 0.0, np.inf, 0.3]
    np.testing.assert_array_equal(known(a.position_covariance_m2), np.zeros((3, 3)))
    np.testing.assert_array_equal(known(b.position_covariance_m2), np.diag([8.0, 9.0, 10.0]))
    np.testing.assert_array_equal(
        known(d.position_covariance_m2), [[11.0, 0.5, 0.0], [0.5, 12.0, 0.0], [0.0, 0.0, 13.0]]
    )
    assert [each.position_stddev_m for each in (a, b, c, d, e)] == pytest.approx([0.0, 3.0, 0.0, 12**0.5, 15**0.5])


def test_an_anchor_of_unknown_place_beside_a_flat_path_has_a_mirror_place() -> None:
    problem, state = two_unknown(FLAT)
    solution = Solution(problem, fit_of(problem, state), errors_of(problem), 0.1)
    estimates = anchor_estimates(solution, IDS, 0.01 * np.eye(20))
    assert [each.mirror_position_m is None for each in estimates] == [True, True, True, False, True]
    np.testing.assert_allclose(known(estimates[3].mirror_position_m), (ANCHORS_M[3] + 0.01) * [1, 1, -1], atol=1e-4)


@pytest.mark.parametrize("inflation", [1.0, 2.0])
@pytest.mark.parametrize(("rise", "is_open"), [(4.4, True), (4.6, False)])
@pytest.mark.parametrize("is_swapped", [True, False])
def test_the_mirror_place_is_the_farther_one_of_two_that_fit_unless_the_ranges_rule_it_out(
    monkeypatch: pytest.MonkeyPatch, rise: float, is_open: bool, inflation: float, is_swapped: bool
) -> None:
    problem, state = two_unknown()
    near, far = state.anchors_m + 0.1, state.anchors_m - 0.2
    sides = (far, near) if is_swapped else (near, far)
    rises = np.where(np.arange(5) == 3, rise * inflation**2, np.inf)
    monkeypatch.setattr(
        anchor_by_anchor, "choose_sides", lambda *_: (replace(state, anchors_m=sides[0]), sides[1], rises)
    )
    solution = Solution(problem, fit_of(problem, state), errors_of(problem, inflation), 0.1)
    mirrors = anchor_by_anchor._mirror_places(solution)
    assert list(mirrors) == ([3] if is_open else [])
    if is_open:
        np.testing.assert_array_equal(mirrors[3], far[3])
