"""Averages of ranges in bins, and the covariance that shared errors give them."""

from __future__ import annotations

import numpy as np

from rangesfm.ranging.errors.range_bins import range_bins


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
