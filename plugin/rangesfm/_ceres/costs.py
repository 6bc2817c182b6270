"""The compiled cost functions, each with what it says and which blocks it acts on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from rangesfm._ceres.compatibility import check_compatibility
from rangesfm._ceres.types import CostFunction


@dataclass(frozen=True)
class RangeErrorModel:
    """How ranges err, beside their bias.

    Attributes:
        short_range_length_m: given, ``amplitude * exp(-distance / length)`` is added to the prediction; the
            amplitude (metres) becomes a block.
        error_curve_m: (m, 2) given, ``amplitude`` times a curve through these (distance, error), distances
            increasing, is added, and the amplitude becomes a block; to take the curve as it is, hold that at 1.
            Its slope is continuous; beyond its ends it stays as it is. Not together with the length.
        loss_scale_too_long: of the robust loss of each range that is longer than predicted, in stddevs, positive;
            infinite: least squares.
        loss_scale_too_short: the same for those that are shorter. Reflections make long ranges likelier: a
            smaller scale for these than for short ones.
        loss_is_bounded: whether that loss is Geman-McClure's, ``r^2 / (1 + r^2 / scale^2)``, which no outlier raises
            beyond ``scale^2``; otherwise Cauchy's, ``scale^2 log(1 + r^2 / scale^2)``.
    """

    short_range_length_m: float | None = None
    error_curve_m: npt.ArrayLike | None = None
    loss_scale_too_long: float = math.inf
    loss_scale_too_short: float = math.inf
    loss_is_bounded: bool = False

    @property
    def has_amplitude(self) -> bool:
        """Whether the costs have the amplitude as a block."""
        return self.short_range_length_m is not None or self.error_curve_m is not None

    @property
    def is_least_squares(self) -> bool:
        """Whether no range is down-weighted."""
        return math.isinf(self.loss_scale_too_long) and math.isinf(self.loss_scale_too_short)


def range_cost(
    *,
    range_m: npt.ArrayLike,
    tag_in_cam_m: npt.ArrayLike | None,
    stddev_m: npt.ArrayLike,
    share: npt.ArrayLike = 1.0,
    has_common_bias: bool = False,
    error_model: RangeErrorModel | None = None,
) -> CostFunction:
    """Ranges measured at one keyframe to one anchor; each is a residual, ``(predicted - range) / stddev`` with

    ``predicted = d + bias + common_bias + amplitude * curve(d)``, ``d = ||R^T (tag_in_cam - t) - anchor||``,
    made robust for itself (see ``RangeErrorModel``): half the sum of squares is the sum of the losses, each times its
    share.

    Blocks: rig_from_world (7,), anchor in the world (3,), range bias (1,): what the radio reads too long. Then,
    as far as they are asked for and in this order: tag_in_cam (3,), common bias (1,), amplitude (1,).
    With the tag on the anchor, where a distance has no derivative, that part of the Jacobian is zero.

    Args:
        range_m: one, or (n,) ranges as measured, positive.
        tag_in_cam_m: (3,) lever arm, the tag's antenna in the rig frame; None makes it a block.
        stddev_m: noise of all ranges, or (n,) of each, positive.
        share: by how much all ranges count beside their noise, or (n,) each, positive.
        has_common_bias: whether a second bias, shared with other anchors, is a block.
        error_model: None is that of least squares, without a curve.

    Raises:
        ValueError: a value is not finite, or outside its limits, or not of its shape.
        SolverError: see ``check_compatibility``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.range_cost(
        range_m=range_m,
        stddev_m=stddev_m,
        tag_in_cam_m=tag_in_cam_m,
        share=share,
        has_common_bias=has_common_bias,
        **_keywords(error_model),
    )


