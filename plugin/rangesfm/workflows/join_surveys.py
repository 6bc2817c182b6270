"""Surveys of one site, each mapped on its own, become one map through the anchors that they share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.export import check_formats
from rangesfm.files.sole_writer import sole_writer
from rangesfm.geometry.reference import read_reference
from rangesfm.progress import Progress
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.anchor_file import default_anchor_frame, read_anchors
from rangesfm.ranging.anchors.site import local_site
from rangesfm.ranging.log import RangeLog
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.workflows.finished_runs import FinishedRun, joined_log, paths_of_surveys, read_finished_runs
from rangesfm.workflows.journal import Journal
from rangesfm.workflows.results import RunResult
from rangesfm.workflows.run import map_in_metres

# Two surveys' files may give a place with other digits.
_SAME_PLACE_M = 1e-3


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
    if survey.output.path.resolve() in [folder.resolve() for folder in folders]:
        raise InputError("the results would overwrite this survey, expected another output path", survey.output.path)
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
    with sole_writer(survey.output.path):
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
    path, frame = anchors.path, anchors.frame
    if path is None or frame == "unknown":
        return ()
    if frame == "first_camera":
        raise InputError(
            "its anchors are given in the frame of its own first photo, which others do not share: give --anchors CSV "
            "in a frame of the site, or --anchor_frame unknown",
            one.result.path,
        )
    if not Path(path).is_file():
        raise InputError(f"its anchors' file is gone, {path}: give --anchors CSV", one.result.path)
    return read_anchors(path)


def _common(settings: Iterable[str | None]) -> str | None:
    """What all surveys have alike; None if they do not."""
    values = set(settings)
    return values.pop() if len(values) == 1 else None


def _images_path(finished: Sequence[FinishedRun]) -> Path | None:
    """The folder of all photos, where there is one and they have kept their names."""
    path = _common(one.result.summary.settings.images.path for one in finished)
    is_renamed = any(name != own for one in finished for own, name in one.own_name.items())
    return None if path is None or is_renamed else Path(path)
