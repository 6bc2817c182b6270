"""Range, distance, position and inertial residuals alone, for users who write their own bundle adjustment.

``examples/own_problem.py`` shows how. Each function describes its parameter blocks, units and errors. A cost is a
``pyceres.CostFunction``. Importing this module raises ``SolverError`` where the compiled part does not fit the
installed pyceres (``rangesfm doctor`` says why).
"""

from rangesfm.solver import (
    add_residual_block,
    direction_cost,
    distance_cost,
    inertial_cost,
    interpolated_range_cost,
    joint_prior_cost,
    keep_from_elimination,
    position_cost,
    range_cost,
)

__all__ = [
    "add_residual_block",
    "direction_cost",
    "distance_cost",
    "inertial_cost",
    "interpolated_range_cost",
    "joint_prior_cost",
    "keep_from_elimination",
    "position_cost",
    "range_cost",
]
