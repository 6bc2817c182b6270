"""Versions of pycolmap and pyceres other than those that the compiled part was made for."""

from __future__ import annotations

import importlib
import importlib.metadata
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import rangesfm
from rangesfm import ceres, installed_versions
from rangesfm.ceres import check_compatibility
from rangesfm.cli import main
from rangesfm.errors import SolverError
from rangesfm.installed_versions import INSTALL_COMMAND, NEEDED_VERSIONS, check_versions, installed_version

OTHER_VERSIONS = [("pycolmap", "4.3.0"), ("pycolmap", "4.1.1"), ("pyceres", "2.5"), ("pyceres", None)]


@pytest.fixture(params=OTHER_VERSIONS, ids=lambda param: "-".join(map(str, param)))
def complaint(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """What is said of a package in another version than needed, in a process that has not looked yet."""
    package, version = request.param
    monkeypatch.setattr(
        installed_versions, "installed_version", lambda name: version if name == package else installed_version(name)
    )
    for check in (check_versions, check_compatibility):
        check.cache_clear()
    yield (
        f"{package} {version or 'is not'} installed, rangesfm needs {package} {NEEDED_VERSIONS[package]}; "
        f"run: {INSTALL_COMMAND}"
    )
    for check in (check_versions, check_compatibility):
        check.cache_clear()


@pytest.mark.parametrize("command", [["ranges", "uwb.csv"], ["report", "out"], ["reconstruct"], ["run", "survey.toml"]])
def test_commands_end_in_one_line_that_names_the_remedy(
    command: list[str],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command) == SolverError.exit_status
    assert capsys.readouterr().err == f"rangesfm: error: {complaint}\n"
    assert not list(tmp_path.iterdir())


def test_functions_refuse_too_and_say_so_with_an_error_of_the_package(
    complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "rangesfm.costs", raising=False)
    for first_use in (lambda: ceres.range_cost, lambda: importlib.import_module("rangesfm.costs")):
        with pytest.raises(SolverError) as caught:
            first_use()
        assert str(caught.value) == complaint
    for name in ("read_ranges", "SolverError"):
        monkeypatch.delitem(vars(rangesfm), name, raising=False)  # as before it was first used
    with pytest.raises(rangesfm.SolverError, match=re.escape(complaint)):
        rangesfm.read_ranges  # noqa: B018


def test_the_pins_checked_are_the_pins_of_the_package() -> None:
    requirements = importlib.metadata.requires("rangesfm")
    assert requirements is not None
    for package, needed in NEEDED_VERSIONS.items():
        major, minor = map(int, needed.split("."))
        (requirement,) = (r for r in requirements if re.match(rf"{package}\b", r))
        assert set(re.findall(r"[<>=]+[\d.]+", requirement)) == {f">={needed}", f"<{major}.{minor + 1}"}
        assert f"'{package}>={needed},<{major}.{minor + 1}'" in INSTALL_COMMAND
