"""Test the compiled part under a sanitizer: its GoogleTest suite, then the Python tests that use it.

    python tests/sanitizers/run.py address      # memory: GCC's AddressSanitizer
    python tests/sanitizers/run.py undefined    # undefined behaviour
    python tests/sanitizers/run.py thread       # data races between Ceres' threads

Needs GCC with its sanitizers, and the packages that the C++ tests need (CONTRIBUTING.md). Builds in a folder of its own
(``--build_path`` keeps it) and changes nothing that is installed. Exit status 0 means that both suites passed without a
finding.

pycolmap, pyceres and Python itself are not built with the sanitizer. It therefore checks the cost functions and their
bindings, and all memory and locks of the process, but it does not see races within those packages.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
RUNTIMES = {"address": "libasan.so", "undefined": "libubsan.so", "thread": "libtsan.so"}
OPTIONS = {
    "ASAN_OPTIONS": "detect_leaks=0",  # Python leaks by design; the GoogleTest suite is searched for leaks
    "UBSAN_OPTIONS": "print_stacktrace=1",
    "TSAN_OPTIONS": "halt_on_error=1",
}
TESTS = ("tests/solver",)
# This test checks which libraries the extension needs, and here it needs the sanitizer's.
NOT_MEANT = (
    "tests/solver/test_compatibility.py::test_the_compiled_part_needs_no_library_that_pycolmap_does_not_need_too"
)
_SITE = "import sys\nsys.meta_path = [finder for finder in sys.meta_path if isinstance(finder, type)]\n"


def build(sanitizer: str, folder: Path) -> None:
    """Build the extension and its C++ tests."""
    pybind11 = subprocess.check_output([sys.executable, "-m", "pybind11", "--cmakedir"], text=True).strip()
    options = {
        "CMAKE_BUILD_TYPE": "Debug",
        "RANGESFM_BUILD_TESTS": "ON",
        "RANGESFM_SANITIZE": sanitizer,
        "Python_EXECUTABLE": sys.executable,
        "pybind11_DIR": pybind11,
    }
    definitions = [f"-D{name}={value}" for name, value in options.items()]
    subprocess.run(["cmake", "-S", ROOT / "cpp_ext", "-B", folder, *definitions], check=True)
    subprocess.run(["cmake", "--build", folder], check=True)


def overlay(build_path: Path, folder: Path) -> None:
    """Make a package with the sanitized extension, which PYTHONPATH puts before any installed one."""
    shutil.copytree(ROOT / "plugin" / "rangesfm", folder / "rangesfm", ignore=shutil.ignore_patterns("*.so"))
    (extension,) = build_path.glob("_cpp*.so")
    shutil.copy(extension, folder / "rangesfm")
    (folder / "sitecustomize.py").write_text(_SITE, encoding="utf-8")


def library(name: str) -> str:
    """Return where the compiler finds a library."""
    return subprocess.check_output(["gcc", f"-print-file-name={name}"], text=True).strip()


def without_shuffled_addresses(sanitizer: str) -> list[str]:
    """Return a command prefix that keeps addresses from being randomized widely.

    GCC's older thread sanitizers stop where the kernel does that.
    """
    return ["setarch", "-R"] if sanitizer == "thread" else []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sanitizer", choices=RUNTIMES)
    parser.add_argument("--build_path", type=Path)
    parser.add_argument("tests", nargs="*", default=TESTS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        build_path = args.build_path or Path(temporary) / "build"
        build(args.sanitizer, build_path)
        environment = {**os.environ, **OPTIONS, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        prefix = without_shuffled_addresses(args.sanitizer)
        cpp_tests = [*prefix, build_path / "tests" / "rangesfm_cost_tests", "--gtest_brief=1"]
        status = subprocess.run(cpp_tests, env={**environment, "ASAN_OPTIONS": "detect_leaks=1"}).returncode
        overlay(build_path, Path(temporary) / "overlay")
        environment["PYTHONPATH"] = str(Path(temporary) / "overlay")
        # The sanitizer looks for functions of the C++ library before Python has loaded that, so it is preloaded too.
        environment["LD_PRELOAD"] = " ".join(map(library, (RUNTIMES[args.sanitizer], "libstdc++.so.6")))
        pytest = [*prefix, sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--deselect", NOT_MEANT]
        return subprocess.run([*pytest, *args.tests], cwd=ROOT, env=environment).returncode or status


if __name__ == "__main__":
    sys.exit(main())
