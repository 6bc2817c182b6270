"""Joining of surveys of one site, each mapped on its own, to one map through the anchors that they share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.export import check_formats
from rangesfm.measurements.clock.offset import NO_OFFSET
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.positions.true_positions import read_true_positions
from rangesfm.measurements.ranges.anchors.anchor import Anchor, default_anchor_frame
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.anchors.site import local_site
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.pipeline.run import map_in_metres, with_results
from rangesfm.progress import SILENT, Journal, Progress
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.files.atomic import require_apart
from rangesfm.util.files.folders import real_path
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.reference import NO_REFERENCE
from rangesfm.util.geometry.trajectory import Trajectory, is_one_after_the_other
from rangesfm.util.processes.threads import at_most, with_one_blas_thread

# In metres. The files of two surveys may round the position of the same anchor differently.
_SAME_PLACE_M = 1e-3
# Largest share of one survey's ranges that another may have by chance.
_MAX_SHARED = 0.5


@dataclass(frozen=True)
class FinishedRun:
    """Result of one run that is to be joined with others.

    Attributes:
        name: of the survey, different from all others.
        result: folder of the result.
        model: unscaled model. The names of its photos are different from those of all other surveys.
        path: camera's path in the model.
        ranges: as the run used them.
        own_name: name of each photo here, by its name in the survey.
        tag_ids: id of each tag here, by its id in the survey.
    """

    name: str
    result: ResultFolder
    model: pycolmap.Reconstruction
    path: Trajectory
    ranges: RangesAsUsed
    own_name: dict[str, str]
    tag_ids: dict[str, str]

    @property
    def tags_in_cam_m(self) -> dict[str, Array]:
        """Return the lever arms (3,) by the ids that the tags have here, metres in the camera frame."""
        arms = self.result.lever_arms_m(list(self.tag_ids))
        return dict(zip(self.tag_ids.values(), arms, strict=True))

    @property
    def measured(self) -> set[tuple[object, ...]]:
        """What tells a survey from others, as it was measured: each range of a photo, with its time, tag and anchor."""
        ranges = self.ranges
        moments = [name or time_s for name, time_s in zip(ranges.image_name, ranges.timestamp_s.tolist(), strict=True)]
        columns = (ranges.keyframe_before, moments, ranges.tag_id, ranges.anchor_id, ranges.range_m.tolist())
        return {row for row in zip(*columns, strict=True) if row[0]}


def read_finished_runs(folders: Sequence[Path]) -> list[FinishedRun]:
    """Read result folders. Where photos or tags of two surveys have the same name, the name of the survey is added.

    Raises:
        InputError: there are fewer than two folders, one survey is given twice, one has no ranges or models, or only
            some have times.
    """
    if len(folders) < 2:
        raise InputError(f"{len(folders)} result folder is given, expected two or more to join")
    results = [read_result_folder(folder) for folder in folders]
    surveys = [_read(name, result) for name, result in zip(_names(folders), results, strict=True)]
    for one, other in combinations(surveys, 2):
        if len(one.measured & other.measured) > _MAX_SHARED * min(len(one.measured), len(other.measured)):
            raise InputError(
                f"has the photos and ranges of {one.result.output_path}: expected each survey once",
                other.result.output_path,
            )
    timed = [survey for survey in surveys if survey.path.timestamps_s is not None]
    if timed and len(timed) < len(surveys):
        bare = next(survey for survey in surveys if survey.path.timestamps_s is None)
        raise InputError(f"its photos have no times, but those of {timed[0].name} have", bare.result.output_path)
    surveys, counts = _with_tags_of_their_own(surveys), Counter(name for one in surveys for name in one.own_name)
    return surveys if max(counts.values(), default=1) == 1 else list(map(_renamed, surveys))


def _names(folders: Sequence[Path]) -> list[str]:
    """Return the part of each path that makes them distinct: the last part, if that is enough."""
    paths = [real_path(folder) for folder in folders]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise InputError("the same result folder is given twice", twice)
    depth = min(len(path.parts) for path in paths)
    for back in range(1, depth + 1):
        names = [path.parts[-back] for path in paths]
        if len(set(names)) == len(names):
            return names
    return [path.as_posix().strip("/") for path in paths]


def _read(name: str, result: ResultFolder) -> FinishedRun:
    model, ranges = _unscaled_model(result), result.read(RangesAsUsed)
    if not ranges:
        raise InputError(
            "has no ranges.csv: surveys are joined through anchors, so each needs ranges", result.output_path
        )
    path = result.path_in(model)
    if not is_one_after_the_other(path):
        expected = "expected the result of one survey: join all surveys at once"
        raise InputError(
            f"two of its photos have the same time, as in a map of several cameras, {expected}", result.output_path
        )
    own_name = {image.name: image.name for image in model.images.values()}
    of_two_anchors = RangeStatus.ANCHOR_ANCHOR.label
    tags = (id_ for id_, status in zip(ranges.tag_id, ranges.status, strict=True) if status != of_two_anchors)
    return FinishedRun(name, result, model, path, ranges, own_name, {id_: id_ for id_ in tags})


def _unscaled_model(result: ResultFolder) -> pycolmap.Reconstruction:
    """Return ``sparse/0``, or the scaled model where ``sparse/0`` has other photos; its scale does not matter here."""
    scaled = result.read_model("sparse_scaled")
    if scaled is None:
        raise InputError("there is no sparse_scaled/0, expected the output_path of a run", result.output_path)
    sfm = result.read_model("sparse")
    return sfm if sfm is not None and _registered(sfm) == _registered(scaled) else scaled


def _registered(model: pycolmap.Reconstruction) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _renamed(survey: FinishedRun) -> FinishedRun:
    own_name = {name: f"{survey.name}/{name}" for name in survey.own_name}
    model = pycolmap.Reconstruction(survey.model)
    for image in model.images.values():
        image.name = own_name[image.name]
    path = replace(survey.path, image_names=tuple(own_name[name] for name in survey.path.image_names))
    return replace(survey, model=model, path=path, own_name=own_name)


def _with_tags_of_their_own(surveys: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Give tags new ids where two surveys use one id with different lever arms or at once; otherwise it is one tag."""
    arms: dict[str, list[Array]] = {}
    spans_s: dict[str, list[tuple[float, float]]] = {}
    for survey in surveys:
        times_s = survey.path.timestamps_s
        for tag_id, arm in survey.tags_in_cam_m.items():
            arms.setdefault(tag_id, []).append(arm)
            if times_s is not None:
                spans_s.setdefault(tag_id, []).append((times_s[0], times_s[-1]))
    differ = {tag_id for tag_id, places in arms.items() if np.ptp(places, axis=0).max() > 0}
    # A tag cannot be on two cameras at once.
    for tag_id, spans in spans_s.items():
        starts_s, ends_s = np.array(sorted(spans)).T
        if np.any(starts_s[1:] < np.maximum.accumulate(ends_s)[:-1]):
            differ.add(tag_id)
    return [
        replace(
            survey,
            tag_ids={tag_id: f"{survey.name}/{tag_id}" if tag_id in differ else tag_id for tag_id in survey.tag_ids},
        )
        for survey in surveys
    ]


