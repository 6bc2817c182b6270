"""The range residuals alone, for bundle adjustment programs of one's own.

See ``examples/own_problem.py``. Blocks, units and errors are described with each function.
"""

from rangesfm._ceres import (
    CostFunction,
    LossFunction,
    add_residual_block,
    cauchy_loss,
    fixed_pose_range_cost,
    interpolated_range_cost,
    normal_prior_cost,
    range_cost,
    zero_tie_cost,
)

__all__ = [
    "CostFunction",
    "LossFunction",
    "add_residual_block",
    "cauchy_loss",
    "fixed_pose_range_cost",
    "interpolated_range_cost",
    "normal_prior_cost",
    "range_cost",
    "zero_tie_cost",
]
