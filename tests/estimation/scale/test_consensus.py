"""The scale on which most ranges agree, exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem
from rangesfm.measurements.ranges.scale.starts import agreeing_intervals, consensus_scales, local_maxima

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

STDDEV_M = 0.1
TOLERANCE_M = 3.0 * STDDEV_M


def known_anchors(survey: Survey, range_m: Array | None = None) -> RangeProblem:
    """The survey's ranges with all anchors known in the first camera's frame, and no biases."""
    observations = survey.observations()
    first_camera_from_sfm = survey.trajectory.world_from_cam[0].T
    anchors = survey.frame_from_site("first_camera").apply(np.array(list(survey.anchors_m.values())))
    return RangeProblem(
        centers=(observations.centers - survey.trajectory.centers[0]) @ first_camera_from_sfm.T,
        tag_from_center=observations.tag_from_center @ first_camera_from_sfm.T,
        anchor_index=observations.log.anchor_index,
        range_m=observations.log.range_m if range_m is None else range_m,
        stddev_m=np.full(len(observations.log), STDDEV_M),
        anchor_mean_m=anchors,
        anchor_stddev_m=np.zeros(len(anchors)),
        bias_mean_m=np.zeros(len(anchors)),
        bias_stddev_m=np.zeros(len(anchors)),
        common_bias_stddev_m=0.0,
        frame_is_free=False,
        share=np.ones(len(observations.log)),
    )


def num_agreeing(problem: RangeProblem, scales: Array) -> Array:
    """Count the ranges that agree with each scale, by trying each of them."""
    offset = problem.tag_from_center - problem.anchor_mean_m[problem.anchor_index]
    distances = np.linalg.norm(scales[:, None, None] * problem.centers + offset, axis=2)
    agrees: Array = np.sum(np.abs(distances - problem.range_m) <= TOLERANCE_M, axis=1, dtype=np.float64)
    return agrees


@pytest.mark.parametrize("obstructed_share", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("seed", range(4))
def test_no_scale_at_all_has_more_ranges_agree(make_survey: MakeSurvey, seed: int, obstructed_share: float) -> None:
    """The count changes only at the ends of intervals, so one trial between any two ends covers every scale."""
    radio = Radio(range_stddev_m=STDDEV_M, obstructed_share=obstructed_share, obstructed_mean_m=2.0)
    problem = known_anchors(make_survey(scale=0.5, radio=radio, num_keyframes=15, seed=seed))
    best = consensus_scales(problem)[0]
    offset = problem.tag_from_center - problem.anchor_mean_m[problem.anchor_index]
    places = np.unique(agreeing_intervals(problem.centers, offset, problem.range_m, np.full(75, TOLERANCE_M)))
    everywhere = np.concatenate([0.5 * (places[:-1] + places[1:]), np.geomspace(1e-3, 1e2, 5000)])
    assert num_agreeing(problem, np.array([best]))[0] == num_agreeing(problem, everywhere).max()


def test_local_maxima_are_those_found_by_counting_at_every_place() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        # Whole numbers, so that many ends coincide.
        starts = rng.integers(0, 30, 12).astype(np.float64)
        ends = starts + rng.integers(1, 8, 12)
        places = np.arange(-0.5, 40.0, 0.25)
        covered = np.sum((starts[:, None] <= places) & (places <= ends[:, None]), axis=0)
        middles, counts = local_maxima(starts, ends)
        expected = []
        changes = np.flatnonzero(np.diff(covered))
        for begin, end in zip(changes[:-1] + 1, changes[1:], strict=True):
            if covered[begin] > covered[begin - 1] and covered[end] > covered[end + 1]:
                expected.append((0.5 * (places[begin] + places[end]), covered[begin]))
        assert list(zip(middles, counts, strict=True)) == expected


@pytest.mark.parametrize("seed", range(5))
def test_sixty_percent_of_wild_ranges_do_not_move_it(make_survey: MakeSurvey, seed: int) -> None:
    survey = make_survey(scale=3.0, radio=Radio(range_stddev_m=STDDEV_M), seed=seed)
    rng = np.random.default_rng(seed)
    ranges = survey.log.range_m
    wild = rng.random(len(ranges)) < 0.6
    best = consensus_scales(known_anchors(survey, np.where(wild, rng.uniform(0.5, 20.0, len(ranges)), ranges)))[0]
    assert best == pytest.approx(survey.site_from_sfm.scale, rel=0.03)


def test_a_camera_that_stands_still_is_refused(make_survey: MakeSurvey) -> None:
    survey = make_survey(centers_m=np.tile([[1.0, 2.0, 1.6]], (20, 1)))
    with pytest.raises(GeometryError, match="no scale explains"):
        consensus_scales(known_anchors(survey))


def test_a_camera_that_only_rounding_keeps_from_the_origin_agrees_with_no_scale() -> None:
    """It is treated like a camera exactly at the origin, whose range is the same at every scale."""
    away = np.array([[1.0, 0.0, 0.0]])
    offset, ranges, tolerance = np.tile([[-2.0, 0.0, 0.0]], (2, 1)), np.array([2.0, 1.0]), np.full(2, 0.5)
    exact, rounded = (
        agreeing_intervals(np.concatenate([first, away]), offset, ranges, tolerance)
        for first in (np.zeros((1, 3)), np.array([[1e-16, -1e-17, 0.0]]))
    )
    np.testing.assert_array_equal(rounded, exact)
