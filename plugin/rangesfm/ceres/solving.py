"""Solving a bundle adjuster's problem, with a say in when it is enough; and its Jacobian as a sparse matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_matrix

from rangesfm.arrays import Array
from rangesfm.ceres.doctor import check_compatibility

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class Step:
    """What the solver just did.

    Attributes:
        is_successful: whether the parameters moved. trust_region_radius: with which the step was found.
        cost: after it. gain: by how much it fell. expected_gain: by how much it would have, were all residuals linear.
    """

    is_successful: bool
    trust_region_radius: float
    cost: float
    gain: float
    expected_gain: float


def solve(adjuster: pycolmap.CeresBundleAdjuster, is_enough: Callable[[Step], bool]) -> Any:
    """Solve as ``adjuster.solve`` does, asking after each step whether that is enough.

    Args:
        is_enough: called with the parameters where the step left them; True ends the solve. What it raises ends it
            too, and is raised here.

    Returns:
        Ceres' summary, a ``pyceres.SolverSummary``.
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
    """Of a block in ``tangent_jacobian``: its tangent size, without the padding of ``keep_from_elimination``."""
    return min(int(problem.parameter_block_tangent_size(block)), len(block))


def tangent_jacobian(problem: Any, blocks: Sequence[Array]) -> csr_matrix:
    """(num_residuals, sum of ``num_columns``): robust losses applied, columns in the order of the blocks.

    Args:
        problem: an adjuster's.
        blocks: parts of the problem that are not constant; all others are taken as constant.
    """
    import pyceres

    options = pyceres.EvaluateOptions()
    options.set_parameter_blocks(list(blocks))
    jacobian = problem.evaluate_jacobian(options)
    shape = jacobian.num_rows, jacobian.num_cols
    padded = csr_matrix(
        (np.asarray(jacobian.values), np.asarray(jacobian.cols), np.asarray(jacobian.rows)), shape=shape
    )
    sizes = np.array([problem.parameter_block_tangent_size(block) for block in blocks], dtype=np.int64)
    wanted = np.minimum(sizes, [len(block) for block in blocks])
    in_block = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return padded[:, in_block < np.repeat(wanted, sizes)] if (wanted < sizes).any() else padded
