"""The packages that rangesfm needs: in which versions, and which are installed.

What goes together stands here and nowhere else in the program. The metadata, the build and the README have to say it in
words of their own, and the tests hold them against this.
"""

from __future__ import annotations

import functools
import importlib.metadata
import re

import rangesfm
from rangesfm.errors import SolverError

PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
# Those that it exchanges C++ objects with: the next version of either needs another build of rangesfm.
NEEDED_VERSIONS = {"pycolmap": "4.2", "pyceres": "2.6"}
# Other packages with the same module, of which one has to be there. COLMAP with CUDA goes by another name on PyPI.
OTHER_BUILDS = {"pycolmap": ("pycolmap-cuda12",)}
# The Ceres inside both of them, and those whose headers describe the same objects.
CERES = "2.2"
CERES_HEADERS = ("2.1", "2.2")
# What else the compiled part is made of: its own affair, so that any of these will do.
EIGEN_HEADERS = ("3.4", "5.0")
PYBIND11 = "3.0"


def installed_version(package: str) -> str | None:
    """Version of an installed package; None if it is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def installed_builds(package: str) -> dict[str, str]:
    """Versions of those installed packages, by name, that hold this one's module: itself, or another build of it."""
    names = (package, *OTHER_BUILDS.get(package, ()))
    return {name: version for name in names if (version := installed_version(name)) is not None}


def is_version(found: str, needed: str) -> bool:
    """Whether a version begins with the numbers of another: 4.2.1 is a 4.2, and 4.20 is none."""
    numbers = needed.split(".")
    return found.split(".")[: len(numbers)] == numbers


def install_command() -> str:
    """What to run to have the versions needed, with the build of pycolmap that is wanted here."""
    wanted = [next(reversed(installed_builds(package)), package) for package in NEEDED_VERSIONS]
    return f"python -m pip install {' '.join(map(_requirement, wanted, NEEDED_VERSIONS.values()))}"


def _requirement(package: str, needed: str) -> str:
    major, minor = map(int, needed.split("."))
    return f"'{package}>={needed},<{major}.{minor + 1}'"


def needed_packages() -> list[str]:
    """All that rangesfm does not work without, by its own metadata; those of NEEDED_VERSIONS if it is not installed."""
    try:
        requirements = importlib.metadata.requires("rangesfm") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = list(NEEDED_VERSIONS)
    # After a semicolon stands when alone it is needed: by an extra, or by an older Python.
    return [re.split(r"[^\w.-]", requirement)[0] for requirement in requirements if ";" not in requirement]


def num_gpus() -> int | None:
    """How many GPUs pycolmap finds; None where it is built without CUDA."""
    import pycolmap

    find = getattr(pycolmap, "get_num_cuda_devices", None)
    return None if find is None else int(find())


@functools.cache
def check_versions() -> None:
    """Check, once in a process and without importing them, that the packages are there in the versions needed.

    Raises:
        SolverError: they are not; it names what is installed, what is needed and what to run.
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
