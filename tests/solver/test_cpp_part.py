"""The C++ part's own tests pass, and compile without a warning, which ``tests.checkers`` looks for in all sources."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from tests.checkers import configure_cpp, failure, tool


def test_cpp_tests_pass(tmp_path: Path) -> None:
    configure_cpp(tmp_path)
    assert failure((tool("cmake"), "--build", tmp_path, "--target", "rangesfm_cost_tests")) == ""
    done = subprocess.run(
        [tmp_path / "tests" / "rangesfm_cost_tests", "--gtest_brief=1"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout
    (num_passed,) = re.findall(r"PASSED  \] (\d+) tests", done.stdout)
    assert int(num_passed) > 0
