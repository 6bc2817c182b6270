"""What a run is given, checked before the long work begins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import InputError
from rangesfm.export import check_formats
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.result.folder import refuse_to_overwrite
from rangesfm.survey.inputs import RangingInputs, read_ranging_inputs
from rangesfm.survey.settings import Survey
from rangesfm.trust.before import notes_before_work, notes_on_model, notes_on_times
from rangesfm.vision.image_times import ImageTimes
from rangesfm.workflows.journal import Journal
from rangesfm.workflows.photos import find_keyframes
from rangesfm.workflows.placed_ranges import ranges_on_path


def read_inputs(survey: Survey, journal: Journal) -> RangingInputs:
    """Everything that can be wrong is found before the long work begins."""
    check_formats(survey.export.formats)
    with survey.source.naming_lines():
        apply_options(pycolmap.BundleAdjustmentOptions(), survey.refine.bundle_adjustment, "refine.bundle_adjustment")
    refuse_to_overwrite((item.path for item in survey.input_paths()), survey.output.path)
    inputs = read_ranging_inputs(survey)
    for note in (*inputs.notes, *notes_before_work(survey, inputs)):
        journal.warn(note)
    return inputs


def checked_inputs(survey: Survey, journal: Journal) -> tuple[RangingInputs, tuple[str, ...], ImageTimes | None]:
    """Ranges and photos that have to do with each other; the photos' times, where any are needed."""
    inputs = read_inputs(survey, journal)
    keyframes, times = find_keyframes(survey, journal, log_names_photos=inputs.log.image_name is not None)
    check_times(survey, inputs, _path_without_places(keyframes, times))
    tell_of_times(survey, inputs, times, journal)
    return inputs, keyframes, times


def check_times(survey: Survey, inputs: RangingInputs, path: Trajectory) -> None:
    """Refuse a reference and ranges that have nothing to do with these photos; where they were does not matter."""
    reference, offset_s = inputs.reference, survey.ranges.time_offset_s
    if reference is not None and not np.isfinite(reference.positions_at(path)[0]).any():
        raise InputError(reference.why_nothing_is_known(path), survey.report.reference)
    if inputs.log.image_name is not None or offset_s is not None:
        ranges_on_path(survey, inputs, path, offset_s or 0.0)


def tell_of_times(survey: Survey, inputs: RangingInputs, times: ImageTimes | None, journal: Journal) -> None:
    """What is odd about two clocks whose offset nobody gave."""
    if times is not None and inputs.log.timestamp_s is not None and survey.ranges.time_offset_s is None:
        for note in notes_on_times(inputs.log.timestamp_s, times.timestamps_s):
            journal.warn(note)


def _path_without_places(keyframes: tuple[str, ...], times: ImageTimes | None) -> Trajectory:
    n = len(keyframes)
    timestamps_s = None if times is None else times.timestamps_s
    return Trajectory(np.arange(n), keyframes, timestamps_s, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))


def read_registered(path: Path, journal: Journal) -> pycolmap.Reconstruction:
    """A model that was brought along; what is wrong with it by itself is told."""
    model = read_model(path)
    if not model.num_reg_images():
        raise InputError("the model has no registered images", path)
    for note in notes_on_model(model):
        journal.warn(note)
    return model
