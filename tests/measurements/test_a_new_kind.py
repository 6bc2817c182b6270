"""A kind of measurement that the program does not know takes part in all stages by its row in the table of kinds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pycolmap
import pytest
from tests.conftest import Command, WalkedSurvey

from rangesfm.arrays import Array
from rangesfm.measurements import kinds_in_words
from rangesfm.measurements.joint_map import JointMap, KindOnMap, fit_kinds
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.kind_as_read import KindAsRead
from rangesfm.measurements.kind_entry import KindEntry
from rangesfm.measurements.kind_words import KindWords
from rangesfm.measurements.planned_kind import PlannedKind
from rangesfm.pipeline import plan_again, result_records, run
from rangesfm.planning import advice, plan_file, planned_kinds
from rangesfm.result import result_folder
from rangesfm.result.summary import ResultSummary
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import Observations, ScaleUncertainty
from rangesfm.survey import kinds_in_map
from rangesfm.survey.kinds_in_map import MapOfPhotos
from rangesfm.util.files.records import Count
from rangesfm.util.geometry.similarity import Similarity, align_points
from rangesfm.util.geometry.trajectory import first_camera_from

STEPS, STEPS_STDDEV_M = "steps", 0.02
NUM_KINDS = len(kinds_in_map.KINDS)
SAID = "a step counter does not know how long a step is"


@dataclass(frozen=True)
class Steps(KindOnMap):
    """How far the camera came from one keyframe to the next, as a step counter has it.

    Attributes:
        distance_m: (n - 1,).
    """

    distance_m: Array
    bending: MapBending

    kind = STEPS

    @property
    def away(self) -> Array:
        return np.diff(self.bending.path.centers, axis=0)

    @property
    def start(self) -> Similarity:
        scales = self.distance_m / np.linalg.norm(self.away, axis=1)
        return first_camera_from(self.bending.path, float(np.median(scales)))

    @cached_property
    def alone(self) -> JointMap:
        return fit_kinds((self,), self.start, self.bending)

    def observed(self, placed: Similarity, *, in_site: bool, max_num: int) -> Observations:
        num = len(self.distance_m)
        predicted_m = placed.scale * np.linalg.norm(self.away, axis=1)
        along = self.away / np.linalg.norm(self.away, axis=1)[:, None]
        by_pose, rows = np.zeros((num, num + 1, 6)), np.arange(num)
        by_pose[rows, rows + 1, 3:] = placed.scale * along
        by_pose[rows, rows, 3:] = -placed.scale * along
        noise_m2 = STEPS_STDDEV_M**2 * np.eye(num)
        return Observations(
            kind=STEPS,
            columns=Columns.of_whole(1),
            design=predicted_m[:, None],
            residual_m=predicted_m - self.distance_m,
            by_pose=by_pose.reshape(num, -1),
            components=(Component(STEPS, noise_m2),),
            alone_m2=noise_m2,
            is_used=np.ones(num, dtype=bool),
        )

    def doubts(self, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
        yield Doubt(SAID)

    def entry(self, on_map: JointMap) -> Mapping[str, object]:
        return {"num": len(self.distance_m)}


class CountedSteps(KindAsRead):
    """The step counter's log, which the tests do not have as a file."""

    def facts(self) -> Iterator[str]:
        yield "step counter: one distance for each two photos"

    @property
    def notes(self) -> tuple[str, ...]:
        return ("the steps are those of who carried the camera",)


class StepsEntry(KindEntry):
    num: Count

    caption = "Counted steps"
    meanings: ClassVar[Mapping[str, str]] = {"num": "distances between photos"}

    def lines(self) -> Iterator[str]:
        yield f"steps: {self.num} distances"

    @property
    def fact(self) -> str:
        return f"{self.num} distances by a step counter give it metres."


class SummaryWithSteps(ResultSummary):
    steps: StepsEntry | None = None


class PlannedSteps(PlannedKind, table=STEPS):
    """A planned step counter."""

    advice = "carry a step counter"

    def on_map(self, bending: MapBending) -> Steps:
        return Steps(np.linalg.norm(np.diff(bending.path.centers, axis=0), axis=1), bending)


