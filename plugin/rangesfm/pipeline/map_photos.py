"""The photos of a survey and their mapping to unscaled models, with checks before the long work."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from rangesfm.colmap.model_files import model_of_trajectory, read_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.colmap.pieces import photos_without_shared_points
from rangesfm.colmap.reprojection import wrong_axes
from rangesfm.colmap.transform import without_photos
from rangesfm.diagnostics.preflight import (
    notes_before_work,
    notes_on_gaps,
    notes_on_model,
    notes_on_silence,
    notes_on_times,
)
from rangesfm.errors import InputError
from rangesfm.export import EXPORTED_NAMES, OFFSET_NAME, check_formats
from rangesfm.measurements.lengths.locate_lengths import check_ends
from rangesfm.pipeline.place_ranges import check_times
from rangesfm.progress import Journal
from rangesfm.result.result_folder import PHOTOS_NAMES, RESULT_NAMES, places_for_photos
from rangesfm.sfm.image_times import ImageTimes, find_image_times, list_images
from rangesfm.sfm.keyframes import select_keyframes
from rangesfm.sfm.mapping import pipeline_options
from rangesfm.sfm.reconstruct import reconstruct_in
from rangesfm.sfm.rigs import read_rigs
from rangesfm.sfm.steps import RECONSTRUCTION_NAMES
from rangesfm.sfm.tags import find_tags, names_of_tags, sides_of_tags
from rangesfm.sfm.unpublished import UnpublishedReconstruction
from rangesfm.survey.kinds_in_map import read_all_kinds
from rangesfm.survey.photo_times import times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.survey.sources.extract import TIMES_NAME, take_photos
from rangesfm.survey.sources.source import is_source
from rangesfm.survey.survey_reader import input_paths
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.folders import real_path
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.trajectory import Trajectory


def result_names(survey: Survey) -> set[str]:
    """Return the names that a result of this survey takes in the output folder, export formats included."""
    return {*RESULT_NAMES, OFFSET_NAME}.union(*(EXPORTED_NAMES[name] for name in survey.export.formats))


def refuse_to_overwrite(survey: Survey) -> None:
    """Check that the results will overwrite no input, and will not be written among the files of an input folder.

    Raises:
        InputError: they would; it names the input.
    """
    folder = real_path(survey.output.path)
    maps = survey.images.model is None
    places = {folder / name for name in result_names(survey)}
    places.update(folder / name for name in (*RECONSTRUCTION_NAMES, *PHOTOS_NAMES) if maps)
    for _, _, given in input_paths(survey):
        path = real_path(given)
        if not places.isdisjoint((path, *path.parents)):
            raise InputError("the results would overwrite this input, expected another output path", given)
        if path.is_dir() and path == folder:
            raise InputError("the results would be written into this input, expected another output path", given)


def begin_run(survey: Survey, journal: Journal) -> SurveyRun:
    """Read and check all inputs but the photos, so that errors are found before the long work begins.

    Raises:
        InputError: a format, an option or a file is wrong.
    """
    check_formats(survey.export.formats)
    with survey.source.naming_lines():
        apply_options(pycolmap.BundleAdjustmentOptions(), survey.refine.bundle_adjustment, "refine.bundle_adjustment")
    refuse_to_overwrite(survey)
    inputs = read_all_kinds(survey)
    notes = [*notes_before_work(survey, inputs)]  # it ends the run where a unit is wrong
    journal.note(*inputs.assumed)
    journal.warn(*inputs.notes, *notes)
    return SurveyRun(survey, inputs, journal)


def with_keyframes(run: SurveyRun) -> tuple[SurveyRun, tuple[str, ...]]:
    """Return the survey with the times of its keyframes, and these, after checks that they fit ranges and reference.

    Raises:
        InputError: they do not.
    """
    run = run.with_photos(photos := list_images(run.survey.photos_path), "the folder")
    keyframes, times = find_keyframes(
        run.survey, run.journal, needs_times=run.inputs.needs_times, keeps_all=not run.inputs.needs_times
    )
    n, timestamps_s = len(keyframes), None if times is None else times.timestamps_s
    nowhere = Trajectory(np.arange(n), keyframes, timestamps_s, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))
    check_times(run, nowhere)
    check_taped_ends(run, keyframes if run.survey.images.rig_config is None else photos)
    return run if times is None else with_times(run, times), keyframes


def check_taped_ends(run: SurveyRun, photos: Collection[str]) -> None:
    """Check that the ends of taped distances are among these photos, markers, tags or anchors; raises InputError."""
    may_be_tags = run.survey.markers.dictionary is not None
    check_ends(run.inputs.tape, photos, run.inputs.log.anchor_ids, may_be_tags=may_be_tags)


def with_times_of_model(run: SurveyRun, sfm: pycolmap.Reconstruction) -> SurveyRun:
    """Return the survey with the times of the photos of its model, if any are needed, also to compare with a reference.

    Raises:
        InputError: no photo has a time, or times are wrong.
    """
    if not (run.inputs.needs_times or isinstance(run.inputs.reference.moments, ByTime)):
        return run
    times = times_of_model(run.survey, sfm, run.survey.given_model_path)
    run.journal.note(*times.assumed)
    run.journal.warn(*times.notes)
    return with_times(run, times)


def with_times(run: SurveyRun, times: ImageTimes) -> SurveyRun:
    """Return the survey with the times of its photos, after warnings of their oddities and of other clocks."""
    log, options = run.inputs.log, run.survey.ranges
    if isinstance(log.moments, ByTime):
        run.journal.warn(*notes_on_gaps(times.timestamps_s, options.max_interpolation_gap_s))
        at_s, is_given = log.timestamp_s + (options.time_offset_s or 0.0), options.time_offset_s is not None
        run.journal.warn(*notes_on_silence(at_s, times.timestamps_s, is_one_clock=is_given))
    for timed in run.timed_logs:
        run.journal.warn(*notes_on_times(timed, times.timestamps_s))
    return replace(run, times=times)


def read_registered(path: Path, journal: Journal) -> pycolmap.Reconstruction:
    """Read a given COLMAP model, or a trajectory as one, and warn of what is wrong with it.

    Photos that share no point with others are left out, unless the model is a trajectory.

    Raises:
        InputError: it cannot be read, has no registered images, or its axes are not as in COLMAP.
    """
    model = model_of_trajectory(path) if path.is_file() else read_model(path)
    if not model.num_reg_images():
        raise InputError("the model has no registered images", path)
    if (said := wrong_axes(model)) is not None:
        raise InputError(said, path)
    journal.warn(*notes_on_model(model))
    if apart := photos_without_shared_points(model):
        journal.warn(
            f"{len(apart)} of {model.num_reg_images()} photos of the model share no point with another, the first is "
            f"{apart[0]}: nothing tells where they are, so they are left out (of poses without any points, none are)"
        )
    return without_photos(model, apart)


def with_photos_in_folder(survey: Survey, journal: Journal, *, restart: bool = False) -> Survey:
    """Extract the photos of a video or a bag into the output folder, and return the survey with these photos.

    If the bag has a camera calibration and the survey has none, that is used. Photos that an earlier run extracted are
    used again unless ``restart`` is true. A survey of a folder of photos is returned unchanged.

    Raises:
        InputError: the source cannot be read, or times are given for it.
    """
    path = survey.images.path
    if path is None or not is_source(path):
        return survey
    if survey.images.times is not None:
        raise InputError("its images have their own times, expected no [images] times", path)
    rate_hz, topic = survey.images.extraction_rate_hz, survey.images.topic
    places = places_for_photos(survey.output.path)
    with journal.stage("photos"):
        folder, taken = take_photos(
            path, places, rate_hz=rate_hz, topic=topic, progress=journal.progress, restart=restart
        )
    journal.note(*taken.notes)
    values: dict[str, Any] = {"images.path": folder, "images.times": folder / TIMES_NAME}
    given = survey.camera
    if taken.camera.model and not (given.model or given.params or given.others):
        values |= {"camera.model": taken.camera.model, "camera.params": taken.camera.params}
    return survey.changed(values)


def find_keyframes(
    survey: Survey, journal: Journal, *, needs_times: bool = False, keeps_all: bool = False
) -> tuple[tuple[str, ...], ImageTimes | None]:
    """Return the keyframes and their times; None in place of times, and order by name, where times are not needed.

    Of the photos that a rig took at the same time, only one is returned, that of the reference camera if there is one.

    Args:
        survey: options.
        journal: for warnings about times.
        needs_times: whether times are needed. keeps_all: whether photos without a time are kept, unless the survey
            gives times.

    Raises:
        InputError: times are needed and cannot be found.
    """
    folder = survey.photos_path
    with journal.timed("keyframes"):
        frames = read_rigs(survey.images.rig_config).frames(list_images(folder))
        names = tuple(frames)
        image_times = None
        with nullcontext() if survey.images.times or needs_times else suppress(InputError):
            image_times = find_image_times(
                folder,
                names,
                survey.images.times,
                frames,
                rate_hz=survey.images.rate_hz,
                columns=survey.images.times_columns,
                unit=survey.images.times_unit,
            )
        if image_times is None or (keeps_all and not survey.images.times and image_times.num_left_out):
            return select_keyframes(names, survey.images), None
        keyframes = select_keyframes(image_times, survey.images)
        journal.note(*image_times.assumed)
        journal.warn(*image_times.notes)
        return keyframes, image_times.subset(keyframes)


def with_tags(run: SurveyRun, names: Sequence[str]) -> SurveyRun:
    """Add the printed tags found in photos to the inputs, if tags are to be looked for.

    Raises:
        InputError: no tags were found, and nothing else is measured in metres.
    """
    survey, inputs, journal = run.survey, run.inputs, run.journal
    wanted = survey.markers
    if wanted.dictionary is None:
        return run
    folder = survey.photos_path
    with journal.stage("tags"):
        markers = find_tags(folder, names, wanted.dictionary, journal.progress)
    if not markers:
        message = (
            f"no tag of {wanted.dictionary} in {len(names)} photos: is it another dictionary ([markers] dictionary)?"
        )
        if not len(inputs.log) and survey.scale.distances is None and survey.points.path is None:
            raise InputError(message, folder)
        journal.warn(message)
    num_photos = len({name for marker in markers.values() for name in marker.image_names})
    journal.progress.message(f"tags: {len(names_of_tags(markers))} of {wanted.dictionary} in {num_photos} photos")
    sides = () if wanted.side_m is None else sides_of_tags(markers, wanted.side_m, wanted.side_stddev_m)
    tape = inputs.tape.with_more(sides).with_more_markers(markers)
    positions = inputs.positions.with_more_markers(markers)
    return replace(run, inputs=replace(inputs, tape=tape, positions=positions))


def map_keyframes(
    survey: Survey,
    keyframes: tuple[str, ...],
    journal: Journal,
    restart: bool,
    *,
    deferred: bool,
) -> tuple[pycolmap.Reconstruction, ...]:
    """Map the keyframes into ``sparse`` and return the models ``sparse/0``, ``sparse/1``, ...

    Args:
        survey: options.
        keyframes: names of the photos.
        journal: for stages, times and warnings.
        restart: whether to do all steps again.
        deferred: whether to keep an earlier reconstruction in its place until the new result is complete.
    """
    rigs = read_rigs(survey.images.rig_config)
    frames = rigs.frames(list_images(survey.photos_path))
    photos = [photo for keyframe in keyframes for photo in frames[keyframe]]
    camera, mapper, seed = survey.camera, survey.mapper, survey.output.seed
    with survey.source.naming_lines():
        pipeline_options(camera, mapper, seed)  # so that bad options are refused before anything is written
        with (
            sole_writer(survey.output.path) as output,
            UnpublishedReconstruction(output, journal.progress, restart=restart) as unpublished,
        ):
            summary = reconstruct_in(unpublished, survey.photos_path, photos, camera, mapper, rigs, seed)
            if deferred:
                unpublished.defer()
            else:
                unpublished.publish([output.path / name for name in RESULT_NAMES])
    journal.seconds.update({**summary.earlier_seconds, **summary.seconds})
    if summary.num_registered < len(photos):
        which = "the model" if len(summary.models) == 1 else f"the largest of {len(summary.models)} models"
        journal.warn(f"{summary.num_registered} of {len(photos)} keyframes are in {which}")
    return summary.models
