"""Packages that rangesfm needs, in which versions, and which versions are installed.

The program takes the needed versions from here only. The package metadata, the build and the README state them again,
and the tests compare those with this module.
"""

from __future__ import annotations

import functools
import importlib.metadata
import re
from pathlib import Path

import rangesfm
from rangesfm.errors import InputError, SolverError

PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
# The compiled part exchanges C++ objects with these packages, so another version of either needs another build of it.
NEEDED_VERSIONS = {"pycolmap": "4.2", "pyceres": "2.6"}
# Packages that provide the same Python module; one of them must be installed. PyPI has pycolmap with CUDA under its own
# name.
OTHER_BUILDS = {"pycolmap": ("pycolmap-cuda12",)}
# Version of Ceres inside pycolmap and pyceres, and the versions whose headers describe the same C++ objects.
CERES = "2.2"
CERES_HEADERS = ("2.1", "2.2")
# Other libraries of the compiled part. It exchanges no objects of theirs, so any of these versions will do.
EIGEN_HEADERS = ("3.4", "5.0")
PYBIND11 = "3.0"


def installed_version(package: str) -> str | None:
    """Return the version of a package, or None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def installed_builds(package: str) -> dict[str, str]:
    """Return name and version of each installed package that provides this package's module: itself or other builds."""
    names = (package, *OTHER_BUILDS.get(package, ()))
    return {name: version for name in names if (version := installed_version(name)) is not None}


def is_version(found: str, needed: str) -> bool:
    """Return whether a version begins with the numbers of another: 4.2.1 is a 4.2, 4.20 is not."""
    numbers = needed.split(".")
    return found.split(".")[: len(numbers)] == numbers


def install_command() -> str:
    """Return the shell command that installs the needed versions, keeping the build of pycolmap that is installed."""
    wanted = [next(reversed(installed_builds(package)), package) for package in NEEDED_VERSIONS]
    return f"python -m pip install {' '.join(map(_requirement, wanted, NEEDED_VERSIONS.values()))}"


def missing_extra(need: str, extra: str, path: Path | None = None) -> InputError:
    """Return the error for a task whose packages are not installed.

    Args:
        need: which task needs which package. extra: name of the optional dependencies that have it. path: of the input.
    """
    return InputError(f"{need}: pip install '.[{extra}]' in a clone of rangesfm installs it", path)


def _requirement(package: str, needed: str) -> str:
    major, minor = map(int, needed.split("."))
    return f"'{package}>={needed},<{major}.{minor + 1}'"


def needed_packages() -> list[str]:
    """Return the names of all required packages from the package metadata.

    Where rangesfm itself is not installed, these are the packages of ``NEEDED_VERSIONS``.
    """
    try:
        requirements = importlib.metadata.requires("rangesfm") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = list(NEEDED_VERSIONS)
    # A requirement with a semicolon is conditional: only an extra or an older Python needs it.
    return [re.split(r"[^\w.-]", requirement)[0] for requirement in requirements if ";" not in requirement]


def num_gpus() -> int | None:
    """Return the number of GPUs that pycolmap finds, or None where it is built without CUDA."""
    import pycolmap

    find = getattr(pycolmap, "get_num_cuda_devices", None)
    return None if find is None else int(find())


@functools.cache
def check_versions() -> None:
    """Check that pycolmap and pyceres are installed in the needed versions, once in a process, without importing them.

    Raises:
        SolverError: they are not. The text names what is installed, what is needed and what to run.
    """
    pair = " and ".join(f"{package} {needed}" for package, needed in NEEDED_VERSIONS.items())
    for package, needed in NEEDED_VERSIONS.items():
        builds = installed_builds(package)
        wrong = [f"{name} {version}" for name, version in builds.items() if not is_version(version, needed)]
        if wrong or not builds:
            raise SolverError(
                f"{' and '.join(wrong) or f'{package} is not'} installed, rangesfm {rangesfm.__version__} is built for"
                f" {pair}; run: {install_command()}"
            )
