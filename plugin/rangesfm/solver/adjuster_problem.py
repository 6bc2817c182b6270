"""A bundle adjuster's problem: adding residuals, solving, and its Jacobian as a sparse matrix."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csc_array, csr_array

from rangesfm.arrays import Array
from rangesfm.solver.installation_checks import check_compatibility
from rangesfm.util.processes.threads import num_threads

if TYPE_CHECKING:
    import pyceres
    import pycolmap

_NUM_POSE_PARAMS = 7
_NUM_POSE_COLUMNS = 6
# Objects that residuals refer to. The problem refers to its adjuster, so only a weak key lets both be freed in the end.
_used_by_adjuster: weakref.WeakKeyDictionary[pycolmap.CeresBundleAdjuster, list[Any]] = weakref.WeakKeyDictionary()


def add_residual_block(
    adjuster: pycolmap.CeresBundleAdjuster,
    cost: pyceres.CostFunction,
    loss: pyceres.LossFunction | None,
    blocks: Sequence[Array],
) -> None:
    """Add a residual to a bundle adjuster's problem, with correct lifetimes and constant poses.

    ``adjuster.problem.add_residual_block`` has two traps. There, cost, loss and blocks live only as long as the Python
    object ``problem``, and solving without it reads freed memory; here they live as long as the adjuster. And a pose
    that the adjuster holds constant is part of its reprojection costs, not of the problem: there, a range would add it
    as a free block without a manifold, which then moves on its own; here it is held constant, as is the pose of a frame
    without observations.

    Args:
        adjuster: from ``pycolmap.create_default_ceres_bundle_adjuster``.
        cost: its blocks must have the sizes and the order of ``blocks``.
        loss: None for least squares.
        blocks: float64, contiguous and writeable arrays, which the solver changes in place.

    Raises:
        ValueError: a block is not such an array, is given twice, or does not have the size that the cost expects.
    """
    for block in blocks:
        if block.dtype != np.float64 or not block.flags.carray:
            raise ValueError("the solver works in place: a block must be a contiguous, writeable float64 array")
    if len({block.__array_interface__["data"][0] for block in blocks}) < len(blocks):
        raise ValueError("a block is given twice: the blocks of one residual must be different ones")
    problem = adjuster.problem
    held = [b for b in blocks if b.size == _NUM_POSE_PARAMS and not problem.has_parameter_block(b)]
    problem.add_residual_block(cost, loss, list(blocks))
    for pose in held:
        problem.set_parameter_block_constant(pose)
    _used_by_adjuster.setdefault(adjuster, []).append((cost, loss, blocks))


def keep_from_elimination(adjuster: pycolmap.CeresBundleAdjuster, block: Array, point: Array) -> None:
    """Make Ceres eliminate only the 3-D points, with its fastest kernels; to call for each free anchor, bias etc.

    Ceres eliminates a set of blocks no two of which share a residual, first those with few neighbours. It has fast
    kernels if all blocks of the set have one size and all others another size. Without this function it takes an anchor
    for one of the points, and eliminating it couples all poses with ranges to it. So the block is tied to a point by
    residuals that are always zero. It also gets as many columns as a pose, of which the last are zero, because of the
    one size.

    Args:
        adjuster: as in ``add_residual_block``.
        block: part of the problem, not constant, of at most 6 numbers.
        point: block of a 3-D point seen by fewer images than ``block`` has neighbours; it may hold several ties.
    """
    check_compatibility()
    from rangesfm import _cpp

    add_residual_block(adjuster, _cpp.zero_tie_cost(size_a=len(block), size_b=len(point)), None, [block, point])
    if not adjuster.problem.has_manifold(block):
        manifold = _cpp.padded_manifold(size=len(block), tangent_size=_NUM_POSE_COLUMNS)
        adjuster.problem.set_manifold(block, manifold)
        _used_by_adjuster[adjuster].append(manifold)


@dataclass(frozen=True)
class Step:
    """One step of the solver.

    Attributes:
        is_successful: whether the parameters changed. trust_region_radius: with which the step was computed.
        cost: after the step. gain: decrease of the cost. expected_gain: decrease if all residuals were linear.
    """

    is_successful: bool
    trust_region_radius: float
    cost: float
    gain: float
    expected_gain: float


def solve_adjuster(adjuster: pycolmap.CeresBundleAdjuster, is_enough: Callable[[Step], bool]) -> Any:
    """Solve like ``adjuster.solve``, and ask after each step whether to stop.

    Args:
        is_enough: called after each step, with the parameters updated; True ends the solution. Its exceptions end the
            solution too and are raised here.

    Returns:
        the summary of Ceres, a ``pyceres.SolverSummary``.
    """
    check_compatibility()
    import pyceres

    class AfterStep(pyceres.IterationCallback):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.radius = 0.0
            self.error: BaseException | None = None

        def __call__(self, summary: Any) -> Any:
            # An exception must not pass through the solver.
            try:
                gain, share = summary.cost_change, summary.relative_decrease
                expected = gain / share if share else 0.0
                step = Step(summary.step_is_successful, self.radius, summary.cost, gain, expected)
                self.radius = summary.trust_region_radius
                if summary.iteration == 0 or not is_enough(step):
                    return pyceres.CallbackReturnType.SOLVER_CONTINUE
                return pyceres.CallbackReturnType.SOLVER_TERMINATE_SUCCESSFULLY
            except BaseException as error:
                self.error = error
                return pyceres.CallbackReturnType.SOLVER_ABORT

    after_step, summary = AfterStep(), pyceres.SolverSummary()
    options = pyceres.SolverOptions(adjuster.options.ceres.create_solver_options(adjuster.config, adjuster.problem))
    options.callbacks, options.update_state_every_iteration = [after_step], True
    pyceres.solve(options, adjuster.problem, summary)
    if after_step.error is not None:
        raise after_step.error
    return summary


def num_columns(problem: Any, block: Array) -> int:
    """Return a block's number of columns in ``tangent_jacobian``: its tangent size without padding."""
    return min(int(problem.parameter_block_tangent_size(block)), len(block))


def tangent_jacobian(problem: Any, blocks: Sequence[Array]) -> csc_array:
    """Return the Jacobian, (num_residuals, sum of ``num_columns``), with robust losses, in the order of the blocks.

    Args:
        problem: of an adjuster.
        blocks: non-constant blocks of the problem; all other blocks are taken as constant.
    """
    import pyceres

    options = pyceres.EvaluateOptions()
    options.set_parameter_blocks(list(blocks))
    options.num_threads = num_threads()  # one thread computes an entry, so their number changes no result
    jacobian = problem.evaluate_jacobian(options)
    _, columns, values = jacobian.to_tuple()
    sizes = np.array([problem.parameter_block_tangent_size(block) for block in blocks], dtype=np.int64)
    wanted = np.minimum(sizes, [len(block) for block in blocks])
    is_padding = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes) >= np.repeat(wanted, sizes)
    place = np.empty(len(is_padding), dtype=columns.dtype)
    place[np.argsort(is_padding, kind="stable")] = np.arange(len(place))  # padding goes to the end, where it is cut off
    shape = jacobian.num_rows, jacobian.num_cols
    by_column = csr_array((values, place[columns], jacobian.rows), shape=shape).tocsc()
    starts = by_column.indptr[: wanted.sum() + 1]
    entries = slice(starts[-1])  # a view of the entries, which take most of the memory of a large map
    return csc_array((by_column.data[entries], by_column.indices[entries], starts), shape=(shape[0], wanted.sum()))
