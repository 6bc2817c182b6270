"""The C++ part's own tests pass, and compile without a warning, which ``tests.checkers`` looks for in all sources."""

from __future__ import annotations

import subprocess
from pathlib import Path

from tests.checkers import configure_cpp, failure, tool


def test_cpp_tests_pass(tmp_path: Path) -> None:
    configure_cpp(tmp_path)
    assert failure((tool("cmake"), "--build", tmp_path, "--target", "rangesfm_cost_tests")) == ""
    command = (tool("ctest"), "--test-dir", tmp_path, "--output-on-failure")
    report = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True).stdout
    assert "100% tests passed" in report, report
    assert "No tests were found" not in report
