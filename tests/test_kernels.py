"""The numeric tests once more, with the BLAS kernels of other processors.

numpy and scipy bring an OpenBLAS with kernels for many processors, which selects the one that fits; each rounds in its
own way. A test that passes with only one of them reveals a decision of the product that depends on rounding. The tests
are divided among the kernels that this processor can execute, so that each rounds in one other way.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.conftest import blas_kernels

# Flags in /proc/cpuinfo that a processor must have for each kernel.
NEEDED_FLAGS = {"Haswell": "avx2", "SkylakeX": "avx512vl", "Nehalem": "sse4_2"}
# Tests of decisions that are made on computed numbers; the slow ones are left out, as in any run of the tests.
TESTS = (
    "tests/solver/test_covariance.py",
    "tests/comparison/test_with_reference.py",
    "tests/measurements/lengths",
    "tests/export/test_frames.py",
    "tests/util/geometry",
    "tests/measurements/ranges/anchors/test_trilateration.py",
    "tests/measurements/ranges/errors",
    "tests/measurements/ranges/test_association.py",
    "tests/estimation/test_carry.py",
    "tests/estimation/test_keyframe_graph.py",
    "tests/estimation/test_vision_information.py",
    "tests/estimation/scale/test_anchor_alignment.py",
    "tests/estimation/scale/test_consensus.py",
    "tests/estimation/scale/test_initialize.py::TestRefused",
    "tests/estimation/scale/test_initialize.py::TestWithoutNoise",
    "tests/measurements/ranges/scale/test_range_equation.py",
    "tests/estimation/scale/test_starts.py",
    "tests/measurements/ranges/scale/test_two_candidate.py",
)


def why_not(kernel: str) -> str:
    """Return why a test with this kernel would tell nothing on this processor, if so."""
    if NEEDED_FLAGS[kernel] not in Path("/proc/cpuinfo").read_text().split():
        return f"this processor cannot execute it: it lacks {NEEDED_FLAGS[kernel]}"
    return "it is this processor's own, with which all tests run" if set(blas_kernels()) == {kernel} else ""


@pytest.mark.parametrize("kernel", NEEDED_FLAGS)
def test_numeric_tests_pass_with_the_kernel(kernel: str, tmp_path: Path) -> None:
    if reason := why_not(kernel):
        pytest.skip(reason)
    others = [name for name in NEEDED_FLAGS if not why_not(name)]
    tests = TESTS[others.index(kernel) :: len(others)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    options = ["-p", "no:cacheprovider", f"--basetemp={tmp_path / 'base'}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=Path(__file__).parents[1],
        env={**environment, "OPENBLAS_CORETYPE": kernel},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert f"BLAS kernels: {kernel}, {kernel}\n" in done.stdout, "of numpy and of scipy"