def joined_log(surveys: Sequence[FinishedRun], use_anchors: Sequence[str]) -> tuple[RangeLog, Indices, Mask]:
    """Join the ranges of all surveys in one log, with times on the cameras' clocks or names of photos.

    Args:
        surveys: all with times, or all without.
        use_anchors: ids of the anchors to use; empty: all.

    Returns:
        The log; (n,) number of the survey of each range; (n,) whether the range was held out as a check.

    Raises:
        InputError: an anchor to be used is in none of the logs.
    """
    anchor_ids = {id_ for survey in surveys for id_ in survey.result.summary.anchors}
    for id_ in use_anchors:
        if id_ not in anchor_ids:
            raise InputError(f"anchor {id_!r} to be used is in none of the surveys ({', '.join(sorted(anchor_ids))})")
    parts = [(one, _rows_to_join(one.ranges, use_anchors)) for one in surveys]
    of_each = [(one, k) for one, rows in parts for k in rows]
    has_times = surveys[0].path.timestamps_s is not None
    log = RangeLog.from_arrays(
        [one.ranges.anchor_id[k] for one, k in of_each],
        np.concatenate([one.ranges.range_m[rows] for one, rows in parts]),
        timestamp_s=np.concatenate([_camera_times_s(one)[rows] for one, rows in parts]) if has_times else (),
        image_name=() if has_times else [_own(one.own_name, one.ranges.image_name[k]) for one, k in of_each],
        tag_id=[_own(one.tag_ids, one.ranges.tag_id[k]) for one, k in of_each],
    )
    number = np.repeat(np.arange(len(parts)), [len(rows) for _, rows in parts])
    is_check = np.array([one.ranges.status[k] == RangeStatus.CHECK.label for one, k in of_each], dtype=bool)
    return log.with_anchors(anchor_ids), number, is_check


