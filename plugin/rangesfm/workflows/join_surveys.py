"""Surveys of one site, each mapped on its own, become one map through the anchors that they share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.export import check_formats
from rangesfm.files.atomic import require_apart, sole_writer
from rangesfm.geometry.reference import read_reference
from rangesfm.geometry.trajectory import Trajectory, is_one_after_the_other
from rangesfm.join.models import PathOfModel
from rangesfm.processes.threads import at_most, with_one_blas_thread
from rangesfm.progress import Journal, Progress
from rangesfm.ranging.anchors.anchor import Anchor, default_anchor_frame, read_anchors
from rangesfm.ranging.anchors.site import local_site
from rangesfm.ranging.association import associate
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.observations import RangeStatus
from rangesfm.result.folder import ResultFolder, read_result_folder
from rangesfm.result.model_path import path_of_model
from rangesfm.result.tables import RangesAsUsed
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.workflows.results import RunResult
from rangesfm.workflows.run import map_in_metres

# Two surveys' files may give a place with other digits.
_SAME_PLACE_M = 1e-3


@dataclass(frozen=True)
class FinishedRun:
    """What one run left.

    Attributes:
        name: unlike that of any other survey here.
        result: its folder.
        model: unscaled; its photos have names of their own among all surveys.
        path: of the model.
        ranges: as it used them.
        own_name: of each photo, as its survey calls it, the name that it has here.
        tag_ids: of each tag, as its survey calls it, the id that it has here.
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
        """(3,) lever arm by the id that a tag has here."""
        arms = self.result.lever_arms_m(list(self.tag_ids))
        return dict(zip(self.tag_ids.values(), arms, strict=True))


def read_finished_runs(folders: Sequence[Path]) -> list[FinishedRun]:
    """Read result folders. Photos and tags that bear the same name in two of them are called after their survey too.

    Raises:
        InputError: fewer than two folders, one of them twice, one without ranges, models or times as the others have.
    """
    if len(folders) < 2:
        raise InputError(f"{len(folders)} result folder is given, expected two or more to join")
    results = [read_result_folder(folder) for folder in folders]
    surveys = [_read(name, result) for name, result in zip(_names(folders), results, strict=True)]
    timed = [survey for survey in surveys if survey.path.timestamps_s is not None]
    if timed and len(timed) < len(surveys):
        bare = next(survey for survey in surveys if survey.path.timestamps_s is None)
        raise InputError(f"its photos have no times, those of {timed[0].name} have", bare.result.path)
    return _with_names_of_their_own(_with_tags_of_their_own(surveys))


def _names(folders: Sequence[Path]) -> list[str]:
    """The part of each path that tells them apart: the last one, if that will do."""
    paths = [folder.resolve() for folder in folders]
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
    if ranges is None:
        raise InputError("there is no ranges.csv, expected the output_path of a run", result.path)
    path = path_of_model(model, result)
    if not is_one_after_the_other(path):
        expected = "expected the result of one survey: join all surveys at once"
        raise InputError(
            f"two of its photos have the same time, as in a map of several cameras, {expected}", result.path
        )
    own_name = {image.name: image.name for image in model.images.values()}
    of_two_anchors = RangeStatus.ANCHOR_ANCHOR.label
    tags = (id_ for id_, status in zip(ranges.tag_id, ranges.status, strict=True) if status != of_two_anchors)
    return FinishedRun(name, result, model, path, ranges, own_name, {id_: id_ for id_ in tags})


def _unscaled_model(result: ResultFolder) -> pycolmap.Reconstruction:
    """``sparse/0``; where that is not all of what was scaled, the scaled model, which is as good."""
    scaled = result.read_model("sparse_scaled")
    if scaled is None:
        raise InputError("there is no sparse_scaled/0, expected the output_path of a run", result.path)
    sfm = result.read_model("sparse")
    return sfm if sfm is not None and _registered(sfm) == _registered(scaled) else scaled


