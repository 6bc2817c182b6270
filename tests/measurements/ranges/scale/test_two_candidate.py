"""The paper's estimate, on ranges that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate, two_candidate

Array = npt.NDArray[np.float64]

ANCHOR_M = np.array([4.0, 0.0, 0.0])


def estimate(centers: list[list[float]], range_m: list[float], lever_m: Array | None = None) -> TwoCandidate | None:
    levers = np.tile(np.zeros(3) if lever_m is None else lever_m, (len(centers), 1))
    return two_candidate(np.array(centers), levers, ANCHOR_M, np.array(range_m))


def test_walking_towards_the_anchor_the_smaller_root_is_the_steady_one() -> None:
    # At a true scale of 1 the cameras stand 1 m and 2 m along x, 3 m and 2 m from the anchor. A range of 3 m also fits
    # a camera 7 m along x (alpha = 7), and one of 2 m fits a camera 6 m along x (alpha = 3).
    table = estimate([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [3.0, 2.0])
    assert table is not None
    np.testing.assert_allclose(table.duplets, [[1.0, 7.0], [1.0, 3.0]], atol=1e-12)
    assert (table.alpha0.mean, table.alpha0.std) == pytest.approx((1.0, 0.0), abs=1e-12)
    assert (table.alpha1.mean, table.alpha1.std) == pytest.approx((5.0, np.sqrt(8.0)))
    assert table.chosen == "alpha0"
    assert table.scale == pytest.approx(1.0)
    assert table.num_without_root == 0


def test_walking_away_beyond_the_anchor_the_larger_root_is_the_steady_one() -> None:
    # The cameras are 5 m and 6 m along x, 1 m and 2 m beyond the anchor; cameras 3 m and 2 m along x have the same
    # ranges (alpha = 3/5, 2/6).
    table = estimate([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]], [1.0, 2.0])
    assert table is not None
    np.testing.assert_allclose(table.duplets, [[0.6, 1.0], [1.0 / 3.0, 1.0]], atol=1e-12)
    assert table.chosen == "alpha1"
    assert table.scale == pytest.approx(1.0)


def test_the_lever_arm_is_metric_and_never_scaled() -> None:
    # The unit of the path is 2 m; a lever arm of half a metre towards the anchor stays half a metre.
    table = estimate([[0.5, 0.0, 0.0], [1.0, 0.0, 0.0]], [2.5, 1.5], lever_m=np.array([0.5, 0.0, 0.0]))
    assert table is not None
    np.testing.assert_allclose(table.duplets[:, 0], [2.0, 2.0], atol=1e-12)
    assert table.scale == pytest.approx(2.0)


def test_each_range_may_have_an_anchor_of_its_own() -> None:
    anchors = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    centers = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    table = two_candidate(centers, np.zeros((2, 3)), anchors, np.array([3.0, 2.0]))
    assert table is not None
    assert table.scale == pytest.approx(1.0)


def test_farther_from_the_anchor_than_the_origin_was_exactly_one_root_is_positive() -> None:
    table = estimate([[-1.0, 0.0, 0.0], [-1.0, 1.0, 0.0]], [5.0, np.sqrt(26.0)])
    assert table is not None
    assert np.all(table.duplets[:, 0] < 0)
    np.testing.assert_allclose(table.duplets[:, 1], 1.0, atol=1e-12)
    assert table.chosen == "alpha1"


def test_a_path_that_first_nears_and_then_leaves_the_anchor_mixes_the_branches() -> None:
    """This is why the estimate is not the default: even exact ranges give a wrong scale."""
    centers = np.column_stack([np.linspace(1.0, 8.0, 15), np.full(15, 1.0), np.zeros(15)])
    ranges = np.linalg.norm(centers - ANCHOR_M, axis=1)
    table = two_candidate(centers, np.zeros((15, 3)), ANCHOR_M, ranges)
    assert table is not None
    assert abs(table.scale - 1.0) > 0.1
    assert np.all(np.min(np.abs(table.duplets - 1.0), axis=1) < 1e-12)
