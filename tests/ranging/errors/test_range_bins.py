"""Averages of ranges in bins, and the covariance that shared errors give them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.errors.range_bins import RangeBins, _labels, noisiness, range_bins

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


def test_a_bin_is_the_average_of_its_ranges_by_their_robust_weights() -> None:
    """Two ranges to the second anchor are in one bin; the first anchor has the range between them."""
    from_m = np.array([[4.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 8.0, 0.0]])
    about_z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found = bins_of(
        [1, 0, 1],
        [100.0, 100.1, 100.4],
        from_m,
        [0.25, 1.0, 0.75],
        cam_from_world=np.array([np.eye(3), about_z, about_z]),
        noise_of_anchor=np.array([0.7, 1.6]),
        tag_index=np.array([2, 1, 2]),
    )
    assert len(found) == 2
    np.testing.assert_array_equal(found.of_range, [1, 0, 1])
    np.testing.assert_allclose(found.worth, [1.0, 1.0])
    np.testing.assert_array_equal(found.anchor_index, [0, 1])
    np.testing.assert_array_equal(found.tag_index, [1, 2])
    np.testing.assert_allclose(found.time_s, [0.1, 0.3])
    np.testing.assert_allclose(found.distance_m, [2.0, 7.0])
    np.testing.assert_allclose(found.from_anchor, np.array([[0.0, 0.0, 1.0], [0.1, 0.9, 0.0]]) ** 0.5)
    np.testing.assert_allclose(found.in_cam, [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(found.noisiness, [0.7, 1.6])
    np.testing.assert_allclose(found.averages.toarray(), [[0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])
    np.testing.assert_allclose(found.mean(from_m.reshape(3, 3, 1))[:, 1:, 0], [[0.0, 2.0], [6.0, 0.0]])
    np.testing.assert_allclose(found.total(np.array([1.0, 10.0, 100.0])), [10.0, 101.0])


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


def test_a_bin_is_half_a_second_of_one_anchor_and_tag() -> None:
    """A tag of -1 is unknown, and is none of the others."""
    since = np.array([0.0, 0.49, 0.51, 0.99, 1.0])
    np.testing.assert_array_equal(_labels(np.zeros(5, int), np.zeros(5, int), since, 450), [0, 0, 1, 1, 2])
    anchors, tags = np.divmod(np.arange(9), 3)
    assert len(set(_labels(anchors, tags - 1, np.zeros(9), 450).tolist())) == 9
    anchors, tags = np.tile(anchors, 2), np.tile(tags, 2)
    labels = _labels(anchors, tags - 1, np.repeat([0.0, 0.6], 9), 450)
    assert sorted(set(labels.tolist())) == [*range(18)]


def test_bins_are_a_quarter_longer_until_they_are_few_enough() -> None:
    """A hundred ranges a second apart are 52 bins of 1.9 s, or 42 bins of 2.4 s."""
    since, nothing = np.arange(100.0), np.zeros(100, dtype=np.int64)
    for max_num, expected in ((99, 82), (53, 52), (52, 52), (51, 42)):
        labels = _labels(nothing, nothing, since, max_num)
        assert len(np.unique(labels)) == expected
    assert len(np.unique(_labels(nothing, nothing, since, 100))) == 100


def test_every_anchor_has_up_to_two_bins_however_few_are_wanted() -> None:
    anchor, since = np.repeat(np.arange(10), 2), np.tile([0.0, 5.0], 10)
    assert len(np.unique(_labels(anchor, 0 * anchor, since, 3))) == 20
    anchor, since = np.repeat(np.arange(10), 3), np.tile([0.0, 5.0, 10.0], 10)
    assert len(np.unique(_labels(anchor, 0 * anchor, since, 3))) <= 20


def test_an_anchor_is_noisy_relative_to_the_median_of_all() -> None:
    sizes = np.array([0.1, 0.2, 0.4, 9.0, 0.01])
    index = np.tile(np.arange(5), 20)
    residuals = np.repeat(np.resize([1.0, -1.0], 20), 5) * sizes[index] + index
    # Each anchor's common error is no noise, and ratios are held between 0.5 and 3.
    np.testing.assert_allclose(noisiness(index, residuals, 5), [0.5, 1.0, 2.0, 3.0, 0.5])


def test_with_less_than_twenty_ranges_an_anchor_counts_as_noisy_as_the_others() -> None:
    index = np.repeat([0, 1, 2], [20, 19, 20])
    residuals = np.resize([1.0, -1.0], 59) * np.array([0.1, 0.9, 0.3])[index]
    median = np.sqrt((0.1**2 + 0.3**2) / 2)
    np.testing.assert_allclose(noisiness(index, residuals, 4), [0.5, 1.0, 0.3 / median, 1.0])
    np.testing.assert_array_equal(noisiness(index[:19], residuals[:19], 2), [1.0, 1.0])
