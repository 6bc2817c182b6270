"""Check of a survey before any long work: what its inputs are, and what can already be known to be wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rangesfm.errors import RangesfmError
from rangesfm.measurements.ranges.range_log import RangeKind
from rangesfm.pipeline.map_photos import (
    begin_run,
    check_taped_ends,
    read_registered,
    with_keyframes,
    with_times_of_model,
)
from rangesfm.pipeline.place_ranges import check_times, path_of_model
from rangesfm.progress import SILENT, Journal
from rangesfm.sfm.camera import cameras_of_photos, check_camera
from rangesfm.sfm.features import feature_options
from rangesfm.sfm.given_database import opened
from rangesfm.sfm.image_times import list_images
from rangesfm.sfm.matching import matching_options
from rangesfm.sfm.photo_files import Photos, contents_of_masks, usable_photos
from rangesfm.sfm.rigs import read_rigs
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.sources.source import is_source, open_source
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.clock_times import span_text

# Largest number of photo sizes and of cameras that are listed.
_MAX_NUM_SIZES = 4


@dataclass
class CheckedSurvey:
    """Findings of a check, in words for the user.

    Attributes:
        facts: inputs that a run will use.
        assumed: assumptions that it will make because the survey does not say otherwise.
        warnings: warnings that it would give before the long work.
        faults: errors with which it would stop before the long work.
    """

    facts: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    faults: list[RangesfmError] = field(default_factory=list)

    @property
    def exit_status(self) -> int:
        return self.faults[0].exit_status if self.faults else 0

    def understood(self) -> list[str]:
        """Return lines on facts and assumptions."""
        return [*self.facts, *(f"assumed: {text}" for text in self.assumed)]

    @contextmanager
    def finding_faults(self) -> Iterator[None]:
        try:
            yield
        except RangesfmError as error:
            if str(error) not in map(str, self.faults):
                self.faults.append(error)


def check_survey(survey: Survey) -> CheckedSurvey:
    """Read all inputs of a run as the run does, and return what they are and what is wrong with them."""
    checked = CheckedSurvey()
    journal = Journal(SILENT, warnings=checked.warnings, notes=checked.assumed)
    model = survey.images.model
    photos = None
    with checked.finding_faults():
        if model is None:
            photos = _check_photos(survey, checked)
    with checked.finding_faults():
        run = begin_run(survey, journal)
        inputs = run.inputs
        if len(inputs.log):
            _tell_of_radio(survey, inputs, checked)
        checked.facts += _facts_of_others(survey, inputs)
        if survey.images.path is not None and is_source(survey.images.path):
            return checked
        if model is None:
            run, keyframes = with_keyframes(run)
            num_keyframes = len(keyframes)
        else:
            sfm = read_registered(model, journal)
            checked.facts.append(f"model: {sfm.num_reg_images()} photos and {sfm.num_points3D()} points in {model}")
            keyframes = tuple(image.name for image in sfm.images.values())
            num_keyframes = sfm.num_reg_frames()
            run = with_times_of_model(run, sfm)
            check_taped_ends(run.with_photos(keyframes, "the map"), keyframes)
            check_times(run, path_of_model(run, sfm))
        _tell_of_times(run, num_keyframes, checked)
        if photos is not None:
            _check_mapper(survey, photos.subset(keyframes), checked)
    return checked


def _check_photos(survey: Survey, checked: CheckedSurvey) -> Photos | None:
    """Check the photos and return them; None where they are still in a video or a bag."""
    folder = survey.photos_path
    if is_source(folder):
        _check_source(survey, folder, checked)
        return None
    photos = usable_photos(folder, list_images(folder))
    sizes = [f"{num} of {width} x {height} pixels" for (width, height), num in Counter(photos.sizes).most_common()]
    more = [f"{len(sizes) - _MAX_NUM_SIZES} more sizes"] if len(sizes) > _MAX_NUM_SIZES else []
    checked.facts.append(f"photos in {folder.name}: {', '.join(sizes[:_MAX_NUM_SIZES] + more)}")
    if photos.left_out:
        name, why = next(iter(photos.left_out.items()))
        checked.warnings.append(f"{len(photos.left_out)} photos are left out, first {name}: {why}")
    with survey.source.naming_lines():
        check_camera(survey.camera)
        found = cameras_of_photos(survey.camera, photos, read_rigs(survey.images.rig_config))
    for number, camera in enumerate(found.cameras[:_MAX_NUM_SIZES]):
        num_photos, focal_length_px = found.of_photo.count(number), camera.mean_focal_length()
        what = f"{camera.model.name} for {num_photos} photos, f {focal_length_px:.0f} pixels"
        first = photos.names[found.of_photo.index(number)]
        if survey.camera.of_photo(first).params and first not in found.guessed:
            checked.facts.append(f"camera: {what}, as given")
        else:
            seen = "by EXIF" if camera.has_prior_focal_length else "guessed from the size of the photos"
            checked.assumed.append(f"camera {what}, {seen}")
    return photos


def _check_mapper(survey: Survey, photos: Photos, checked: CheckedSurvey) -> None:
    mapper = survey.mapper
    with survey.source.naming_lines():
        feature_options(mapper)
        matching_options(mapper, len(photos.names), survey.output.seed)
    if mapper.mask_path is not None:
        masks = contents_of_masks(mapper.mask_path, photos)
        checked.facts.append(f"masks: of {len(masks)} photos")
    if mapper.database_path is not None:
        with TemporaryDirectory() as scratch, opened(mapper.database_path, photos, Path(scratch)) as given:
            checked.facts.append(f"database: {given.note}")


def _check_source(survey: Survey, path: Path, checked: CheckedSurvey) -> None:
    """Add the facts about a video or a bag that are known before its photos are extracted."""
    source, rate_hz = open_source(path, survey.images.topic), survey.images.extraction_rate_hz
    num = f"about {source.num_photos(rate_hz)} photos at {rate_hz:g} Hz"
    checked.facts.append(f"photos of {path.name}: {source.what}; {num}, extracted when a run begins")
    checked.facts += [*source.notes]
    checked.assumed.append(f"the photos' times are {source.clock}")
    with survey.source.naming_lines():
        check_camera(survey.camera)


def _tell_of_radio(survey: Survey, inputs: RangingInputs, checked: CheckedSurvey) -> None:
    log, anchors = inputs.log, inputs.anchors
    num_used = int(np.count_nonzero(log.kind == RangeKind.TAG_ANCHOR))
    name = "" if survey.ranges.path is None else survey.ranges.path.name
    checked.facts.append(
        f"ranges: {num_used} of {_counted(log.tag_ids, 'tag')} to {_counted(log.anchor_ids, 'anchor')} in {name} "
        f"({log.format})"
    )
    surveyed = [anchor.anchor_id for anchor in anchors if anchor.position_m is not None]
    if surveyed and inputs.anchor_frame != "unknown":
        source = "the log" if survey.anchors.path is None else survey.anchors.path.name
        checked.facts.append(
            f"anchors: {len(surveyed)} of {len(anchors)} have positions in {source} (frame {inputs.anchor_frame})"
        )
    else:
        checked.assumed.append(
            "no position of an anchor is known: all are estimated, and the map is in the first camera's frame"
        )
    if {"tag_in_cam_m", "lever_arms_m"} & survey.tag.model_fields_set:
        arms = (f"{', '.join(f'{x:g}' for x in arm)} m" for arm in inputs.tag_in_cam_m.tolist() if not np.isnan(arm[0]))
        checked.facts.append(f"lever arm: the tag is at {'; '.join(arms)} in the camera frame (right, down, forward)")


def _facts_of_others(survey: Survey, inputs: RangingInputs) -> Iterator[str]:
    facts = [fact for each in inputs.beside_ranges for fact in each.facts()]
    is_alone = len(facts) == len(survey.metric_keys) == 1 and not len(inputs.log)
    yield from (f"{fact}{', which alone determine the scale (no ranges)' * is_alone}" for fact in facts)
    if survey.markers.dictionary is not None:
        side = "" if survey.markers.side_m is None else f" of {survey.markers.side_m:g} m"
        yield f"tags: those of {survey.markers.dictionary}{side} will be looked for in the photos"
    if len(inputs.reference):
        name = "" if survey.report.reference is None else f" in {survey.report.reference.name}"
        yield f"reference: {len(inputs.reference)} positions{name}, only for comparison"


def _tell_of_times(run: SurveyRun, num_keyframes: int, checked: CheckedSurvey) -> None:
    times, logs = run.times, run.timed_logs
    if times is None:
        why = "the ranges name their photos" if len(run.inputs.log) else "there are no ranges"
        checked.facts.append(f"times: none are needed for {num_keyframes} keyframes, {why}")
        return
    timed = num_keyframes if len(times) == num_keyframes else f"{len(times)} of {num_keyframes}"
    first_s, last_s = times.timestamps_s[[0, -1]]
    of_logs = "".join(f", {log.words} from {log.span}" for log in logs)
    checked.facts.append(f"times: {timed} keyframes from {span_text(first_s, last_s)} ({times.source}){of_logs}")
    for log in logs:
        at_s = log.image_times_s
        shared_s = max(min(at_s.max(), last_s) - max(at_s.min(), first_s), 0.0)
        overlap = f"the {log.words} cover {shared_s:.1f} of the {last_s - first_s:.1f} s of the photos"
        if log.offset_s is not None:
            checked.facts.append(f"clocks: with the time offset of {log.offset_s:g} s, {overlap}")
        else:
            checked.assumed.append(f"the clocks differ by a time offset, which is searched for; without any, {overlap}")


def _counted(ids: Sequence[str], what: str) -> str:
    return f"{len(ids)} {what}{'s' * (len(ids) != 1)} ({', '.join(ids)})"
