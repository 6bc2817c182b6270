"""How wrong the scale may be is said honestly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.demo.ranges import Radio
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.ranging.errors.shared_errors import ANTENNA_STDDEV_M
from rangesfm.scale.estimate import ScaleUncertainty

if TYPE_CHECKING:
    from tests.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

WITHOUT_BIASES = RangeModelOptions(range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
FAR_ANCHORS_M = {"A": (9.0, 2.0, 2.5), "B": (-9.0, 1.0, 0.4), "C": (0.5, 9.0, 3.0), "D": (1.0, -9.0, 0.2)}


def drifting_errors(survey: Survey, stddev: float, memory_s: float, seed: int) -> Array:
    """(n,) errors of each anchor that come and go over some seconds."""
    log = survey.simulated.log
    assert log.timestamp_s is not None
    rng = np.random.default_rng(seed)
    errors = np.zeros(len(log))
    for k in range(len(log.anchor_ids)):
        rows = np.flatnonzero(log.anchor_index == k)
        keep = np.exp(-np.diff(log.timestamp_s[rows]) / memory_s)
        errors[rows[0]] = rng.standard_normal()
        for before, after, kept in zip(rows[:-1], rows[1:], keep, strict=True):
            errors[after] = kept * errors[before] + np.sqrt(1 - kept**2) * rng.standard_normal()
    return stddev * errors


def test_with_independent_errors_formal_and_resampled_stddev_are_the_scatter(make_survey: MakeSurvey) -> None:
    surveys = [make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.1), seed=seed) for seed in range(60)]
    options = ScaleOptions(bootstrap_block_s=1.0)
    estimates = [
        survey.scale("first_camera", "ABCD", range_model=WITHOUT_BIASES, options=options) for survey in surveys
    ]
    errors = [survey.relative_error(estimate) for survey, estimate in zip(surveys, estimates, strict=True)]
    formal = float(np.median([estimate.uncertainty.formal for estimate in estimates]))
    assert np.std(errors) / formal == pytest.approx(1.0, abs=0.25)
    bootstrap = float(np.median([estimate.uncertainty.bootstrap for estimate in estimates]))
    jackknife = float(np.median([estimate.uncertainty.jackknife or 0.0 for estimate in estimates]))
    assert bootstrap / formal == pytest.approx(1.0, abs=0.15)
    assert jackknife / formal == pytest.approx(1.0, abs=0.2)


def test_with_correlated_errors_the_empirical_stddev_is_the_larger_and_covers_the_scatter(
    make_survey: MakeSurvey,
) -> None:
    errors, formals, empiricals, inflations = [], [], [], []
    for seed in range(20):
        survey = make_survey(anchors_m=FAR_ANCHORS_M, num_keyframes=200, seed=seed)
        log = survey.log_with(survey.simulated.distance_m + drifting_errors(survey, 0.1, 4.0, seed))
        options = ScaleOptions(bootstrap_block_s=10.0)
        estimate = survey.scale("first_camera", "ABCD", log, options=options, range_model=WITHOUT_BIASES)
        errors.append(survey.relative_error(estimate))
        formals.append(estimate.uncertainty.formal)
        empiricals.append(estimate.uncertainty.empirical)
        inflations.append(estimate.errors.inflation)
    # About 20 ranges in a row of 5 a second err together.
    assert np.median(inflations) > 2.0
    assert np.median(empiricals) > 1.5 * np.median(formals)
    assert np.std(errors) > 1.5 * np.median(formals)
    assert np.std(errors) < 1.5 * np.median(empiricals)


def test_the_larger_resampling_figure_and_the_range_model_make_the_empirical_stddev() -> None:
    assert ScaleUncertainty(0.001, 0.003, 0.002, 0.004).empirical == pytest.approx(0.005)
    assert ScaleUncertainty(0.001, 0.002, 0.003, 0.004).empirical == pytest.approx(0.005)
    assert ScaleUncertainty(0.001, 0.003, None, 0.004).empirical == pytest.approx(0.005)


def test_leaving_anchors_out_in_turn_takes_three_of_them(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m={name: FAR_ANCHORS_M[name] for name in "AB"}, radio=Radio(range_stddev_m=0.1))
    assert survey.scale("first_camera", "AB").uncertainty.jackknife is None


def test_the_same_seed_gives_the_same_figures_and_another_one_hardly_different_ones(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.1))
    first, again, other = (survey.scale("first_camera", "ABCDE", seed=seed).uncertainty for seed in (0, 0, 1))
    assert first == again
    assert other.bootstrap != first.bootstrap
    assert other.bootstrap == pytest.approx(first.bootstrap, rel=0.5)


def test_four_times_the_ranges_halve_it(make_survey: MakeSurvey) -> None:
    few, many = (
        make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.1), num_epochs=num).scale(
            "first_camera", "ABCD", range_model=WITHOUT_BIASES
        )
        for num in (2, 8)
    )
    assert many.uncertainty.formal / few.uncertainty.formal == pytest.approx(0.5, rel=0.2)
    assert many.uncertainty.bootstrap / few.uncertainty.bootstrap == pytest.approx(0.5, rel=0.5)


def test_few_blocks_or_anchors_widen_the_interval_as_students_t_does() -> None:
    many = ScaleUncertainty(0.001, 0.002, None, 0.0, 0.001, 1000, 1)
    assert many.half_width_95 == pytest.approx(1.96 * 0.002, rel=0.01)
    assert replace(many, num_blocks=5).half_width_95 == pytest.approx(2.776 * 0.002, rel=0.01)
    assert replace(many, correlated=0.002, correlated_dof=3.0).half_width_95 == pytest.approx(3.182 * 0.002, rel=0.01)
    assert replace(many, jackknife=0.002, num_anchors=3).half_width_95 == pytest.approx(4.303 * 0.002, rel=0.01)
    assert replace(many, range_model=0.03).half_width_95 == pytest.approx(1.96 * 0.03, rel=0.01)


def test_what_is_fitted_leaves_less_to_see_the_errors_correlation_by(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m={"A": FAR_ANCHORS_M["A"]}, radio=Radio(range_stddev_m=0.1))
    known, unknown = (survey.scale(frame, "A").uncertainty for frame in ("first_camera", "unknown"))
    assert known.num_blocks == unknown.num_blocks
    assert known.num_blocks - 2.01 < known.correlated_dof <= known.num_blocks - 1
    # The scale, the anchor's place, and a bias that has a prior.
    assert unknown.num_blocks - 5.01 < unknown.correlated_dof <= unknown.num_blocks - 4


def test_what_leaving_out_anchors_shows_of_their_antennas_is_not_counted_twice() -> None:
    alone = ScaleUncertainty(0.001, 0.003, None, 0.0, 0.001, 1000, 1, antennas=0.004)
    assert alone.empirical == pytest.approx(0.005)
    assert alone.half_width_95 == pytest.approx(1.96 * 0.005, rel=0.01)
    many = replace(alone, jackknife=0.006, num_anchors=1000)
    assert many.empirical == pytest.approx(0.006)
    assert many.half_width_95 == pytest.approx(1.96 * 0.006, rel=0.01)


def antenna_error(directions: Array, rng: np.random.Generator, num: int = 200) -> Array:
    """(n,) one draw of an antenna's error: lobes of random strength about random axes, half linear, half quadratic."""
    axes = rng.standard_normal((num, 3))
    cosines = directions @ (axes / np.linalg.norm(axes, axis=1)[:, None]).T
    lobes = np.sqrt(1.5) * cosines + np.sqrt(2.5) * (3 * cosines**2 - 1) / 2
    error: Array = ANTENNA_STDDEV_M * lobes @ rng.standard_normal(num) / np.sqrt(num)
    return error


