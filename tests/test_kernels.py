"""The numeric tests once more with the BLAS of other processors.

numpy and scipy bring an OpenBLAS that has kernels for many processors and takes the one that suits; each rounds in its
own way. A test that passes with one of them alone shows a decision of the product that hangs on rounding.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.conftest import blas_kernels

# By what a processor must have for it, as /proc/cpuinfo says.
NEEDED_FLAGS = {"Haswell": "avx2", "SkylakeX": "avx512vl", "Nehalem": "sse4_2"}
# Where decisions are made on computed numbers, as far as that is quick: about half a minute for a kernel.
TESTS = (
    "distances",
    "export/test_frames.py",
    "ranging/test_association.py",
    "ranging/test_clock_search.py",
    "ranging/test_inlier_noise.py",
    "ranging/test_noise.py",
    "ranging/test_place.py",
    "ranging/test_robust_loss.py",
    "ranging/test_shared_errors.py",
    "ranging/test_trilateration.py::TestPositionsInAPlane",
    "ranging/test_trilateration.py::TestRefusal",
    "ranging/test_trilateration.py::TestRounding",
    "ranging/test_trilateration.py::TestWithoutNoise",
    "refinement/test_carry.py",
    "refinement/test_keyframe_graph.py",
    "refinement/test_points_in_cameras.py",
    "refinement/test_unbend.py",
    "refinement/test_weights.py",
    "scale/test_anchor_alignment.py",
    "scale/test_consensus.py",
    "scale/test_initialize.py::TestRefused",
    "scale/test_initialize.py::TestWithoutNoise",
    "scale/test_range_equation.py",
    "scale/test_starts.py",
    "scale/test_two_candidate.py",
    "test_comparison.py",
    "test_covariance.py",
    "test_geometry.py",
    "test_reference.py",
)


@pytest.mark.parametrize("kernel", NEEDED_FLAGS)
def test_numeric_tests_pass_with_the_kernel(kernel: str, tmp_path: Path) -> None:
    if NEEDED_FLAGS[kernel] not in Path("/proc/cpuinfo").read_text().split():
        pytest.skip(f"this processor cannot execute it: it lacks {NEEDED_FLAGS[kernel]}")
    if set(blas_kernels()) == {kernel}:
        pytest.skip("it is this processor's own, with which all tests run")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", f"--basetemp={tmp_path / 'base'}", *TESTS],
        cwd=Path(__file__).parent,
        env={**environment, "OPENBLAS_CORETYPE": kernel},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert f"BLAS kernels: {kernel}, {kernel}\n" in done.stdout, "of numpy and of scipy"
