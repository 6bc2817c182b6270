"""What the compiled part offers; ``rangesfm._ceres`` documents it. Raises ValueError for values out of range."""

import numpy.typing as npt

from rangesfm._ceres.types import CostFunction, Manifold

version: str
ceres_version: str
pybind11_version: str
pybind11_internals_version: int

def range_cost(
    *,
    range_m: npt.ArrayLike,
    stddev_m: npt.ArrayLike,
    tag_in_cam_m: npt.ArrayLike | None,
    share: npt.ArrayLike = ...,
    has_common_bias: bool = ...,
    short_range_length_m: float | None = ...,
    error_curve_m: npt.ArrayLike | None = ...,
    loss_scale_too_long: float = ...,
    loss_scale_too_short: float = ...,
    loss_is_bounded: bool = ...,
) -> CostFunction: ...
def fixed_pose_range_cost(
    *,
    range_m: npt.ArrayLike,
    stddev_m: npt.ArrayLike,
    tag_in_world_m: npt.ArrayLike,
    share: npt.ArrayLike = ...,
    has_common_bias: bool = ...,
    short_range_length_m: float | None = ...,
    error_curve_m: npt.ArrayLike | None = ...,
    loss_scale_too_long: float = ...,
    loss_scale_too_short: float = ...,
    loss_is_bounded: bool = ...,
) -> CostFunction: ...
def interpolated_range_cost(
    *,
    range_m: npt.ArrayLike,
    stddev_m: npt.ArrayLike,
    tag_in_cam_m: npt.ArrayLike | None,
    weight: npt.ArrayLike,
    offset_in_world_m: npt.ArrayLike,
    interval_s: float | None = ...,
    offset_velocity_in_world_m_per_s: npt.ArrayLike | None = ...,
    share: npt.ArrayLike = ...,
    has_common_bias: bool = ...,
    short_range_length_m: float | None = ...,
    error_curve_m: npt.ArrayLike | None = ...,
    loss_scale_too_long: float = ...,
    loss_scale_too_short: float = ...,
    loss_is_bounded: bool = ...,
) -> CostFunction: ...
def distance_cost(
    *,
    distance_m: float,
    stddev_m: float,
    a_in_cam_m: npt.ArrayLike | None,
    b_in_cam_m: npt.ArrayLike | None,
    has_bias: bool,
    loss_scale: float,
) -> CostFunction: ...
def direction_cost(
    *, direction_in_world: npt.ArrayLike, direction_in_cam: npt.ArrayLike, stddev_rad: float
) -> CostFunction: ...
def normal_prior_cost(*, mean: npt.ArrayLike, stddev: npt.ArrayLike) -> CostFunction: ...
def joint_prior_cost(*, mean: npt.ArrayLike, whitening: npt.ArrayLike) -> CostFunction: ...
def zero_tie_cost(*, size_a: int, size_b: int) -> CostFunction: ...
def padded_manifold(*, size: int, tangent_size: int) -> Manifold: ...
