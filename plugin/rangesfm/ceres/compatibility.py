"""Whether pycolmap, pyceres and the compiled part, as they are installed, share their types."""

from __future__ import annotations

import functools
import math
from typing import cast

import numpy as np

from rangesfm.errors import SolverError
from rangesfm.installed_versions import INSTALL_COMMAND, NEEDED_VERSIONS, check_versions, installed_version


@functools.cache
def check_compatibility() -> None:
    """Check, once in a process, that pycolmap, pyceres and the compiled part really share their types.

    Raises:
        SolverError: they do not; it names what is installed, what is needed and what to run.
    """
    check_versions()
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