@pytest.fixture
def counted(walked_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Add the kind to the table; all its distances are by a factor too long, which may be changed."""
    by_photo = dict(zip(walked_survey.image_names, walked_survey.centers_m, strict=True))
    rng, factor = np.random.default_rng(0), {"longer": 1.0}
    noise_m = STEPS_STDDEV_M * rng.standard_normal(len(by_photo) - 1)

    def locate(inputs: Any, at: MapOfPhotos) -> Steps:
        true_m = np.linalg.norm(np.diff([by_photo[name] for name in at.path.image_names], axis=0), axis=1)
        return Steps(factor["longer"] * true_m + noise_m, at.bending)

    words = KindWords(STEPS, "counted steps", {STEPS: "noise of the counted steps"})
    row = kinds_in_map.Kind(words, locate, lambda survey: CountedSteps(), PlannedSteps)
    for module in (kinds_in_map, plan_file, advice, plan_again):
        monkeypatch.setattr(module, "KINDS", (*kinds_in_map.KINDS[:NUM_KINDS], row))
    for module in (kinds_in_words, planned_kinds, run):
        monkeypatch.setattr(module, "KINDS_IN_WORDS", (*kinds_in_words.KINDS_IN_WORDS[:NUM_KINDS], words))
    for module in (result_records, result_folder):  # the declaration of its entry in result.json
        monkeypatch.setattr(module, "ResultSummary", SummaryWithSteps)
    return factor


def refined(
    survey: WalkedSurvey, command: Command, *flags: str, has_ranges: bool = True
) -> tuple[dict[str, Any], float]:
    """Refine the map, and return its ``result.json`` and by how much the metric map is too large."""
    given = survey.flags if has_ranges else ("--input_path", "sparse/0", "--images", "images.csv")
    command("refine", *given, *flags, "--no_report", "--quiet", "--output_path", "out", cwd=survey.folder)
    out = survey.folder / "out"
    model = pycolmap.Reconstruction(out / "sparse_metric" / "0")
    centers_m = {image.name: image.projection_center() for image in model.images.values()}
    path_m = np.array([centers_m[name] for name in survey.image_names])
    too_large = align_points(survey.centers_m, path_m).scale - 1
    return json.loads((out / "result.json").read_text(encoding="utf-8")), too_large


@pytest.mark.parametrize("flags", [("--anchor_frame", "unknown"), ("--anchors", "anchors.csv")])
def test_beside_ranges_it_has_its_say_in_the_scale_and_the_refined_map_is_moved_to_it(
    flags: tuple[str, ...], own_survey: WalkedSurvey, counted: dict[str, float], rangesfm_command: Command
) -> None:
    with_it, off = refined(own_survey, rangesfm_command, *flags)
    true_scale = own_survey.site_from_sfm.scale
    by_kind = with_it["scale"]["by_kind"]
    assert set(by_kind) == {"ranges", STEPS}
    assert by_kind[STEPS]["value"] == pytest.approx(true_scale, abs=3 * by_kind[STEPS]["stddev"])
    assert with_it["scale"]["stddev_empirical"] < min(each["stddev"] for each in by_kind.values())
    low, high = with_it["scale"]["interval_95"]
    assert low < true_scale < high
    assert abs(off) < (high - low) / (high + low)
    assert SAID not in with_it["scale"]["reasons"]
    assert [test["rejected"] for test in with_it["tests"] if test["name"] == f"{STEPS} against ranges"] == [False]
    # The refinement knows ranges alone: what moves the map is what this kind says of it as a whole.
    counted["longer"] = 1.01
    longer, further_off = refined(own_survey, rangesfm_command, *flags)
    assert 0.001 < further_off - off < 0.01
    assert longer["scale"]["value"] / with_it["scale"]["value"] - 1 == pytest.approx(further_off - off, rel=0.05)


def test_alone_it_gives_the_map_its_metres_and_says_what_is_doubtful(
    own_survey: WalkedSurvey, counted: dict[str, float], rangesfm_command: Command
) -> None:
    ends, length_m = own_survey.image_names[::20][:2], np.linalg.norm(np.diff(own_survey.centers_m[::20][:2], axis=0))
    check = f"from,to,distance_m,stddev_m,kind\n{ends[0]},{ends[1]},{length_m:.3f},0.01,check\n"
    (own_survey.folder / "checks.csv").write_text(check)
    found, off = refined(own_survey, rangesfm_command, "--distances", "checks.csv", has_ranges=False)
    scale = found["scale"]
    assert (scale["method"], found["frame"], scale["verdict"]) == (STEPS, "first_camera", "doubtful")
    assert scale["reasons"][0] == SAID
    assert abs(off) < 1.96 * scale["stddev_empirical"] / scale["value"] < 0.02
    assert scale["by_kind"][STEPS]["value"] == pytest.approx(scale["value"], rel=0.01)
    counted["longer"] = 1.01
    _, further_off = refined(own_survey, rangesfm_command, "--distances", "checks.csv", has_ranges=False)
    assert (1 + further_off) / (1 + off) == pytest.approx(1.01, abs=1e-4)


PLAN = """
[anchors]
places = { A1 = [4, 0, 2.4], A2 = [-4, 1, 0.5], A3 = [0, 5, 2.8], A4 = [1, -5, 0.3] }
[path]
waypoints = [[-2, -2, 1.2], [2, -2, 1.8], [2, 2, 1.3], [-2, 2, 1.9]]
photo_rate_hz = 1.0
"""


def test_its_words_are_in_check_run_and_report(
    own_survey: WalkedSurvey, counted: dict[str, float], rangesfm_command: Command
) -> None:
    flags = (*own_survey.flags, "--anchors", "anchors.csv")
    checked = rangesfm_command("check", *flags, cwd=own_survey.folder).stdout
    assert "step counter: one distance for each two photos" in checked
    assert "assumed: the steps are those of who carried the camera" in checked
    assert "\nsteps: 39 distances\n" in rangesfm_command("scale", *flags, cwd=own_survey.folder).stdout
    out = own_survey.folder / "out"
    assert json.loads((out / "result.json").read_text(encoding="utf-8"))[STEPS] == {"num": 39}
    rangesfm_command("report", "out", cwd=own_survey.folder)
    page = (out / "report.html").read_text(encoding="utf-8")
    for said in (
        *("39 distances by a step counter give it metres.", "Counted steps", "distances between photos"),
        *('data-key="steps.num"', "noise of the counted steps", "steps alone"),
    ):
        assert said in page, said


def test_a_plan_advises_it_and_says_what_it_would_bring(
    tmp_path: Path, counted: dict[str, float], rangesfm_command: Command
) -> None:
    (tmp_path / "without.toml").write_text(PLAN)
    (tmp_path / "with.toml").write_text(f"{PLAN}[steps]\n")
    without, planned = (rangesfm_command("plan", name, cwd=tmp_path).stdout for name in ("without.toml", "with.toml"))
    assert "carry a step counter" in without
    assert "steps alone" not in without
    assert "carry a step counter" not in planned
    assert "\nsteps alone (95 %): scale +-" in planned
