"""The compiled cost functions, and Ceres as pyceres shows it. No other module touches either.

A range residual goes into the problem of one of pycolmap's bundle adjusters::

    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    cost = range_cost(range_m=4.2, tag_in_cam_m=[0, -0.09, -0.066], stddev_m=0.1)
    pose = reconstruction.frame(frame_id).rig_from_world.params
    add_residual_block(adjuster, cost, cauchy_loss(2.4), [pose, anchor_in_world, range_bias])
    adjuster.solve()

Poses are COLMAP's blocks: rig_from_world as [qx qy qz qw tx ty tz], and "cam" is the rig frame (the rig's
reference camera). Metres throughout, residuals in stddevs; every value is checked where a cost is made.

pycolmap, pyceres and the compiled part exchange C++ objects, which works only between the versions that
``pyproject.toml`` pins. Whatever is first used here checks it, by a residual whose cost is known.
"""

from __future__ import annotations

import functools
import importlib.metadata
import math
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from rangesfm.errors import SolverError

if TYPE_CHECKING:
    import pycolmap

NEEDED_VERSIONS = {"pycolmap": "4.2", "pyceres": "2.6"}
INSTALL_COMMAND = "python -m pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'"

_NUM_POSE_PARAMS = 7


class CostFunction(Protocol):
    """A ``pyceres.CostFunction``: to be added to a problem, or evaluated to see what it says."""

    def num_residuals(self) -> int: ...
    def parameter_block_sizes(self) -> list[int]: ...
    def evaluate(
        self, *blocks: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], list[npt.NDArray[np.float64]]]:
        """Residuals (n, 1), and for each block of size k the Jacobian (n, k)."""


class LossFunction(Protocol):
    """A ``pyceres.LossFunction``."""

    def evaluate(self, squared_norm: float) -> npt.NDArray[np.float64]:
        """(3,) the loss and its first two derivatives."""


def range_cost(*, range_m: float, tag_in_cam_m: npt.ArrayLike, stddev_m: float) -> CostFunction:
    """A range measured at a keyframe: ``(||R^T (tag_in_cam - t) - anchor|| + bias - range) / stddev``.

    Blocks: rig_from_world (7,), anchor in the world (3,), range bias (1,): what the radio reads too long.
    With the tag on the anchor, where a distance has no derivative, the Jacobian is zero but for the bias.

    Args:
        range_m: measured, positive.
        tag_in_cam_m: (3,) lever arm, the tag's antenna in the rig frame.
        stddev_m: noise of the range, positive.

    Raises:
        ValueError: a value is not finite, or outside its limits, or not (3,).
        SolverError: see ``check_compatibility``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.range_cost(range_m=range_m, tag_in_cam_m=tag_in_cam_m, stddev_m=stddev_m)


def fixed_pose_range_cost(*, range_m: float, tag_in_world_m: npt.ArrayLike, stddev_m: float) -> CostFunction:
    """A range measured from a known place: ``(||tag_in_world - anchor|| + bias - range) / stddev``.

    Blocks: anchor in the world (3,), range bias (1,). Arguments and errors as for ``range_cost``, but
    tag_in_world_m: (3,) the tag's antenna in the world.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.fixed_pose_range_cost(range_m=range_m, tag_in_world_m=tag_in_world_m, stddev_m=stddev_m)


def interpolated_range_cost(
    *, range_m: float, tag_in_cam_m: npt.ArrayLike, weight: float, offset_in_world_m: npt.ArrayLike, stddev_m: float
) -> CostFunction:
    """A range measured between two keyframes.

    The tag is at ``(1 - weight) * p_before + weight * p_after + offset`` with ``p = R^T (tag_in_cam - t)`` of
    either pose. Blocks: rig_from_world before (7,) and after (7,), two different frames; anchor in the world
    (3,); range bias (1,). Arguments and errors as for ``range_cost``, and

    Args:
        weight: from 0 (at the pose before) to 1 (at the pose after).
        offset_in_world_m: (3,) what a curved path has beyond the straight line; it stays as it is.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.interpolated_range_cost(
        range_m=range_m,
        tag_in_cam_m=tag_in_cam_m,
        weight=weight,
        offset_in_world_m=offset_in_world_m,
        stddev_m=stddev_m,
    )


def normal_prior_cost(*, mean: npt.ArrayLike, stddev: npt.ArrayLike) -> CostFunction:
    """What was known of a block of n numbers beforehand, each for itself: ``(x - mean) / stddev``.

    Args:
        mean: (n,) in the block's unit.
        stddev: (n,) likewise, positive.

    Raises:
        ValueError, SolverError: as ``range_cost``.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.normal_prior_cost(mean=mean, stddev=stddev)


def zero_tie_cost(*, size_a: int, size_b: int) -> CostFunction:
    """Two residuals, always zero, that tie two blocks of these sizes; for the solver's sake only.

    Each free anchor and each free range bias should be tied to a 3-D point that few images see: otherwise
    Ceres eliminates it together with the points and loses its specialised kernels.
    """
    check_compatibility()
    from rangesfm import _cpp

    return _cpp.zero_tie_cost(size_a=size_a, size_b=size_b)


def cauchy_loss(scale: float) -> LossFunction:
    """Cauchy's robust loss ``scale^2 log(1 + r^2 / scale^2)``; scale in stddevs, positive."""
    if not (math.isfinite(scale) and scale > 0):
        raise ValueError(f"loss scale is {scale}, expected a finite number greater than 0")
    import pyceres

    loss: LossFunction = pyceres.CauchyLoss(scale)
    return loss


