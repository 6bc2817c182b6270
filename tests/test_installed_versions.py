"""Versions and builds of pycolmap and pyceres other than those that the compiled part was made for."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.installed import with_installed

import rangesfm
from rangesfm import solver
from rangesfm.cli import main
from rangesfm.errors import SolverError
from rangesfm.installed_versions import check_versions, install_command, installed_builds, is_version
from rangesfm.solver import check_compatibility

REMEDY = "python -m pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'"
CUDA_REMEDY = REMEDY.replace("pycolmap", "pycolmap-cuda12")
OTHER_VERSIONS = [("pycolmap", "4.3.0"), ("pycolmap", "4.1.1"), ("pyceres", "2.5"), ("pyceres", None)]


@pytest.fixture(params=OTHER_VERSIONS, ids=lambda param: "-".join(map(str, param)))
def complaint(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The expected message about a package of a wrong version, in a process that has not checked versions yet."""
    package, version = request.param
    with_installed(monkeypatch, pycolmap_cuda12=None, **{package: version})
    for check in (check_versions, check_compatibility):
        check.cache_clear()
    yield (
        f"{package} {version or 'is not'} installed, rangesfm {rangesfm.__version__} is built for pycolmap 4.2 and"
        f" pyceres 2.6; run: {REMEDY}"
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
    for first_use in (lambda: solver.range_cost, lambda: importlib.import_module("rangesfm.costs")):
        with pytest.raises(SolverError) as caught:
            first_use()
        assert str(caught.value) == complaint
    for name in ("read_ranges", "SolverError"):
        monkeypatch.delitem(vars(rangesfm), name, raising=False)  # so that its first use is repeated
    with pytest.raises(rangesfm.SolverError, match=re.escape(complaint)):
        rangesfm.read_ranges  # noqa: B018


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Forget the result of the version check before and after the test."""
    check_versions.cache_clear()
    yield
    check_versions.cache_clear()


@pytest.mark.usefixtures("unchecked")
def test_the_build_with_cuda_is_as_good_as_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, pycolmap=None, pycolmap_cuda12="4.2.1")
    check_versions()
    assert installed_builds("pycolmap") == {"pycolmap-cuda12": "4.2.1"}
    assert install_command() == CUDA_REMEDY


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("other", [None, "4.2.1"])
def test_another_version_of_the_build_with_cuda_is_refused_by_its_name(
    other: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_installed(monkeypatch, pycolmap=other, pycolmap_cuda12="4.3.0")
    with pytest.raises(SolverError, match=r"^pycolmap-cuda12 4\.3\.0 installed, rangesfm .* pycolmap 4\.2 ") as caught:
        check_versions()
    assert str(caught.value).endswith(f"run: {CUDA_REMEDY}")


@pytest.mark.parametrize(
    ("found", "needed", "fits"),
    [("4.2.1", "4.2", True), ("4.2", "4.2", True), ("4.20", "4.2", False), ("4", "4.2", False), ("5.0.1", "5.0", True)],
)
def test_a_version_fits_by_whole_numbers(found: str, needed: str, fits: bool) -> None:
    assert is_version(found, needed) == fits
