"""Claims of the CI workflows about the project are true."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.simulated.small_demo import make_small_demo

if TYPE_CHECKING:
    from tests.conftest import Command

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]


def test_what_tries_a_wheel_ends_well(
    rangesfm_command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the demo has small photos, which take a quarter of the time; a release tries the large ones."""
    monkeypatch.setattr("rangesfm.demo.survey.make_demo_survey", make_small_demo)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    commands = project["tool"]["cibuildwheel"]["test-command"].split(" && ")
    assert [command.split()[:2] for command in commands] == [["rangesfm", "doctor"], ["rangesfm", "demo"]]
    for command in commands:
        rangesfm_command(*shlex.split(command)[1:], cwd=tmp_path)