def test_the_scatter_that_an_antenna_causes_is_the_one_stated(make_survey: MakeSurvey) -> None:
    anchor_m = FAR_ANCHORS_M["A"]
    survey = make_survey(anchors_m={"A": anchor_m}, radio=Radio(range_stddev_m=0.05), num_epochs=4)
    log, path = survey.simulated.log, survey.trajectory
    of_keyframe = np.repeat(np.arange(len(path)), 4)
    tags = survey.centers_m + survey.world_from_cam @ survey.tag_in_cam_m
    directions = (tags - anchor_m)[of_keyframe]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    errors, stated = [], []
    for seed in range(60):
        wrong = survey.log_with(log.range_m + antenna_error(directions, np.random.default_rng(seed)))
        estimate = survey.scale("first_camera", "A", wrong, range_model=WITHOUT_BIASES)
        errors.append(survey.relative_error(estimate))
        stated.append(estimate.uncertainty.antennas)
    assert np.std(errors) / np.median(stated) == pytest.approx(1.0, abs=0.25)


def test_an_error_curve_that_nobody_knows_widens_the_interval_and_a_known_one_hardly(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.03), num_epochs=5)
    log = survey.simulated.log
    calibrated = replace(log, shared_stddev_m=np.full(len(log), 0.01))
    unknown, known = (survey.scale("unknown", (), each).uncertainty.range_model for each in (log, calibrated))
    assert known == pytest.approx(unknown / 7, rel=0.5)