def fixed_pose_range_cost(
    *,
    range_m: npt.ArrayLike,
    tag_in_world_m: npt.ArrayLike,
    stddev_m: npt.ArrayLike,
    share: npt.ArrayLike = 1.0,
    has_common_bias: bool = False,
    error_model: RangeErrorModel | None = None,
) -> CostFunction:
    """Ranges measured from a known place: as ``range_cost`` with ``d = ||tag_in_world - anchor||``.

    Blocks: anchor in the world (3,), range bias (1,); then common bias (1,) and amplitude (1,), if asked for.
    Arguments and errors as for ``range_cost``, but tag_in_world_m: (3,) the tag's antenna in the world.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.fixed_pose_range_cost(
        range_m=range_m,
        stddev_m=stddev_m,
        tag_in_world_m=tag_in_world_m,
        share=share,
        has_common_bias=has_common_bias,
        **_keywords(error_model),
    )


def interpolated_range_cost(
    *,
    range_m: npt.ArrayLike,
    tag_in_cam_m: npt.ArrayLike | None,
    weight: npt.ArrayLike,
    offset_in_world_m: npt.ArrayLike,
    stddev_m: npt.ArrayLike,
    interval_s: float | None = None,
    offset_velocity_in_world_m_per_s: npt.ArrayLike | None = None,
    share: npt.ArrayLike = 1.0,
    has_common_bias: bool = False,
    error_model: RangeErrorModel | None = None,
) -> CostFunction:
    """Ranges measured between two keyframes to one anchor.

    As ``range_cost``, with the tag at ``(1 - w) * p_before + w * p_after + offset + time_shift * velocity``,
    ``p = R^T (tag_in_cam - t)`` of either pose, and ``w = weight + time_shift / interval``. The time shift is
    how much later than thought the ranges were taken: what to add to the clock offset.
    Blocks: rig_from_world before (7,) and after (7,), two different frames; anchor in the world (3,); range
    bias (1,). Then, as far as they are asked for and in this order: tag_in_cam (3,), time shift (1,), common
    bias (1,), amplitude (1,). Arguments and errors as for ``range_cost``, and

    Args:
        weight: of all, or (n,) of each: from 0 (at the pose before) to 1 (at the pose after).
        offset_in_world_m: (3,) or (n, 3), what a curved path has beyond the straight line; it stays as it is,
            also where the lever arm is a block.
        interval_s: time from the keyframe before to that after, positive; given, the time shift is a block.
        offset_velocity_in_world_m_per_s: (3,) or (n, 3), how the offset changes with time; None: not at all.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.interpolated_range_cost(
        range_m=range_m,
        stddev_m=stddev_m,
        tag_in_cam_m=tag_in_cam_m,
        weight=weight,
        offset_in_world_m=offset_in_world_m,
        interval_s=interval_s,
        offset_velocity_in_world_m_per_s=offset_velocity_in_world_m_per_s,
        share=share,
        has_common_bias=has_common_bias,
        **_keywords(error_model),
    )


def distance_cost(
    *,
    distance_m: float,
    stddev_m: float,
    a_in_cam_m: npt.ArrayLike | None = None,
    b_in_cam_m: npt.ArrayLike | None = None,
    has_bias: bool = False,
    loss_scale: float = math.inf,
) -> CostFunction:
    """A distance between two ends a and b, by tape or by radio: ``(||a - b|| + bias - distance) / stddev``.

    An end is a point in the world or fixed to a camera. Blocks: of end a, then of end b, each a point (3,) or,
    where its place in the rig frame is given, rig_from_world (7,); then the bias (1,), what is read too long,
    if there is one. The two ends are different blocks. Between two anchors both are points.

    Args:
        distance_m: measured, positive.
        stddev_m: its noise, positive.
        a_in_cam_m, b_in_cam_m: (3,) the end in the rig frame; None for a point.
        has_bias: whether a bias is a block.
        loss_scale: of a bounded loss (see ``RangeErrorModel``), in stddevs, positive; infinite: least squares.

    Raises:
        ValueError, SolverError: as ``range_cost``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.distance_cost(
        distance_m=distance_m,
        stddev_m=stddev_m,
        a_in_cam_m=a_in_cam_m,
        b_in_cam_m=b_in_cam_m,
        has_bias=has_bias,
        loss_scale=loss_scale,
    )


def direction_cost(
    *, direction_in_world: npt.ArrayLike, direction_in_cam: npt.ArrayLike, stddev_rad: float
) -> CostFunction:
    """A direction of the world that was seen from a camera, such as the vertical: 3 residuals, in stddevs.

    Block: ``rig_from_world`` (7,).

    Args:
        direction_in_world, direction_in_cam: (3,) of any length ("cam" is the rig frame).
        stddev_rad: of the direction, as an angle.

    Raises:
        ValueError, SolverError: as ``range_cost``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.direction_cost(
        direction_in_world=direction_in_world, direction_in_cam=direction_in_cam, stddev_rad=stddev_rad
    )


def normal_prior_cost(*, mean: npt.ArrayLike, stddev: npt.ArrayLike) -> CostFunction:
    """What was known of a block of n numbers beforehand, each for itself: ``(x - mean) / stddev``.

    Args:
        mean: (n,) in the block's unit.
        stddev: (n,) likewise, positive.

    Raises:
        ValueError, SolverError: as ``range_cost``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.normal_prior_cost(mean=mean, stddev=stddev)


def joint_prior_cost(*, mean: npt.ArrayLike, whitening: npt.ArrayLike) -> CostFunction:
    """What was known beforehand of n numbers that are not independent: ``whitening (x - mean)``.

    Blocks: each number for itself (1,), as the range biases of anchors, which share the tag's.

    Args:
        mean: (n,) in the blocks' unit.
        whitening: (n, n) ``whitening^T whitening`` is the inverse of the numbers' covariance.

    Raises:
        ValueError, SolverError: as ``range_cost``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.joint_prior_cost(mean=mean, whitening=whitening)


def zero_tie_cost(*, size_a: int, size_b: int) -> CostFunction:
    """Two residuals, always zero, that tie two blocks of these sizes; ``keep_from_elimination`` says what for."""
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.zero_tie_cost(size_a=size_a, size_b=size_b)


def _keywords(error_model: RangeErrorModel | None) -> dict[str, Any]:
    return {} if error_model is None else vars(error_model)