def _own(names: dict[str, str], name: str) -> str:
    return names.get(name, name)


def _rows_to_join(ranges: RangesAsUsed, use_anchors: Sequence[str]) -> list[int]:
    """Return the numbers of the ranges to the chosen anchors, without ranges between two tags, which are not used."""
    is_wanted = [not use_anchors or id_ in use_anchors for id_ in ranges.anchor_id]
    return [k for k, wanted in enumerate(is_wanted) if wanted and ranges.status[k] != RangeStatus.TAG_TAG.label]


def _camera_times_s(survey: FinishedRun) -> Array:
    """Return the time of each range on the camera's clock, (n,) seconds.

    For ranges without a place on the path, it follows from the time offset.
    """
    at_place_s = survey.ranges.camera_times_s(survey.result.timestamps_s)
    offset_s = survey.result.summary.time_offset.value_s or 0.0
    return np.where(np.isfinite(at_place_s), at_place_s, survey.ranges.timestamp_s + offset_s)


def paths_of_surveys(
    surveys: Sequence[FinishedRun], log: RangeLog, number: Indices, is_check: Mask, tags_in_cam_m: Array
) -> list[PathOfModel]:
    """Return each survey's model with its own ranges on its path, placed with the survey's own options.

    Ranges that a survey held out stay held out; ranges of other surveys count as outside the path.
    """
    paths = []
    for k, survey in enumerate(surveys):
        placed = associate(log, survey.path, tags_in_cam_m, options=survey.result.summary.settings.ranges.association)
        status = np.where(placed.has_place & (number != k), RangeStatus.OUTSIDE_PATH, placed.status).astype(np.int8)
        status[(status == RangeStatus.USED) & is_check] = RangeStatus.CHECK
        placed = replace(placed, status=status)
        paths.append(PathOfModel(survey.name, survey.model, survey.path, placed, NO_OFFSET))
    return paths


@with_one_blas_thread
def join_surveys(survey: Survey, folders: Sequence[Path], *, progress: Progress = SILENT) -> ResultFolder:
    """Make one map of several surveys from the results of their runs.

    Args:
        survey: options, output and, if they are not those of the surveys, the anchors. All else comes from the results.
        folders: of results. The others are joined to the first one, or left out.
        progress: is told of stages and warnings.

    Raises:
        InputError: a folder is not a result, or the anchors of two surveys contradict each other.
        GeometryError: none of the others can be joined to the first one.
    """
    journal = Journal(progress)
    check_formats(survey.export.formats)
    require_apart(folders, survey.output.path)
    finished = read_finished_runs(folders)
    log, number, is_check = joined_log(finished, survey.anchors.use)
    anchors, frame = _anchors(survey, finished, log)
    crs = survey.anchors.crs or _common(one.result.summary.settings.anchors.crs for one in finished) or ""
    site, anchors = local_site(anchors, frame, crs, survey.anchors.path)
    arms = {tag_id: arm for one in finished for tag_id, arm in one.tags_in_cam_m.items()}
    tags_in_cam_m = np.array([arms[tag_id] for tag_id in log.tag_ids])
    reference = NO_REFERENCE if survey.report.reference is None else read_true_positions(survey.report.reference)
    inputs = RangingInputs(log, tags_in_cam_m, anchors, frame, site, Tape(), reference)
    as_joined = survey.changed(
        {
            "images.path": _images_path(finished),
            "mapper.close_loops": False,  # the surveys have no common database
            "ranges.time_offset": 0.0,
            "tag.lever_arms_m": {tag_id: tuple(arm.tolist()) for tag_id, arm in arms.items()},
        }
    )
    with sole_writer(survey.output.path), at_most(survey.mapper.num_threads):
        paths = paths_of_surveys(finished, log, number, is_check, tags_in_cam_m)
        run = SurveyRun(as_joined, inputs, journal)
        return with_results(run, map_in_metres(run, paths, refine=survey.refine.enabled, must_join=True))


