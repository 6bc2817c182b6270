"""Each command hands its survey to the right stage and prints what comes back."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from rangesfm.cli import main
from rangesfm.config import Survey
from rangesfm.doctor import Check


@dataclass
class Calls:
    """Stands in for the pipeline: what was asked of it."""

    made: list[tuple[str, Survey, dict[str, Any]]] = field(default_factory=list)

    def stage(self, name: str) -> Any:
        def run(survey: Survey, **options: Any) -> SimpleNamespace:
            options.pop("progress").message("working")
            self.made.append((name, survey, options))
            return SimpleNamespace(summary_lines=lambda: [f"{name} is done", "scale 2.5"])

        return run


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calls:
    calls = Calls()
    pipeline = ModuleType("rangesfm.pipeline")
    for name in ("run_survey", "reconstruct_survey", "scale_model", "refine_model"):
        setattr(pipeline, name, calls.stage(name))
    monkeypatch.setitem(sys.modules, "rangesfm.pipeline", pipeline)
    (tmp_path / "photos").mkdir()
    (tmp_path / "model").mkdir()
    (tmp_path / "uwb.csv").touch()
    monkeypatch.chdir(tmp_path)
    return calls


@pytest.mark.parametrize(
    ("argv", "stage", "options"),
    [
        (["run", "--images", "photos", "--ranges", "uwb.csv"], "run_survey", {"restart": False}),
        (["run", "--images", "photos", "--ranges", "uwb.csv", "--restart"], "run_survey", {"restart": True}),
        (["run", "--input_path", "model", "--ranges", "uwb.csv"], "refine_model", {}),
        (["reconstruct", "--images", "photos", "--restart"], "reconstruct_survey", {"restart": True}),
        (["scale", "--input-path", "model", "--ranges", "uwb.csv"], "scale_model", {}),
        (["refine", "--input-path", "model", "--ranges", "uwb.csv"], "refine_model", {}),
    ],
)
def test_command_runs_its_stage_and_prints_the_summary(
    argv: list[str], stage: str, options: dict[str, Any], calls: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == 0
    ((name, survey, given),) = calls.made
    assert (name, given) == (stage, options)
    assert (survey.images_path is None) != (survey.model_path is None)
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [f"{stage} is done", "scale 2.5"]
    assert captured.err == "working\n"


def test_quiet_run_prints_the_summary_alone(calls: Calls, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "--images", "photos", "--quiet"]) == 0
    assert capsys.readouterr() == ("reconstruct_survey is done\nscale 2.5\n", "")


def test_demo_makes_a_survey_and_runs_it_against_the_truth(calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    def make(folder: Path, *, num_photos: int, seed: int, progress: object) -> SimpleNamespace:
        folder.mkdir()
        (folder / "reference.csv").touch()
        survey_path = folder / "survey.toml"
        survey_path.write_text(f"[images]\nevery_nth = {num_photos}\n[output]\nseed = 1\n")
        return SimpleNamespace(survey_path=survey_path)

    monkeypatch.setattr("rangesfm.simulate.survey.make_demo_survey", make)
    assert main(["demo", "yard", "--num-photos", "12", "--seed", "5", "--num-threads", "2"]) == 0
    ((name, survey, options),) = calls.made
    assert (name, options) == ("run_survey", {"restart": False})
    assert (survey.keyframes.every_nth, survey.seed, survey.mapper.num_threads) == (12, 5, 2)
    assert survey.reference_path == Path.cwd() / "yard" / "reference.csv"
    assert survey.output_path == Path.cwd() / "yard" / "out"


@pytest.mark.parametrize(("ok", "status"), [(True, 0), (False, 4)])
def test_doctor_fails_where_a_part_does_not_fit(
    ok: bool, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = [
        Check("numpy", "2.0", "any", True),
        Check("pyceres", "1.0", "2.6", ok, "" if ok else "pip install pyceres==2.6"),
    ]
    monkeypatch.setattr("rangesfm.doctor.diagnose", lambda: checks)
    assert main(["doctor"]) == status
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == (2 if ok else 3)
    assert ok or "expected 2.6; pip install pyceres==2.6" in lines[-1]
