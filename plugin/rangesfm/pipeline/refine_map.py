"""Refinement of a scaled map by the options of a survey, and what is measured in the map at rest (sections 5 to 7)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from rangesfm.arrays import Mask
from rangesfm.colmap.reprojection import point_errors
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.finished_map import why_broken
from rangesfm.errors import GeometryError, SolverError
from rangesfm.estimation.drift import bend
from rangesfm.estimation.map_posterior import bending_of_firm_parts, errors_at_estimate, likely_bend
from rangesfm.estimation.map_problem import MapProblem, map_problem
from rangesfm.estimation.photo_bending import PhotoBending, parts_of_path
from rangesfm.estimation.refinement import MapAtRest, joint_errors, refine, refine_with_loops
from rangesfm.estimation.vision_information import Loop
from rangesfm.estimation.with_ranges import refined_ranges, summarize
from rangesfm.measurements.joint_map import JointMap, KindOnMap, beside_others, join_kinds, tested_kinds
from rangesfm.measurements.kind import MapState
from rangesfm.pipeline.metric_result import MetricResult, RefinedMap
from rangesfm.result.result_folder import is_refined_model
from rangesfm.solver.bending import MapBending, WalkBending
from rangesfm.solver.covariance import PhotosAlone
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.survey.kinds_in_map import MapOfPhotos, kinds_in_map, measured_in_map
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.similarity import IDENTITY, align_points
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import at_most


def refine_map(run: SurveyRun, metric: MetricResult) -> MetricResult:
    """Refine a scaled map with all that was measured. Where that breaks the map, the scaled map stays the result.

    Raises:
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    run, model_path = _with_open_clock(run, metric), run.survey.images.model
    is_refined = model_path is not None and is_refined_model(model_path)
    with at_most(run.survey.mapper.num_threads):
        return _finished(run, metric, refine(_problem(run, metric, is_refined=is_refined)))


def refine_closed_map(
    run: SurveyRun, metric: MetricResult, loops: Sequence[Loop], merge_tracks: Callable[[pycolmap.Reconstruction], None]
) -> MetricResult | None:
    """Close the loops of a refined map, and refine it again; None if they are closed in it.

    Args:
        metric: with the refined map. loops, merge_tracks: as for ``refine_with_loops``.

    Raises:
        SolverError: as for ``refine_map``.
    """
    run = _with_open_clock(run, metric)
    assert metric.kept is not None, "a refined map"
    with at_most(run.survey.mapper.num_threads):
        rest = refine_with_loops(_problem(run, metric, is_refined=True), metric.kept.kinds, loops, merge_tracks)
        return None if rest is None else _finished(run, metric, rest)


def _with_open_clock(run: SurveyRun, metric: MetricResult) -> SurveyRun:
    """Return the survey with the time offset to be estimated where it is not certain."""
    offset = metric.path.time_offset
    if offset.is_certain or run.survey.refine.time_offset_stddev_s:
        return run
    return run.changed({"refine.time_offset_stddev_s": offset.stddev_s})


def _problem(run: SurveyRun, metric: MetricResult, *, is_refined: bool) -> MapProblem:
    """Return the problem of a copy of the map and all that was measured of it."""
    survey, path, model = run.survey, metric.trajectory, pycolmap.Reconstruction(metric.final)
    estimate = metric.estimate.with_anchors(metric.anchors)
    return map_problem(
        model,
        measured_in_map(metric.inputs, survey, estimate, path, model),
        path,
        camera=survey.camera,
        options=survey.refine,
        first_pose_is_fixed=estimate.frame != "site",
        is_refined=is_refined,
        num_threads=survey.mapper.num_threads,
    )


