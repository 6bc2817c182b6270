"""Averages of ranges in bins, and the covariance that shared errors give them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.errors.range_bins import RangeBins, range_bins

Array = npt.NDArray[np.float64]


def test_uncertain_places_of_one_gap_are_one_error_for_all_of_its_ranges() -> None:
    rng = np.random.default_rng(0)
    num = 120
    anchor, gap = np.arange(num) % 2, np.arange(num) // 20
    towards = rng.normal(size=(num, 3))
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    placing_m, weight = rng.uniform(0.0, 0.05, num), rng.uniform(0.1, 1.0, num)
    found = range_bins(
        anchor,
        np.zeros(num, dtype=np.int64),
        np.arange(num) / 10.0,
        5.0 * towards,
        np.tile(np.eye(3), (num, 1, 1)),
        weight,
        np.ones(2),
    )
    covariance = found.shared_by_places(towards, placing_m, gap)
    # Each gap draws one vector, which moves the antenna for all of its ranges.
    shifts = rng.standard_normal((40_000, 6, 3))
    drawn = np.array([found.mean(placing_m * np.sum(towards * shift[gap], axis=1)) for shift in shifts])
    np.testing.assert_allclose(covariance, drawn.T @ drawn / len(drawn), atol=4e-2 * covariance.max())
    apart = found.of_range[gap == 0][:, None], found.of_range[gap == 5]
    assert np.all(covariance[apart] == 0)


def test_the_mean_of_a_bin_of_one_outlier_is_its_own_value() -> None:
    found = range_bins(
        np.zeros(1, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.zeros(1),
        np.array([[5.0, 0.0, 0.0]]),
        np.eye(3)[None],
        np.array([0.01]),
        np.ones(1),
    )
    np.testing.assert_allclose(found.mean(np.array([3.0])), 3.0)


def bins_of(
    anchor: list[int], time_s: list[float], from_anchor_m: Array, weight: list[float], **others: Any
) -> RangeBins:
    num = len(anchor)
    given = {
        "tag_index": np.zeros(num, dtype=np.int64),
        "cam_from_world": np.tile(np.eye(3), (num, 1, 1)),
        "noise_of_anchor": np.ones(max(anchor) + 1),
    } | others
    return range_bins(
        anchor_index=np.array(anchor),
        time_s=np.array(time_s),
        from_anchor_m=from_anchor_m,
        robust_weight=np.array(weight),
        **given,
    )


def test_ranges_without_any_weight_take_no_part_and_a_tag_at_an_anchor_is_in_no_direction() -> None:
    found = bins_of([0, 0], [0.0, 0.0], np.zeros((2, 3)), [0.0, 1.0])
    np.testing.assert_allclose(found.robust_weight, [0.0, 1.0])
    np.testing.assert_allclose(found.worth, [1.0])
    np.testing.assert_array_equal(found.from_anchor, [[0.0, 0.0, 0.0]])


def test_there_is_no_bin_of_ranges_without_weight_alone() -> None:
    """An outlier between ranges of another anchor, and one of its own anchor's between good ones."""
    from_m = np.array([[4.0, 0.0, 0.0], [0.0, 3e5, 0.0], [0.0, 2.0, 0.0], [5.0, 0.0, 0.0], [9e4, 0.0, 0.0]])
    found = bins_of([0, 1, 1, 0, 0], [0.0, 1.0, 2.0, 3.0, 3.1], from_m, [1.0, 1e-30, 0.5, 1.0, 1e-20])
    np.testing.assert_array_equal(found.anchor_index, [0, 0, 1])
    np.testing.assert_allclose(found.worth, [1.0, 1.0, 0.5])
    np.testing.assert_allclose(found.distance_m, [4.0, 5.0, 2.0])
    np.testing.assert_allclose(found.mean(np.array([1.0, 1e9, 2.0, 3.0, 1e9])), [1.0, 3.0, 2.0])


def test_where_no_range_has_any_weight_all_count_alike() -> None:
    found = bins_of([0, 1], [0.0, 0.0], np.eye(2, 3), [0.0, 1e-30])
    assert found.worth[0] == found.worth[1] > 0
