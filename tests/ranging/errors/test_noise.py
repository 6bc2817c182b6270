"""Stretches of time whose errors go together."""

from __future__ import annotations

import numpy as np

from rangesfm.ranging.errors.noise import stretch_labels


def test_a_stretch_is_as_long_as_asked() -> None:
    labels = stretch_labels(100.0 + np.arange(0.0, 200.0, 0.5), 10.0)
    np.testing.assert_array_equal(np.bincount(labels), np.full(20, 20))


def test_a_short_log_has_eight_all_the_same() -> None:
    labels = stretch_labels(np.linspace(0.0, 16.0, 161), 10.0)
    np.testing.assert_array_equal(np.unique(labels), np.arange(9))
    np.testing.assert_array_equal(np.bincount(labels)[:8], np.full(8, 20))


def test_ranges_of_one_moment_are_one_stretch() -> None:
    np.testing.assert_array_equal(stretch_labels(np.full(5, 3.0), 10.0), 0)
