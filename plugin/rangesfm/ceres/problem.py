"""Residuals into a bundle adjuster's problem."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.ceres.compatibility import check_compatibility

if TYPE_CHECKING:
    import pyceres
    import pycolmap


_NUM_POSE_PARAMS = 7
_NUM_POSE_COLUMNS = 6


def add_residual_block(
    adjuster: pycolmap.CeresBundleAdjuster,
    cost: pyceres.CostFunction,
    loss: pyceres.LossFunction | None,
    blocks: Sequence[Array],
) -> None:
    """Add a residual to a bundle adjuster's problem, so that nothing it needs can go missing or astray.

    ``adjuster.problem.add_residual_block`` does the same for those who know its two traps. There, cost, loss
    and blocks live only as long as the Python object ``problem``, and to solve without it reads freed memory;
    here they live as long as the adjuster. And a pose that the adjuster holds constant is part of its
    reprojection costs, not of the problem: there, a range makes it a new free block without a manifold, which
    then wanders off alone; here it is held, as is the pose of a frame without observations.

    Args:
        adjuster: from ``pycolmap.create_default_ceres_bundle_adjuster``.
        cost: of which the blocks must have the sizes, in its order.
        loss: None for least squares.
        blocks: the arrays that the solver works on, in place: float64, contiguous, writeable.

    Raises:
        ValueError: a block is no such array, or given twice, or not of the cost's size.
    """
    ResidualAdder(adjuster).add(cost, loss, blocks)


def add_normal_prior(
    adjuster: pycolmap.CeresBundleAdjuster, block: Array, mean: npt.ArrayLike, stddev: npt.ArrayLike
) -> None:
    """Add what was known of a block of n numbers beforehand, each for itself: ``(x - mean) / stddev``.

    Args:
        adjuster: as in ``add_residual_block``.
        block: (n,) without a manifold, such as an anchor, a range bias or a lever arm.
        mean: (n,) in the block's unit.
        stddev: of all, or (n,) likewise, positive.

    Raises:
        ValueError: a value is not finite, or a stddev not positive, or not of its shape.
    """
    means, stddevs = np.asarray(mean, dtype=np.float64), np.broadcast_to(stddev, block.shape)
    variances = np.square(stddevs)
    is_right = np.isfinite(means) & (stddevs > 0) & (variances > 0) & np.isfinite(variances)
    if means.shape != block.shape or not is_right.all():
        raise ValueError(
            f"a prior of mean {mean!r} and stddev {stddev!r}, expected finite and positive for each number"
        )
    check_compatibility()
    import pyceres

    cost = pyceres.factors.NormalPrior(means, np.diag(variances))
    add_residual_block(adjuster, cost, None, [block])


def keep_from_elimination(adjuster: pycolmap.CeresBundleAdjuster, block: Array, point: Array) -> None:
    """Have Ceres eliminate the 3-D points alone, with its fastest kernels; for each free anchor, bias and the like.

    Ceres eliminates a set of blocks no two of which share a residual, first those of few neighbours, and has kernels
    for blocks of one size that see blocks of one other size. Left alone, an anchor is taken for one of the points, and
    eliminating it couples all poses that it was ranged from. So it is tied to a point by residuals that are always
    zero; and takes as many columns as a pose, the last of them zero, since the kernels are for one size.

    Args:
        adjuster: as in ``add_residual_block``.
        block: part of its problem, not constant, of 6 numbers at most.
        point: a 3-D point's block that fewer images see than ``block`` has neighbours; it may hold several ties.
    """
    check_compatibility()
    from rangesfm import _cpp

    add_residual_block(adjuster, _cpp.zero_tie_cost(size_a=len(block), size_b=len(point)), None, [block, point])
    if not adjuster.problem.has_manifold(block):
        manifold = _cpp.padded_manifold(size=len(block), tangent_size=_NUM_POSE_COLUMNS)
        adjuster.problem.set_manifold(block, manifold)
        _used_by_adjuster[adjuster].append(manifold)


class ResidualAdder:
    """What ``add_residual_block`` does, for one residual after the other into the same problem."""

    def __init__(self, adjuster: pycolmap.CeresBundleAdjuster) -> None:
        self._problem = adjuster.problem
        self._used = _used_by_adjuster.setdefault(adjuster, [])

    def add(self, cost: pyceres.CostFunction, loss: pyceres.LossFunction | None, blocks: Sequence[Array]) -> None:
        """See ``add_residual_block``."""
        for block in blocks:
            if block.dtype != np.float64 or not block.flags.carray:
                raise ValueError("the solver works in place: a block must be a contiguous, writeable float64 array")
        if len({block.__array_interface__["data"][0] for block in blocks}) < len(blocks):
            raise ValueError("a block is given twice: the blocks of one residual must be different ones")
        problem = self._problem
        held = [b for b in blocks if b.size == _NUM_POSE_PARAMS and not problem.has_parameter_block(b)]
        problem.add_residual_block(cost, loss, list(blocks))
        for pose in held:
            problem.set_parameter_block_constant(pose)
        self._used.append((cost, loss, blocks))


# What residuals refer to. The problem refers to its adjuster, so only a weak key lets the two go in the end.
_used_by_adjuster: weakref.WeakKeyDictionary[pycolmap.CeresBundleAdjuster, list[Any]] = weakref.WeakKeyDictionary()
