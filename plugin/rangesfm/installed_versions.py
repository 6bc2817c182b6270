"""The packages that rangesfm needs: in which versions, and which are installed."""

from __future__ import annotations

import functools
import importlib.metadata
import re

from rangesfm.errors import SolverError

# Those that it exchanges C++ objects with.
NEEDED_VERSIONS = {"pycolmap": "4.2", "pyceres": "2.6"}
INSTALL_COMMAND = "python -m pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'"


def installed_version(package: str) -> str | None:
    """Version of an installed package; None if it is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def needed_packages() -> list[str]:
    """All that rangesfm does not work without, by its own metadata; those of NEEDED_VERSIONS if it is not installed."""
    try:
        requirements = importlib.metadata.requires("rangesfm") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = list(NEEDED_VERSIONS)
    # After a semicolon stands when alone it is needed: by an extra, or by an older Python.
    return [re.split(r"[^\w.-]", requirement)[0] for requirement in requirements if ";" not in requirement]


@functools.cache
def check_versions() -> None:
    """Check, once in a process and without importing them, that the packages are there in the versions needed.

    Raises:
        SolverError: they are not; it names what is installed, what is needed and what to run.
    """
    for package, needed in NEEDED_VERSIONS.items():
        found = installed_version(package)
        if found is None or found.split(".")[:2] != needed.split("."):
            raise SolverError(
                f"{package} {found or 'is not'} installed, rangesfm needs {package} {needed}; run: {INSTALL_COMMAND}"
            )
