"""The formatter, the linter and the type checker pass for all files, and so do the C++ part's own tests."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CPP_SOURCES = sorted(path for path in (ROOT / "cpp_ext").rglob("*") if path.suffix in (".cc", ".h"))
PYTHON_FOLDERS = [name for name in ("plugin", "tests", "examples") if any((ROOT / name).rglob("*.py"))]


def tool(name: str) -> str:
    """Return the path of a tool: from this interpreter's environment (its version is pinned), else the system's."""
    path = shutil.which(name, path=sysconfig.get_path("scripts")) or shutil.which(name)
    if path is None:
        pytest.fail(f"{name} is missing; run: python -m pip install '.[test]', and for cmake: apt-get install cmake")
    return path


def run(*command: str | Path) -> str:
    """Run a command at the repository's root and return its output; if it fails, the test fails with that output."""
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode != 0:
        pytest.fail(f"{' '.join(map(str, command))}\n{done.stdout}", pytrace=False)
    return done.stdout


@pytest.fixture(scope="module")
def cpp_build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configured build folder of the C++ part and its tests, with the compile commands that clang-tidy needs.

    All sources of a target are compiled as one, because most of the time goes into the headers of Ceres and Eigen.
    """
    folder = tmp_path_factory.mktemp("cpp_build")
    run(
        *(tool("cmake"), "-S", ROOT / "cpp_ext", "-B", folder),
        "-DCMAKE_BUILD_TYPE=Debug",
        "-DCMAKE_CXX_FLAGS_DEBUG=",  # nobody debugs this build, and symbols take a quarter of the time
        "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON",
        "-DCMAKE_UNITY_BUILD=ON",
        "-DCMAKE_UNITY_BUILD_BATCH_SIZE=0",  # all sources of a target
        "-DRANGESFM_BUILD_TESTS=ON",
        f"-DPython_EXECUTABLE={sys.executable}",
        f"-Dpybind11_DIR={run(sys.executable, '-m', 'pybind11', '--cmakedir').strip()}",
    )
    return folder


def test_python_is_formatted() -> None:
    run(tool("ruff"), "format", "--check", *PYTHON_FOLDERS)


def test_python_keeps_the_rules() -> None:
    run(tool("ruff"), "check", *PYTHON_FOLDERS)


def test_python_types_are_right() -> None:
    run(tool("mypy"), *PYTHON_FOLDERS)


def test_class_variables_have_a_type() -> None:
    """Pydantic refuses a plain ``ClassVar`` on Python 3.10 in a model when its module is imported."""
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted((ROOT / "plugin").rglob("*.py"))}
    assert [name for name, text in texts.items() if re.search(r": ClassVar(?!\[)\b", text)] == []


def test_cpp_is_formatted() -> None:
    run(tool("clang-format"), "--dry-run", "-Werror", *CPP_SOURCES)


def test_cpp_keeps_the_rules(cpp_build: Path) -> None:
    compiled = [Path(command["file"]) for command in json.loads((cpp_build / "compile_commands.json").read_text())]
    bundles = [path for path in compiled if path.suffix == ".cxx"]
    text = "".join(path.read_text() for path in bundles)
    assert [path.name for path in CPP_SOURCES if path.suffix == ".cc" and f'"{path}"' not in text] == []

    def check(bundle: Path) -> None:
        # The bundle includes sources, and it is not below the folder with the rules.
        options = ("--quiet", f"--config-file={ROOT / '.clang-tidy'}", "--checks=-bugprone-suspicious-include")
        run(tool("clang-tidy"), *options, "-p", cpp_build, bundle)

    # Headers are checked where they are included.
    with ThreadPoolExecutor(os.cpu_count()) as executor:
        list(executor.map(check, bundles))


def test_cpp_tests_pass(cpp_build: Path) -> None:
    run(tool("cmake"), "--build", cpp_build, "--parallel", str(os.cpu_count()))
    report = run(tool("ctest"), "--test-dir", cpp_build, "--output-on-failure")
    assert "100% tests passed" in report
    assert "No tests were found" not in report
