"""What ``rangesfm doctor`` and every result say of the installation."""

from __future__ import annotations

import pytest

from rangesfm.ceres import doctor
from rangesfm.ceres.doctor import Check, diagnose, versions
from rangesfm.errors import SolverError
from rangesfm.installed_versions import installed_version


def check_named(name: str) -> Check:
    (check,) = (check for check in diagnose() if check.name == name)
    return check


def test_this_installation_is_well() -> None:
    assert [check for check in diagnose() if not check.ok] == []


def test_everything_a_run_depends_on_is_looked_at() -> None:
    assert [check.name for check in diagnose()] == [
        *("Python", "rangesfm", "pycolmap", "pyceres", "numpy", "scipy", "Pillow", "pydantic", "filelock", "psutil"),
        *("rich", "Jinja2", "ruamel.yaml", "vl-convert-python"),
        *("compiled part", "Ceres", "threads", "CUDA"),
    ]


@pytest.mark.parametrize(("package", "version"), [("pycolmap", "4.3.0"), ("pyceres", None)])
def test_a_package_that_does_not_fit_is_named_with_what_to_run(
    monkeypatch: pytest.MonkeyPatch, package: str, version: str | None
) -> None:
    monkeypatch.setattr(
        "rangesfm.ceres.doctor.installed_version", lambda name: version if name == package else installed_version(name)
    )
    check = check_named(package)
    assert not check.ok
    assert check.found == (version or "not installed")
    assert "pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'" in check.remedy


def test_a_compiled_part_that_does_not_fit_is_reported_and_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise SolverError("it does not fit; do this")

    monkeypatch.setattr(doctor, "check_compatibility", fail)
    check = check_named("compiled part")
    assert not check.ok
    assert check.remedy == "it does not fit; do this"


def test_two_versions_of_ceres_do_not_go_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pyceres.__ceres_version__", "2.3.0")
    check = check_named("Ceres")
    assert not check.ok
    assert check.found == "2.2.0 in pycolmap, 2.3.0 in pyceres"


def test_an_older_python_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MIN_PYTHON", (3, 99))
    check = check_named("Python")
    assert not check.ok
    assert "3.99" in check.remedy


def test_versions_are_texts_and_name_every_part() -> None:
    found = versions()
    assert found.keys() >= {"python", "rangesfm", "pycolmap", "pyceres", "numpy", "scipy", "Pillow", "compiled_part"}
    assert all(isinstance(value, str) and value for value in found.values())
