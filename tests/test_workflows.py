"""Claims of the CI workflows about the project are true."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from ruamel.yaml import YAML
from tests.checkers import WORKFLOWS
from tests.simulated.small_demo import make_small_demo

from rangesfm.installed_versions import PYTHONS

if TYPE_CHECKING:
    from tests.conftest import Command

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]


def read(path: Path) -> dict[str, Any]:
    return dict(YAML(typ="safe").load(path))


def jobs() -> list[Any]:
    """Return each job of each workflow, with a name that says where it is from."""
    return [
        pytest.param(workflow, name, id=f"{workflow.stem}-{name}")
        for workflow in WORKFLOWS
        for name in read(workflow)["jobs"]
    ]


def test_there_is_one_for_every_pull_request_two_a_week_and_the_release() -> None:
    starts = {workflow.stem: set(read(workflow)["on"]) for workflow in WORKFLOWS}
    assert starts.keys() == {"accuracy", "newest", "release", "tests"}
    assert "pull_request" in starts["tests"]
    assert all("schedule" in starts[name] for name in ("accuracy", "newest"))
    assert "push" in starts["release"]


@pytest.mark.parametrize(("workflow", "name"), jobs())
def test_a_job_waits_for_jobs_that_are_there_and_runs_what_is_there(workflow: Path, name: str) -> None:
    all_jobs = read(workflow)["jobs"]
    needs = all_jobs[name].get("needs", [])
    assert {needs} if isinstance(needs, str) else set(needs) <= all_jobs.keys() - {name}
    for step in all_jobs[name]["steps"]:
        for path in re.findall(r"(?:tests|\.ci|examples)/[\w./]+", step.get("run", "")):
            assert (ROOT / path).is_file(), path
        for module in re.findall(r"-m (tests[.\w]+)", step.get("run", "")):
            folder = ROOT / module.replace(".", "/")
            assert folder.with_suffix(".py").is_file() or (folder / "__main__.py").is_file(), module


def test_pull_requests_are_tried_on_the_oldest_a_middle_and_the_newest_python() -> None:
    tried = read(ROOT / ".github/workflows/tests.yml")["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert (tried[0], tried[-1]) == (PYTHONS[0], PYTHONS[-1])
    assert set(tried) < set(PYTHONS)


def test_the_newest_are_tried_without_the_versions_that_all_else_is_tried_with() -> None:
    by_job = read(ROOT / ".github/workflows/newest.yml")["jobs"]
    commands = [step["run"] for job in by_job.values() for step in job["steps"] if "run" in step]
    assert not any("constraints" in command for command in commands)
    assert any("--upgrade" in command and "pycolmap" in command and "scipy" in command for command in commands)


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
