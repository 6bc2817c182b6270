"""Residuals in pycolmap's bundle adjustment."""

from __future__ import annotations

import itertools
import subprocess
import sys
import textwrap
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyceres
import pycolmap
import pytest

from rangesfm.solver import (
    add_residual_block,
    distance_cost,
    joint_prior_cost,
    keep_from_elimination,
    range_cost,
)

if TYPE_CHECKING:
    from tests.solver.conftest import AdjusterOf, PoseBlock

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = np.array([-0.0012, -0.0900, -0.0663])
ANCHOR_IN_WORLD_M = np.array([3.0, -2.0, 1.0])
START_ERROR_M = np.array([0.3, 0.2, -0.1])


def cost_of(problem: pyceres.Problem) -> float:
    return 0.5 * float(np.sum(np.square(problem.evaluate_residuals())))


@pytest.mark.parametrize(
    "anchor_in_world",
    [np.zeros(3, dtype=np.float32), np.zeros((3, 3))[:, 0], np.broadcast_to(0.0, 3), np.zeros(2)],
    ids=["float32", "a column", "read-only", "too short"],
)
def test_blocks_that_the_solver_cannot_work_on_in_place_are_refused(
    reconstruction: pycolmap.Reconstruction, anchor_in_world: Array, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    adjuster = adjuster_of(reconstruction)
    num_residuals = adjuster.problem.num_residuals()
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    with pytest.raises(ValueError, match=r"in place|num_dims"):
        add_residual_block(adjuster, cost, None, [pose_block(reconstruction, 1), anchor_in_world, np.zeros(1)])
    assert adjuster.problem.num_residuals() == num_residuals


def test_a_block_given_twice_is_refused(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    # Given the same block twice, Ceres would abort the process.
    adjuster, pose = adjuster_of(reconstruction), pose_block(reconstruction, 1)
    cost = distance_cost(distance_m=1.0, stddev_m=0.1, a_in_cam_m=[0, 0, 0], b_in_cam_m=[1, 0, 0])
    with pytest.raises(ValueError, match="given twice"):
        add_residual_block(adjuster, cost, None, [pose, pose_block(reconstruction, 1)])


def test_a_range_adds_half_its_squared_residual_to_the_bundle_adjustments_cost(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    adjuster = adjuster_of(reconstruction)
    before = cost_of(adjuster.problem)
    blocks = [pose_block(reconstruction, 1), np.array([3.0, -2.0, 1.0]), np.zeros(1)]
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    expected = 0.5 * cost.evaluate(*blocks)[0].item() ** 2
    add_residual_block(adjuster, cost, None, blocks)
    assert cost_of(adjuster.problem) - before == pytest.approx(expected)


def test_a_cauchy_loss_tames_an_outlier_in_pycolmaps_solver(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    adjuster = adjuster_of(reconstruction)
    blocks = [pose_block(reconstruction, 1), np.array([3.0, -2.0, 1.0]), np.zeros(1)]
    cost = range_cost(range_m=100.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    squared = cost.evaluate(*blocks)[0].item() ** 2
    add_residual_block(adjuster, cost, pyceres.CauchyLoss(2.0), blocks)
    summary = adjuster.solve()
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    expected = 0.5 * 2.0**2 * np.log1p(squared / 2.0**2)
    assert summary.ceres_summary.initial_cost == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_ranges_pull_an_unscaled_model_to_its_scale(
    reconstruction: pycolmap.Reconstruction, num_threads: int, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    rng = np.random.default_rng(0)
    anchors = rng.uniform(-8.0, 8.0, (4, 3))
    truth = {
        i: np.array(reconstruction.frame(i).rig_from_world.inverse().translation)  # type: ignore[union-attr]
        for i in reconstruction.reg_frame_ids()
    }
    reconstruction.transform(pycolmap.Sim3d(1.05, pycolmap.Rotation3d(), np.zeros(3)))
    adjuster = adjuster_of(reconstruction, num_threads=num_threads)
    for (frame_id, center), anchor in itertools.product(truth.items(), anchors):
        distance = float(np.linalg.norm(center - anchor))
        cost = range_cost(range_m=distance, tag_in_cam_m=[0, 0, 0], stddev_m=0.01)
        bias = np.zeros(1)
        add_residual_block(adjuster, cost, None, [pose_block(reconstruction, frame_id), anchor, bias])
        adjuster.problem.set_parameter_block_constant(anchor)
        adjuster.problem.set_parameter_block_constant(bias)
    assert adjuster.solve().is_solution_usable()
    for frame_id, center in truth.items():
        rig_from_world = reconstruction.frame(frame_id).rig_from_world
        assert rig_from_world is not None
        assert rig_from_world.inverse().translation == pytest.approx(center, abs=1e-5)


def test_a_pose_that_the_adjuster_holds_stays_where_it_is(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    pose = pose_block(reconstruction, 1)
    before = pose.copy()
    adjuster = adjuster_of(reconstruction, constant_frame_id=1)
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.01)
    add_residual_block(adjuster, cost, None, [pose, np.array([3.0, -2.0, 1.0]), np.zeros(1)])
    adjuster.solve()
    np.testing.assert_array_equal(pose, before)


@pytest.mark.parametrize("hold", [True, False])
def test_a_pose_that_the_adjuster_holds_is_no_part_of_its_problem_until_a_range_makes_it_one(
    reconstruction: pycolmap.Reconstruction, hold: bool, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    """This is why ``add_residual_block`` exists, shown on the bare problem; the test fails if pycolmap changes it."""
    pose = pose_block(reconstruction, 1)
    before = pose.copy()
    adjuster = adjuster_of(reconstruction, constant_frame_id=1)
    problem = adjuster.problem
    assert not problem.has_parameter_block(pose)
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.01)
    problem.add_residual_block(cost, None, [pose, np.array([3.0, -2.0, 1.0]), np.zeros(1)])
    assert not problem.is_parameter_block_constant(pose)
    assert not problem.has_manifold(pose)
    if hold:
        problem.set_parameter_block_constant(pose)
    adjuster.solve()
    assert np.array_equal(pose, before) == hold


@pytest.mark.parametrize(
    ("kept", "structure"), [(True, "2,3,6"), (False, "d,d,d")], ids=["kept from elimination", "left alone"]
)
def test_a_free_anchor_and_bias_leave_the_solver_its_kernels_where_kept_from_elimination(
    reconstruction: pycolmap.Reconstruction, kept: bool, structure: str, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    adjuster, anchor, bias = adjuster_with_free_anchor(reconstruction, adjuster_of, pose_block)
    if kept:
        keep_from_elimination(adjuster, anchor, next(iter(reconstruction.points3D.values())).xyz)
        keep_from_elimination(adjuster, bias, next(iter(reconstruction.points3D.values())).xyz)
    summary = adjuster.solve()
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    assert summary.ceres_summary.schur_structure_used == structure


def test_what_is_kept_from_elimination_ends_at_the_same_place(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    ends = []
    for kept in (True, False):
        copy = pycolmap.Reconstruction(reconstruction)
        adjuster, anchor, bias = adjuster_with_free_anchor(copy, adjuster_of, pose_block)
        if kept:
            keep_from_elimination(adjuster, anchor, next(iter(copy.points3D.values())).xyz)
            keep_from_elimination(adjuster, bias, next(iter(copy.points3D.values())).xyz)
        adjuster.solve()
        ends.append(np.concatenate([anchor, bias]))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
    assert np.linalg.norm(ends[0][:3] - ANCHOR_IN_WORLD_M) < 1e-4


def adjuster_with_free_anchor(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> tuple[pycolmap.CeresBundleAdjuster, Array, Array]:
    """Return an adjuster with exact ranges to an anchor that starts at a wrong position; the anchor and its bias."""
    adjuster, anchor, bias = adjuster_of(reconstruction), ANCHOR_IN_WORLD_M + START_ERROR_M, np.zeros(1)
    for frame_id in reconstruction.reg_frame_ids():
        pose = pose_block(reconstruction, frame_id)
        unbiased = range_cost(range_m=1.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=1.0)
        distance = unbiased.evaluate(pose, ANCHOR_IN_WORLD_M, bias)[0].item() + 1.0
        cost = range_cost(range_m=distance, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
        add_residual_block(adjuster, cost, None, [pose, anchor, bias])
    add_residual_block(adjuster, joint_prior_cost(mean=[[0.0]], whitening=[[10.0]]), None, [bias])
    adjuster.options.ceres.solver_options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    return adjuster, anchor, bias


LIFETIMES = """
    {imports}
    import gc, itertools
    import numpy as np
    from rangesfm import solver
    from rangesfm.solver import adjuster_problem

    def make():
        reconstruction = pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=30
            )
        )
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in reconstruction.reg_image_ids():
            config.add_image(image_id)
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.ceres.solver_options.max_num_iterations = 2
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
        residuals = []
        for frame_id in reconstruction.reg_frame_ids():
            cost = solver.range_cost(range_m=1.0, tag_in_cam_m=[0, 0, 0], stddev_m=1.0)
            loss = pyceres.CauchyLoss(1.0)
            blocks = [reconstruction.frame(frame_id).rig_from_world.params, np.ones(3), np.zeros(1)]
            solver.add_residual_block(adjuster, cost, loss, blocks)
            residuals.append((cost, loss, blocks))
            point = next(iter(reconstruction.points3D.values())).xyz
            solver.keep_from_elimination(adjuster, blocks[1], point)
        return dict(adjuster=adjuster, problem=adjuster.problem, reconstruction=reconstruction, residuals=residuals)

    for order in itertools.permutations(("adjuster", "problem", "reconstruction", "residuals")):
        held = make()
        for name in order:
            del held[name]
            gc.collect()
            make()  # takes and scribbles over whatever memory became free
            if "adjuster" in held:
                assert held["adjuster"].solve().is_solution_usable(), (order, name)
            elif "problem" in held:
                assert np.all(np.isfinite(held["problem"].evaluate_residuals())), (order, name)
    gc.collect()
    assert not adjuster_problem._used_by_adjuster, "adjusters that nobody refers to are still there"
"""


@pytest.mark.parametrize("first", ["pycolmap", "pyceres"])
def test_references_may_be_dropped_in_any_order(first: str) -> None:
    # In a process of its own, because a failure here would abort the process.
    imports = "import pycolmap, pyceres" if first == "pycolmap" else "import pyceres, pycolmap"
    script = textwrap.dedent(LIFETIMES).format(imports=imports)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr[-2000:]
