"""All checkers of the sources and of the CI workflows: ``python -m tests.checkers``.

They run side by side, one for each processor. What a checker that fails says is printed; then the exit status is 1.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
CPP_SOURCES = sorted(path for path in (ROOT / "cpp_ext").rglob("*") if path.suffix in (".cc", ".h"))
PYTHON_FOLDERS = ("plugin", "tests", "examples")
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))

Words = Sequence[str | Path]


def tool(name: str) -> str:
    """Return the path of a tool: from this interpreter's environment (its version is pinned), else the system's."""
    path = shutil.which(name, path=sysconfig.get_path("scripts")) or shutil.which(name)
    if path is None:
        sys.exit(f"{name} is missing; run: python -m pip install '.[test]', and for cmake: apt-get install cmake")
    return path


def failure(command: Words) -> str:
    """Run a command at the repository's root; if it fails, return its words and its output, else nothing."""
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return f"$ {' '.join(map(str, command))}\n{done.stdout}" if done.returncode != 0 else ""


def simple_checkers() -> list[Words]:
    """Return the commands that need no build folder, the longest first."""
    return [
        (tool("mypy"), *PYTHON_FOLDERS),
        (tool("ruff"), "check", *PYTHON_FOLDERS),
        (tool("ruff"), "format", "--check", *PYTHON_FOLDERS),
        (tool("clang-format"), "--dry-run", "-Werror", *CPP_SOURCES),
        (tool("check-jsonschema"), "--builtin-schema", "vendor.github-workflows", *WORKFLOWS),
        (tool("zizmor"), "--offline", "--no-progress", *WORKFLOWS),
    ]


def configure_cpp(build: Path) -> None:
    """Prepare the build of the C++ part and its tests in a folder, with the compile commands that clang-tidy needs.

    All sources of a target are compiled as one, because most of the time goes into the headers of Ceres and Eigen.
    """
    pybind11 = subprocess.run([sys.executable, "-m", "pybind11", "--cmakedir"], capture_output=True, text=True)
    failed = failure(
        (
            *(tool("cmake"), "-S", ROOT / "cpp_ext", "-B", build),
            "-DCMAKE_BUILD_TYPE=Debug",
            "-DCMAKE_CXX_FLAGS_DEBUG=",  # nobody debugs this build, and symbols take a quarter of the time
            "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON",
            "-DCMAKE_UNITY_BUILD=ON",
            "-DCMAKE_UNITY_BUILD_BATCH_SIZE=0",  # all sources of a target
            "-DRANGESFM_BUILD_TESTS=ON",
            f"-DPython_EXECUTABLE={sys.executable}",
            f"-Dpybind11_DIR={pybind11.stdout.strip()}",
        )
    )
    if failed:
        sys.exit(failed)


def clang_tidy(build: Path) -> list[Words]:
    """Return a command for each target of a prepared build; headers are checked where they are included.

    The sources of a target are included by one file, which is not below the folder that has the rules.
    """
    compiled = [Path(each["file"]) for each in json.loads((build / "compile_commands.json").read_text())]
    bundles = [path for path in compiled if path.suffix == ".cxx"]
    text = "".join(path.read_text() for path in bundles)
    left_out = [path for path in CPP_SOURCES if path.suffix == ".cc" and f'"{path}"' not in text]
    if left_out:
        sys.exit(f"{left_out[0]} is in no target of cpp_ext/CMakeLists.txt, so that clang-tidy would not read it")
    rules = (f"--config-file={ROOT / '.clang-tidy'}", "--checks=-bugprone-suspicious-include")
    return [(tool("clang-tidy"), "--quiet", *rules, "-p", build, bundle) for bundle in bundles]


def main() -> int:
    with ThreadPoolExecutor(os.cpu_count()) as executor, TemporaryDirectory() as folder:
        checks = [executor.submit(failure, command) for command in simple_checkers()]
        configure_cpp(Path(folder))
        checks += [executor.submit(failure, command) for command in clang_tidy(Path(folder))]
        failures = [failed for check in checks if (failed := check.result())]
    print(*failures, sep="\n", end="")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
