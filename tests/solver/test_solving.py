"""Solving with a callback that decides when to stop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest

from rangesfm.solver import Step, solve_adjuster

if TYPE_CHECKING:
    from tests.solver.conftest import AdjusterOf, PoseBlock


def perturbed(reconstruction: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    for point in reconstruction.points3D.values():
        point.xyz = point.xyz + np.random.default_rng(0).normal(0.0, 0.05, 3)
    return reconstruction


def test_it_ends_where_the_adjuster_itself_ends(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    copy = pycolmap.Reconstruction(perturbed(reconstruction))
    steps: list[Step] = []

    def is_enough(step: Step) -> bool:
        steps.append(step)
        return False

    summary = solve_adjuster(adjuster_of(reconstruction), is_enough)
    theirs = adjuster_of(copy).solve()
    assert isinstance(theirs, pycolmap.CeresBundleAdjustmentSummary)
    assert summary.final_cost == pytest.approx(theirs.ceres_summary.final_cost, rel=1e-6, abs=1e-12)
    np.testing.assert_allclose(pose_block(reconstruction, 2), pose_block(copy, 2), atol=1e-9)
    assert sum(step.is_successful for step in steps) + 1 == summary.num_successful_steps
    assert steps[0].gain > 0


def test_it_ends_as_soon_as_it_is_enough_with_the_parameters_of_that_step(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf
) -> None:
    seen: list[np.ndarray] = []
    point = next(iter(perturbed(reconstruction).points3D.values()))
    before = point.xyz.copy()

    def is_enough(step: Step) -> bool:
        seen.append(point.xyz.copy())
        return step.is_successful

    summary = solve_adjuster(adjuster_of(reconstruction), is_enough)
    assert summary.termination_type.name == "USER_SUCCESS"
    assert summary.num_successful_steps == 2  # Ceres counts the start as one
    assert not np.array_equal(seen[-1], before)
    np.testing.assert_array_equal(seen[-1], point.xyz)


def test_what_is_raised_in_between_ends_it_and_comes_through(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf
) -> None:
    def is_enough(_: Step) -> bool:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solve_adjuster(adjuster_of(perturbed(reconstruction)), is_enough)
