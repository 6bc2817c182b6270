"""Ranges of a survey with which models of its photos are compared, after one of them was scaled by the survey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.comparison.model_ranges import ModelRanges
from rangesfm.measurements.ranges.range_observations import USED
from rangesfm.pipeline.run import map_of_model
from rangesfm.progress import SILENT, Journal
from rangesfm.survey.kinds_in_map import read_all_kinds
from rangesfm.survey.photo_times import times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.geometry.moments import ByPhoto


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
    run = SurveyRun(survey, read_all_kinds(survey), Journal(SILENT))
    times = {} if isinstance(run.inputs.log.moments, ByPhoto) else times_of_model(survey, model, model_path).by_name()
    metric = map_of_model(run, model, refine=False)
    log = metric.observations.log
    log = replace(log, moments=log.moments.later(metric.path.offset_s))
    anchors = {anchor.anchor_id: anchor for anchor in metric.anchors if np.isfinite(anchor.position_m).all()}
    scaled = metric.estimate.metric_from_sfm
    return ModelRanges(
        log=log.subset(np.isin(metric.observations.status, USED)),
        tags_in_cam_m=dict(zip(log.tag_ids, metric.inputs.tag_in_cam_m, strict=True)),
        anchors_m={id_: anchor.position_m for id_, anchor in anchors.items()},
        biases_m={id_: anchor.range_bias_m for id_, anchor in anchors.items()},
        image_times_s=times,
        metric_path=metric.trajectory.transformed(scaled),
        association=run.survey.ranges,
    )
