"""The range and distance residuals alone, for bundle adjustment programs of one's own.

See ``examples/own_problem.py``. Blocks, units and errors are described with each function.
"""

from rangesfm._ceres import (
    AddedRanges,
    CostFunction,
    LossFunction,
    PlacedRanges,
    RangeBlocks,
    RangeErrorModel,
    add_ranges,
    add_residual_block,
    cauchy_loss,
    combine_ranges,
    direction_cost,
    distance_cost,
    fixed_pose_range_cost,
    interpolated_range_cost,
    joint_prior_cost,
    keep_from_elimination,
    normal_prior_cost,
    range_cost,
    zero_tie_cost,
)

__all__ = [
    "AddedRanges",
    "CostFunction",
    "LossFunction",
    "PlacedRanges",
    "RangeBlocks",
    "RangeErrorModel",
    "add_ranges",
    "add_residual_block",
    "cauchy_loss",
    "combine_ranges",
    "direction_cost",
    "distance_cost",
    "fixed_pose_range_cost",
    "interpolated_range_cost",
    "joint_prior_cost",
    "keep_from_elimination",
    "normal_prior_cost",
    "range_cost",
    "zero_tie_cost",
]
