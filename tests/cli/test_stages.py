"""Each command hands its survey to the right stage and prints what comes back."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from rangesfm.cli import main
from rangesfm.solver.installation_checks import InstallationCheck
from rangesfm.survey.settings import Survey


@dataclass
class Calls:
    """A stand-in for the pipeline that records the calls made to it."""

    made: list[tuple[str, Survey, dict[str, Any]]] = field(default_factory=list)

    def stage(self, name: str) -> Any:
        def run(survey: Survey, **options: Any) -> SimpleNamespace | list[str]:
            options.pop("progress").message("working")
            self.made.append((name, survey, options))
            lines = [f"{name} is done", "scale 2.5"]
            return lines if name == "reconstruct_survey" else SimpleNamespace(lines=lines)

        return run


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calls:
    calls = Calls()
    pipeline = ModuleType("rangesfm.pipeline.run")
    for name in ("run_survey", "reconstruct_survey", "scale_model", "refine_model"):
        setattr(pipeline, name, calls.stage(name))
    monkeypatch.setitem(sys.modules, "rangesfm.pipeline.run", pipeline)
    (tmp_path / "photos").mkdir()
    (tmp_path / "model").mkdir()
    for name in ("uwb.csv", "walk.MP4"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return calls


@pytest.mark.parametrize(
    ("argv", "stage", "options"),
    [
        (["run", "--images", "photos", "--ranges", "uwb.csv"], "run_survey", {"restart": False}),
        (["run", "--images", "photos", "--ranges", "uwb.csv", "--restart"], "run_survey", {"restart": True}),
        (["run", "--input_path", "model", "--ranges", "uwb.csv"], "run_survey", {"restart": False}),
        (["reconstruct", "--images", "photos", "--restart"], "reconstruct_survey", {"restart": True}),
        (["reconstruct", "--images", "walk.MP4"], "reconstruct_survey", {"restart": False}),
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
    assert (survey.images.path is None) != (survey.images.model is None)
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [f"{stage} is done", "scale 2.5"]
    assert captured.err == "working\n"


def test_quiet_run_prints_the_summary_alone(calls: Calls, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "--images", "photos", "--quiet"]) == 0
    assert capsys.readouterr() == ("reconstruct_survey is done\nscale 2.5\n", "")


@pytest.mark.parametrize(
    ("flags", "maker", "num_photos"),
    [
        (["--num-photos", "20"], "survey.make_demo_survey", 20),
        (["--scene", "corridor"], "corridor.make_corridor_survey", 96),
    ],
)
def test_demo_makes_a_survey_and_runs_it_against_the_truth(
    flags: list[str], maker: str, num_photos: int, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(folder: Path, *, num_photos: int, seed: int, imu: bool) -> SimpleNamespace:
        folder.mkdir()
        (folder / "reference.csv").touch()
        survey_path = folder / "survey.toml"
        survey_path.write_text(f"[images]\nevery_nth = {num_photos}\n[output]\nseed = 1\n")
        return SimpleNamespace(survey_path=survey_path)

    monkeypatch.setattr(f"rangesfm.demo.{maker}", make)
    assert main(["demo", "yard", *flags, "--seed", "5", "--num-threads", "2"]) == 0
    ((name, survey, options),) = calls.made
    assert (name, options) == ("run_survey", {"restart": False})
    assert (survey.images.every_nth, survey.output.seed, survey.mapper.num_threads) == (num_photos, 5, 2)
    assert survey.report.reference == Path.cwd() / "yard" / "reference.csv"
    assert survey.output.path == Path.cwd() / "yard" / "out"


@pytest.mark.parametrize(("ok", "status"), [(True, 0), (False, 4)])
def test_doctor_fails_where_a_part_does_not_fit(
    ok: bool, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = [
        InstallationCheck("numpy", "2.0", "any", True),
        InstallationCheck("pyceres", "1.0", "2.6", ok, "" if ok else "pip install pyceres==2.6"),
    ]
    monkeypatch.setattr("rangesfm.solver.installation_checks.diagnose", lambda: checks)
    assert main(["doctor"]) == status
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == (2 if ok else 3)
    assert ok or "expected 2.6; pip install pyceres==2.6" in lines[-1]


def test_lever_arms_of_several_tags_are_given_one_by_one(calls: Calls) -> None:
    start = ["scale", "--input_path", "model", "--ranges", "uwb.csv"]
    assert main([*start, "--tag-in-cam", "T1:-0.1,0,2", "--tag_in_cam", "A:B:0,0,1"]) == 0
    assert main([*start, "--tag_in_cam", "-0.1,0,2"]) == 0
    (_, several, _), (_, one, _) = calls.made
    assert several.tag.lever_arms_m == {"T1": (-0.1, 0.0, 2.0), "A:B": (0.0, 0.0, 1.0)}
    assert (one.tag.tag_in_cam_m, one.tag.lever_arms_m) == ((-0.1, 0.0, 2.0), {})


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--tag_in_cam", ":1,2,3"], "has no tag's id before the colon"),
        (["--tag_in_cam", "T:1,2"], "has 2 numbers, expected X,Y,Z in metres"),
        (["--tag_in_cam", "1,2,3", "--tag_in_cam", "T:1,2,3"], "--tag_in_cam is given with an ID and without"),
    ],
)
def test_lever_arms_that_cannot_be_are_refused(
    flags: list[str], said: str, calls: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scale", "--input_path", "model", "--ranges", "uwb.csv", *flags]) == 2
    assert said in capsys.readouterr().err
    assert not calls.made


def test_radio_log_is_described_by_the_flags_of_the_ranges_command(calls: Calls) -> None:
    flags = ["--columns", "timestamp=t,anchor_id=n", "--stamp_unit", "us", "--propagation_speed", "299.7e6"]
    assert main(["refine", "--input_path", "model", "--ranges", "uwb.csv", *flags, "--ranging_interval_s", "0.1"]) == 0
    ranges = calls.made[0][1].ranges
    assert ranges.columns == {"timestamp": "t", "anchor_id": "n"}
    assert (ranges.stamp_unit, ranges.propagation_speed) == ("us", 299.7e6)
    assert ranges.ranging_interval_s == 0.1
