"""Loops of simulated surveys: proposed by the refined map, tested against the ranges, closed by merging of tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from tests.simulated.looped import Closed, LoopedSurvey, ScaledMap, close, two_aisles, two_laps
from tests.simulated.surveys import range_log

from rangesfm.estimation import refinement
from rangesfm.estimation.refinement import joint_errors
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.util.geometry.similarity import align_points, rmse
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction


def error_m(survey: LoopedSurvey, model: pycolmap.Reconstruction) -> float:
    """Return the root mean square error of the keyframes after the best rigid motion."""
    truth = survey.survey.model
    path = trajectory_from_reconstruction(model, truth.timestamps_s)
    return rmse(align_points(path.centers, truth.centers_m, with_scale=False).apply(path.centers) - truth.centers_m)


@pytest.fixture(scope="module")
def laps() -> LoopedSurvey:
    return two_laps(60, size_m=(24.0, 16.0), num_observations=100)


@pytest.fixture(scope="module")
def closed(laps: LoopedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Closed:
    return close(laps, laps.chain(), range_log(laps.survey, 1), tmp_path_factory.mktemp("laps"))


def test_the_map_proposes_pairs_of_both_laps_that_see_the_same(closed: Closed, laps: LoopedSurvey) -> None:
    far = [pair for pair in closed.tried.proposed if pair[1] - pair[0] > laps.max_track_length]
    assert len(far) >= len(laps.truth.images) // 2
    assert np.mean([pair in laps.matches for pair in far]) > 0.5


def test_closed_loops_tie_the_laps_together(closed: Closed, laps: LoopedSurvey) -> None:
    assert len(closed.tried.closed) > 10
    assert not closed.tried.contradicted
    assert error_m(laps, closed.after.model) < 0.5 * error_m(laps, closed.before.model)
    longest = max(
        max(element.image_id for element in point.track.elements)
        - min(element.image_id for element in point.track.elements)
        for point in closed.after.model.points3D.values()
    )
    assert longest > 20


@pytest.mark.parametrize("is_far", [False, True])
def test_a_map_is_refined_again_only_where_closing_bends_it_visibly(
    closed: Closed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_far: bool
) -> None:
    monkeypatch.setattr(refinement, "_just_visible_m", lambda *_: 0.0 if is_far else 1.0)
    before = replace(closed.after, database_path=tmp_path / "again.db")
    loops, _ = before.finder.tested(before.matches_of(sorted(closed.tried.closed)))
    again = before.with_closed(loops, closed.tried)
    assert (again is not None) == is_far
    if again is not None:
        movement_m = error_m(closed.after.looped, again.model) - error_m(closed.after.looped, closed.after.model)
        assert abs(movement_m) < 0.01


def test_a_map_that_was_bent_to_its_ranges_is_not_bent_again() -> None:
    laps = two_laps(100, size_m=(24.0, 16.0), num_observations=40, pixel_stddev=1.0)
    scaled = ScaledMap.of(laps.survey, laps.chain(), range_log(laps.survey, 1))
    refined = scaled.refined().problem.metric
    again = scaled.refined(refined).problem.metric
    scaled_m, refined_m, again_m = (
        trajectory_from_reconstruction(model, laps.survey.model.timestamps_s).centers
        for model in (scaled.scaled, refined, again)
    )
    assert rmse(again_m - refined_m) < 0.005 * rmse(refined_m - scaled_m)


def test_pairs_that_look_alike_in_two_aisles_are_contradicted_by_the_ranges() -> None:
    survey = two_aisles(num_keyframes=10, length_m=4.0)
    scaled = ScaledMap.of(survey.looped.survey, survey.looped.chain(), range_log(survey.looped.survey, 1))
    rest = scaled.refined()
    covariance = joint_errors(rest, 1.0)
    finder = LoopFinder.in_refined_map(rest.problem.metric, scaled.trajectory, covariance, rest.pixel_stddev, seed=0)
    loops, contradicted = finder.tested(survey.alike)
    assert not loops
    assert len(contradicted) > 0.9 * len(survey.alike) > 10
