"""What the compiled part offers; ``rangesfm._ceres`` documents it. Raises ValueError for values out of range."""

import numpy.typing as npt

from rangesfm._ceres import CostFunction

version: str
ceres_version: str
pybind11_version: str
pybind11_internals_version: int

def range_cost(*, range_m: float, tag_in_cam_m: npt.ArrayLike, stddev_m: float) -> CostFunction: ...
def fixed_pose_range_cost(*, range_m: float, tag_in_world_m: npt.ArrayLike, stddev_m: float) -> CostFunction: ...
def interpolated_range_cost(
    *, range_m: float, tag_in_cam_m: npt.ArrayLike, weight: float, offset_in_world_m: npt.ArrayLike, stddev_m: float
) -> CostFunction: ...
def normal_prior_cost(*, mean: npt.ArrayLike, stddev: npt.ArrayLike) -> CostFunction: ...
def zero_tie_cost(*, size_a: int, size_b: int) -> CostFunction: ...
