"""
Cost functions of rangesfm, to be used through the package rangesfm.solver.
"""

from __future__ import annotations
import numpy
import numpy.typing
import pyceres
import typing

def direction_cost(
    *,
    direction_in_world: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    direction_in_cam: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    stddev_rad: typing.SupportsFloat | typing.SupportsIndex,
) -> pyceres.CostFunction: ...
def distance_cost(
    *,
    distance_m: typing.SupportsFloat | typing.SupportsIndex,
    stddev_m: typing.SupportsFloat | typing.SupportsIndex,
    a_in_cam_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None = None,
    b_in_cam_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None = None,
    has_bias: bool = False,
    loss_scale: typing.SupportsFloat | typing.SupportsIndex = ...,
) -> pyceres.CostFunction: ...
def inertial_cost(
    *,
    interval_s: typing.SupportsFloat | typing.SupportsIndex,
    turn: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    speed: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    shift: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    at: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    by_sensor: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    whitening: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    rig_from_imu: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    share: typing.SupportsFloat | typing.SupportsIndex = 1.0,
    loss_scale: typing.SupportsFloat | typing.SupportsIndex = ...,
) -> pyceres.CostFunction: ...
def interpolated_range_cost(
    *,
    range_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    stddev_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    tag_in_cam_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None,
    weight: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    offset_in_world_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    interval_s: typing.SupportsFloat | typing.SupportsIndex | None = None,
    share: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] = 1.0,
    loadings_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None = None,
    short_range_length_m: typing.SupportsFloat | typing.SupportsIndex | None = None,
    loss_scale: typing.SupportsFloat | typing.SupportsIndex = ...,
    loss_is_bounded: bool = False,
) -> pyceres.CostFunction: ...
def joint_prior_cost(
    *,
    mean: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    whitening: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
) -> pyceres.CostFunction: ...
def padded_manifold(
    *, size: typing.SupportsInt | typing.SupportsIndex, tangent_size: typing.SupportsInt | typing.SupportsIndex
) -> pyceres.Manifold: ...
def position_cost(
    *,
    position_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    whitening: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    tag_in_cam_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None,
    weight: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None = None,
    offset_in_world_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None = None,
    interval_s: typing.SupportsFloat | typing.SupportsIndex | None = None,
    share: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] = 1.0,
    loss_scale: typing.SupportsFloat | typing.SupportsIndex = ...,
) -> pyceres.CostFunction: ...
def range_cost(
    *,
    range_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    stddev_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64],
    tag_in_cam_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None,
    share: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] = 1.0,
    loadings_m: typing.Annotated[numpy.typing.ArrayLike, numpy.float64] | None = None,
    short_range_length_m: typing.SupportsFloat | typing.SupportsIndex | None = None,
    loss_scale: typing.SupportsFloat | typing.SupportsIndex = ...,
    loss_is_bounded: bool = False,
) -> pyceres.CostFunction: ...
def zero_tie_cost(
    *, size_a: typing.SupportsInt | typing.SupportsIndex, size_b: typing.SupportsInt | typing.SupportsIndex
) -> pyceres.CostFunction: ...

ceres_version: str
pybind11_internals_version: int
pybind11_version: str
