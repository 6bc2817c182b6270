"""Loops of a given model are closed by the matches of its database, which are added to a copy of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pycolmap
import pytest
from tests.known import known
from tests.listener import Listener
from tests.outputs import names_in
from tests.simulated.looped import around_a_room, bent_laps, two_laps, write_matches, write_survey
from tests.simulated.surveys import TAG_IN_CAM_M

from rangesfm.errors import InputError
from rangesfm.estimation import refinement
from rangesfm.pipeline.close_loops import close_loops_of_survey
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.run import refine_model
from rangesfm.pipeline.run_results import write_results
from rangesfm.progress import Journal, Progress
from rangesfm.result.result_folder import ResultFolder
from rangesfm.result.result_tables import LoopPairs
from rangesfm.result.summary import ResultSummary
from rangesfm.sfm.loop_database import LoopMatching
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.manifest import content_hash
from rangesfm.util.geometry.similarity import rmse


@dataclass(frozen=True)
class Laps:
    """Files of a survey of two laps, whose model and database tie neighbours in time only. Tests must not change them.

    Attributes:
        survey: with the model and its database.
        database: path of the database.
    """

    survey: Survey
    database: Path


@pytest.fixture(scope="module")
def laps(tmp_path_factory: pytest.TempPathFactory) -> Laps:
    folder = tmp_path_factory.mktemp("laps")
    write_survey(bent_laps(), folder)
    survey = Survey().changed(
        {
            "images.model": folder / "sparse",
            "images.times": folder / "images.csv",
            "ranges.path": folder / "uwb.csv",
            "ranges.time_offset": 0.0,
            "anchors.path": folder / "anchors.csv",
            "anchors.frame": "first_camera",
            "tag.tag_in_cam_m": tuple(TAG_IN_CAM_M.tolist()),
            "camera.refine_intrinsics": False,
            "mapper.database_path": folder / "database.db",
            "report.reference": folder / "reference.csv",
            "output.path": folder / "out",
        }
    )
    return Laps(survey, folder / "database.db")


@dataclass(frozen=True)
class ClosedLaps:
    """The result of a run that was interrupted after the matching, and then done again.

    Attributes:
        last: the map of which the result was written.
        counts: numbers of pairs done and of all pairs, as the second run told them in the stage of loops.
    """

    summary: ResultSummary
    last: MetricResult
    counts: list[tuple[int, int]]


@pytest.fixture(scope="module")
def closed(laps: Laps) -> ClosedLaps:
    before, listener = content_hash(laps.database), Listener()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LoopMatching, "keep", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            refine_model(laps.survey, progress=Progress())
    written: list[MetricResult] = []

    def write(run: SurveyRun, made: MetricResult) -> ResultFolder:
        written.append(made)
        return write_results(run, made)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rangesfm.pipeline.run.write_results", write)
        summary = refine_model(laps.survey, progress=listener).summary
    assert content_hash(laps.database) == before
    return ClosedLaps(summary, written[0], listener.updates["loops"])


def num_pairs(path: Path) -> int:
    with pycolmap.Database.open(path) as database:
        return len(database.read_two_view_geometry_num_inliers()[0])


def test_a_model_with_its_database_has_its_loops_closed(closed: ClosedLaps, laps: Laps) -> None:
    loops = closed.summary.loops
    assert loops is not None
    assert loops.num_proposed >= loops.num_verified >= loops.num_closed > 20
    error_m = {row.name: row.rmse_se3_m for row in closed.summary.comparison}
    before_m, after_m = error_m["refined, loops open"], error_m["refined"]
    assert before_m is not None
    assert after_m is not None
    assert after_m < 0.5 * before_m
    # The ranges learn next to no bending of this map, which the noise of its features bends nevertheless.
    assert loops.num_contradicted == 0
    out = laps.survey.output.path
    table = LoopPairs.read(out)
    assert table is not None
    assert len(table.pairs("closed")) == loops.num_closed
    assert num_pairs(out / "database.db") == num_pairs(laps.database) + loops.num_closed
    assert set(names_in(out / ".rangesfm")) == {"manifest.json"}
    assert 'id="loops"' in (out / "report.html").read_text(encoding="utf-8")


def test_loops_are_closed_where_the_metres_come_from_two_lengths(tmp_path: Path) -> None:
    looped = around_a_room()
    write_survey(looped, tmp_path)
    names, at_m = list(looped.survey.model.timestamps_s), looped.survey.model.centers_m
    rows = [f"{names[a]},{names[b]},{np.linalg.norm(at_m[a] - at_m[b]):.3f},0.005" for a, b in ((0, 12), (30, 42))]
    (tmp_path / "lengths.csv").write_text("\n".join(["from,to,distance_m,stddev_m", *rows]) + "\n")
    given = {
        "images.model": tmp_path / "sparse",
        "camera.refine_intrinsics": False,
        "mapper.database_path": tmp_path / "database.db",
        "scale.distances": tmp_path / "lengths.csv",
        "report.reference": tmp_path / "reference.csv",
        "output.path": tmp_path / "out",
    }
    made = refine_model(Survey().changed(given), progress=Progress())
    assert made.summary.scale.verdict == "good"
    error_m = {row.name: row.rmse_sim3_m for row in made.summary.comparison}
    assert known(error_m["refined"]) < 0.5 * known(error_m["refined, loops open"])
    assert len(known(LoopPairs.read(tmp_path / "out")).pairs("closed")) == known(made.summary.loops).num_closed > 10


def test_the_map_before_is_the_one_that_open_loops_would_give(closed: ClosedLaps, laps: Laps, tmp_path: Path) -> None:
    last, loops = closed.last, known(known(closed.last.kept).loops)
    moved_m = rmse(last.trajectory.as_in(last.final).centers - known(loops.before).centers)
    assert known(closed.summary.loops).moved_m == pytest.approx(moved_m, abs=1e-9)
    changes = {"output.path": tmp_path / "out", "mapper.close_loops": False, "scale.max_relative_stddev": 10.0}
    rows = {row.name: row.rmse_m for row in refine_model(laps.survey.changed(changes)).summary.comparison}
    (before_m,) = (row.rmse_m for row in closed.summary.comparison if row.name == "refined, loops open")
    assert before_m == pytest.approx(rows["refined"], rel=1e-6)


def test_an_interrupted_run_goes_on_with_the_matches_that_it_has(closed: ClosedLaps) -> None:
    num_done, num_all = closed.counts[0]
    assert num_done == num_all
    assert num_done > 50


@pytest.mark.parametrize("is_found", [False, True])
def test_where_no_loops_are_found_or_closing_them_bends_nothing_visible_the_map_stays_as_refined(
    laps: Laps, tmp_path: Path, is_found: bool
) -> None:
    changes = {"output.path": tmp_path / "out", "report.reference": None, "scale.max_relative_stddev": 10.0}
    listener, survey = Listener(), laps.survey.changed(changes)
    with pytest.MonkeyPatch.context() as patch:
        if is_found:
            patch.setattr(refinement, "_just_visible_m", lambda *_: 1000.0)
        else:
            patch.setattr(LoopFinder, "propose", lambda *_, **__: {})
        loops = known(refine_model(survey, progress=listener).summary.loops)
    assert listener.stages.count("refinement") == 1 + is_found
    assert (loops.num_proposed > 0, loops.num_closed, loops.moved_m) == (is_found, 0, 0)


def test_loops_stay_open_where_that_is_asked_for(laps: Laps) -> None:
    survey = laps.survey.changed({"mapper.close_loops": False})
    run = SurveyRun(survey, cast("RangingInputs", None), Journal(Progress()))
    assert close_loops_of_survey(run, refined := cast("MetricResult", object())) is refined


def test_a_database_of_another_model_is_refused(laps: Laps, tmp_path: Path) -> None:
    other = tmp_path / "other.db"
    looped = two_laps(60, size_m=(24.0, 16.0), num_observations=20)
    write_matches(other, looped.truth, {})
    survey = laps.survey.changed({"mapper.database_path": other, "output.path": tmp_path / "out"})
    with pytest.raises(InputError, match=r"frame_00001\.jpg has other features in the model"):
        refine_model(survey, progress=Progress())
    assert not (tmp_path / "out" / "result.json").exists()
