"""The report of ``rangesfm doctor`` and of every result about the installation."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pyceres
import pycolmap
import pytest
from tests.installed import with_gpus, with_installed

import rangesfm
from rangesfm import _cpp
from rangesfm.ceres import installation_checks
from rangesfm.ceres.installation_checks import InstallationCheck, diagnose, recorded_versions
from rangesfm.errors import SolverError


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
    """examples/gpu.md says so. If this test fails, try a GPU with range residuals and update that page."""
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


def test_versions_are_texts_and_name_every_part() -> None:
    found = recorded_versions()
    assert found.keys() >= {"python", "rangesfm", "pycolmap", "pyceres", "numpy", "scipy", "Pillow", "compiled_part"}
    assert all(isinstance(value, str) and value for value in found.values())
    assert found["platform"] == platform.platform()
    assert found["python"] == platform.python_version()


@pytest.mark.parametrize("version", ["0.1", None])
def test_a_package_that_may_have_any_version_must_only_be_there(
    version: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_installed(monkeypatch, some_package=version)
    remedy = "" if version else "run: python -m pip install some-package"
    expected = InstallationCheck("some-package", version or "not installed", "any", bool(version), remedy)
    assert installation_checks._check_package("some-package") == expected


def test_both_builds_must_fit_and_only_one_may_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, pycolmap="4.2.1", pycolmap_cuda12="4.2.1")
    check = installation_checks._check_package("pycolmap")
    assert check.expected == "one of pycolmap and pycolmap-cuda12, as both are the module pycolmap"
    assert not check.ok
    with_installed(monkeypatch, pycolmap="4.2.1", pycolmap_cuda12="4.1.0")
    check = installation_checks._check_package("pycolmap")
    assert (check.expected, check.ok) == ("4.2", False)
    assert check.remedy.startswith("run: python -m pip install 'pycolmap-cuda12>=4.2,<4.3'")


def test_a_package_that_fits_needs_no_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, pycolmap="4.2.9", pycolmap_cuda12=None)
    expected = InstallationCheck("pycolmap", "4.2.9", "4.2", ok=True, remedy="")
    assert installation_checks._check_package("pycolmap") == expected


def test_this_python_fits_and_says_so() -> None:
    expected = InstallationCheck("Python", platform.python_version(), "3.10 to 3.14", ok=True, remedy="")
    assert installation_checks._check_python() == expected


def test_what_asks_the_packages_themselves_is_left_out_where_one_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, numpy=None)
    names = [check.name for check in diagnose()]
    assert names[-1] == "compiled part"
    assert not {"Ceres", "threads", "CUDA"} & set(names)


def test_versions_of_ceres_are_said_by_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pycolmap, "__ceres_version__", "2.2.1")
    monkeypatch.setattr(pyceres, "__ceres_version__", "2.2.2")
    monkeypatch.setattr(_cpp, "ceres_version", "2.1.3")
    found = "2.2.1 in pycolmap, 2.2.2 in pyceres, 2.1.3 in the compiled part's headers"
    assert installation_checks._check_ceres() == InstallationCheck("Ceres", found, "2.2 in both", ok=True)


@pytest.mark.parametrize(
    ("libraries", "headers", "fits"),
    [
        (("2.2.0", "2.2.0"), "2.2.0", True),
        (("2.2.5", "2.2.5"), "2.1.0", True),
        (("2.2.0", "2.2.0"), "2.3.0", False),
        (("2.2.0", "2.2.1"), "2.2.0", False),
        (("2.3.0", "2.3.0"), "2.2.0", False),
        (("2.1.0", "2.1.0"), "2.1.0", False),
    ],
)
def test_versions_of_ceres_fit_if_the_libraries_have_one_and_the_headers_a_known_one(
    libraries: tuple[str, str], headers: str, fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pycolmap, "__ceres_version__", libraries[0])
    monkeypatch.setattr(pyceres, "__ceres_version__", libraries[1])
    monkeypatch.setattr(_cpp, "ceres_version", headers)
    if fits:
        installation_checks._compare_ceres_versions()
        return
    met = f"Ceres {libraries[0]} in pycolmap, Ceres {libraries[1]} in pyceres, Ceres {headers} in the compiled part's h"
    with pytest.raises(SolverError, match=met) as raised:
        installation_checks._compare_ceres_versions()
    assert "; expected 2.2 in the packages, headers of 2.1 or 2.2; installed: pycolmap " in str(raised.value)


@pytest.mark.parametrize("num_usable", [1, 3])
def test_the_cores_that_may_be_used_are_said_beside_those_there_are(
    num_usable: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(num_usable)) if process == 0 else set())
    expected = InstallationCheck("threads", f"{num_usable} of 8 cores", "1 or more", ok=True)
    assert installation_checks._check_threads() == expected


@pytest.mark.parametrize(("num_cores", "said"), [(None, "1 of 1 cores"), (6, "6 of 6 cores")])
def test_where_no_one_says_how_many_cores_may_be_used_it_is_all_of_them(
    num_cores: int | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: num_cores)
    monkeypatch.delattr(os, "sched_getaffinity")
    assert installation_checks._check_threads().found == said


def test_a_residual_of_known_cost_costs_the_same_everywhere() -> None:
    found = installation_checks._costs_of_known_residual()
    places = ["in pyceres' problem", "in pycolmap's problem", "in pycolmap's solver", "less after pycolmap's solver"]
    assert list(found) == places
    assert list(found.values()) == pytest.approx([2.0] * 4, abs=1e-9)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ImportError("no such library"), "no such library"),
        (TypeError("unknown type"), "pyceres does not know its cost functions as ones of Ceres"),
    ],
)
def test_an_error_at_the_first_residual_says_what_does_not_fit(
    error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(installation_checks, "_costs_of_known_residual", fail)
    with pytest.raises(SolverError, match=f"^the compiled part does not fit the installed packages: {said}; inst"):
        installation_checks.check_compatibility.__wrapped__()


@pytest.mark.parametrize(("cost", "fits"), [(2.0 + 1e-10, True), (2.0 - 1e-8, False), (2.0 + 1e-8, False)])
def test_a_residual_may_cost_what_is_known_up_to_rounding(
    cost: float, fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation_checks, "_costs_of_known_residual", lambda: {"here": 2.0, "there": cost})
    if fits:
        installation_checks.check_compatibility.__wrapped__()
        return
    with pytest.raises(SolverError, match=f"a residual of cost 2.0 costs {cost} there; installed: "):
        installation_checks.check_compatibility.__wrapped__()


def test_what_does_not_fit_is_said_with_all_versions_and_what_to_run(monkeypatch: pytest.MonkeyPatch) -> None:
    with_installed(monkeypatch, pycolmap="4.2.1", pycolmap_cuda12=None, pyceres=None)
    assert str(installation_checks._incompatible("why")) == (
        "the compiled part does not fit the installed packages: why; installed: pycolmap 4.2.1, pyceres not installed, "
        f"rangesfm {installation_checks.compiled_part_version()}; run: python -m pip install 'pycolmap>=4.2,<4.3' "
        "'pyceres>=2.6,<2.7', then install rangesfm anew"
    )


def test_the_compiled_part_says_what_it_was_built_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_cpp, "pybind11_version", "3.0.1")
    monkeypatch.setattr(_cpp, "pybind11_internals_version", 11)
    monkeypatch.setattr(_cpp, "ceres_version", "2.2.0")
    said = "built with pybind11 3.0.1 (internals 11) and headers of Ceres 2.2.0"
    assert installation_checks.compiled_part_version() == said


def test_a_compiled_part_that_is_missing_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rangesfm._cpp", None)
    monkeypatch.delattr(rangesfm, "_cpp", raising=False)
    assert installation_checks.compiled_part_version() == "not there"
