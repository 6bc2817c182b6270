"""A whole log of ranges into a bundle adjuster's problem, in few residual blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rangesfm._ceres.costs import RangeErrorModel, interpolated_range_cost, range_cost
from rangesfm._ceres.problem import ResidualAdder
from rangesfm._ceres.types import CostFunction, LossFunction

if TYPE_CHECKING:
    import pycolmap

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PlacedRanges:
    """n ranges, each at a keyframe (``before == after``) or between two.

    Attributes:
        range_m: (n,) measured, positive.
        stddev_m: (n,) noise, positive.
        before, after: (n,) keyframes by their index in ``RangeBlocks.poses``.
        weight: (n,) from 0 (at ``before``) to 1 (at ``after``).
        offset_in_world_m: (n, 3) what a curved path has beyond the straight line.
        anchor_index: (n,) in ``RangeBlocks.anchors``.
        tag_index: (n,) in ``RangeBlocks.tags_in_cam``.
        interval_s: (n,) time from ``before`` to ``after``; needed only for a time shift.
        offset_velocity_in_world_m_per_s: (n, 3) how the offset changes with time; None: not at all.
        share: (n,) by how much each counts beside its noise, positive; None: 1.
    """

    range_m: Array
    stddev_m: Array
    before: Indices
    after: Indices
    weight: Array
    offset_in_world_m: Array
    anchor_index: Indices
    tag_index: Indices
    interval_s: Array | None = None
    offset_velocity_in_world_m_per_s: Array | None = None
    share: Array | None = None

    def shares(self, rows: Indices) -> Array:
        """(k,) of some of the ranges."""
        return np.ones(len(rows)) if self.share is None else self.share[rows]


@dataclass(frozen=True)
class RangeBlocks:
    """The parameter blocks that ranges act on; the solver changes them in place.

    Attributes:
        poses: rig_from_world (7,) of each keyframe.
        anchors: (3,) each, in the world.
        biases: (1,) of each anchor: what its ranges read too long.
        tags_in_cam: (3,) of each tag: its antenna in the rig frame; blocks only if ``lever_arms_are_free``.
        lever_arms_are_free: whether the tags' places are estimated.
        common_biases: (1,) of each tag, on top of the anchors'; None for none.
        time_shift: (1,) seconds that the ranges were taken later than thought; None: taken as they are. It
            acts on ranges between two keyframes, also on those with a weight of 0 or 1.
        amplitude: (1,) of the error model's curve; given exactly where there is one.
    """

    poses: Sequence[Array]
    anchors: Sequence[Array]
    biases: Sequence[Array]
    tags_in_cam: Sequence[Array]
    lever_arms_are_free: bool = False
    common_biases: Sequence[Array] | None = None
    time_shift: Array | None = None
    amplitude: Array | None = None


@dataclass(frozen=True)
class AddedRanges:
    """What came into the problem.

    Attributes:
        num_residual_blocks, num_residuals: of the problem; fewer residuals than ranges where some were combined.
        rows: (num_residuals,) which range each residual is of, in the problem's order; of combined ones, the first.
        constant_cost: what the combined ranges would have added to the cost, whatever the parameters.
    """

    num_residual_blocks: int
    num_residuals: int
    rows: Indices
    constant_cost: float


def add_ranges(
    adjuster: pycolmap.CeresBundleAdjuster,
    ranges: PlacedRanges,
    blocks: RangeBlocks,
    error_model: RangeErrorModel | None = None,
    loss: LossFunction | None = None,
) -> AddedRanges:
    """Add ranges to a bundle adjuster's problem: those of one place, anchor and tag as one residual block.

    The solver's work grows with the blocks and with the pairs of blocks that share a residual, much less with
    the residuals in one; and each block takes some microseconds to add. Robust losses act on each range all the
    same. Ranges at a keyframe that count by least squares are combined into one without loss.

    Args:
        adjuster: as in ``add_residual_block``, which says what is held and what lives how long.
        ranges: n, in any order.
        blocks: of which those that no range refers to do not become part of the problem.
        error_model: None is least squares, without a curve.
        loss: of Ceres; with one, each range is a residual block of its own, in their order: from a bad start that
            takes fewer iterations than a loss of the error model.

    Raises:
        ValueError: as ``range_cost`` and ``add_residual_block``; a time shift without intervals; an amplitude
            without a curve, or a curve without one.
    """
    error_model = error_model or RangeErrorModel()
    if (blocks.amplitude is not None) != error_model.has_amplitude:
        raise ValueError("the amplitude is given without a curve in the error model, or the curve without it")
    if blocks.time_shift is not None and ranges.interval_s is None:
        raise ValueError("a time shift needs interval_s, the time between the keyframes of each range")
    adder = ResidualAdder(adjuster)
    residual_rows: list[Indices] = []
    constant_cost = 0.0
    for rows in _groups(ranges) if loss is None else np.arange(len(ranges.range_m))[:, None]:
        if ranges.before[rows[0]] == ranges.after[rows[0]]:
            cost, lost = _cost_at_keyframe(ranges, rows, blocks, error_model)
            constant_cost += lost
        else:
            cost = _cost_between_keyframes(ranges, rows, blocks, error_model)
        adder.add(cost, loss, _blocks_of_group(ranges, int(rows[0]), blocks))
        residual_rows.append(rows[: cost.num_residuals()])
    in_order = np.concatenate([np.zeros(0, dtype=np.int64), *residual_rows])
    return AddedRanges(len(residual_rows), len(in_order), in_order, constant_cost)


def combine_ranges(range_m: Array, stddev_m: Array) -> tuple[Array, Array, float]:
    """The one range that says what n of the same distance say together, by least squares.

    ``sum (d - r_i)^2 / s_i^2 = (d - r)^2 / s^2 + constant`` for every d, with the weighted mean r and
    ``1 / s^2 = sum 1 / s_i^2``.

    Args:
        range_m, stddev_m: (n,), n >= 1.

    Returns:
        range (1,), stddev (1,), and half of the constant: what is missing in the cost.
    """
    information = 1.0 / np.square(stddev_m)
    total = information.sum()
    mean = information @ range_m / total
    constant = float(information @ np.square(range_m - mean))
    return np.array([mean]), np.array([1.0 / np.sqrt(total)]), 0.5 * constant


def _groups(ranges: PlacedRanges) -> Iterator[Indices]:
    """Rows of the ranges that share keyframes, anchor and tag."""
    keys = np.stack([ranges.before, ranges.after, ranges.anchor_index, ranges.tag_index])
    if keys.shape[1] == 0:
        return
    order = np.lexsort(keys[::-1])
    starts = np.flatnonzero(np.any(np.diff(keys[:, order]) != 0, axis=0)) + 1
    yield from np.split(order, starts)


def _cost_at_keyframe(
    ranges: PlacedRanges, rows: Indices, blocks: RangeBlocks, error_model: RangeErrorModel
) -> tuple[CostFunction, float]:
    """And what it lacks in the cost, of ranges that were combined."""
    range_m, stddev_m, share, lost = ranges.range_m[rows], ranges.stddev_m[rows], ranges.shares(rows), 0.0
    if error_model.is_least_squares:
        range_m, stddev_m, lost = combine_ranges(range_m, stddev_m / np.sqrt(share))
        share = np.ones(1)
    cost = range_cost(
        range_m=range_m,
        stddev_m=stddev_m,
        share=share,
        tag_in_cam_m=None if blocks.lever_arms_are_free else blocks.tags_in_cam[ranges.tag_index[rows[0]]],
        has_common_bias=blocks.common_biases is not None,
        error_model=error_model,
    )
    return cost, lost


def _cost_between_keyframes(
    ranges: PlacedRanges, rows: Indices, blocks: RangeBlocks, error_model: RangeErrorModel
) -> CostFunction:
    shifts = blocks.time_shift is not None and ranges.interval_s is not None
    velocity = ranges.offset_velocity_in_world_m_per_s
    return interpolated_range_cost(
        range_m=ranges.range_m[rows],
        stddev_m=ranges.stddev_m[rows],
        share=ranges.shares(rows),
        tag_in_cam_m=None if blocks.lever_arms_are_free else blocks.tags_in_cam[ranges.tag_index[rows[0]]],
        weight=ranges.weight[rows],
        offset_in_world_m=ranges.offset_in_world_m[rows],
        interval_s=float(ranges.interval_s[rows[0]]) if shifts else None,  # type: ignore[index]
        offset_velocity_in_world_m_per_s=None if velocity is None else velocity[rows],
        has_common_bias=blocks.common_biases is not None,
        error_model=error_model,
    )


def _blocks_of_group(ranges: PlacedRanges, row: int, blocks: RangeBlocks) -> list[Array]:
    """In the order of the costs."""
    before, after, anchor, tag = (
        int(index[row]) for index in (ranges.before, ranges.after, ranges.anchor_index, ranges.tag_index)
    )
    found = [blocks.poses[before]]
    if before != after:
        found.append(blocks.poses[after])
    found += [blocks.anchors[anchor], blocks.biases[anchor]]
    if blocks.lever_arms_are_free:
        found.append(blocks.tags_in_cam[tag])
    if blocks.time_shift is not None and before != after:
        found.append(blocks.time_shift)
    if blocks.common_biases is not None:
        found.append(blocks.common_biases[tag])
    if blocks.amplitude is not None:
        found.append(blocks.amplitude)
    return found
