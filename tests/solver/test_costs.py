"""The compiled cost functions in Python: blocks of pycolmap's problems, and values that they refuse.

Their residuals and derivatives are tested in C++, in ``cpp_ext/tests``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyceres
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from rangesfm._cpp import padded_manifold, zero_tie_cost
from rangesfm.solver import (
    add_residual_block,
    direction_cost,
    distance_cost,
    interpolated_range_cost,
    joint_prior_cost,
    range_cost,
)

if TYPE_CHECKING:
    from tests.solver.conftest import AdjusterOf, PoseBlock

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = np.array([-0.0012, -0.0900, -0.0663])


def moved(pose: Array, step: Array) -> Array:
    """Return a pose after a step in its tangent space, on COLMAP's manifold.

    Ceres turns Eigen's quaternions by twice the step's length, from the left.
    """
    rotation = Rotation.from_rotvec(2.0 * step[:3]) * Rotation.from_quat(pose[:4])
    return np.concatenate([rotation.as_quat(), pose[4:] + step[3:]])


def test_jacobian_in_pycolmaps_problem_is_the_finite_difference_on_its_manifold(
    reconstruction: pycolmap.Reconstruction, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    adjuster = adjuster_of(reconstruction)
    anchor_in_world, range_bias = np.array([3.0, -2.0, 1.0]), np.array([0.1])
    pose = pose_block(reconstruction, 1)
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    add_residual_block(adjuster, cost, None, [pose, anchor_in_world, range_bias])
    options = pyceres.EvaluateOptions()
    options.set_parameter_blocks([pose, anchor_in_world, range_bias])
    jacobian = adjuster.problem.evaluate_jacobian(options)

    row = np.zeros(jacobian.num_cols)
    first, last = jacobian.rows[-2:]  # the range was added last
    row[jacobian.cols[first:last]] = jacobian.values[first:last]

    def residual(step: Array) -> float:
        return float(cost.evaluate(moved(pose, step), anchor_in_world, range_bias)[0].item())

    expected = [(residual(1e-6 * unit) - residual(-1e-6 * unit)) / 2e-6 for unit in np.eye(6)]
    assert row[:6] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert len(row) == 6 + 3 + 1


def test_pose_block_is_colmaps_own(reconstruction: pycolmap.Reconstruction) -> None:
    rig_from_world = reconstruction.frame(1).rig_from_world
    assert rig_from_world is not None
    tag_in_world = rig_from_world.inverse() * TAG_IN_CAM_M
    anchor_in_world = np.array([3.0, -2.0, 1.0])
    expected = np.linalg.norm(tag_in_world - anchor_in_world) - 4.0
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=1.0)
    residuals, _ = cost.evaluate(rig_from_world.params, anchor_in_world, np.zeros(1))
    assert residuals.item() == pytest.approx(expected, abs=1e-12)


GOOD_RANGE = {"range_m": 4.0, "tag_in_cam_m": [0.0, 0.0, 0.0], "stddev_m": 0.1}
GOOD_BETWEEN = {**GOOD_RANGE, "weight": 0.5, "offset_in_world_m": [0.0, 0.0, 0.0]}


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"range_m": 0.0}, "range_m"),
        ({"range_m": -1.0}, "range_m"),
        ({"range_m": float("nan")}, "range_m"),
        ({"range_m": float("inf")}, "range_m"),
        ({"stddev_m": 0.0}, "stddev_m"),
        ({"stddev_m": -0.1}, "stddev_m"),
        ({"stddev_m": float("nan")}, "stddev_m"),
        ({"share": 0.0}, "share"),
        ({"tag_in_cam_m": [0.0, 0.0]}, "3 numbers"),
        ({"tag_in_cam_m": [[0.0, 0.0, 0.0]]}, "one dimension"),
        ({"tag_in_cam_m": 0.0}, "one dimension"),
        ({"tag_in_cam_m": [0.0, float("nan"), 0.0]}, "finite"),
        ({"weight": -0.01}, "from 0 to 1"),
        ({"weight": 1.01}, "from 0 to 1"),
        ({"weight": float("nan")}, "finite"),
        ({"offset_in_world_m": [float("inf"), 0.0, 0.0]}, "finite"),
    ],
)
def test_values_that_mean_nothing_are_refused(bad: dict[str, float | list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        interpolated_range_cost(**{**GOOD_BETWEEN, **bad})  # type: ignore[arg-type]
    if bad.keys() <= GOOD_RANGE.keys():
        with pytest.raises(ValueError, match=message):
            range_cost(**{**GOOD_RANGE, **bad})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"range_m": []}, "range_m has 1 dimensions and 0 numbers"),
        ({"range_m": [[4.0]]}, "range_m has 2 dimensions"),
        ({"range_m": [4.0, -1.0]}, "range_m"),
        ({"range_m": [4.0, 5.0], "stddev_m": [0.1, 0.1, 0.1]}, "stddev_m has .* one for each of 2 ranges"),
        ({"range_m": [4.0, 5.0], "stddev_m": [0.1, 0.0]}, "stddev_m"),
        ({"range_m": [4.0, 5.0], "share": [1.0, float("inf")]}, "share"),
        ({"range_m": [4.0, 5.0], "weight": [0.1, 1.2]}, "from 0 to 1"),
        ({"range_m": [4.0, 5.0], "offset_in_world_m": [[0, 0, 0]]}, "3 for each of 2 ranges"),
        ({"interval_s": 0.0}, "interval_s"),
        ({"offset_in_world_m": [0.0, 1.0]}, "offset_in_world_m has .* 3 numbers"),
        ({"short_range_length_m": 0.0}, "short_range_length_m"),
        ({"short_range_length_m": float("inf")}, "short_range_length_m"),
        ({"loss_scale": 0.0}, "loss_scale"),
        ({"loss_scale": -np.inf}, "loss_scale"),
        ({"loss_scale": np.nan}, "loss_scale"),
    ],
)
def test_models_and_many_ranges_that_mean_nothing_are_refused(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        interpolated_range_cost(**{**GOOD_BETWEEN, **bad})


def test_priors_and_ties_of_impossible_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="direction_in_cam is zero"):
        direction_cost(direction_in_world=[0, 0, 1], direction_in_cam=[0, 0, 0], stddev_rad=0.1)
    with pytest.raises(ValueError, match="more than 0"):
        direction_cost(direction_in_world=[0, 0, 1], direction_in_cam=[0, 0, 1], stddev_rad=0.0)
    with pytest.raises(ValueError, match="rows of 2 numbers"):
        joint_prior_cost(mean=[1.0, 2.0], whitening=np.eye(3))
    with pytest.raises(ValueError, match="whitening is nan"):
        joint_prior_cost(mean=[1.0], whitening=[[np.nan]])
    with pytest.raises(ValueError, match="mean has 0 dimensions"):
        joint_prior_cost(mean=1.0, whitening=[[1.0]])
    with pytest.raises(ValueError, match="size_b"):
        zero_tie_cost(size_a=3, size_b=0)
    with pytest.raises(ValueError, match="at least the block's size"):
        padded_manifold(size=7, tangent_size=6)
    with pytest.raises(ValueError, match="a_in_cam_m"):
        distance_cost(distance_m=1.0, stddev_m=0.1, a_in_cam_m=[0.0, 0.0])
    with pytest.raises(ValueError, match="distance_m"):
        distance_cost(distance_m=0.0, stddev_m=0.1)
    with pytest.raises(ValueError, match="loss_scale"):
        distance_cost(distance_m=1.0, stddev_m=0.1, loss_scale=0.0)
