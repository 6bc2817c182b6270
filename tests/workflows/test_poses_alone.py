"""Commands on models of poses without points: whatever the path and the ranges, they end with a result or a reason."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.conftest import Command
from tests.simulated.poses_alone import POSITIONS, RANGES, PosesAlone, write_poses_alone


def scaled(survey: PosesAlone, run: Command, *flags: str) -> dict[str, Any]:
    """Scale a survey, and return its ``result.json``."""
    done = run("scale", *survey.flags, *flags, "--output_path", "out", cwd=survey.folder)
    assert "Warning" not in done.stderr
    found: dict[str, Any] = json.loads((survey.folder / "out" / "result.json").read_text(encoding="utf-8"))
    return found


def holds(interval: list[float], value: float) -> bool:
    return interval[0] < value < interval[1]


def test_a_path_that_drifts_by_more_than_its_ranges_scatter_has_a_page(
    tmp_path: Path, rangesfm_command: Command
) -> None:
    survey = write_poses_alone(tmp_path, drift_m=0.2, seed=1)
    scale = scaled(survey, rangesfm_command, *RANGES)["scale"]
    assert holds(scale["interval_95"], survey.scale)
    assert any(reason.startswith("the path drifts by") for reason in scale["reasons"])
    assert "slow wandering of the ranges" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("noise_m", [0.0, 0.03])
def test_an_exactly_level_path_has_its_scale_from_positions(
    tmp_path: Path, rangesfm_command: Command, noise_m: float
) -> None:
    survey = write_poses_alone(tmp_path, height_amplitude_m=0.0)
    rng, path = np.random.default_rng(2), tmp_path / "positions.csv"
    header, *lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    moved = [[name, *(str(float(x) + noise_m * rng.standard_normal()) for x in at)] for name, *at in rows]
    path.write_text("\n".join([header, *map(",".join, moved)]) + "\n")
    scale = scaled(survey, rangesfm_command, *POSITIONS, "--no_report")["scale"]
    assert scale["verdict"] == "good"
    assert holds(scale["interval_95"], survey.scale)
