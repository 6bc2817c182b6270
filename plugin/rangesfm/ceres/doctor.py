"""Is everything here that a run needs, and does it fit together?"""

from __future__ import annotations

import functools
import math
import os
import platform
import sys
from dataclasses import dataclass
from typing import cast

import numpy as np

from rangesfm.errors import SolverError
from rangesfm.installed_versions import (
    INSTALL_COMMAND,
    NEEDED_VERSIONS,
    check_versions,
    installed_version,
    needed_packages,
)

MIN_PYTHON = (3, 10)
MAX_PYTHON = (3, 13)
_KNOWN_COST = 2.0


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    Attributes:
        name: what.
        found: as it is here.
        expected: as it should be.
        ok: whether rangesfm works with it.
        remedy: what to do where it does not; empty where it does.
    """

    name: str
    found: str
    expected: str
    ok: bool
    remedy: str = ""


def diagnose() -> list[Check]:
    """Look at everything a run depends on. Nothing is raised or printed: what fails is in the list."""
    checks = [_check_python(), _check_package("rangesfm", "", "python -m pip install rangesfm")]
    for package in needed_packages():
        command = INSTALL_COMMAND if package in NEEDED_VERSIONS else f"python -m pip install {package}"
        checks.append(_check_package(package, NEEDED_VERSIONS.get(package, ""), command))
    checks.append(_check_compiled_part())
    # The rest asks pycolmap and pyceres themselves.
    if all(check.ok for check in checks):
        checks += [_check_ceres(), _check_threads(), _check_cuda()]
    return checks


def versions() -> dict[str, str]:
    """Versions that a result depends on, for the record; "not installed" where one is missing."""
    return {
        "python": platform.python_version(),
        **{package: installed_version(package) or "not installed" for package in ("rangesfm", *needed_packages())},
        "compiled_part": compiled_part_version(),
        "platform": platform.platform(),
    }


def _check_python() -> Check:
    ok = MIN_PYTHON <= sys.version_info[:2] <= MAX_PYTHON
    expected = f"{'.'.join(map(str, MIN_PYTHON))} to {'.'.join(map(str, MAX_PYTHON))}"
    return Check("Python", platform.python_version(), expected, ok, "" if ok else f"use Python {expected}")


def _check_package(package: str, needed: str, command: str) -> Check:
    """Whether a package is there in a version that begins as needed ("4.2"; "" for any)."""
    found = installed_version(package)
    numbers = needed.split(".") if needed else []
    ok = found is not None and found.split(".")[: len(numbers)] == numbers
    return Check(package, found or "not installed", needed or "any", ok, "" if ok else f"run: {command}")


def _check_compiled_part() -> Check:
    try:
        check_compatibility()
        remedy = ""
    except SolverError as error:
        remedy = str(error)
    expected = "shares its types with pycolmap and pyceres"
    return Check("compiled part", compiled_part_version(), expected, not remedy, remedy)


def _check_ceres() -> Check:
    import pyceres
    import pycolmap

    of_pycolmap, of_pyceres = pycolmap.__ceres_version__, pyceres.__ceres_version__
    ok = of_pycolmap == of_pyceres
    found = f"{of_pycolmap} in pycolmap, {of_pyceres} in pyceres"
    return Check("Ceres", found, "the same in both", ok, "" if ok else f"run: {INSTALL_COMMAND}")


def _check_threads() -> Check:
    num_cores = os.cpu_count() or 1
    # A container or a batch queue may allow fewer than there are.
    num_usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else num_cores
    return Check("threads", f"{num_usable} of {num_cores} cores", "1 or more", ok=True)


def _check_cuda() -> Check:
    import pycolmap

    found = "pycolmap has it" if pycolmap.has_cuda else "pycolmap has none: features and matching on the processor"
    return Check("CUDA", found, "not needed", ok=True)


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


def _incompatible(problem: str) -> SolverError:
    found = ", ".join(f"{package} {installed_version(package) or 'not'}" for package in NEEDED_VERSIONS)
    return SolverError(
        f"the compiled part does not fit the installed packages: {problem}; installed: {found}, "
        f"rangesfm {compiled_part_version()}; run: {INSTALL_COMMAND}, then install rangesfm anew"
    )
