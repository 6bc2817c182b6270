"""Many ranges of one place in one residual block are as if each had its own; and ranges in a rig."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyceres
import pycolmap
import pytest

from rangesfm.solver import add_residual_block, interpolated_range_cost, range_cost

if TYPE_CHECKING:
    from tests.solver.conftest import AdjusterOf, PoseBlock

Array = npt.NDArray[np.float64]

LOSS_SCALE = 2.0


def cost_of(adjuster: pycolmap.CeresBundleAdjuster) -> float:
    return 0.5 * float(np.sum(np.square(adjuster.problem.evaluate_residuals())))


def initial_cost(adjuster: pycolmap.CeresBundleAdjuster) -> float:
    """Return the cost of the start as the solver reports it."""
    adjuster.options.ceres.solver_options.max_num_iterations = 0
    summary = adjuster.solve()
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    return float(summary.ceres_summary.initial_cost)


def gradient_norm(adjuster: pycolmap.CeresBundleAdjuster) -> float:
    """Return the gradient's norm of the whole problem, which depends on every residual and Jacobian."""
    jacobian = adjuster.problem.evaluate_jacobian()
    rows = np.repeat(np.arange(jacobian.num_rows), np.diff(jacobian.rows))
    residuals = np.asarray(adjuster.problem.evaluate_residuals())
    gradient = np.bincount(jacobian.cols, residuals[rows] * np.asarray(jacobian.values), jacobian.num_cols)
    return float(np.linalg.norm(gradient))


@pytest.mark.parametrize("num_poses", [1, 2])
def test_cost_and_gradient_of_one_block_are_those_of_the_ranges_one_by_one(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock, num_poses: int
) -> None:
    """At a keyframe, and between two; a loss of Ceres acts on a whole block, the one of the cost on each range."""
    rng, num = np.random.default_rng(0), 30
    model: dict[str, Any] = {"tag_in_cam_m": rng.normal(0, 0.1, 3)}
    each: dict[str, Any] = {"range_m": rng.uniform(1.0, 10.0, num), "stddev_m": rng.uniform(0.5, 2.0, num)}
    if num_poses == 2:
        each |= {"weight": rng.uniform(size=num), "offset_in_world_m": rng.normal(0, 0.1, (num, 3))}
    make = range_cost if num_poses == 1 else interpolated_range_cost
    poses = [pose_block(reconstruction, i) for i in sorted(reconstruction.reg_frame_ids())[:num_poses]]
    blocks = [*poses, rng.normal(0, 5, 3), rng.normal(0, 0.1, 1)]
    one_by_one, together = adjuster_of(reconstruction), adjuster_of(reconstruction)
    for k in range(num):
        cost = make(**model, **{name: values[k] for name, values in each.items()})
        add_residual_block(one_by_one, cost, pyceres.CauchyLoss(LOSS_SCALE), blocks)
    add_residual_block(together, make(**model, **each, loss_scale=LOSS_SCALE), None, blocks)
    assert gradient_norm(together) == pytest.approx(gradient_norm(one_by_one), rel=1e-9)
    # The solver's initial cost is used because with one of Ceres' losses the cost is not half the sum of the squared
    # residuals.
    assert cost_of(together) == pytest.approx(initial_cost(one_by_one), rel=1e-9)


def test_the_tag_hangs_on_the_rig_frame_whichever_cameras_the_rig_has(
    adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    """Ranges from the rig frame correct a scale that is 4 % off, with three cameras in the rig."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=8, num_points3D=80, track_length=8
    )
    reconstruction = pycolmap.synthesize_dataset(options)
    tag_in_cam, anchors = np.array([0.3, -0.2, 0.1]), list(np.random.default_rng(3).uniform(-8, 8, (4, 3)))
    frames = sorted(reconstruction.reg_frame_ids())

    def tags() -> Array:
        poses = [reconstruction.frame(i).rig_from_world for i in frames]
        return np.array([pose.inverse() * tag_in_cam for pose in poses if pose is not None])

    truth, baselines = tags(), [pose.translation.copy() for pose in sensor_poses(reconstruction)]
    assert len(baselines) == 2
    range_m = np.linalg.norm(truth[:, None] - anchors, axis=2)
    reconstruction.transform(pycolmap.Sim3d(1.04, pycolmap.Rotation3d(), np.zeros(3)))
    adjuster = adjuster_of(reconstruction)
    biases = [np.zeros(1) for _ in anchors]
    for frame, of_frame_m in zip(frames, range_m, strict=True):
        for anchor, bias, distance_m in zip(anchors, biases, of_frame_m, strict=True):
            cost = range_cost(range_m=distance_m, tag_in_cam_m=tag_in_cam, stddev_m=1e-3)
            add_residual_block(adjuster, cost, None, [pose_block(reconstruction, frame), anchor, bias])
    for block in (*anchors, *biases):
        adjuster.problem.set_parameter_block_constant(block)
    assert adjuster.solve().is_solution_usable()
    assert tags() == pytest.approx(truth, abs=1e-5)
    for pose, baseline in zip(sensor_poses(reconstruction), baselines, strict=True):
        assert pose.translation == pytest.approx(baseline, abs=1e-5)


def sensor_poses(reconstruction: pycolmap.Reconstruction) -> list[pycolmap.Rigid3d]:
    """Return the poses of the cameras in their rig, without the reference camera, which is the rig frame."""
    (rig,) = reconstruction.rigs.values()
    return [rig.sensor_from_rig(sensor) for sensor in rig.non_ref_sensors]
