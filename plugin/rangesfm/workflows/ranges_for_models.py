"""Ranges of a survey with which models of its photos are compared, after one of them was scaled by the survey."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from rangesfm.comparison.model_ranges import ModelRanges, ranges_of_map
from rangesfm.progress import Journal, SilentProgress
from rangesfm.survey.inputs import read_ranging_inputs, times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.workflows.run import map_of_model


def ranges_of_survey(survey: Survey, model: pycolmap.Reconstruction, model_path: Path) -> ModelRanges:
    """Return the ranges of a log, placed on a model: those that the scaled model uses, and its anchors.

    The model is scaled as ``rangesfm scale`` does it.

    Args:
        survey: log, anchors, lengths, tag and photo times.
        model: in any unit.
        model_path: folder from which the model was read.

    Raises:
        InputError: the photos have no times, or no range has a place on the path.
        GeometryError: the ranges do not determine the time offset or the scale of the model.
    """
    survey = survey.changed({"images.model": model_path.absolute()})
    run = SurveyRun(survey, read_ranging_inputs(survey), Journal(SilentProgress()))
    times = None if run.inputs.log.image_name is not None else times_of_model(survey, model, model_path).by_name()
    return ranges_of_map(*map_of_model(run, model, refine=False), times)