def _anchors(survey: Survey, finished: Sequence[FinishedRun], log: RangeLog) -> tuple[tuple[Anchor, ...], str]:
    """Return the anchors with what is known of them, and the frame of their positions."""
    if survey.anchors.path is not None:
        given = read_anchors(survey.anchors.path, columns=survey.anchors.columns, unit=survey.anchors.unit)
    elif survey.anchors.frame == "unknown":
        given = ()
    else:
        given = _anchors_of_surveys(finished)
    known = {anchor.anchor_id for anchor in given}
    anchors = (*given, *(Anchor(anchor_id) for anchor_id in log.anchor_ids if anchor_id not in known))
    frame = survey.anchors.frame or default_anchor_frame(anchors)
    if frame != "unknown" and all(anchor.position_m is None for anchor in anchors):
        raise InputError(f"anchor frame {frame!r} needs anchor positions and the surveys have none: give --anchors CSV")
    return anchors, frame


def _anchors_of_surveys(finished: Sequence[FinishedRun]) -> tuple[Anchor, ...]:
    """Return the anchors in the files of the surveys.

    Raises:
        InputError: two surveys have different positions of an anchor.
    """
    by_id: dict[str, Anchor] = {}
    for one in finished:
        for anchor in _anchors_of(one):
            before = by_id.setdefault(anchor.anchor_id, anchor)
            if before.position_m is None:
                by_id[anchor.anchor_id] = anchor
            elif anchor.position_m is not None:
                off_m = float(np.linalg.norm(before.position_m - anchor.position_m))
                if off_m > _SAME_PLACE_M:
                    raise InputError(
                        f"anchor {anchor.anchor_id!r} is {off_m:.3f} m from its position in another survey's file: "
                        "give --anchors CSV for all of them",
                        one.result.output_path,
                    )
    return tuple(by_id.values())


def _anchors_of(one: FinishedRun) -> tuple[Anchor, ...]:
    anchors = one.result.summary.settings.anchors
    path, frame = one.result.anchors_path, anchors.frame
    if path is None or frame == "unknown":
        return ()
    if frame == "first_camera":
        raise InputError(
            "its anchors are in the frame of its own first photo, which other surveys do not share: give --anchors CSV "
            "in a site frame, or --anchor_frame unknown",
            one.result.output_path,
        )
    if not path.is_file():
        raise InputError(
            f"its file of anchors does not exist any more, {path}: give --anchors CSV", one.result.output_path
        )
    return read_anchors(path, columns=anchors.columns, unit=anchors.unit)


def _common(settings: Iterable[str | None]) -> str | None:
    """Return the value that all surveys have; None if they have different values."""
    values = set(settings)
    return values.pop() if len(values) == 1 else None


def _images_path(finished: Sequence[FinishedRun]) -> Path | None:
    """Return the folder of all photos; None if they are in several folders, or have new names here."""
    paths = {one.result.images_path for one in finished}
    is_renamed = any(name != own for one in finished for own, name in one.own_name.items())
    return None if is_renamed or len(paths) > 1 else paths.pop()
