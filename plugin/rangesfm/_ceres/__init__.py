"""The compiled cost functions, and Ceres as pyceres shows it. No other package touches either.

A range residual goes into the problem of one of pycolmap's bundle adjusters::

    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    cost = range_cost(range_m=4.2, tag_in_cam_m=[0, -0.09, -0.066], stddev_m=0.1)
    pose = reconstruction.frame(frame_id).rig_from_world.params
    add_residual_block(adjuster, cost, cauchy_loss(2.4), [pose, anchor_in_world, range_bias])
    adjuster.solve()

and a whole log of them in one call by ``add_ranges``. Poses are COLMAP's blocks: rig_from_world as
[qx qy qz qw tx ty tz], and "cam" is the rig frame (the rig's reference camera). Metres throughout, residuals in
stddevs; every value is checked where a cost is made.

pycolmap, pyceres and the compiled part exchange C++ objects, which works only between the versions that
``pyproject.toml`` pins. Whatever is first used here checks it, by a residual whose cost is known.
"""

from rangesfm._ceres.compatibility import (
    check_compatibility,
    compiled_part_version,
    pyceres_ceres_version,
)
from rangesfm._ceres.costs import (
    RangeErrorModel,
    direction_cost,
    distance_cost,
    fixed_pose_range_cost,
    interpolated_range_cost,
    joint_prior_cost,
    normal_prior_cost,
    range_cost,
    zero_tie_cost,
)
from rangesfm._ceres.jacobian import num_columns, tangent_jacobian
from rangesfm._ceres.many_ranges import AddedRanges, PlacedRanges, RangeBlocks, add_ranges, combine_ranges
from rangesfm._ceres.problem import add_residual_block, cauchy_loss, keep_from_elimination
from rangesfm._ceres.solving import Step, solve
from rangesfm._ceres.types import CostFunction, LossFunction

__all__ = [
    "AddedRanges",
    "CostFunction",
    "LossFunction",
    "PlacedRanges",
    "RangeBlocks",
    "RangeErrorModel",
    "Step",
    "add_ranges",
    "add_residual_block",
    "cauchy_loss",
    "check_compatibility",
    "combine_ranges",
    "compiled_part_version",
    "direction_cost",
    "distance_cost",
    "fixed_pose_range_cost",
    "interpolated_range_cost",
    "joint_prior_cost",
    "keep_from_elimination",
    "normal_prior_cost",
    "num_columns",
    "pyceres_ceres_version",
    "range_cost",
    "solve",
    "tangent_jacobian",
    "zero_tie_cost",
]
