"""Paths of models with the ranges of a survey on them, after checks that both belong together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from rangesfm.colmap.transform import without_photos
from rangesfm.errors import InputError
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction


def place_ranges(run: SurveyRun, models: Sequence[pycolmap.Reconstruction]) -> list[PathOfModel]:
    """Return unscaled models of a survey with the ranges on their paths, the first one first.

    The time offset is searched for on the path of the first model, unless it is given. A photo that several models have
    is kept in the first of them; models without photos of their own are left out with a warning.

    Args:
        run: the survey.
        models: unscaled models of its photos.

    Raises:
        InputError: reference or ranges do not fit the first model.
        GeometryError: the ranges do not determine the time offset.
    """
    trajectory = path_of_model(run, models[0])
    num = models[0].num_reg_frames()
    if num_without_time := num - len(trajectory):
        run.journal.warn(f"{num_without_time} of {num} photos of the model have no time and are left out")
    check_times(run, trajectory)
    offset = run.find_time_offset(trajectory)
    offset_s = offset.at(run.inputs.log.timestamp_s)
    paths = [PathOfModel("sparse/0", models[0], trajectory, run.ranges_on(trajectory, offset_s), offset)]
    names = set(trajectory.image_names)
    for k, model in enumerate(models[1:], start=1):
        rest = without_photos(model, names)
        path = path_of_model(run, rest)
        if not len(path):
            run.journal.warn(f"sparse/{k} is left out: its photos have no times, or are also in other models")
            continue
        names.update(path.image_names)
        placed = run.ranges_on(path, offset_s, may_be_none=True)
        paths.append(PathOfModel(f"sparse/{k}", rest, path, placed, offset))
    return paths


def check_times(run: SurveyRun, path: Trajectory) -> None:
    """Check that all that was measured belongs to the photos of a path, by names or times. Its places do not matter.

    Raises:
        InputError: the reference has none of the photos, a log shares no time with them, or no range has a place on the
            path.
    """
    reference, offset_s = run.inputs.reference, run.survey.ranges.time_offset_s
    if len(reference) and not np.isfinite(reference.positions_at(path)[0]).any():
        why = reference.why_nothing_is_known("keyframes", reference.moments_of(path))
        raise InputError(why, run.survey.report.reference)
    photos_s, max_difference_s = path.timestamps_s, run.survey.ranges.max_time_difference_s
    for timed in run.timed_logs:
        if photos_s is not None and (apart := timed.why_apart(photos_s, max_difference_s)) is not None:
            raise InputError(apart, timed.path)
    if isinstance(run.inputs.log.moments, ByPhoto) or offset_s is not None:
        run.ranges_on(path, offset_s or 0.0)


def path_of_model(run: SurveyRun, model: pycolmap.Reconstruction) -> Trajectory:
    """Return the path of a model; of the photos that have a time, if times are needed."""
    if run.times is None:
        return trajectory_from_reconstruction(model)
    return trajectory_from_reconstruction(model, run.times.by_name(), time_resolution_s=run.times.resolution_s)
