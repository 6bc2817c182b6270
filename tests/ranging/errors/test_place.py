"""Ranges from one place count as much as their mean is worth."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.ranging.errors.place import (
    correlation_in_place,
    place_labels,
    shares_of_places,
)


def test_a_place_is_a_bin_and_an_anchor() -> None:
    tags = np.array(
        [[0.05, 0.05, 0.05], [0.15, 0.01, 0.19], [0.25, 0.05, 0.05], [0.05, 0.05, 0.05], [-0.05, 0.05, 0.05]]
    )
    labels = place_labels(tags, np.array([0, 0, 0, 1, 0]))
    assert labels[0] == labels[1]
    assert len(set(labels.tolist())) == 4
    assert sorted(set(labels.tolist())) == [0, 1, 2, 3], "labels can count"


def test_places_far_apart_and_far_away_are_told_apart() -> None:
    corners = 1e7 * np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    assert len(set(place_labels(corners, np.zeros(8, dtype=np.int64)).tolist())) == 8


@pytest.mark.parametrize("true_share", [0.0, 0.3, 0.8])
def test_the_correlation_of_a_place_is_found(true_share: float) -> None:
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 2000, 20_000)
    errors = np.sqrt(true_share) * rng.normal(size=2000)[labels] + np.sqrt(1 - true_share) * rng.normal(size=20_000)
    assert correlation_in_place(errors, labels) == pytest.approx(true_share, abs=0.03)


def test_errors_without_two_in_a_place_have_no_correlation() -> None:
    assert correlation_in_place(np.ones(100), np.arange(100)) == 0.0
    assert correlation_in_place(np.zeros(100), np.zeros(100, dtype=np.int64)) == 0.0


def test_without_correlation_all_count_alike() -> None:
    assert shares_of_places(np.array([0, 0, 0, 1]), 0.0) == pytest.approx(np.ones(4))


def test_a_place_of_one_error_counts_as_one_range() -> None:
    shares = shares_of_places(np.array([0, 0, 0, 0, 1]), 1.0)
    assert shares[:4].sum() == pytest.approx(shares[4])


def test_shares_make_the_mean_of_correlated_errors_better() -> None:
    """A camera lingers in a few places: their common errors dominate the plain mean."""
    rng = np.random.default_rng(2)
    labels = np.repeat(np.arange(60), np.where(np.arange(60) < 5, 400, 5))
    plain, weighted = [], []
    for _ in range(200):
        errors = 0.8 * rng.normal(size=60)[labels] + 0.6 * rng.normal(size=len(labels))
        shares = shares_of_places(labels, correlation_in_place(errors, labels))
        plain.append(errors.mean())
        weighted.append(np.average(errors, weights=shares))
    assert np.std(weighted) < 0.5 * np.std(plain)


def test_the_formal_variance_holds_for_independent_errors() -> None:
    shares = shares_of_places(np.repeat([0, 1, 2], [50, 10, 1]), 0.5)
    variance_of_mean = np.sum(shares**2) / shares.sum() ** 2
    assert variance_of_mean == pytest.approx(1 / shares.sum())


def test_rounding_does_not_part_a_place_on_round_coordinates() -> None:
    """Every other coordinate lies on the edge of a grid bin, on a level path at 1.6 m in whole decimetres."""
    rng = np.random.default_rng(0)
    tags = np.column_stack([0.1 * rng.integers(-50, 50, (400, 2)), np.full(400, 1.6)])
    index = np.zeros(400, dtype=np.int64)
    labels = place_labels(tags, index)
    assert len(set(labels.tolist())) == len(np.unique(np.floor_divide(np.rint(10 * tags), 2), axis=0))
    for _ in range(5):
        np.testing.assert_array_equal(place_labels(tags + rng.choice([-1e-13, 1e-13], tags.shape), index), labels)


def test_rounding_has_no_place() -> None:
    labels = np.repeat(np.arange(20), 10)
    assert correlation_in_place(1e-12 * np.repeat(np.random.default_rng(0).normal(size=20), 10), labels) == 0.0
