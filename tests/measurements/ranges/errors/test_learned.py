"""The errors of ranges are learnt from their residuals, as far as these show them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import multivariate_normal, norm

from rangesfm.measurements.ranges.errors.components import COMPONENTS
from rangesfm.measurements.ranges.errors.learned import learn_errors, radio_components
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, range_bins
from rangesfm.solver.noise import Component, ComponentLikelihood, Noise, learnt_sizes, usual_sizes

Array = npt.NDArray[np.float64]

NUM_ANCHORS, NUM_EPOCHS = 4, 100
NO_MAP = np.zeros((0, 1))


@pytest.fixture(scope="module")
def walked() -> RangeBins:
    """Bins of one range each, to four anchors every half second on a walk among them."""
    rng = np.random.default_rng(0)
    time_s = np.repeat(np.arange(NUM_EPOCHS) * 0.5, NUM_ANCHORS)
    along = time_s / 50 * 2 * np.pi
    tag_m = np.column_stack([3 * np.cos(along), 2 * np.sin(2 * along), 1 + 0.5 * np.sin(3 * along)])
    anchor_index = np.tile(np.arange(NUM_ANCHORS), NUM_EPOCHS)
    anchors_m = np.array([[6.0, 0, 2], [-6, 1, 0.5], [0, 7, 2.5], [1, -7, 0.3]])
    turns = np.linalg.qr(rng.standard_normal((len(time_s), 3, 3)))[0]
    num = len(time_s)
    return range_bins(
        anchor_index,
        np.zeros(num, int),
        time_s,
        tag_m - anchors_m[anchor_index],
        turns,
        np.ones(num),
        np.ones(NUM_ANCHORS),
    )


def uncalibrated(of: RangeBins) -> tuple[Component, ...]:
    return radio_components(of, np.full(len(of), np.nan))


def learnt(
    of: RangeBins, off_m: Array, design: Array, prior: Array, noise_m: float, curve_stddev_m: float = np.nan
) -> Noise:
    components = radio_components(of, np.full(len(off_m), curve_stddev_m))
    return learn_errors(components, of, of.mean(off_m), of.mean(design), prior, noise_m)


def learn(of: RangeBins, off_m: Array) -> Noise:
    return learnt(of, off_m, np.zeros((len(off_m), 1)), NO_MAP, 0.05)


def stddevs(learned: Noise) -> dict[str, float]:
    return dict(zip(learned.names, learned.stddevs.tolist(), strict=True))


@pytest.mark.parametrize("component", COMPONENTS, ids=lambda component: component.name)
def test_every_component_is_a_covariance(component, walked: RangeBins) -> None:  # type: ignore[no-untyped-def]
    correlation = component.correlation(walked)
    np.testing.assert_allclose(correlation, correlation.T, atol=1e-12)
    assert np.linalg.eigvalsh(correlation).min() > -1e-9 * len(walked)


def test_unknowns_that_say_the_same_twice_change_nothing(walked: RangeBins) -> None:
    """Redundant columns of the design do not change the result, not even by rounding.

    Otherwise rounding would decide how much such a direction may explain.
    """
    rng = np.random.default_rng(3)
    design, prior = rng.standard_normal((len(walked), 6)), np.eye(2, 6)
    off_m = 0.1 * rng.standard_normal(len(walked)) + design @ rng.standard_normal(6)
    mixture = rng.standard_normal((6, 9)) @ np.diag(10.0 ** -np.arange(9))
    once = learnt(walked, off_m, design, prior, 0.05)
    for many in (np.hstack([np.eye(6), mixture]), np.hstack([mixture, np.zeros((6, 2)), np.eye(6)])):
        twice = learnt(walked, off_m, design @ many, prior @ many, 0.05)
        np.testing.assert_allclose(twice.stddevs, once.stddevs, rtol=1e-6)


@pytest.mark.parametrize("name", ["antenna", "off_axis", "time", "place", "view", "bias"])
def test_errors_ten_times_as_large_as_usual_are_seen_whatever_they_are_taken_for(name: str, walked: RangeBins) -> None:
    component = next(each for each in COMPONENTS if each.name == name)
    values, vectors = np.linalg.eigh(component.correlation(walked))
    drawn = vectors @ (np.sqrt(np.maximum(values, 0)) * np.random.default_rng(1).standard_normal(len(values)))
    off_m = 10 * component.median * drawn + 0.02 * np.random.default_rng(2).standard_normal(len(values))
    learned = learn(walked, off_m)
    # Only the variance about their mean, because a common error of all ranges is not seen here.
    covariance = learned.covariance_m2
    variance = np.mean(np.diag(covariance)) - np.mean(covariance)
    assert 0.7 < np.sqrt(variance) / np.std(off_m) < 3.0


def test_anchors_that_are_all_late_towards_where_they_do_not_face_are_seen_to_be_alike(walked: RangeBins) -> None:
    facing = np.stack([walked.from_anchor[walked.anchor_index == k].mean(axis=0) for k in range(NUM_ANCHORS)])
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    angle = np.arccos(np.clip(np.sum(walked.from_anchor * facing[walked.anchor_index], axis=1), -1, 1))
    found = stddevs(learn(walked, 0.3 * angle + 0.02 * np.random.default_rng(2).standard_normal(len(walked))))
    assert found["off_axis"] > 2 * found["antenna"]
    assert found["off_axis"] > 2 * found["tag_antenna"]


def test_noise_alone_leaves_the_rest_at_what_radios_let_expect_or_less(walked: RangeBins) -> None:
    off_m = 0.05 * np.random.default_rng(2).standard_normal(len(walked))
    found, usual = stddevs(learn(walked, off_m)), usual_sizes(uncalibrated(walked))
    assert found.pop("white") == pytest.approx(0.05, rel=0.15)
    for name, stddev in found.items():
        assert stddev < 1.2 * usual[name], name


def test_what_a_survey_does_not_show_counts_with_the_mean_of_its_variance_over_radios(walked: RangeBins) -> None:
    slope = next(each for each in COMPONENTS if each.name == "slope")
    of_radios = slope.median * np.exp(slope.spread * np.random.default_rng(6).standard_normal(200_000))
    expected = np.sqrt(np.mean(of_radios**2))
    assert usual_sizes(uncalibrated(walked))["slope"] == pytest.approx(expected, rel=0.02)
    distance_m = walked.distance_m[walked.of_range]  # a free scale absorbs all of it
    scaled_free = learnt(walked, np.zeros(len(walked)), distance_m[:, None], NO_MAP, 0.05)
    assert stddevs(scaled_free)["slope"] == pytest.approx(expected, rel=0.02)


def test_errors_are_learnt_alike_from_a_start_nearby(walked: RangeBins) -> None:
    off_m = 0.1 * np.random.default_rng(2).standard_normal(len(walked))
    given = (uncalibrated(walked), off_m, np.zeros((len(walked), 1)), NO_MAP)
    sizes = learnt_sizes(*given)
    assert learnt_sizes(*given, near=sizes) == pytest.approx(sizes, rel=1e-3)


def test_a_learnt_curve_counts_as_it_is_stated(walked: RangeBins) -> None:
    off_m = 0.02 * np.random.default_rng(3).standard_normal(len(walked))
    learned = learnt(walked, off_m, np.zeros((len(off_m), 1)), NO_MAP, 0.02, 0.03)
    assert learned.names[-1] == "learnt_curve"
    np.testing.assert_allclose(np.diag(learned.covariances_m2[-1]), 0.03**2)


def test_a_radio_with_far_more_noise_may_be_off_by_more_in_all_else(walked: RangeBins) -> None:
    off_m = 0.05 * np.random.default_rng(4).standard_normal(len(walked))
    usual, bad = (learnt(walked, k * off_m, np.zeros((len(off_m), 1)), NO_MAP, k * 0.05) for k in (1, 16))
    ratio = [np.sqrt(each.covariances_m2[each.names.index("slope")].max()) for each in (usual, bad)]
    assert ratio[1] > 5 * ratio[0]


def two_causes() -> ComponentLikelihood:
    """Noise and a common error, with two unknowns of which one has a prior."""
    rng, num = np.random.default_rng(7), 12
    return ComponentLikelihood(
        of_components=np.stack([np.eye(num), np.ones((num, num))]),
        log_medians=np.log([0.05, 0.1]),
        spreads=np.array([0.5, 0.8]),
        known=0.001 * np.eye(num),
        off_m=0.1 * rng.standard_normal(num),
        design=rng.standard_normal((num, 2)),
        prior_design=np.array([[3.0, 0.0]]),
    )


def covariance_of(likelihood: ComponentLikelihood, logs: Array) -> Array:
    stddevs = np.exp(logs)
    return np.asarray(np.einsum("k,kij->ij", stddevs**2, likelihood.of_components) + likelihood.known)


def test_the_likelihood_is_that_of_residuals_whose_unknowns_are_integrated_out() -> None:
    """Differences of it equal those of the density of what was measured, with the unknowns free but for their prior."""
    likelihood = two_causes()
    values = []
    for logs in (np.log([0.05, 0.1]), np.log([0.08, 0.03])):
        covariance = covariance_of(likelihood, logs)
        # A free unknown is one with a vast variance.
        unknown = np.diag([1 / 9, 1e6])
        of_all = covariance + likelihood.design @ unknown @ likelihood.design.T
        density = multivariate_normal.logpdf(likelihood.off_m, cov=of_all)
        prior = np.sum(norm.logpdf(logs, likelihood.log_medians, likelihood.spreads))
        values.append((likelihood._negative_with_gradient(logs)[0], density + prior))
    (first, first_log), (second, second_log) = values
    assert first - second == pytest.approx(second_log - first_log, abs=1e-3)


def test_the_gradient_of_the_likelihood_is_its_derivative() -> None:
    likelihood, logs = two_causes(), np.log([0.07, 0.05])
    _, gradient = likelihood._negative_with_gradient(logs)
    for k, step in enumerate(1e-5 * np.eye(2)):
        higher, lower = (likelihood._negative_with_gradient(logs + sign * step)[0] for sign in (1, -1))
        assert gradient[k] == pytest.approx((higher - lower) / 2e-5, rel=1e-5)


def test_the_most_likely_sizes_are_where_the_gradient_vanishes_from_any_start() -> None:
    likelihood = two_causes()
    found = likelihood.most_likely(likelihood.log_medians)
    np.testing.assert_allclose(likelihood._negative_with_gradient(found)[1], 0.0, atol=1e-3)
    np.testing.assert_allclose(likelihood.most_likely(np.log([0.02, 0.4])), found, atol=1e-3)
