"""Is everything here that a run needs, and does it fit together?"""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass

from rangesfm.ceres import check_compatibility, compiled_part_version, pyceres_ceres_version
from rangesfm.errors import SolverError
from rangesfm.installed_versions import INSTALL_COMMAND, NEEDED_VERSIONS, installed_version, needed_packages

MIN_PYTHON = (3, 10)
MAX_PYTHON = (3, 13)


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
    import pycolmap

    of_pycolmap, of_pyceres = pycolmap.__ceres_version__, pyceres_ceres_version()
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
