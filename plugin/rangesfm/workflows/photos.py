"""Photos by a survey, checked before the long work begins: keyframes, times and the unscaled models of them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap

from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import InputError
from rangesfm.export import check_formats
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.result.folder import forget_result, refuse_to_overwrite
from rangesfm.survey.inputs import RangingInputs, read_ranging_inputs
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes, find_image_times, list_images
from rangesfm.vision.keyframes import select_keyframes
from rangesfm.vision.mapping_loop import GlobalAdjustment
from rangesfm.vision.reconstruct import reconstruct
from rangesfm.workflows.journal import Journal
from rangesfm.workflows.placed_ranges import ranges_on_path


def read_inputs(survey: Survey, journal: Journal) -> RangingInputs:
    """Everything that can be wrong is found before the long work begins."""
    check_formats(survey.export.formats)
    with survey.source.naming_lines():
        apply_options(pycolmap.BundleAdjustmentOptions(), survey.refine.bundle_adjustment, "refine.bundle_adjustment")
    refuse_to_overwrite((item.path for item in survey.input_paths()), survey.output.path)
    inputs = read_ranging_inputs(survey)
    for note in inputs.notes:
        journal.warn(note)
    return inputs


def checked_inputs(survey: Survey, journal: Journal) -> tuple[RangingInputs, tuple[str, ...], ImageTimes | None]:
    """Ranges and photos that have to do with each other; the photos' times, where any are needed."""
    inputs = read_inputs(survey, journal)
    keyframes, times = find_keyframes(survey, journal, log_names_photos=inputs.log.image_name is not None)
    check_times(survey, inputs, _path_without_places(keyframes, times))
    return inputs, keyframes, times


def check_times(survey: Survey, inputs: RangingInputs, path: Trajectory) -> None:
    """Refuse a reference and ranges that have nothing to do with these photos; where they were does not matter."""
    reference, offset_s = inputs.reference, survey.ranges.time_offset_s
    if reference is not None and not np.isfinite(reference.positions_at(path)[0]).any():
        raise InputError(reference.why_nothing_is_known(path), survey.report.reference)
    if inputs.log.image_name is not None or offset_s is not None:
        ranges_on_path(survey, inputs, path, offset_s or 0.0)


def _path_without_places(keyframes: tuple[str, ...], times: ImageTimes | None) -> Trajectory:
    n = len(keyframes)
    timestamps_s = None if times is None else times.timestamps_s
    return Trajectory(np.arange(n), keyframes, timestamps_s, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))


def read_registered(path: Path) -> pycolmap.Reconstruction:
    model = read_model(path)
    if not model.num_reg_images():
        raise InputError("the model has no registered images", path)
    return model


_Done = TypeVar("_Done")


def find_keyframes(
    survey: Survey, journal: Journal, *, log_names_photos: bool | None = None
) -> tuple[tuple[str, ...], ImageTimes | None]:
    """The photos to reconstruct and their times; without times, where none are needed, in the order of their names.

    Args:
        log_names_photos: then no photo is left out for want of a time; None: there is no log.
    """
    folder = _images_path(survey)
    with journal.timed("keyframes"):
        names = list_images(folder)
        image_times = None
        with nullcontext() if survey.images.times or log_names_photos is False else suppress(InputError):
            image_times = find_image_times(folder, names, survey.images.times)
        if image_times is None or (log_names_photos and not survey.images.times and image_times.num_left_out):
            return select_keyframes(names, survey.images), None
        keyframes = select_keyframes(image_times, survey.images)
        return keyframes, noted(image_times, journal).of(keyframes)


def map_keyframes(
    survey: Survey,
    keyframes: tuple[str, ...],
    journal: Journal,
    restart: bool,
    adjustment: GlobalAdjustment | None = None,
) -> tuple[pycolmap.Reconstruction, ...]:
    """Map the keyframes into ``sparse``; returns ``sparse/0``, ``sparse/1``, ..."""
    summary = with_photos(partial(reconstruct, adjustment=adjustment), survey, keyframes, journal, restart)
    journal.seconds.update(summary.seconds)
    if summary.num_registered < summary.num_keyframes:
        which = "the model" if len(summary.models) == 1 else f"the largest of {len(summary.models)} models"
        journal.warn(f"{summary.num_registered} of {summary.num_keyframes} keyframes are in {which}")
    return summary.models


def with_photos(
    do: Callable[..., _Done], survey: Survey, keyframes: tuple[str, ...], journal: Journal, restart: bool
) -> _Done:
    """Call ``reconstruct``, or a part of it, for the keyframes of a survey."""
    with survey.source.naming_lines():
        return do(
            _images_path(survey),
            keyframes,
            survey.output.path,
            camera=survey.camera,
            mapper=survey.mapper,
            seed=survey.output.seed,
            progress=journal.progress,
            restart=restart,
            before_change=lambda: forget_result(survey.output.path),
        )


def _images_path(survey: Survey) -> Path:
    if survey.images.path is None:
        raise InputError("no photos: give [images] path in a survey file, or --images FOLDER")
    return survey.images.path


def noted(image_times: ImageTimes, journal: Journal) -> ImageTimes:
    for note in image_times.notes:
        journal.warn(note)
    return image_times
