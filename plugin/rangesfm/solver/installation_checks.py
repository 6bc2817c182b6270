"""Checks that everything a run needs is installed and fits together."""

from __future__ import annotations

import functools
import math
import os
import platform
from dataclasses import dataclass
from typing import cast

import numpy as np

from rangesfm.errors import SolverError
from rangesfm.installed_versions import (
    CERES,
    CERES_HEADERS,
    NEEDED_VERSIONS,
    OTHER_BUILDS,
    PYTHONS,
    check_versions,
    install_command,
    installed_builds,
    is_version,
    needed_packages,
    num_gpus,
)

_KNOWN_COST = 2.0


@dataclass(frozen=True)
class InstallationCheck:
    """One check of the installation.

    Attributes:
        name: of what is checked.
        found: what is installed.
        expected: what is needed.
        ok: whether rangesfm works with it.
        remedy: what to do if not; empty if ok.
    """

    name: str
    found: str
    expected: str
    ok: bool
    remedy: str = ""


def diagnose() -> list[InstallationCheck]:
    """Check everything a run depends on. Nothing is raised or printed; failures are in the list."""
    checks = [_check_python(), _check_package("rangesfm"), *map(_check_package, needed_packages())]
    checks.append(_check_compiled_part())
    # The other checks ask pycolmap and pyceres themselves, so these must work.
    if all(check.ok for check in checks):
        checks += [_check_ceres(), _check_threads(), _check_cuda()]
    return checks


def recorded_versions() -> dict[str, str]:
    """Return the versions that a result depends on, for the record; "not installed" where one is missing."""
    return {
        "python": platform.python_version(),
        **{package: _found(package) for package in ("rangesfm", *needed_packages())},
        "compiled_part": compiled_part_version(),
        "platform": platform.platform(),
    }


def _found(package: str) -> str:
    """Return the installed version in words, with the name of the build if it is another one."""
    builds = installed_builds(package)
    said = [version if name == package else f"{version} ({name})" for name, version in builds.items()]
    return " and ".join(said) or "not installed"


def _check_python() -> InstallationCheck:
    ok = any(is_version(platform.python_version(), python) for python in PYTHONS)
    expected = f"{PYTHONS[0]} to {PYTHONS[-1]}"
    return InstallationCheck("Python", platform.python_version(), expected, ok, "" if ok else f"use Python {expected}")


def _check_package(package: str) -> InstallationCheck:
    """Check that a package is installed once, and in the version needed."""
    needed, builds = NEEDED_VERSIONS.get(package), installed_builds(package)
    expected, remedy = needed or "any", ""
    if not builds or not all(needed is None or is_version(version, needed) for version in builds.values()):
        remedy = f"run: {install_command() if needed else f'python -m pip install {package}'}"
    elif len(builds) > 1:  # both builds have written their files into the same folder
        expected = f"one of {' and '.join(builds)}, as both are the module {package}"
        remedy = f"run: python -m pip uninstall -y {' '.join(builds)}, then {install_command()}"
    return InstallationCheck(package, _found(package), expected, not remedy, remedy)


def _check_compiled_part() -> InstallationCheck:
    try:
        check_compatibility()
        remedy = ""
    except SolverError as error:
        remedy = str(error)
    expected = "shares its types with pycolmap and pyceres"
    return InstallationCheck("compiled part", compiled_part_version(), expected, not remedy, remedy)


def _check_ceres() -> InstallationCheck:
    # If the versions did not fit, the check of the compiled part would have failed.
    found = ", ".join(f"{version} in {where}" for where, version in _ceres_versions().items())
    return InstallationCheck("Ceres", found, f"{CERES} in both", ok=True)


def _check_threads() -> InstallationCheck:
    num_cores = os.cpu_count() or 1
    # A container or a batch queue may allow fewer cores than there are.
    num_usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else num_cores
    return InstallationCheck("threads", f"{num_usable} of {num_cores} cores", "1 or more", ok=True)


def _check_cuda() -> InstallationCheck:
    num = num_gpus()
    if num is None:
        others = " or ".join(OTHER_BUILDS["pycolmap"])
        found = f"pycolmap has none (that would be {others}): the processor is used"
    elif num == 0:
        found = "pycolmap has it, and there is no GPU: the processor is used"
    else:
        found = f"pycolmap has it, and there {'is 1 GPU' if num == 1 else f'are {num} GPUs'} for features and matching"
    return InstallationCheck("CUDA", found, "not needed", ok=True)


@functools.cache
def check_compatibility() -> None:
    """Check, once per process, that pycolmap, pyceres and the compiled part share their types.

    Raises:
        SolverError: they do not; the message names what is installed, what is needed and what to run.
    """
    check_versions()
    try:
        _compare_ceres_versions()
        costs = _costs_of_known_residual()
    except ImportError as error:
        raise _incompatible(str(error)) from error
    except TypeError as error:
        raise _incompatible("pyceres does not know its cost functions as ones of Ceres") from error
    for where, cost in costs.items():
        if not math.isclose(cost, _KNOWN_COST):
            raise _incompatible(f"a residual of cost {_KNOWN_COST} costs {cost} {where}")


def _ceres_versions() -> dict[str, str]:
    """Return the versions of Ceres in use, by where they are."""
    import pyceres
    import pycolmap

    from rangesfm import _cpp

    return {
        "pycolmap": pycolmap.__ceres_version__,
        "pyceres": pyceres.__ceres_version__,
        "the compiled part's headers": _cpp.ceres_version,
    }


def _compare_ceres_versions() -> None:
    """Raise SolverError for versions of Ceres other than those known to have the same memory layout."""
    found = _ceres_versions()
    *libraries, headers = found.values()
    fits = all(is_version(version, CERES) for version in libraries) and len(set(libraries)) == 1
    if not fits or not any(is_version(headers, known) for known in CERES_HEADERS):
        met = ", ".join(f"Ceres {version} in {where}" for where, version in found.items())
        raise _incompatible(f"{met}; expected {CERES} in the packages, headers of {' or '.join(CERES_HEADERS)}")


def _costs_of_known_residual() -> dict[str, float]:
    """Return the cost of one range residual in both packages' problems, and before and after pycolmap's solver.

    The tag is 5 m from the anchor, the bias is 0.5 m and the range is 5 m. So the residual is 2 standard deviations of
    0.25 m, and the cost is half its square.
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
    # Anchor and bias are free, so a correct Jacobian reduces the cost to zero.
    costs["less after pycolmap's solver"] = summary.initial_cost - summary.final_cost
    return costs


def compiled_part_version() -> str:
    """Describe what the compiled part was built with."""
    try:
        from rangesfm import _cpp
    except ImportError:
        return "not there"
    with_pybind11 = f"pybind11 {_cpp.pybind11_version} (internals {_cpp.pybind11_internals_version})"
    return f"built with {with_pybind11} and headers of Ceres {_cpp.ceres_version}"


def _incompatible(problem: str) -> SolverError:
    found = ", ".join(f"{package} {_found(package)}" for package in NEEDED_VERSIONS)
    return SolverError(
        f"the compiled part does not fit the installed packages: {problem}; installed: {found}, "
        f"rangesfm {compiled_part_version()}; run: {install_command()}, then install rangesfm anew"
    )
