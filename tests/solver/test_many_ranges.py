"""A whole log of ranges in a bundle adjustment: the same as adding them one by one, in fewer blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyceres
import pycolmap
import pytest

from rangesfm.solver import (
    PlacedRanges,
    RangeBlocks,
    add_ranges,
    add_residual_block,
    interpolated_range_cost,
    range_cost,
)

if TYPE_CHECKING:
    from tests.solver.conftest import AdjusterOf, PoseBlock

Array = npt.NDArray[np.float64]

NUM_RANGES, NUM_ANCHORS, NUM_TAGS, NUM_POSES = 200, 3, 2, 6
LOSS_SCALE = 2.0


@pytest.fixture
def ranges() -> PlacedRanges:
    """Ranges at and between the keyframes, in random order."""
    rng = np.random.default_rng(0)
    before = rng.integers(NUM_POSES - 1, size=NUM_RANGES)
    after = before + rng.integers(2, size=NUM_RANGES)
    between = before != after
    return PlacedRanges(
        range_m=rng.uniform(1.0, 10.0, NUM_RANGES),
        stddev_m=rng.uniform(0.5, 2.0, NUM_RANGES),
        before=before,
        after=after,
        weight=np.where(between, rng.uniform(size=NUM_RANGES), 0.0),
        offset_in_world_m=np.where(between[:, None], rng.normal(0, 0.1, (NUM_RANGES, 3)), 0.0),
        anchor_index=rng.integers(NUM_ANCHORS, size=NUM_RANGES),
        tag_index=rng.integers(NUM_TAGS, size=NUM_RANGES),
        interval_s=np.full(NUM_RANGES, 0.5),
    )


def blocks_of(reconstruction: pycolmap.Reconstruction, pose_block: PoseBlock) -> RangeBlocks:
    rng = np.random.default_rng(1)
    return RangeBlocks(
        poses=[pose_block(reconstruction, i) for i in sorted(reconstruction.reg_frame_ids())],
        anchors=list(rng.normal(0, 5, (NUM_ANCHORS, 3))),
        biases=list(rng.normal(0, 0.1, (NUM_ANCHORS, 1))),
        tags_in_cam=list(rng.normal(0, 0.1, (NUM_TAGS, 3))),
    )


def add_one_by_one(
    adjuster: pycolmap.CeresBundleAdjuster,
    ranges: PlacedRanges,
    blocks: RangeBlocks,
    loss: pyceres.LossFunction | None = None,
) -> None:
    for i in range(NUM_RANGES):
        ends = [blocks.anchors[ranges.anchor_index[i]], blocks.biases[ranges.anchor_index[i]]]
        tag = blocks.tags_in_cam[ranges.tag_index[i]]
        before, after = blocks.poses[ranges.before[i]], blocks.poses[ranges.after[i]]
        if before is after:
            cost = range_cost(range_m=ranges.range_m[i], tag_in_cam_m=tag, stddev_m=ranges.stddev_m[i])
            add_residual_block(adjuster, cost, loss, [before, *ends])
        else:
            cost = interpolated_range_cost(
                range_m=ranges.range_m[i],
                tag_in_cam_m=tag,
                weight=ranges.weight[i],
                offset_in_world_m=ranges.offset_in_world_m[i],
                stddev_m=ranges.stddev_m[i],
            )
            add_residual_block(adjuster, cost, loss, [before, after, *ends])


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


def test_cost_and_gradient_are_those_of_the_ranges_one_by_one(
    reconstruction: pycolmap.Reconstruction, ranges: PlacedRanges, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    blocks = blocks_of(reconstruction, pose_block)
    one_by_one, together = adjuster_of(reconstruction), adjuster_of(reconstruction)
    before = together.problem.num_residual_blocks()
    add_one_by_one(one_by_one, ranges, blocks, pyceres.CauchyLoss(LOSS_SCALE))
    add_ranges(together, ranges, blocks, loss_scale=LOSS_SCALE)
    assert gradient_norm(together) == pytest.approx(gradient_norm(one_by_one), rel=1e-9)
    # The solver's initial cost is used because with one of Ceres' losses the cost is not half the sum of the squared
    # residuals.
    assert cost_of(together) == pytest.approx(initial_cost(one_by_one), rel=1e-9)
    assert 0 < together.problem.num_residual_blocks() - before < NUM_RANGES / 2


def test_each_range_has_its_residual_where_it_is_said_to_be(
    reconstruction: pycolmap.Reconstruction, ranges: PlacedRanges, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    blocks = blocks_of(reconstruction, pose_block)
    one_by_one, together = adjuster_of(reconstruction), adjuster_of(reconstruction)
    add_one_by_one(one_by_one, ranges, blocks)
    rows = add_ranges(together, ranges, blocks)
    assert len(set(rows)) == NUM_RANGES
    expected = np.asarray(one_by_one.problem.evaluate_residuals())[-NUM_RANGES:]
    np.testing.assert_allclose(np.asarray(together.problem.evaluate_residuals())[rows], expected, atol=1e-12)


def test_everything_that_can_be_estimated_reaches_its_block(
    reconstruction: pycolmap.Reconstruction, ranges: PlacedRanges, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    fixed = blocks_of(reconstruction, pose_block)
    blocks = replace(
        fixed,
        lever_arms_are_free=True,
        time_shift=np.zeros(1),
        amplitude=np.zeros(1),
    )
    adjuster, same = adjuster_of(reconstruction), adjuster_of(reconstruction)
    add_ranges(adjuster, ranges, blocks, short_range_length_m=1.0, loss_scale=LOSS_SCALE)
    add_ranges(same, ranges, fixed, loss_scale=LOSS_SCALE)
    assert cost_of(adjuster) == pytest.approx(cost_of(same), rel=1e-12)
    assert blocks.time_shift is not None
    assert blocks.amplitude is not None
    for block in (*blocks.tags_in_cam, blocks.time_shift, blocks.amplitude):
        assert adjuster.problem.has_parameter_block(block)
        before = cost_of(adjuster)
        block += 0.1
        assert cost_of(adjuster) != pytest.approx(before, rel=1e-6)
    assert not any(same.problem.has_parameter_block(tag) for tag in fixed.tags_in_cam)


def test_a_short_range_error_needs_its_amplitude_and_a_time_shift_its_intervals(
    reconstruction: pycolmap.Reconstruction, ranges: PlacedRanges, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    adjuster, blocks = adjuster_of(reconstruction), blocks_of(reconstruction, pose_block)
    of_short = r"^of short_range_length_m and its amplitude one is given without the other$"
    with pytest.raises(ValueError, match=of_short):
        add_ranges(adjuster, ranges, blocks, short_range_length_m=1.0)
    with pytest.raises(ValueError, match=of_short):
        add_ranges(adjuster, ranges, replace(blocks, amplitude=np.zeros(1)))
    of_shift = r"^a time shift needs interval_s, the time between the keyframes of each range$"
    with pytest.raises(ValueError, match=of_shift):
        add_ranges(adjuster, replace(ranges, interval_s=None), replace(blocks, time_shift=np.zeros(1)))


def test_no_ranges_are_no_blocks(
    reconstruction: pycolmap.Reconstruction, ranges: PlacedRanges, adjuster_of: AdjusterOf, pose_block: PoseBlock
) -> None:
    none = PlacedRanges(**{name: value[:0] for name, value in vars(ranges).items() if value is not None})
    adjuster = adjuster_of(reconstruction)
    before = adjuster.problem.num_residual_blocks()
    assert len(add_ranges(adjuster, none, blocks_of(reconstruction, pose_block))) == 0
    assert adjuster.problem.num_residual_blocks() == before


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
    frame, anchor = (index.ravel() for index in np.meshgrid(np.arange(len(frames)), np.arange(4)))
    ranges = PlacedRanges(
        range_m=np.linalg.norm(truth[frame] - np.array(anchors)[anchor], axis=1),
        stddev_m=np.full(len(frame), 1e-3),
        before=frame,
        after=frame,
        weight=np.zeros(len(frame)),
        offset_in_world_m=np.zeros((len(frame), 3)),
        anchor_index=anchor,
        tag_index=np.zeros(len(frame), dtype=np.int64),
    )
    reconstruction.transform(pycolmap.Sim3d(1.04, pycolmap.Rotation3d(), np.zeros(3)))
    adjuster = adjuster_of(reconstruction)
    biases = [np.zeros(1) for _ in anchors]
    poses = [pose_block(reconstruction, i) for i in frames]
    add_ranges(adjuster, ranges, RangeBlocks(poses, anchors, biases, [tag_in_cam]))
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
