"""``rangesfm ranges calibrate`` writes the error curve that the other commands read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from rangesfm.cli import main
from rangesfm.cli.arguments import Commands, normalize, parse
from rangesfm.cli.survey_flags import survey_from_arguments
from rangesfm.measurements.ranges.errors.error_curve import read_error_curve
from rangesfm.survey.inputs import read_ranging_inputs

ANCHORS = {"a": (0.0, 0.0, 2.0), "b": (6.0, 0.0, 0.3), "c": (6.0, 5.0, 2.0), "d": (0.0, 5.0, 0.3)}


@pytest.fixture
def survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write 2000 ranges that are 0.1 m too long on average, and positions by time."""
    monkeypatch.chdir(tmp_path)
    times = np.arange(500) / 10
    tags = np.array([3.0, 2.5, 1.2]) + np.array([2.8, 2.3, 0.8]) * np.sin(times[:, None] * [0.31, 0.47, 0.83])
    rng = np.random.default_rng(0)
    rows = [
        f"{t},{name},{np.linalg.norm(tag - at) + 0.1 + rng.normal(0, 0.03):.4f}"
        for t, tag in zip(times, tags)
        for name, at in ANCHORS.items()
    ]
    Path("uwb.csv").write_text("\n".join(["timestamp_s,anchor_id,range_m", *rows]) + "\n")
    Path("anchors.csv").write_text(
        "anchor_id,x_m,y_m,z_m\n" + "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in ANCHORS.items())
    )
    Path("truth.csv").write_text(
        "timestamp_s,x_m,y_m,z_m\n" + "".join(f"{t + 7},{x},{y},{z}\n" for t, (x, y, z) in zip(times, tags.tolist()))
    )
    return tmp_path


COMMAND = ["ranges", "calibrate", "uwb.csv", "--anchors", "anchors.csv", "--positions", "truth.csv"]


def test_the_curve_is_printed_written_and_drawn(survey: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--time_offset", "7", "--output_path", "curve.csv", "--plot", "curve.png"]
    assert main([*COMMAND, *more]) == 0
    text = capsys.readouterr().out
    assert "2000 of 2000 have a known length" in text
    assert "written to curve.csv" in text
    curve = read_error_curve("curve.csv")
    np.testing.assert_allclose(curve.error_m, 0.1, atol=0.04)
    assert Path("curve.png").read_bytes().startswith(b"\x89PNG")


def test_every_command_takes_the_curve(survey: Path) -> None:
    assert main([*COMMAND, "--time_offset", "7", "--output_path", "curve.csv"]) == 0
    for command in ("run", "scale", "refine"):
        flags = ["--ranges", "uwb.csv", "--anchors", "anchors.csv"]
        raw, corrected = (
            read_ranging_inputs(survey_from_arguments(parse(normalize([command, *flags, *more])))).log
            for more in ([], ["--error-curve", "curve.csv"])
        )
        np.testing.assert_allclose(raw.range_m - corrected.range_m, 0.1, atol=0.05)
        assert np.isnan(raw.shared_stddev_m).all()
        assert np.isfinite(corrected.shared_stddev_m).all()


def test_the_help_promises_the_curve_to_the_commands_that_take_it(capsys: pytest.CaptureFixture[str]) -> None:
    takes = {}
    for command in Commands().by_name:
        assert main([*command.split(), "--help"]) == 0
        takes[command] = "--error_curve CSV" in capsys.readouterr().out
    assert main(["ranges", "calibrate", "--help"]) == 0
    promised = re.search(r"(\w+(, \w+)+ and \w+) take the file", " ".join(capsys.readouterr().out.split()))
    assert promised is not None
    assert set(re.findall(r"\w+", promised[1])) - {"and"} == {command for command, does in takes.items() if does}


def test_bad_input_leaves_no_curve(survey: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*COMMAND, "--output_path", "curve.csv", "--time_offset", "1000"]) == 2
    assert "none of the ranges is at a known position" in capsys.readouterr().err
    assert main([*COMMAND]) == 2
    assert "--output_path" in capsys.readouterr().err
    assert not Path("curve.csv").exists()


def test_a_log_named_calibrate_can_still_be_read(survey: Path) -> None:
    Path("uwb.csv").rename("calibrate")
    assert main(["ranges", "./calibrate"]) == 0
