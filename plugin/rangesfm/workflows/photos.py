"""Photos by a survey: which become keyframes, when they were taken, and the unscaled models of them."""

from __future__ import annotations

from contextlib import nullcontext, suppress
from pathlib import Path

import pycolmap

from rangesfm.errors import InputError
from rangesfm.result.folder import forget_result
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes, find_image_times, list_images
from rangesfm.vision.keyframes import select_keyframes
from rangesfm.vision.mapping_loop import GlobalAdjustment
from rangesfm.vision.reconstruct import reconstruct
from rangesfm.workflows.journal import Journal


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
    with survey.source.naming_lines():
        summary = reconstruct(
            _images_path(survey),
            keyframes,
            survey.output.path,
            camera=survey.camera,
            mapper=survey.mapper,
            seed=survey.output.seed,
            progress=journal.progress,
            restart=restart,
            before_change=lambda: forget_result(survey.output.path),
            adjustment=adjustment,
        )
    journal.seconds.update(summary.seconds)
    if summary.num_registered < summary.num_keyframes:
        which = "the model" if len(summary.models) == 1 else f"the largest of {len(summary.models)} models"
        journal.warn(f"{summary.num_registered} of {summary.num_keyframes} keyframes are in {which}")
    return summary.models


def _images_path(survey: Survey) -> Path:
    if survey.images.path is None:
        raise InputError("no photos: give [images] path in a survey file, or --images FOLDER")
    return survey.images.path


def noted(image_times: ImageTimes, journal: Journal) -> ImageTimes:
    for note in image_times.notes:
        journal.warn(note)
    return image_times
