"""The range and distance residuals alone, for bundle adjustment programs of one's own.

See ``examples/own_problem.py``. Blocks, units and errors are described with each function. A cost is a
``pyceres.CostFunction``; importing this raises ``SolverError`` where pyceres does not fit (``rangesfm doctor``).
"""

from rangesfm.ceres import (
    PlacedRanges,
    RangeBlocks,
    add_normal_prior,
    add_ranges,
    add_residual_block,
    direction_cost,
    distance_cost,
    interpolated_range_cost,
    joint_prior_cost,
    keep_from_elimination,
    range_cost,
)

__all__ = [
    "PlacedRanges",
    "RangeBlocks",
    "add_normal_prior",
    "add_ranges",
    "add_residual_block",
    "direction_cost",
    "distance_cost",
    "interpolated_range_cost",
    "joint_prior_cost",
    "keep_from_elimination",
    "range_cost",
]
