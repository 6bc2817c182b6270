"""The promises of a release: one version, a changelog that names it, licences and parts of all that is shipped."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

import pytest

import rangesfm
from rangesfm.installed_versions import (
    CERES_HEADERS,
    EIGEN_HEADERS,
    NEEDED_VERSIONS,
    OTHER_BUILDS,
    PYBIND11,
    PYTHONS,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
CHANGELOG = (ROOT / ".github" / "CHANGELOG.md").read_text(encoding="utf-8")


def shipped(pattern: str) -> dict[str, str]:
    """Return the texts of those files in the distribution's metadata whose path matches the pattern, by path."""
    files = importlib.metadata.files("rangesfm")
    assert files is not None
    return {
        str(path): path.read_text(encoding="utf-8") for path in files if re.search(rf"dist-info/{pattern}", str(path))
    }


def test_version_is_semantic_and_the_newest_of_the_changelog() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", rangesfm.__version__)
    newest = re.search(r"^## (.+)$", CHANGELOG, re.MULTILINE)
    assert newest is not None
    assert newest[1] == rangesfm.__version__


def next_minor(version: str) -> str:
    major, minor = map(int, version.split("."))
    return f"{major}.{minor + 1}"


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    """Return the content of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_metadata_and_the_wheels_are_for_the_versions_that_are_said(project: dict[str, Any]) -> None:
    metadata, tools = project["project"], project["tool"]
    assert metadata["requires-python"] == f">={PYTHONS[0]},<{next_minor(PYTHONS[-1])}"
    pythons = [line.rpartition(" ")[2] for line in metadata["classifiers"] if ":: Python :: 3." in line]
    assert tuple(pythons) == PYTHONS
    assert tools["cibuildwheel"]["build"] == [f"cp{python.replace('.', '')}-*" for python in PYTHONS]
    for package, needed in NEEDED_VERSIONS.items():
        assert f"{package}>={needed},<{next_minor(needed)}" in metadata["dependencies"]
    for requirements in (project["build-system"]["requires"], metadata["optional-dependencies"]["test"]):
        assert f"pybind11>={PYBIND11},<{next_minor(PYBIND11)}" in requirements


def test_the_readme_says_the_versions_that_go_together() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = readme[readme.index("## Compatibility") : readme.index("## Licence")]
    rows = dict(re.findall(r"^\| ([^|]+?) \| ([^|]+?) \|$", table, re.MULTILINE))
    assert rows["Python"] == f"{', '.join(PYTHONS[:-1])} and {PYTHONS[-1]}"
    assert rows["pycolmap or pycolmap-cuda12 / pyceres"].startswith(" / ".join(NEEDED_VERSIONS.values()) + " ")
    assert OTHER_BUILDS == {"pycolmap": ("pycolmap-cuda12",)}
    for name, known in (("Ceres", CERES_HEADERS), ("Eigen", EIGEN_HEADERS)):
        assert f"{name} {' or '.join(known)}" in rows["building"]
    assert f"pybind11 {PYBIND11}" in rows["building"]
