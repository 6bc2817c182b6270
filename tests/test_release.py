"""The promises of a release: one version, a changelog that names it, licences and parts of all that is shipped."""

from __future__ import annotations

import importlib.metadata
import json
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
    is_version,
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


@pytest.fixture(scope="module")
def bundled() -> dict[str, tuple[str, str]]:
    """Version and licence of each third-party part of the wheel, by name."""
    (text,) = shipped(r"sboms/").values()
    document = json.loads(text)
    assert (document["bomFormat"], document["metadata"]["component"]["version"]) == ("CycloneDX", rangesfm.__version__)
    return {part["name"]: (part["version"], part["licenses"][0]["license"]["id"]) for part in document["components"]}


def test_version_is_semantic_and_the_newest_of_the_changelog() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", rangesfm.__version__)
    newest = re.search(r"^## (.+)$", CHANGELOG, re.MULTILINE)
    assert newest is not None
    assert newest[1] == rangesfm.__version__


def test_every_part_has_a_version_and_its_licence_is_shipped(bundled: dict[str, tuple[str, str]]) -> None:
    assert bundled.keys() == {"eigen", "ceres-solver", "pybind11", "three", "vega", "vega-lite"}
    licences = shipped(r"licenses/")
    own = importlib.metadata.metadata("rangesfm")["License-Expression"].split(" AND ")
    for name, (version, licence) in bundled.items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version)
        assert licence in own
        assert any(name.startswith(Path(path).stem) for path in licences)


def test_parts_are_of_the_versions_that_are_looked_for(bundled: dict[str, tuple[str, str]]) -> None:
    assert any(is_version(bundled["eigen"][0], known) for known in EIGEN_HEADERS)
    assert any(is_version(bundled["ceres-solver"][0], known) for known in CERES_HEADERS)
    assert is_version(bundled["pybind11"][0], PYBIND11)
    recipe = (ROOT / "plugin/rangesfm/report/assets/vendor/build.sh").read_text(encoding="utf-8")
    for name in ("three", "vega", "vega-lite"):
        assert f" {name}@{bundled[name][0]} " in recipe


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


def test_contributors_install_what_the_build_requires(project: dict[str, Any]) -> None:
    page = (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8")
    needed = " ".join(f"'{requirement}'" for requirement in project["build-system"]["requires"])
    assert f"pip install {needed}\n" in page


def test_the_build_looks_for_the_versions_that_are_said() -> None:
    recipe = (ROOT / "cpp_ext" / "CMakeLists.txt").read_text(encoding="utf-8")
    oldest, newest = EIGEN_HEADERS
    assert f"Eigen3_VERSION VERSION_LESS {oldest} OR NOT Eigen3_VERSION VERSION_LESS {next_minor(newest)})" in recipe
    assert f"expected {oldest} or {newest}" in recipe
    assert f"find_package(pybind11 {PYBIND11}...<{next_minor(PYBIND11)} " in recipe
    fetched = (ROOT / "cpp_ext" / "fetch_headers.cmake").read_text(encoding="utf-8")
    (ceres,) = re.findall(r"ceres-solver-([\d.]+)\.tar", fetched)
    (eigen,) = re.findall(r"set\(Eigen3_VERSION ([\d.]+)\)", fetched)
    assert any(is_version(ceres, known) for known in CERES_HEADERS)
    assert any(is_version(eigen, known) for known in EIGEN_HEADERS)


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
