"""Ceres' Jacobian of a problem as a sparse matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix


def tangent_jacobian(problem: Any, blocks: Sequence[npt.NDArray[np.float64]]) -> csr_matrix:
    """(num_residuals, sum of tangent sizes): robust losses applied, columns in the order of the blocks.

    Args:
        problem: an adjuster's.
        blocks: parts of the problem that are not constant; all others are taken as constant.
    """
    import pyceres

    options = pyceres.EvaluateOptions()
    options.set_parameter_blocks(list(blocks))
    jacobian = problem.evaluate_jacobian(options)
    shape = jacobian.num_rows, jacobian.num_cols
    return csr_matrix((np.asarray(jacobian.values), np.asarray(jacobian.cols), np.asarray(jacobian.rows)), shape=shape)
