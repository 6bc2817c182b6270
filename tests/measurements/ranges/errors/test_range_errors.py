"""The noise of ranges, found from their residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE, RobustLoss

Array = npt.NDArray[np.float64]
NUM_EACH = 400


def make_errors(stddev_m: float = 1.0, *, loss: RobustLoss = GEMAN_MCCLURE) -> RangeErrors:
    """Errors of three anchors in turn, for 400 rounds of half a second."""
    n = 3 * NUM_EACH
    rounds = np.arange(n) // 3
    return RangeErrors(
        stddev_m=np.full(n, stddev_m),
        share=np.ones(n),
        inflation=1.0,
        given_m=np.full(n, np.nan),
        shared_m=np.zeros(n),
        placing_m=np.zeros(n),
        anchor_index=np.arange(n) % 3,
        block=rounds // 20,
        place=np.arange(n),
        loss=loss,
        common_bias_stddev_m=0.1,
    )


def noise(stddevs_m: tuple[float, float, float]) -> Array:
    values: Array = np.random.default_rng(0).standard_normal(3 * NUM_EACH) * np.tile(stddevs_m, NUM_EACH)
    return values


def test_a_noisier_anchor_is_known_by_its_residuals() -> None:
    found = make_errors().seen_by_bending_map(noise((0.05, 0.05, 0.3)), 0.0)
    assert found.stddev_m[2] == pytest.approx(0.3, rel=0.15)
    assert found.stddev_m[0] == pytest.approx(0.05, rel=0.15)
    assert found.inflation == pytest.approx(1.0, abs=0.25)


def test_what_the_map_takes_from_the_residuals_is_given_back() -> None:
    plain, widened = (make_errors().seen_by_bending_map(noise((0.1, 0.1, 0.1)), num) for num in (0.0, 900.0))
    assert widened.stddev_m[0] == pytest.approx(2 * plain.stddev_m[0])


def test_ranges_of_one_place_that_err_alike_count_for_less() -> None:
    """A hundred places have two ranges to each anchor each; one more place has all the others."""
    num_places = 101
    rounds = np.minimum(np.arange(3 * NUM_EACH) // 3 // 2, num_places - 1)
    place = rounds + num_places * (np.arange(3 * NUM_EACH) % 3)
    alike = 0.1 * np.random.default_rng(2).standard_normal(3 * num_places)[place]
    errors = replace(make_errors(), place=place)
    apart, together = (
        errors.seen_by_bending_map(noise((0.1, 0.1, 0.1)), 0.0),
        errors.seen_by_bending_map(noise((0.1, 0.1, 0.1)) + alike, 0.0),
    )
    lingered = rounds == num_places - 1
    assert apart.share[lingered].mean() > 0.5 * apart.share[~lingered].mean()
    assert together.share[lingered].mean() < 0.1 * together.share[~lingered].mean()
    as_if_each_its_own = make_errors().seen_by_bending_map(noise((0.1, 0.1, 0.1)) + alike, 0.0)
    assert together.inflation < 0.7 * as_if_each_its_own.inflation
