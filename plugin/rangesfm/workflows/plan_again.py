"""A finished survey as a plan: what another one like it would know, and what to change next time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import up_in_world
from rangesfm.geometry.gravity import UP_IN_SITE
from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.result.folder import ResultFolder, read_result_folder
from rangesfm.result.ranges_as_used import RangesAsUsed


def plan_of_result(path: str | Path) -> PlannedSurvey:
    """The same path and anchors, as the run's map has them, and as many ranges as it used.

    What a map in the first camera's frame calls up is what is up in its photos. What the run learnt of its radio is not
    taken over: the radio errs as radios mostly do.

    Raises:
        InputError: no result folder, one without a metric model, without used ranges or without times.
    """
    folder = read_result_folder(Path(path))
    model, ranges = folder.read_metric_model(), folder.read(RangesAsUsed)
    if model is None or ranges is None or not ranges.is_used.any():
        raise InputError("has no metric model or no used ranges, expected a finished result", path)
    if folder.timestamps_s is None:
        raise InputError("its photos have no times, expected a result of photos with times", path)
    trajectory = trajectory_from_reconstruction(model, folder.timestamps_s)
    is_site = folder.summary.frame == "site"
    up = up_in_world(trajectory, "auto", is_site=is_site)
    level = Rotation.align_vectors(UP_IN_SITE[None], up[None])[0].as_matrix()
    used = np.array(ranges.anchor_id, dtype=str)[ranges.is_used]
    anchors = _anchors(folder, set(used.tolist()), level)
    (arm,) = folder.lever_arms_m(ranges.tag_id[:1])
    planned = PlannedSurvey(
        trajectory=trajectory.transformed(1.0, level, np.zeros(3)),
        anchors=anchors,
        anchor_frame="site" if is_site else _frame(folder),
        rate_hz=1.0,
        tag_in_cam_m=tuple(arm.tolist()),
    )
    return planned.ranging(len(used))


def _anchors(folder: ResultFolder, heard: set[str], level: Array) -> tuple[Anchor, ...]:
    found = {name: np.array(at) for name, at in folder.anchor_positions_m.items() if name in heard}
    stddevs = {name: anchor.stddev_m or 0.0 for name, anchor in folder.summary.anchors.items()}
    return tuple(Anchor(name, level @ at, stddevs[name]) for name, at in found.items())


def _frame(folder: ResultFolder) -> str:
    is_known = any(anchor.surveyed_position_m is not None for anchor in folder.summary.anchors.values())
    return "first_camera" if is_known else "unknown"
