"""Several models of a survey become one where their photos match, unless the ranges exclude it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from tests.simulated.looped import LoopedSurvey, two_aisles, two_laps, write_matches
from tests.simulated.model import random_similarity
from tests.simulated.surveys import TAG_IN_CAM_M, range_log

from rangesfm.colmap.transform import rescale, without_photos
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import local_site
from rangesfm.pipeline.join_models import tie_by_photos
from rangesfm.pipeline.place_ranges import place_ranges
from rangesfm.progress import Journal, Progress
from rangesfm.sfm.image_times import ImageTimes
from rangesfm.sfm.loop_database import LoopMatching
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.similarity import align_points, rmse


def run_of(looped: LoopedSurvey, folder: Path) -> SurveyRun:
    """Return the run of a survey whose photos were matched with neighbours in time."""
    survey = looped.survey
    (site, _), log = local_site((), "unknown", ""), range_log(survey, 1, num_each=4)
    anchors = tuple(Anchor(name, position) for name, position in survey.anchors_m.items())
    inputs = RangingInputs(log, TAG_IN_CAM_M[None], anchors, survey.anchor_frame, site, Tape())
    write_matches(folder / "database.db", looped.truth, looped.neighbours, with_descriptors=True)
    changes = {"output.path": folder, "mapper.matching": "sequential", "ranges.time_offset": 0.0}
    times = survey.model.timestamps_s
    of_photos = ImageTimes(tuple(times), np.array(list(times.values())), 0.001, "csv")
    return SurveyRun(Survey().changed(changes), inputs, Journal(Progress()), of_photos)


def models_of(looped: LoopedSurvey, parts: Sequence[Sequence[str]]) -> list[pycolmap.Reconstruction]:
    """Return a model of each part of the photos, each in a world and unit of its own."""
    rng, cut, names = np.random.default_rng(0), looped.cut(), set(looped.survey.model.timestamps_s)
    return [rescale(without_photos(cut, names.difference(part)), random_similarity(rng)) for part in parts]


def tied(run: SurveyRun, models: list[pycolmap.Reconstruction]) -> list[PathOfModel]:
    with sole_writer(run.survey.output.path):
        return tie_by_photos(run, place_ranges(run, models))


def test_two_laps_that_were_mapped_apart_become_one_model(tmp_path: Path) -> None:
    looped = two_laps(48, size_m=(12.0, 8.0), num_observations=100)
    names = list(looped.survey.model.timestamps_s)
    run, models = run_of(looped, tmp_path), models_of(looped, [names[:24], names[24:]])
    lens = models[1].camera(1)  # each model has found parameters of its own for the same camera
    lens.params = (1.002 * lens.params).tolist()
    (path,) = tied(run, models)
    assert path.trajectory.image_names == tuple(names)
    truth_m = looped.survey.model.centers_m
    assert rmse(align_points(path.trajectory.centers, truth_m).apply(path.trajectory.centers) - truth_m) < 0.3
    lengths = [
        max(element.image_id for element in point.track.elements)
        - min(element.image_id for element in point.track.elements)
        for point in path.sfm.points3D.values()
    ]
    assert np.mean(np.array(lengths) > looped.max_track_length) > 0.2
    assert path.observations.has_place.sum() > 0.98 * len(run.inputs.log)


def test_aisles_that_look_alike_stay_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey = two_aisles()
    looped = survey.looped
    names, run = list(looped.survey.model.timestamps_s), run_of(looped, tmp_path)
    monkeypatch.setattr(LoopMatching, "match", lambda *_: survey.alike)
    paths = tied(run, models_of(looped, [names[:10], names[-10:]]))
    assert [path.trajectory.image_names for path in paths] == [tuple(names[:10]), tuple(names[-10:])]
    (warning,) = run.journal.warnings
    assert "sparse/1 looks like a part of sparse/0, but is none: ranges to A" in warning