def _finished(run: SurveyRun, metric: MetricResult, rest: MapAtRest) -> MetricResult:
    """Learn the errors at a map at rest, and return it as a result at its best estimate with its covariance."""
    options, on_map = run.survey.refine, metric.estimate.on_map
    if on_map.kinds:  # else nothing is known of the scale's error
        on_map = _measured_at_rest(run, metric, rest)
        if options.time_offset_stddev_s:
            on_map = on_map.without_clocks()
        on_map = on_map.concluded()
    covariance = UNKNOWN_ERRORS
    if options.covariance:
        anchor_ids = metric.observations.log.anchor_ids
        covariance = errors_at_estimate(on_map, rest, anchor_ids) if on_map.is_at_rest else joint_errors(rest, 1.0)
        if not covariance.are_known:
            run.journal.warn(
                "no covariance of the poses: too many keyframes, or photos and ranges do not determine all poses"
            )
    model, path = rest.problem.metric, metric.trajectory
    model.update_point_3d_errors()
    summary = summarize(rest, covariance)
    broken = why_broken(metric.scaled, model, path, metric.estimate, summary, options.range_loss_scale)
    if broken and not point_errors(metric.scaled).fit:
        raise SolverError(
            f"the refinement broke the map: {'; '.join(broken)}; nor do the points of the model before it fit the "
            "photos: check that model, photos and camera parameters belong together (rangesfm scale gives the path "
            "alone)"
        )
    if not on_map.is_at_rest:
        scale = align_points(path.centers, path.as_in(model).centers).scale
    elif broken:
        scale = on_map.metres_per_unit
    else:
        scale, (model, state) = on_map.scale.value, _at_estimate(on_map, rest, path)
        summary = replace(summary, ranges=refined_ranges(rest, state, covariance, on_map.estimate))
    refined = RefinedMap(
        **vars(summary), model=model, kinds=rest.problem.kinds, on_map=on_map, scale=scale, why_broken=broken
    )
    return replace(metric, refined=refined)


def _at_estimate(at_rest: JointMap, rest: MapAtRest, unscaled: Trajectory) -> tuple[pycolmap.Reconstruction, MapState]:
    """Return a map bent and moved as a whole to its best estimate (section 6), and its state.

    Args:
        unscaled: path of the unscaled model.
    """
    bent, model = likely_bend(at_rest, unscaled), pycolmap.Reconstruction(rest.problem.metric)
    if len(bent.frame_ids):
        bend(model, bent)
    model, blocks = rescale(model, at_rest.estimate), {**rest.state.blocks}
    for each in at_rest.kinds:
        blocks.update(each.moved(at_rest.posterior, bent).blocks)
    return model, MapState(model_poses(model, rest.problem.frame_ids), blocks)


def with_anchors_on_likelier_sides(run: SurveyRun, start: MetricResult, metric: MetricResult) -> MetricResult:
    """Return a refined map, refined again if the ranges say that an unknown anchor is on the other side of the path.

    If that breaks the map, the first refinement stays.

    Args:
        start: the scaled map. metric: the same, refined.
    """
    if metric.kept is None:
        return metric
    estimate, refined, at = start.estimate, metric.kept, metric.kept.on_map
    for sides in (sides for each in at.kinds for sides in each.sides(at)):
        estimate = estimate.with_anchors(sides.applied_to(estimate.ranges.anchors))
        if sides.has_crossed:
            again = refine_map(run, replace(start, estimate=estimate))
            return metric if again.kept is None else again
        refined = refined.with_anchors(sides.moved(at.estimate).applied_to(refined.ranges.anchors))
    return replace(metric, estimate=estimate, refined=refined)


def _bending_at_rest(rest: MapAtRest, path: Trajectory, is_firm: Mask) -> MapBending:
    if rest.equations is not None:
        with contextlib.suppress(GeometryError):  # the photos do not determine the map up to a similarity
            photos = PhotosAlone(rest.equations, rest.pixel_stddev_at_rest)
            return PhotoBending(photos, path, parts_of_path(path, rest.parts), is_firm, is_at_optimum=False)
    return WalkBending(path)


def _measured_at_rest(run: SurveyRun, metric: MetricResult, rest: MapAtRest) -> JointMap:
    """Return a map at rest with all that is measured in it."""
    of_largest = np.isin(metric.trajectory.frame_ids, rest.parts[0])
    bending = _bending_at_rest(rest, metric.trajectory.as_in(rest.problem.metric), of_largest)
    found = _measured_in(run, metric, rest, bending, of_largest)
    of_firm = bending_of_firm_parts(found)
    return found if of_firm is None else _measured_in(run, metric, rest, of_firm, of_firm.is_firm)


def _measured_in(run: SurveyRun, metric: MetricResult, rest: MapAtRest, bending: MapBending, is_firm: Mask) -> JointMap:
    """Return a map at rest with all that is measured in it; ``is_firm``: (k,) poses of the path that are its size."""
    before = metric.estimate.on_map.kinds
    scale = align_points(metric.trajectory.centers[is_firm], bending.path.centers[is_firm]).scale
    of_model = MapOfPhotos(rest.problem.metric, bending, run.survey, metric.observations, scale, before, rest)
    located, _ = kinds_in_map(metric.inputs, of_model)
    others = tested_kinds(
        [each for each in located if isinstance(each, KindOnMap)], IDENTITY, MAX_NUM_OBSERVATIONS, is_last=True
    )
    joined = join_kinds(beside_others(located, others), IDENTITY, bending, is_at_rest=True)
    return replace(joined, metres_per_unit=scale)
