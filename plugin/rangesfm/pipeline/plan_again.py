"""A finished survey as the plan of another one like it: what that would determine, and what to change next time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError, InputError
from rangesfm.export.metric_map import colored_points, level_axes, up_in_world
from rangesfm.measurements.planned_kind import PlannedKind
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.measurements.ranges.scale.doubts import CALIBRATE
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.planning.advice import advise, best_words
from rangesfm.planning.expected import expect
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.result.result_folder import read_result_folder
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.survey.kinds_in_map import KINDS
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory, is_one_after_the_other

# Assumed rate of photos without times.
_PHOTO_RATE_HZ = 2.0
# Shares of the points between which the room is: some points are seen through windows, or wrong.
_MOST_OF_POINTS = (0.01, 0.99)
# A map without a place in a site has no coordinates that anybody knows: these are about its first photo.
_AXES, _LEVEL = " (metres right of, ahead of and above the first photo)", " above the first photo"
# An anchor on a wall is in front of it: distance of the wall behind it, metres.
_BEHIND_M = 0.05


def plan_of_result(path: AnyPath) -> PlannedSurvey:
    """Return the plan of a survey with the path, the anchors and the number of ranges of a finished one.

    Path and anchors are those of the result's map, and the errors of radio and inertial sensor are those that the run
    has learnt. For a map in the frame of the first camera, up is as measured, or the mean upward direction of photos.

    Raises:
        InputError: the folder is not a result, or has no metric model, or neither used ranges nor an inertial sensor.
    """
    folder = read_result_folder(Path(path))
    model, ranges = folder.read_metric_model(), folder.read(RangesAsUsed)
    used = np.array(ranges.anchor_id, dtype=str)[ranges.is_used]
    entries = {kind: entry.to_json() for kind, entry in folder.summary.of_kinds.items()}
    others = _others(
        {kind: {k: v for k, v in entry.items() if isinstance(v, float)} for kind, entry in entries.items()}
    )
    if model is None:
        raise InputError("has no metric model, expected a finished result", path)
    if not len(used) and not others:
        raise InputError("was made without ranges, expected a result with some: a plan takes the radio from them", path)
    trajectory = folder.path_in(model)
    if not is_one_after_the_other(trajectory):
        expected = "expected the result of one survey"
        raise InputError(f"two of its photos have the same time, as in a map of several cameras, {expected}", path)
    (arm,) = folder.lever_arms_m(ranges.tag_id[:1]) if ranges else np.zeros((1, 3))
    stddevs = {name: anchor.stddev_m or 0.0 for name, anchor in folder.summary.anchors.items()}
    heard = {name: np.array(at) for name, at in folder.anchor_positions_m.items() if name in set(used)}
    anchors = [Anchor(name, at, stddevs[name]) for name, at in heard.items()]
    is_known = any(anchor.surveyed_position_m is not None for anchor in folder.summary.anchors.values())
    frame, stddevs_m = _frame(folder.summary.frame, is_known=is_known), folder.summary.scale.error_stddevs
    on_earth, upward = folder.summary.georeference, None if folder.summary.up is None else folder.summary.up[0]
    site = Site(georeference=None if on_earth is None else on_earth.georeference)
    planned = _of_run(trajectory, anchors, frame, arm, stddevs_m, site, others)
    return _levelled(planned, colored_points(model)[0], len(used), upward)


def with_advice(metric: MetricResult, upward: Gravity | None) -> MetricResult:
    """Add advice on what to change next time, where the scale or the place is doubtful.

    Args:
        upward: the upward direction in the first camera as given.
    """
    doubtful = metric.estimate.verdict == "doubtful", metric.place is not None and metric.place.verdict == "doubtful"
    if metric.estimate.method == "two-candidate":  # another survey would not make its scale more certain
        return metric
    observations = metric.observations
    used = observations.has_place & (observations.status < RangeStatus.OUTLIER)
    if not any(doubtful) or not used.any() or not is_one_after_the_other(metric.trajectory):
        return metric
    log, estimate = observations.log, metric.estimate
    heard = {log.anchor_ids[k] for k in np.unique(log.anchor_index[used])}
    anchors = [
        Anchor(a.anchor_id, a.position_m, a.position_stddev_m)
        for a in metric.anchors
        if a.anchor_id in heard and np.isfinite(a.position_m).all()
    ]
    is_known = any(anchor.prior_position_m is not None for anchor in metric.anchors)
    trajectory = metric.trajectory.as_in(metric.final)
    arm = metric.inputs.tag_in_cam_m[max(int(log.tag_index[used][0]), 0)]
    try:
        frame, stddevs = _frame(estimate.frame, is_known=is_known), estimate.ranges.error_stddevs
        points_m = colored_points(metric.final)[0]
        site = Site(georeference=metric.inputs.site.georeference)
        others = _others({kind.kind: metric.all_measured.problem.sizes for kind in metric.kinds})
        planned = _of_run(trajectory, anchors, frame, arm, stddevs, site, others)
        expected = expect(_levelled(planned, points_m, int(used.sum()), metric.upward(upward)))
    except (InputError, GeometryError):  # the upward direction is unknown, or a survey like this one would be refused
        return metric
    words = best_words(advise(expected), for_scale=doubtful[0], for_place=doubtful[1])
    is_computed = any(each.startswith(CALIBRATE) for each in words)
    before = [each for each in estimate.advice if not (is_computed and each.startswith(CALIBRATE))]
    return replace(metric, estimate=replace(estimate, advice=tuple(dict.fromkeys((*before, *words)))))


def _others(learnt: Mapping[str, Mapping[str, float]]) -> dict[str, PlannedKind]:
    """Return plans of the kinds of measurement that have a table of their own, given what was learnt of each kind."""
    planned = {kind.words.kind: kind.planned for kind in KINDS if kind.planned is not None}
    return {name: kind.like(learnt[name]) for name, kind in planned.items() if name in learnt}


def _of_run(
    trajectory: Trajectory,
    anchors: Sequence[Anchor],
    frame: str,
    tag_in_cam_m: Array,
    component_stddevs: Mapping[str, float],
    site: Site,
    others: Mapping[str, PlannedKind],
) -> PlannedSurvey:
    """Return the survey of a run as a plan in the axes of its map, with assumed times where the photos have none."""
    times = np.arange(len(trajectory)) / _PHOTO_RATE_HZ if trajectory.timestamps_s is None else trajectory.timestamps_s
    return PlannedSurvey(
        trajectory=replace(trajectory, timestamps_s=times),
        anchors=tuple(anchors),
        anchor_frame=frame,
        rate_hz=1.0,
        tag_in_cam_m=tuple(tag_in_cam_m.tolist()),
        component_stddevs=component_stddevs,
        others=others,
        times_are_known=trajectory.timestamps_s is not None,
        site=site,
    )


def _levelled(of_run: PlannedSurvey, points_m: Array, num_ranges: int, upward: Array | None) -> PlannedSurvey:
    """Return the plan with z up, inside what the photos show.

    Args:
        points_m: (n, 3) points of the map. upward: (3,) unit vector in it, as measured; None: the photos tell it.
    """
    if of_run.anchor_frame == "site":
        level, planned = np.eye(3), of_run
    else:
        level = level_axes(of_run.trajectory, up_in_world(of_run.trajectory, "auto", upward))
        anchors = tuple(replace(a, position_m=level @ np.array(a.position_m)) for a in of_run.anchors)
        path = of_run.trajectory.transformed(Similarity(1.0, level, np.zeros(3)))
        planned = replace(of_run, trajectory=path, anchors=anchors, site=Site(), axes=_AXES, level=_LEVEL)
    return _inside(planned.ranging(num_ranges) if planned.anchors else planned, points_m @ level.T)


def _inside(planned: PlannedSurvey, points_m: Array) -> PlannedSurvey:
    """Return the plan inside what the photos show, with anchors where they show something to fix them to.

    Nobody can say what is outside or above path, anchors and points (n, 3): whether there is room, or a ceiling.
    """
    low, high = np.quantile(points_m, _MOST_OF_POINTS, axis=0) if len(points_m) else planned.places_m[:2]
    places = np.vstack([planned.places_m, [low, high]])
    (left, front, lowest), (right, back, highest) = places.min(axis=0) - _BEHIND_M, places.max(axis=0) + _BEHIND_M
    corners = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    surfaces_m = points_m[np.all((points_m >= low) & (points_m <= high), axis=1)] if len(points_m) else points_m
    some = np.linspace(0, len(surfaces_m) - 1, min(len(surfaces_m), 500)).astype(np.int64)
    return replace(
        planned,
        walls_m=(corners,),
        walls_are="edge of what the photos show",
        heights_m=(lowest, highest),
        allowed_m=surfaces_m[some] if len(some) else planned.anchors_m,
    )


def _frame(frame: str, *, is_known: bool) -> str:
    return "site" if frame == "site" else "first_camera" if is_known else "unknown"
