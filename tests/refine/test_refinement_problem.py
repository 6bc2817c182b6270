"""The fixed input of a refinement: its frames, what holds the map, and the errors of the ranges' residuals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.known import known
from tests.refine.test_bundle_adjustment import orbit
from tests.refine.test_radio import ANCHORS, LOSS, errors, estimate, four_ranges

from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.refine.radio import AddedRadio, radio_blocks
from rangesfm.refine.refinement_problem import RefinementProblem

Array = npt.NDArray[np.float64]


def a_problem(**given: Any) -> RefinementProblem:
    """Return a problem with four ranges, of which the third has no place."""
    model, none = orbit(), SimpleNamespace()
    others: dict[str, Any] = {"distances": SimpleNamespace(marker_ids={}), "positions": none, **given}
    return RefinementProblem(
        metric=model, ranges=four_ranges(model), radio=estimate(), camera=CameraOptions(), options=RefineOptions(),
        **{"first_pose_is_fixed": False, "gravity": None, "num_threads": 1, "is_refined": False, **others},
    )  # fmt: skip


def in_standard_deviations(off_m: Array) -> Array:
    """Return the residuals of the three ranges in the problem, in the standard deviation of its residuals."""
    scaled = off_m / np.array([0.2, 0.3, 0.4])
    worth = np.array([1.0, 0.5, 0.25]) / 1.5**2
    return np.asarray(np.sign(scaled) * np.sqrt(worth * LOSS.rho(scaled**2)[0]))


def test_errors_of_ranges_are_those_learnt_in_units_of_the_residuals() -> None:
    problem = a_problem()
    blocks = radio_blocks(problem.radio, problem.metric, problem.ranges.trajectory, problem.options)
    blocks.biases[0][:] += 0.1  # the solver's values count
    rows, shared = np.array([30, 31, 32]), np.array([40, 41])
    added = AddedRadio(blocks, [], rows, shared)
    rng = np.random.default_rng(0)
    parts = np.einsum("kij,klj->kil", *[rng.normal(size=(3, 2, 2))] * 2)
    bins: Any = None
    learned = LearnedErrors(("noise", "bending", "bias"), np.ones(3), parts, bins, np.array([1, -1, 0]))
    found = known(problem.residual_errors(added, replace(errors(), learned=learned), bending_factor=2.0))
    radio = added.estimate(problem.radio)
    off_m = problem.ranges.predicted_m(problem.metric, radio) + problem.ranges.shared_m(radio)
    off_m = (off_m - problem.ranges.observations.log.range_m)[[3, 0, 1]]
    step = 1e-6
    slopes = (in_standard_deviations(off_m + step) - in_standard_deviations(off_m - step)) / (2 * step)
    # The first range errs with the second bin, the last one with the first; the second took no part in learning.
    expected = np.array([[0.0, slopes[0]], [0.0, 0.0], [slopes[2], 0.0]])
    np.testing.assert_allclose(found.by_error.toarray(), expected, rtol=1e-6)
    # Bending is in the errors of the photos' residuals, whose unit is twice as large.
    np.testing.assert_allclose(found.covariance, (parts[0] + parts[2]) / 4)
    assert found.variance_of_others == pytest.approx(0.25)
    np.testing.assert_array_equal(found.rows, rows)
    np.testing.assert_array_equal(found.exact, shared)
    assert problem.residual_errors(added, errors(), bending_factor=2.0) is None


def test_residuals_are_predicted_minus_measured_with_shared_errors() -> None:
    problem = a_problem()
    found, ranges = problem.residuals_m(estimate()), problem.ranges
    expected = ranges.predicted_m(problem.metric, estimate()) - ranges.observations.log.range_m
    expected += ranges.shared_errors_m @ [0.5, -1.0]
    np.testing.assert_allclose(found, expected)
    assert np.flatnonzero(np.isnan(found)).tolist() == [2]


def test_frames_without_a_time_come_last() -> None:
    problem = a_problem()
    names = [problem.ranges.trajectory.image_names[k] for k in (4, 1, 2)]
    timed = problem.ranges.trajectory.timed({name: float(k) for k, name in enumerate(names)})
    some = replace(problem, ranges=replace(problem.ranges, trajectory=timed))
    np.testing.assert_array_equal(some.frame_ids, [5, 2, 3, 1, 4, 6])
    assert some.first_frame_id == 5


@pytest.mark.parametrize(
    ("stddevs_m", "first_pose_is_fixed", "expected"),
    [((0.1, np.inf), False, None), ((np.inf, np.inf), False, 0), ((0.0, 0.1), True, 0), ((np.inf, 0.0), False, None)],
)
def test_the_first_frame_is_held_unless_surveyed_anchors_place_the_map(
    stddevs_m: tuple[float, float], first_pose_is_fixed: bool, expected: int | None
) -> None:
    anchors = tuple(
        replace(each, prior_position_stddev_m=stddev) for each, stddev in zip(ANCHORS[:2], stddevs_m, strict=True)
    )
    problem = replace(a_problem(first_pose_is_fixed=first_pose_is_fixed), radio=estimate(anchors=anchors))
    assert problem.held_frame == expected


@pytest.mark.parametrize("is_fixed", [True, False])
def test_the_photos_are_adjusted_without_points_that_are_left_out_but_with_markers(is_fixed: bool) -> None:
    problem = a_problem(first_pose_is_fixed=is_fixed)
    a, b, c = sorted(problem.metric.points3D)[:3]
    distances: Any = SimpleNamespace(marker_ids={"A": a, "C": c})
    problem = replace(problem, distances=distances, left_out_ids=frozenset([a, b]))
    bundle = problem.of_photos(77)
    points = [problem.metric.point3D(point_id).xyz for point_id in (a, b, c)]
    assert [bundle.adjuster.problem.has_parameter_block(point) for point in points] == [True, False, True]
    assert bundle.adjuster.options.ceres.solver_options.max_num_iterations == 77
    ties = {next(bundle.tie_points).ctypes.data for _ in problem.metric.points3D}
    assert ties.isdisjoint(point.ctypes.data for point in points)
    poses = radio_blocks(problem.radio, problem.metric, problem.ranges.trajectory, problem.options).poses
    assert [bundle.adjuster.problem.has_parameter_block(pose) for pose in poses] == [not is_fixed, *[True] * 5]
