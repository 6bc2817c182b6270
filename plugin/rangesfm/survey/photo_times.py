"""Times of the photos of a model, as a survey gives them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rangesfm.errors import InputError
from rangesfm.sfm.image_times import ImageTimes, find_image_times, list_images, read_image_times_csv, times_at_rate
from rangesfm.sfm.rigs import read_rigs
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.trajectory import photos_by_frame

if TYPE_CHECKING:
    import pycolmap


def times_of_model(survey: Survey, sfm: pycolmap.Reconstruction, model_path: Path) -> ImageTimes:
    """Return the times of the photos of a model. The table of times may have other photos, too."""
    frames, images = photos_by_frame(sfm), survey.images
    if images.times is not None:
        return read_image_times_csv(images.times, frames=frames, columns=images.times_columns, unit=images.times_unit)
    if images.rate_hz is None:
        return find_image_times(images.path or model_path, tuple(sorted(frames)))
    if images.path is None:
        raise InputError("image_rate_hz counts all photos, also those that are not in the model: give --images FOLDER")
    taken = read_rigs(images.rig_config).frames(list_images(images.path))
    times = times_at_rate(tuple(taken), images.rate_hz)
    time_of = {photo: time for first, time in times.by_name().items() for photo in taken[first]}
    known = {first: time_of[photo] for first, photos in frames.items() for photo in photos if photo in time_of}
    if not known:
        raise InputError(f"none of the model's photos, such as {next(iter(frames))}, is in this folder", images.path)
    ordered = sorted(known, key=known.__getitem__)
    return replace(times, image_names=tuple(ordered), timestamps_s=np.array([known[name] for name in ordered]))
