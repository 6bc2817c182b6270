"""``rangesfm plan`` prints what a survey will determine, or why the file is not a plan."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rangesfm.cli import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "plan.toml"
STRAIGHT = """
[anchors]
frame = "unknown"
places = {A = [2, 8, 1.6]}
[path]
waypoints = [[0, 0, 1.6], [2, 0, 1.6]]
speed_m_per_s = 0.25
"""


def test_the_example_is_planned_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", str(EXAMPLE), "--output_path", str(tmp_path / "plan")]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert re.search(r"^scale: good; -[\d.]+ to \+[\d.]+ % \(95 %\)$", printed.out, re.MULTILINE)
    assert "what would gain most for the place" in printed.out
    content = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert "<figure" in (tmp_path / "plan" / "plan.html").read_text()
    assert 0 < content["scale_stddev"] < 0.1
    assert (content["verdict"], content["place"]["verdict"]) == ("good", "good")


def test_a_scale_that_a_run_would_refuse_has_a_page_and_advice_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plan.toml").write_text(STRAIGHT)
    assert main(["plan", str(tmp_path / "plan.toml"), "--output_path", str(tmp_path / "plan")]) == 3
    printed = capsys.readouterr()
    assert printed.err == ""
    assert re.search(r"^scale: refused; .* % \(95 %\)\n  the scale is only known to", printed.out, re.MULTILINE)
    assert re.search(r"^what would gain most for the scale, now .* \(95 %\):\n  1\. ", printed.out, re.MULTILINE)
    assert json.loads((tmp_path / "plan" / "plan.json").read_text())["verdict"] == "refused"
    assert "<h2>Scale: refused</h2>" in (tmp_path / "plan" / "plan.html").read_text()


def test_a_key_that_is_not_known_is_named_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(STRAIGHT + "speed = 1.0\n")
    assert main(["plan", str(path)]) == 2
    assert capsys.readouterr().err.startswith(f"rangesfm: error: {path}:8: unknown key 'speed' in [path]")
    assert not (tmp_path / "plan").exists()
