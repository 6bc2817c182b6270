"""Stretches of time in which errors are correlated."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.ranging.errors.noise import correlation_inflation, stretch_labels


def test_a_stretch_is_as_long_as_asked() -> None:
    labels = stretch_labels(100.0 + np.arange(0.0, 200.0, 0.5), 10.0)
    np.testing.assert_array_equal(np.bincount(labels), np.full(20, 20))


def test_a_short_log_has_eight_all_the_same() -> None:
    labels = stretch_labels(np.linspace(0.0, 16.0, 161), 10.0)
    np.testing.assert_array_equal(np.unique(labels), np.arange(9))
    np.testing.assert_array_equal(np.bincount(labels)[:8], np.full(8, 20))


def test_ranges_of_one_moment_are_one_stretch() -> None:
    np.testing.assert_array_equal(stretch_labels(np.full(5, 3.0), 10.0), 0)


def test_errors_of_a_stretch_that_are_alike_widen_and_rounding_does_not() -> None:
    groups = np.repeat(np.arange(20), 25)
    alike = np.repeat(np.random.default_rng(0).normal(size=20), 25)
    assert correlation_inflation(alike, np.ones(500), groups) == pytest.approx(5.0)
    assert correlation_inflation(1e-12 * alike, np.ones(500), groups) == 1.0
    assert correlation_inflation(0 * alike, np.ones(500), groups) == 1.0


def test_one_stretch_says_nothing_of_what_the_errors_of_one_have_in_common() -> None:
    assert correlation_inflation(np.ones(500), np.ones(500), np.zeros(500, dtype=np.int64)) == 1.0