def _registered(model: pycolmap.Reconstruction) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _with_names_of_their_own(surveys: Sequence[FinishedRun]) -> list[FinishedRun]:
    counts = Counter(name for survey in surveys for name in survey.own_name)
    return list(surveys) if max(counts.values(), default=1) == 1 else list(map(_renamed, surveys))


def _renamed(survey: FinishedRun) -> FinishedRun:
    own_name = {name: f"{survey.name}/{name}" for name in survey.own_name}
    model = pycolmap.Reconstruction(survey.model)
    for image in model.images.values():
        image.name = own_name[image.name]
    path = replace(survey.path, image_names=tuple(own_name[name] for name in survey.path.image_names))
    return replace(survey, model=model, path=path, own_name=own_name)


def _with_tags_of_their_own(surveys: Sequence[FinishedRun]) -> list[FinishedRun]:
    """A tag that has the same id and the same lever arm in two surveys is the same one."""
    arms: dict[str, list[Array]] = {}
    for survey in surveys:
        for tag_id, arm in survey.tags_in_cam_m.items():
            arms.setdefault(tag_id, []).append(arm)
    differ = {tag_id for tag_id, places in arms.items() if np.ptp(places, axis=0).max() > 0}
    return [
        replace(
            survey,
            tag_ids={tag_id: f"{survey.name}/{tag_id}" if tag_id in differ else tag_id for tag_id in survey.tag_ids},
        )
        for survey in surveys
    ]


def joined_log(surveys: Sequence[FinishedRun], use_anchors: Sequence[str]) -> tuple[RangeLog, Indices, Mask]:
    """All their ranges: on the cameras' clocks, or by photo.

    Args:
        use_anchors: ids; empty: all.

    Returns:
        the log; (n,) the survey of each range; (n,) whether it was held out as a check.

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
        timestamp_s=np.concatenate([_camera_times_s(one)[rows] for one, rows in parts]) if has_times else None,
        image_name=None if has_times else [_own(one.own_name, one.ranges.image_name[k]) for one, k in of_each],
        tag_id=[_own(one.tag_ids, one.ranges.tag_id[k]) for one, k in of_each],
    )
    number = np.repeat(np.arange(len(parts)), [len(rows) for _, rows in parts])
    is_check = np.array([one.ranges.status[k] == RangeStatus.CHECK.label for one, k in of_each], dtype=bool)
    return log.with_anchors(anchor_ids), number, is_check


def _own(names: dict[str, str], name: str) -> str:
    return names.get(name, name)


def _rows_to_join(ranges: RangesAsUsed, use_anchors: Sequence[str]) -> list[int]:
    """Of the wanted anchors; ranges between two tags have no say, and no anchor."""
    is_wanted = [not use_anchors or id_ in use_anchors for id_ in ranges.anchor_id]
    return [k for k, wanted in enumerate(is_wanted) if wanted and ranges.status[k] != RangeStatus.TAG_TAG.label]


def _camera_times_s(survey: FinishedRun) -> Array:
    """(n,) when each range was taken, by the photos around it; of those without a place, by the clocks' offset."""
    ranges, times = survey.ranges, survey.result.timestamps_s
    if times is None:
        return np.full(len(ranges.range_m), np.nan)
    offset = survey.result.summary.time_offset.value_s or 0.0
    before, after = (
        np.array([times.get(name, np.nan) for name in names], dtype=np.float64)
        for names in (ranges.keyframe_before, ranges.keyframe_after)
    )
    at_place = (1 - ranges.weight) * before + ranges.weight * after
    return np.where(np.isfinite(at_place), at_place, ranges.timestamp_s + offset)


