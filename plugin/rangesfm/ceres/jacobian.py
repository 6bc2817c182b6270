"""Ceres' Jacobian of a problem as a sparse matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix


def num_columns(problem: Any, block: npt.NDArray[np.float64]) -> int:
    """Of a block in ``tangent_jacobian``: its tangent size, without the padding of ``keep_from_elimination``."""
    return min(int(problem.parameter_block_tangent_size(block)), len(block))


def tangent_jacobian(problem: Any, blocks: Sequence[npt.NDArray[np.float64]]) -> csr_matrix:
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
    sizes = [problem.parameter_block_tangent_size(block) for block in blocks]
    wanted = [np.arange(size) < num_columns(problem, block) for size, block in zip(sizes, blocks, strict=True)]
    return padded[:, np.concatenate(wanted)] if sum(sizes) > sum(map(np.sum, wanted)) else padded
