"""What a release promises: one version, a changelog that names it, licences and parts of all that is shipped."""

from __future__ import annotations

import importlib.metadata
import json
import re
from pathlib import Path

import pytest

import rangesfm

ROOT = Path(__file__).parents[1]
CHANGELOG = (ROOT / ".github" / "CHANGELOG.md").read_text(encoding="utf-8")


def shipped(pattern: str) -> dict[str, str]:
    """Texts of those files in the distribution's metadata whose path fits the pattern, by that path."""
    files = importlib.metadata.files("rangesfm")
    assert files is not None
    return {
        str(path): path.read_text(encoding="utf-8") for path in files if re.search(rf"dist-info/{pattern}", str(path))
    }


@pytest.fixture(scope="module")
def bundled() -> dict[str, tuple[str, str]]:
    """Version and licence of each part of the wheel that is not rangesfm's own, by name."""
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
    assert bundled["eigen"][0].startswith("3.4")
    assert bundled["ceres-solver"][0] in ("2.1.0", "2.2.0")
    assert bundled["pybind11"][0].startswith("3.0.")
    recipe = (ROOT / "plugin/rangesfm/report/assets/vendor/build.sh").read_text(encoding="utf-8")
    for name in ("three", "vega", "vega-lite"):
        assert f" {name}@{bundled[name][0]} " in recipe