def paths_of_surveys(
    surveys: Sequence[FinishedRun], log: RangeLog, number: Indices, is_check: Mask, tags_in_cam_m: Array
) -> list[PathOfModel]:
    """Each survey's model with its own ranges on its path, as the survey put them there; checks stay checks."""
    paths = []
    for k, survey in enumerate(surveys):
        placed = associate(log, survey.path, tags_in_cam_m, options=survey.result.summary.settings.ranges.association)
        status = np.where(placed.has_place & (number != k), RangeStatus.OUTSIDE_PATH, placed.status).astype(np.int8)
        status[(status == RangeStatus.USED) & is_check] = RangeStatus.CHECK
        paths.append(PathOfModel(survey.name, survey.model, survey.path, replace(placed, status=status)))
    return paths


@with_one_blas_thread
def join_surveys(survey: Survey, folders: Sequence[Path], *, progress: Progress) -> RunResult:
    """One map of several surveys, from what their runs left.

    Args:
        survey: options, the anchors if they are not those of the surveys, and the output; the rest is the surveys'.
        folders: of results; to the first one the others are joined, or left out.

    Raises:
        InputError: a folder is not what a run writes, or the surveys' anchors contradict each other.
        GeometryError: none of the others can be joined to the first one.
    """
    journal = Journal(progress)
    check_formats(survey.export.formats)
    finished = read_finished_runs(folders)
    require_apart(folders, survey.output.path)
    log, number, is_check = joined_log(finished, survey.anchors.use)
    anchors, frame = _anchors(survey, finished, log)
    crs = survey.anchors.crs or _common(one.result.summary.settings.anchors.crs for one in finished)
    site, anchors = local_site(anchors, frame, crs, survey.anchors.path)
    arms = {tag_id: arm for one in finished for tag_id, arm in one.tags_in_cam_m.items()}
    tags_in_cam_m = np.array([arms[tag_id] for tag_id in log.tag_ids])
    reference = None if survey.report.reference is None else read_reference(survey.report.reference)
    inputs = RangingInputs(log, tags_in_cam_m, anchors, frame, site, None, reference, ())
    as_joined = survey.changed(
        {
            "images.path": _images_path(finished),
            "ranges.time_offset": 0.0,
            "tag.lever_arms_m": {tag_id: tuple(arm.tolist()) for tag_id, arm in arms.items()},
        }
    )
    with sole_writer(survey.output.path), at_most(survey.mapper.num_threads):
        paths = paths_of_surveys(finished, log, number, is_check, tags_in_cam_m)
        return map_in_metres(as_joined, inputs, paths, None, journal, refine=survey.refine.enabled, must_join=True)


def _anchors(survey: Survey, finished: Sequence[FinishedRun], log: RangeLog) -> tuple[tuple[Anchor, ...], str]:
    """What is known of the anchors, and the frame of their positions."""
    if survey.anchors.path is not None:
        given = read_anchors(survey.anchors.path)
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
    """As the surveys' own files have them."""
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
                        f"anchor {anchor.anchor_id!r} is {off_m:.3f} m from where another survey's file has it: give "
                        "--anchors CSV for all of them",
                        one.result.path,
                    )
    return tuple(by_id.values())


def _anchors_of(one: FinishedRun) -> tuple[Anchor, ...]:
    anchors = one.result.summary.settings.anchors
    path, frame = one.result.anchors_path, anchors.frame
    if path is None or frame == "unknown":
        return ()
    if frame == "first_camera":
        raise InputError(
            "its anchors are given in the frame of its own first photo, which others do not share: give --anchors CSV "
            "in a frame of the site, or --anchor_frame unknown",
            one.result.path,
        )
    if not path.is_file():
        raise InputError(f"its anchors' file is gone, {path}: give --anchors CSV", one.result.path)
    return read_anchors(path)


def _common(settings: Iterable[str | None]) -> str | None:
    """What all surveys have alike; None if they do not."""
    values = set(settings)
    return values.pop() if len(values) == 1 else None


def _images_path(finished: Sequence[FinishedRun]) -> Path | None:
    """The folder of all photos, where there is one and they have kept their names."""
    paths = {one.result.images_path for one in finished}
    is_renamed = any(name != own for one in finished for own, name in one.own_name.items())
    return None if is_renamed or len(paths) > 1 else paths.pop()
