"""The report of ``rangesfm doctor`` and of every result about the installation."""

from __future__ import annotations

import subprocess
import sys

import pytest
from tests.installed import with_gpus, with_installed

from rangesfm.errors import SolverError
from rangesfm.solver import installation_checks
from rangesfm.solver.installation_checks import InstallationCheck, diagnose, recorded_versions


def check_named(name: str) -> InstallationCheck:
    (check,) = (check for check in diagnose() if check.name == name)
    return check


def test_this_installation_is_well() -> None:
    assert [check for check in diagnose() if not check.ok] == []


def test_everything_a_run_depends_on_is_looked_at() -> None:
    assert [check.name for check in diagnose()] == [
        *("Python", "rangesfm", "pycolmap", "pyceres", "numpy", "scipy", "Pillow", "pydantic", "filelock", "psutil"),
        *("rich", "threadpoolctl", "Jinja2", "ruamel.yaml", "vl-convert-python"),
        *("compiled part", "Ceres", "threads", "CUDA"),
    ]


@pytest.mark.parametrize(("package", "version"), [("pycolmap", "4.3.0"), ("pyceres", None)])
def test_a_package_that_does_not_fit_is_named_with_what_to_run(
    monkeypatch: pytest.MonkeyPatch, package: str, version: str | None
) -> None:
    with_installed(monkeypatch, **{package: version}, pycolmap_cuda12=None)
    check = check_named(package)
    assert not check.ok
    assert check.found == (version or "not installed")
    assert "pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'" in check.remedy


def test_the_build_with_cuda_is_well_and_goes_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, pycolmap=None, pycolmap_cuda12="4.2.1")
    check = check_named("pycolmap")
    assert (check.ok, check.found) == (True, "4.2.1 (pycolmap-cuda12)")
    assert recorded_versions()["pycolmap"] == check.found


def test_two_builds_over_each_other_are_not_well(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, pycolmap="4.2.1", pycolmap_cuda12="4.2.0")
    check = check_named("pycolmap")
    assert not check.ok
    assert check.found == "4.2.1 and 4.2.0 (pycolmap-cuda12)"
    assert check.remedy.startswith(
        "run: python -m pip uninstall -y pycolmap pycolmap-cuda12, then python -m pip install"
    )


@pytest.mark.parametrize(
    ("num_gpus", "said"),
    [
        (None, "pycolmap has none (that would be pycolmap-cuda12): the processor is used"),
        (0, "pycolmap has it, and there is no GPU: the processor is used"),
        (1, "pycolmap has it, and there is 1 GPU for features and matching"),
        (2, "pycolmap has it, and there are 2 GPUs for features and matching"),
    ],
)
def test_what_there_is_of_cuda_is_said_and_is_never_wrong(
    num_gpus: int | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_gpus(monkeypatch, num_gpus)
    check = check_named("CUDA")
    assert (check.found, check.ok) == (said, True)


def test_no_wheel_of_pycolmap_solves_a_bundle_adjustment_on_a_gpu() -> None:
    """examples/big_surveys.md says so. If this test fails, try a GPU with range residuals and update that page."""
    code = """if True:
        import pycolmap  # and not pyceres, which has a Ceres of its own
        options = pycolmap.BundleAdjustmentOptions().ceres.solver_options
        options.num_threads = 1
        options.linear_solver_type = type(options.linear_solver_type).DENSE_SCHUR
        libraries = type(options.dense_linear_algebra_library_type)
        for options.dense_linear_algebra_library_type in (libraries.EIGEN, libraries.CUDA):
            print(*options.IsValid(), sep=": ")
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    on_processor, on_gpu = done.stdout.splitlines()
    assert on_processor.startswith("True")
    assert on_gpu.startswith("False: Can't use DENSE_SCHUR with dense_linear_algebra_library_type = CUDA")


def test_a_compiled_part_that_does_not_fit_is_reported_and_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise SolverError("it does not fit; do this")

    monkeypatch.setattr(installation_checks, "check_compatibility", fail)
    check = check_named("compiled part")
    assert not check.ok
    assert check.remedy == "it does not fit; do this"


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("where", "version", "said"),
    [
        ("pyceres.__ceres_version__", "2.3.0", "Ceres 2.2.0 in pycolmap, Ceres 2.3.0 in pyceres, "),
        ("pyceres.__ceres_version__", "2.2.1", "Ceres 2.2.0 in pycolmap, Ceres 2.2.1 in pyceres, "),
        (
            "rangesfm._cpp.ceres_version",
            "2.3.0",
            "Ceres 2.3.0 in the compiled part's headers; expected 2.2 in the pack",
        ),
        (
            "rangesfm._cpp.ceres_version",
            "2.0.0",
            "Ceres 2.0.0 in the compiled part's headers; expected 2.2 in the pack",
        ),
    ],
)
def test_versions_of_ceres_that_do_not_go_together_are_refused_before_anything_is_computed(
    where: str, version: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(where, version)
    monkeypatch.setattr(
        installation_checks, "_costs_of_known_residual", lambda: pytest.fail("objects of two kinds have met")
    )
    check = check_named("compiled part")
    assert not check.ok
    assert said in check.remedy


def test_a_python_that_is_not_listed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation_checks, "PYTHONS", ("3.98", "3.99"))
    check = check_named("Python")
    assert not check.ok
    assert check.remedy == "use Python 3.98 to 3.99"
