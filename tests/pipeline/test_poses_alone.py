"""Commands on models of poses without points: whatever the path and the ranges, they end with a result or a reason."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.conftest import Command
from tests.simulated.poses_alone import POSITIONS, RANGES, Garble, PosesAlone, write_poses_alone

Array = npt.NDArray[np.float64]

KNOWN, UNKNOWN = ("--anchors", "anchors.csv"), ("--anchor_frame", "unknown")


def scaled(survey: PosesAlone, run: Command, *flags: str) -> dict[str, Any]:
    """Scale a survey, and return its ``result.json``."""
    done = run("scale", *survey.flags, *flags, "--output_path", "out", cwd=survey.folder)
    assert "Warning" not in done.stderr
    found: dict[str, Any] = json.loads((survey.folder / "out" / "result.json").read_text(encoding="utf-8"))
    return found


def relative_width(interval: list[float]) -> float:
    return interval[1] / interval[0] - 1


def holds(interval: list[float], value: float) -> bool:
    return interval[0] < value < interval[1]


def test_a_path_that_drifts_by_more_than_its_ranges_scatter_has_a_page(
    tmp_path: Path, rangesfm_command: Command
) -> None:
    survey = write_poses_alone(tmp_path, drift_m=0.2, seed=1)
    scale = scaled(survey, rangesfm_command, *RANGES, *KNOWN)["scale"]
    assert holds(scale["interval_95"], survey.scale)
    assert any(reason.startswith("the path drifts by") for reason in scale["reasons"])
    assert "slow wandering of the ranges" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_run_scales_poses_alone_and_a_refinement_of_them_is_refused(
    tmp_path: Path, rangesfm_command: Command
) -> None:
    survey = write_poses_alone(tmp_path)
    flags = (*survey.flags, *RANGES, *KNOWN, "--no_report", "--output_path", "out")
    done = rangesfm_command("refine", *flags, cwd=tmp_path, status=2)
    assert "has no 3-D points to refine: a trajectory can only be scaled" in done.stderr
    done = rangesfm_command("run", *flags, cwd=tmp_path)
    assert "the model has no 3-D points: it is scaled, and not refined" in done.stdout + done.stderr
    assert holds(json.loads((tmp_path / "out" / "result.json").read_text())["scale"]["interval_95"], survey.scale)


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


def far_off(range_m: Array, rng: np.random.Generator) -> Array:
    return np.where(rng.random(len(range_m)) < 0.2, rng.uniform(900.0, 1900.0, len(range_m)), range_m)


def anything(range_m: Array, rng: np.random.Generator) -> Array:
    return np.where(rng.random(len(range_m)) < 0.2, rng.uniform(0.0, 1000.0, len(range_m)), range_m)


@pytest.mark.parametrize(
    ("garble", "drift_m", "anchors"),
    [(far_off, 0.0, KNOWN), (far_off, 0.2, UNKNOWN), (anything, 0.2, KNOWN), (anything, 0.0, UNKNOWN)],
)
def test_a_fifth_of_garbage_leaves_scale_and_place_as_they_are_without(
    tmp_path: Path, rangesfm_command: Command, garble: Garble, drift_m: float, anchors: Sequence[str]
) -> None:
    survey = write_poses_alone(tmp_path, drift_m=drift_m, garble=garble, seed=3)
    found = scaled(survey, rangesfm_command, *RANGES, *anchors, "--no_report")
    assert found["scale"]["verdict"] == "good"
    assert holds(found["scale"]["interval_95"], survey.scale)
    assert relative_width(found["scale"]["interval_95"]) < 0.04
    assert anchors == UNKNOWN or found["place"]["worst_keyframe_stddev_m"] < 0.3


def test_the_papers_estimate_is_refused_where_the_ranges_exclude_it_and_has_no_interval(
    tmp_path: Path, rangesfm_command: Command
) -> None:
    survey = write_poses_alone(tmp_path)
    flags = (*RANGES, *KNOWN, "--scale_method")
    refused = rangesfm_command("scale", *survey.flags, *flags, "two-candidate", cwd=tmp_path, status=3)
    assert "outside the 95 % interval of the robust estimate" in refused.stderr
    found = scaled(survey, rangesfm_command, *flags, "two-candidate-unchecked")
    assert not 0.5 < found["scale"]["value"] / survey.scale < 2.0
    no_words = {name: found["scale"][name] for name in ("interval_95", "stddev_formal", "stddev_empirical")}
    assert not any([*no_words.values(), found["place"], found["reliability"], found["tests"]])
    assert found["scale"]["reasons"] == ["two-candidate, for comparison: nothing is known of its error"]
    assert "how long 10 m in this map are is open" in (tmp_path / "out" / "report.html").read_text("utf-8").lower()
