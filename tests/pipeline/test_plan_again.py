"""A finished survey is planned again: the plan agrees with its run, and says what to change next time."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from tests.conftest import SITE_M

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.scale.doubts import CALIBRATE
from rangesfm.pipeline.plan_again import _levelled, _of_run, plan_of_result
from rangesfm.planning.advice import advise
from rangesfm.planning.expected import expect
from rangesfm.planning.survey_plan import plan_survey
from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey


@pytest.mark.parametrize(
    "anchors",
    [("--anchors", "anchors.csv", "--anchor_frame", "site"), ("--anchor_frame", "unknown")],
    ids=["site", "unknown"],
)
def test_the_plan_is_of_the_map_that_the_run_found(
    anchors: tuple[str, ...], walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    flags = (*walked_survey.flags, "--no_report", "--output_path", out)
    rangesfm_command("scale", *flags, *anchors, cwd=walked_survey.folder)
    planned = plan_of_result(out)
    result = json.loads((out / "result.json").read_text())
    assert planned.anchor_frame == anchors[-1]
    assert len(planned.trajectory) == 40
    assert planned.num_ranges == pytest.approx(result["ranges"]["num_used"], rel=0.01)
    # The camera was held upright; its height changes by some decimetres on a loop of metres.
    assert np.ptp(planned.trajectory.centers[:, 2]) < 0.5 * np.ptp(planned.trajectory.centers[:, 0])
    # The plan takes the range errors that the run has learnt, so it expects about the same uncertainty.
    assert planned.component_stddevs == result["scale"]["error_stddevs"]
    stated = result["scale"]["stddev_empirical"] / result["scale"]["value"]
    assert expect(planned).uncertainty.empirical == pytest.approx(stated, rel=0.3)
    printed = rangesfm_command("plan", "--from", out, cwd=tmp_path).stdout
    assert "what would gain most for the scale" in printed
    assert ("place: good; x" in printed) == (anchors[-1] == "site")


def test_a_doubtful_survey_is_told_what_its_plan_would_change(
    walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rangesfm.estimation.scale.scale_estimate.DOUBTFUL_ABOVE", 1e-3)
    flags = (*walked_survey.flags, "--anchor_frame", "unknown", "--use_anchors", "A1", "--no_report")
    printed = rangesfm_command("scale", *flags, "--output_path", tmp_path / "out", cwd=walked_survey.folder).stdout
    scale = json.loads((tmp_path / "out" / "result.json").read_text())["scale"]
    assert scale["verdict"] == "doubtful"
    advised = plan_survey(plan_of_result(tmp_path / "out")).advice_for_scale
    best = [advice for advice in scale["advice"] if "the scale would be" in advice]
    assert best
    assert best[0].startswith(advised[0].words)
    assert sum(advice.startswith(CALIBRATE) for advice in scale["advice"]) <= 1
    assert f"next time: {best[0]}" in printed


def test_a_survey_is_told_it_too_where_only_a_check_length_contradicts_the_map(
    walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    first, last = walked_survey.image_names[0], walked_survey.image_names[20]
    wrong_m = 1.2 * np.linalg.norm(walked_survey.centers_m[0] - walked_survey.centers_m[20])
    tape = tmp_path / "distances.csv"
    tape.write_text(f"from,to,distance_m,stddev_m,kind\n{first},{last},{wrong_m:.3f},0.01,check\n")
    flags = (*walked_survey.flags, "--anchors", "anchors.csv", "--anchor_frame", "site", "--no_report")
    for out, more in (("without", ()), ("with", ("--distances", tape))):
        rangesfm_command("scale", *flags, *more, "--output_path", tmp_path / out, cwd=walked_survey.folder)
    before, scale = (json.loads((tmp_path / out / "result.json").read_text())["scale"] for out in ("without", "with"))
    assert (before["verdict"], before["advice"]) == ("good", [])
    assert scale["verdict"] == "doubtful"
    assert scale["reasons"][0].startswith(f"check distance from {first} to {last}: ")
    assert any("the scale would be" in advice for advice in scale["advice"])


def test_advice_on_a_finished_survey_stays_inside_what_its_photos_show() -> None:
    """Nobody can say what is behind or above path, anchors and the surfaces that the photos show."""
    times = np.linspace(0.0, 40.0, 41)
    centers = np.column_stack([2 * np.cos(times / 6), 1.5 * np.sin(times / 6), 1.5 + 0.1 * np.sin(times)])
    names = tuple(f"{k:02d}.jpg" for k in range(41))
    path = Trajectory(np.arange(41), names, times, centers, np.tile(np.eye(3), (41, 1, 1)))
    anchors = [Anchor(f"A{x}{y}", np.array([3.9 * x, 2.9 * y, 1.8]), 0.02) for x in (-1, 1) for y in (-1, 1)]
    rng = np.random.default_rng(2)
    room = rng.uniform((-4.0, -3.0, 0.0), (4.0, 3.0, 2.6), size=(500, 3))
    yard = rng.uniform((-40.0, -40.0, 0.0), (40.0, 40.0, 0.4), size=(500, 3))
    for name, points, highest_m in (("room", room, 2.65), ("yard", yard, 1.85)):
        planned = _levelled(_of_run(path, anchors, "site", np.zeros(3), {}, Site(), {}), points, 2000, None)
        assert planned.walls_are == "edge of what the photos show"
        advice = advise(expect(planned))
        assert any(each.kind == "anchor place" for each in advice), name
        moved = [each.planned.anchors_m for each in advice if each.kind in ("anchor place", "one more anchor")]
        for anchors_m in moved:
            # Photos show something to fix the anchor to.
            away_m = np.linalg.norm(anchors_m[:, None] - points, axis=2).min(axis=1)
            assert np.count_nonzero(away_m < 1e-9) == 1
        assert max(each.planned.anchors_m[:, 2].max() for each in advice) <= highest_m
        assert not any(each.kind == "wider anchors" for each in advice)


def test_advice_has_the_coordinates_of_the_site_or_says_of_what_they_are(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    anchors = own_survey.folder / "anchors.csv"
    typed = anchors.read_text().replace("A3,1018.0,5008.0", "A3,1018.0,5009.5")
    assert typed != anchors.read_text()
    anchors.write_text(typed)
    flags = (*own_survey.flags, "--no_report", "--output_path", "out")
    triple = re.compile(r"(-?[\d.]+), (-?[\d.]+), (-?[\d.]+)")

    def places_m(lines: list[str], words: str) -> Array:
        told = [line for line in lines if triple.search(line)]
        assert any("survey three control points" in line and words in line for line in told)
        assert all(words in line for line in told)
        return np.array([place for line in told for place in triple.findall(line)], dtype=np.float64)

    rangesfm_command("scale", *flags, "--anchors", "anchors.csv", cwd=own_survey.folder)
    scale = json.loads((own_survey.folder / "out" / "result.json").read_text())["scale"]
    assert np.abs(places_m(scale["advice"], "") - SITE_M).max() < 25
    rangesfm_command("scale", *flags, "--anchor_frame", "unknown", "--use_anchors", "A1", cwd=own_survey.folder)
    planned = rangesfm_command("plan", "--from", "out", cwd=own_survey.folder).stdout.splitlines()
    assert np.abs(places_m(planned, "metres right of, ahead of and above the first photo")).max() < 25


def test_a_folder_that_holds_no_result_is_refused(tmp_path: Path, rangesfm_command: Command) -> None:
    with pytest.raises(InputError, match="not a result folder"):
        plan_of_result(tmp_path)
    assert rangesfm_command("plan", cwd=tmp_path, status=2).stderr.count("\n") == 1
