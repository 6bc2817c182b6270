"""The packages that rangesfm exchanges C++ objects with: which versions it needs, and which are installed."""

from __future__ import annotations

import functools
import importlib.metadata

from rangesfm.errors import SolverError

NEEDED_VERSIONS = {"pycolmap": "4.2", "pyceres": "2.6"}
INSTALL_COMMAND = "python -m pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'"


def installed_version(package: str) -> str | None:
    """Version of an installed package; None if it is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


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