def add_residual_block(
    adjuster: pycolmap.CeresBundleAdjuster,
    cost: CostFunction,
    loss: LossFunction | None,
    blocks: Sequence[npt.NDArray[np.float64]],
) -> None:
    """Add a residual to a bundle adjuster's problem, so that nothing it needs can go missing or astray.

    ``adjuster.problem.add_residual_block`` does the same for those who know its two traps. There, cost, loss
    and blocks live only as long as the Python object ``problem``, and to solve without it reads freed memory;
    here they live as long as the adjuster. And a pose that the adjuster holds constant is part of its
    reprojection costs, not of the problem: there, a range makes it a new free block without a manifold, which
    then wanders off alone; here it is held, as is the pose of a frame without observations.

    Args:
        adjuster: from ``pycolmap.create_default_ceres_bundle_adjuster``.
        cost: of which the blocks must have the sizes, in its order.
        loss: None for least squares.
        blocks: the arrays that the solver works on, in place: float64, contiguous, writeable.

    Raises:
        ValueError: a block is no such array, or not of the cost's size.
    """
    for block in blocks:
        if block.dtype != np.float64 or not block.flags.carray:
            raise ValueError("the solver works in place: a block must be a contiguous, writeable float64 array")
    problem = adjuster.problem
    held = [b for b in blocks if b.size == _NUM_POSE_PARAMS and not problem.has_parameter_block(b)]
    problem.add_residual_block(cost, loss, list(blocks))
    for pose in held:
        problem.set_parameter_block_constant(pose)
    _used_by_adjuster.setdefault(adjuster, []).append((cost, loss, blocks))


# What residuals refer to. The problem refers to its adjuster, so only a weak key lets the two go in the end.
_used_by_adjuster: weakref.WeakKeyDictionary[pycolmap.CeresBundleAdjuster, list[Any]] = weakref.WeakKeyDictionary()


@functools.cache
def check_compatibility() -> None:
    """Check, once in a process, that pycolmap, pyceres and the compiled part really share their types.

    Raises:
        SolverError: they do not; it names what is installed, what is needed and what to run.
    """
    for package, needed in NEEDED_VERSIONS.items():
        found = installed_version(package)
        if found is None or found.split(".")[:2] != needed.split("."):
            raise _incompatible(f"needs {package} {needed}")
    try:
        costs = _costs_of_known_residual()
    except ImportError as error:
        raise _incompatible(str(error)) from error
    except TypeError as error:
        raise _incompatible("pyceres does not know its cost functions as ones of Ceres") from error
    for where, cost in costs.items():
        if not math.isclose(cost, _KNOWN_COST):
            raise _incompatible(f"a residual of cost {_KNOWN_COST} costs {cost} {where}")


_KNOWN_COST = 2.0


def _costs_of_known_residual() -> dict[str, float]:
    """What one range residual costs in either package's problem, and as pycolmap's solver finds and leaves it.

    The tag is 5 m from the anchor; with 0.5 m of bias that is 2 stddevs of 0.25 m more than the range of 5 m,
    and half its square is the cost.
    """
    import pyceres
    import pycolmap

    from rangesfm import _cpp

    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    reconstruction = pycolmap.Reconstruction()
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, pycolmap.BundleAdjustmentConfig(), reconstruction)
    problems = {"in pyceres' problem": pyceres.Problem(), "in pycolmap's problem": adjuster.problem}
    costs = {}
    for name, problem in problems.items():
        cost = _cpp.range_cost(range_m=5.0, tag_in_cam_m=[1.0, 0.0, 0.0], stddev_m=0.25)
        pose, anchor, bias = np.array([0.0, 0, 0, 1, 0, 0, 0]), np.array([4.0, 4, 0]), np.array([0.5])
        problem.add_residual_block(cost, None, [pose, anchor, bias])
        problem.set_parameter_block_constant(pose)
        costs[name] = sum(0.5 * residual**2 for residual in problem.evaluate_residuals())
    summary = cast(pycolmap.CeresBundleAdjustmentSummary, adjuster.solve()).ceres_summary
    costs["in pycolmap's solver"] = summary.initial_cost
    # Anchor and bias are free, so that a right Jacobian leaves nothing over.
    costs["less after pycolmap's solver"] = summary.initial_cost - summary.final_cost
    return costs


def installed_version(package: str) -> str | None:
    """Version of an installed package; None if it is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def compiled_part_version() -> str:
    """What the compiled part was built with, in words."""
    try:
        from rangesfm import _cpp
    except ImportError:
        return "not there"
    return f"built with pybind11 {_cpp.pybind11_version} (internals {_cpp.pybind11_internals_version})"


def pyceres_ceres_version() -> str:
    """Version of the Ceres inside pyceres."""
    import pyceres

    return str(pyceres.__ceres_version__)


def _incompatible(problem: str) -> SolverError:
    found = ", ".join(f"{package} {installed_version(package) or 'not'}" for package in NEEDED_VERSIONS)
    return SolverError(
        f"the compiled part does not fit the installed packages: {problem}; installed: {found}, "
        f"rangesfm {compiled_part_version()}; run: {INSTALL_COMMAND}, then install rangesfm anew"
    )
