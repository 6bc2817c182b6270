"""The check that the installed packages fit together."""

from __future__ import annotations

import re
import subprocess

import pyceres
import pytest

from rangesfm import _cpp
from rangesfm.errors import SolverError
from rangesfm.solver import check_compatibility


def test_the_gate_opens_for_what_is_installed() -> None:
    check_compatibility()


@pytest.mark.usefixtures("unchecked")
def test_the_gate_stays_shut_where_types_are_not_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    # pybind11 raises this for a type that it does not know.
    def unknown_type(**_: object) -> pyceres.CostFunction:
        raise TypeError("Unable to convert function return value to a Python type! The signature was\n\t...")

    monkeypatch.setattr(_cpp, "range_cost", unknown_type)
    with pytest.raises(SolverError, match="pyceres does not know its cost functions"):
        check_compatibility()


@pytest.mark.usefixtures("unchecked")
def test_the_gate_stays_shut_where_a_known_cost_comes_out_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    right = _cpp.range_cost
    monkeypatch.setattr(
        _cpp,
        "range_cost",
        lambda *, range_m, tag_in_cam_m, stddev_m: right(
            range_m=range_m, tag_in_cam_m=tag_in_cam_m, stddev_m=2 * stddev_m
        ),
    )
    with pytest.raises(SolverError, match=r"a residual of cost 2\.0 costs 0\.5 in pyceres' problem"):
        check_compatibility()


def test_the_compiled_part_needs_no_library_that_pycolmap_does_not_need_too() -> None:
    """Ceres is linked in statically: a second Ceres library of the system would conflict with pycolmap's."""
    readelf = subprocess.run(["readelf", "-dW", _cpp.__file__], capture_output=True, text=True, check=True)
    needed = set(re.findall(r"NEEDED.*\[(.+?)\.so", readelf.stdout))
    assert needed <= {"libstdc++", "libm", "libgcc_s", "libc", "ld-linux-x86-64", "ld-linux-aarch64"}
