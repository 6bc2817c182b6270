"""The noise of the inliers is found although most ranges are outliers."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.ranging.errors.noise import inlier_noise


def spoilt(num: int, share: float, side: float, seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Residuals of stddev 0.1 m, of which a share is off to one side by 2 m on average."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(num) < share
    residuals: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = 0.1 * rng.standard_normal(num)
    return residuals + side * wrong * rng.exponential(2.0, num)


@pytest.mark.parametrize(("num", "num_seeds"), [(50, 200), (300, 50), (20_000, 2)])
def test_without_outliers_it_is_the_standard_deviation(num: int, num_seeds: int) -> None:
    found = [inlier_noise(spoilt(num, 0.0, 1.0, seed)).stddev for seed in range(num_seeds)]
    assert np.mean(found) == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["long", "short"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.75])
def test_outliers_on_one_side_are_no_noise(share: float, side: float) -> None:
    found = [inlier_noise(spoilt(400, share, side, seed)) for seed in range(5)]
    np.testing.assert_allclose([one.stddev for one in found], 0.1, rtol=0.3)
    np.testing.assert_allclose([one.num for one in found], 400 * (1 - share), rtol=0.35)


def test_the_order_and_the_unit_do_not_matter() -> None:
    residuals = spoilt(5000, 0.4, 1.0, seed=0)
    shuffled = np.random.default_rng(1).permutation(residuals)
    assert inlier_noise(shuffled).stddev == pytest.approx(inlier_noise(residuals).stddev, rel=1e-12)
    assert inlier_noise(1000 * residuals).stddev == pytest.approx(1000 * inlier_noise(residuals).stddev, rel=1e-9)


@pytest.mark.parametrize("num", [0, 3, 50])
def test_residuals_of_zero_leave_a_stddev_that_can_be_divided_by(num: int) -> None:
    assert 0 < inlier_noise(np.zeros(num)).stddev < 1e-6


def test_the_likelier_of_two_explanations_leaves_a_narrow_bulk_and_outliers() -> None:
    residuals = spoilt(400, 0.7, 1.0, seed=0)
    smeared = residuals - np.median(residuals)
    assert inlier_noise(residuals).log_likelihood > inlier_noise(smeared).log_likelihood + 10


@pytest.mark.parametrize("num", [300, 20_000])
def test_the_likelihood_without_outliers_is_that_of_gaussian_noise(num: int) -> None:
    residuals = spoilt(num, 0.0, 1.0, seed=1)
    gaussian = -0.5 * np.sum((residuals / 0.1) ** 2) - num * np.log(0.1 * np.sqrt(2 * np.pi))
    assert inlier_noise(residuals).log_likelihood == pytest.approx(gaussian, rel=0.02)


def test_of_few_residuals_it_is_that_of_gaussian_noise_of_their_own_size() -> None:
    residuals = spoilt(15, 0.0, 1.0, seed=1)
    found = inlier_noise(residuals)
    gaussian = -0.5 * np.sum((residuals / found.stddev) ** 2) - 15 * np.log(found.stddev * np.sqrt(2 * np.pi))
    assert found.log_likelihood == pytest.approx(gaussian, rel=1e-12)
