"""Making of the metric map from unscaled models and ranges by the options of a survey: scale, refinement, judgement."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import LoosePiece, frames_of_largest_part, loose_pieces
from rangesfm.colmap.reprojection import point_errors
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.finished_map import (
    doubts_of_map,
    doubts_of_pieces,
    place_of_map,
    why_broken,
)
from rangesfm.diagnostics.lens import doubt_of_lens, fit_lens
from rangesfm.diagnostics.point_tests import Placed, diagnose_points
from rangesfm.errors import GeometryError, SolverError
from rangesfm.estimation.drift import bend
from rangesfm.estimation.map_problem import MapProblem, map_problem
from rangesfm.estimation.photo_bending import PhotoBending, bending_of_model, by_photos, likely_bend
from rangesfm.estimation.refinement import MapAtRest, joint_errors, refine, refine_with_loops
from rangesfm.estimation.scale.bent_estimate import estimate_by_bent
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.scale.scale_verdict import refuse_unknown
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.estimation.with_ranges import summarize
from rangesfm.measurements.joint_map import (
    Doubt,
    JointMap,
    KindOnMap,
    beside_others,
    find_kind,
    join_kinds,
    tested_kinds,
    upward_by,
)
from rangesfm.measurements.kind import MapState
from rangesfm.measurements.lengths.length_scale import LengthScale
from rangesfm.measurements.lengths.locate_lengths import surveyed_distances
from rangesfm.measurements.positions.clock import POSITIONS
from rangesfm.measurements.positions.position_scale import PositionScale
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.clock.offset import TimeOffset
from rangesfm.measurements.ranges.clock.time_offset import REMEDY
from rangesfm.measurements.ranges.cost import Ranges
from rangesfm.measurements.ranges.errors.components import CLOCKS
from rangesfm.measurements.ranges.mistakes.anchor_sides import likelier_sides
from rangesfm.measurements.ranges.mistakes.bent_path import bends_m, bent_to_ranges
from rangesfm.measurements.ranges.mistakes.diagnosis import Diagnosis, causes_in_words, diagnose_ranges
from rangesfm.measurements.ranges.mistakes.linearized import RangesOnMap, ranges_on_map
from rangesfm.measurements.ranges.radio import RadioLog, ranges_of_map
from rangesfm.measurements.ranges.scale.binned_ranges import RANGES
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.source import Measured
from rangesfm.pipeline.close_loops import RefinedMap, close_loops_of_survey
from rangesfm.pipeline.join_models import ModelVerdict, join_models
from rangesfm.pipeline.metric_result import MetricResult, Rivals
from rangesfm.result.result_folder import is_refined_model
from rangesfm.solver.bending import FrameSteps, MapBending, WalkBending
from rangesfm.solver.mistakes import MistakeTests
from rangesfm.solver.posterior import MAX_NUM_OBSERVATIONS
from rangesfm.survey.kinds_in_map import MapOfPhotos, kinds_in_map, sources_in_map
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.gravity import gravity_of
from rangesfm.util.geometry.numerics import NORMAL_95, NOTHING_KNOWN
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.similarity import IDENTITY, align_points
from rangesfm.util.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.util.processes.threads import at_most

# Two likely time offsets whose scales differ by more than this fraction leave the scale undetermined, ...
_MAX_SPREAD = 0.03
# ... unless all offsets with such different scales together have a probability of at most this.
_HARDLY_LIKELY = 0.05
_ANY_STDDEV = 1e3  # a relative stddev of the scale that never leads to a refusal


def join_by_survey(
    run: SurveyRun, paths: Sequence[PathOfModel], *, must_join: bool
) -> tuple[PathOfModel, tuple[ModelVerdict, ...]]:
    """Join the models to the first one; models that cannot be joined are left out with a warning.

    Args:
        run: survey of the models.
        paths: models with the ranges on their paths.
        must_join: whether it is an error if no other model can be joined.

    Returns:
        The joined model, and the verdicts on all models (none where there is only one).

    Raises:
        GeometryError: no other model can be joined, and ``must_join`` is true.
    """
    if len(paths) == 1:
        return paths[0], ()
    joined = join_models(run, paths)
    left_out = [model for model in joined.verdicts if model.joined_from_sfm is None]
    if must_join and len(left_out) == len(paths) - 1:
        reasons = "; ".join(f"{model.name}: {model.reason}" for model in left_out)
        raise GeometryError(f"nothing can be joined to {paths[0].name}: {reasons}")
    whose = (f"{model.name} ({model.num_images} photos) is left out: {model.reason}" for model in left_out)
    run.journal.warn(*joined.notes, *whose)
    return joined.path, joined.verdicts


def metric_map(run: SurveyRun, path: PathOfModel, *, refine: bool) -> MetricResult:
    """Scale a map, refine it if asked for, and judge the final map.

    Raises:
        GeometryError: the scale is not determined, or is less certain than asked for.
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    pieces = _pieces_not_held(run, path)
    with run.journal.stage("scale"):
        metric = scale_by_survey(run, path, is_a_start=refine)
    if refine:
        with run.journal.stage("refinement"):
            refined = _with_anchors_on_likelier_sides(run, metric, refine_map(run, metric))
        metric = close_loops_of_survey(run, refined, refine_closed_map)
        if pieces and metric.loops is not None and metric.loops.closed:  # loops hold pieces that neighbours do not
            pieces = _pieces_not_held(
                run, replace(path, sfm=metric.final, trajectory=path.trajectory.as_in(metric.final))
            )
    of_pieces = doubts_of_pieces(pieces, path.sfm.num_reg_images())
    run.journal.warn(*(doubt.reason for doubt in of_pieces))
    with run.journal.stage("judgement"):
        return judge_map(run, metric, of_pieces)


def _pieces_not_held(run: SurveyRun, path: PathOfModel) -> tuple[LoosePiece, ...]:
    """Return the parts of a model that share few points with the rest, which do not determine their scale."""
    pieces = loose_pieces(path.sfm)
    bending = bending_by_survey(run.survey, path) if pieces else None
    if not isinstance(bending, PhotoBending):  # the photos determine nothing, or are too many to tell
        return pieces
    return tuple(piece for piece in pieces if not bending.hold_together(piece.image_names))


def scale_by_survey(run: SurveyRun, path: PathOfModel, *, is_a_start: bool) -> MetricResult:
    """Estimate the scale and return the rescaled map.

    Args:
        run: the survey.
        path: model with the ranges on its path.
        is_a_start: whether a refinement follows. Then the refined map is judged, and not this one.

    Raises:
        GeometryError: the scale is not determined.
    """
    survey, inputs, offset = run.survey, run.inputs, path.time_offset
    if offset is not None and offset.offset_matters:
        path = replace(path, observations=replace(path.observations, time_offset_stddev_s=offset.stddev_s))
    # Which control points and lengths contradict the others depends on how far the photos let the map drift.
    is_judged = not is_a_start or inputs.positions.are_known or len(inputs.tape.control().distances) > 0
    bending = bending_by_survey(survey, path) if is_judged else None
    limit = max(survey.scale.max_relative_stddev, NOTHING_KNOWN)  # a refinement can start from less certain scales
    try:
        estimate = run.changed({"scale.max_relative_stddev": limit}).estimate_scale(path, bending)
    except GeometryError as error:
        if doubts := "; ".join(inputs.positions.doubts_of_clock()):
            raise GeometryError(f"{error}; {doubts}") from None
        raise _refused_with_cause(error, run, path) from None
    on_map = None
    if not is_a_start and (on_map := _ranges_on_scaled(estimate, bending)) is not None:
        sides = likelier_sides(on_map)
        on_map, estimate = sides.on_map, estimate_by_bent(estimate, sides.on_map, survey.scale)
        estimate = estimate.with_anchors(sides.applied_to(estimate.anchors))
    rivals = _by_rivals(run, path, estimate)
    scaled = rescale(path.sfm, estimate.metric_from_sfm)
    ranges = _ranges(run, path.trajectory, estimate, estimate.anchors)
    predicted = ranges.predicted_m(MapState(model_poses(scaled, path.trajectory.frame_ids), ranges.blocks))
    weights = estimate.errors.robust_weights(predicted - inputs.log.range_m)
    offset_s = offset.value_s if offset is not None else survey.ranges.time_offset_s
    lengths, positions = estimate.find(LengthScale), estimate.find(PositionScale)
    tape = inputs.tape.without([*(() if lengths is None else lengths.left_out)])
    known = inputs.positions.without(() if positions is None else positions.names_left_out)
    return MetricResult(
        path.trajectory, offset, offset_s, estimate, scaled, predicted, weights, tape=tape, positions=known,
        rivals=rivals, on_map=on_map,
    )  # fmt: skip


def bending_by_survey(survey: Survey, path: PathOfModel) -> MapBending:
    """Return how an unscaled model may be bent: by the bundle adjustment of its photos, or as a path without points."""
    return bending_of_model(path.sfm, path.trajectory, survey.camera, survey.refine, survey.mapper.num_threads)


def _refused_with_cause(error: GeometryError, run: SurveyRun, path: PathOfModel) -> GeometryError:
    """Return the refusal, with the likeliest mistake added if the ranges show one on a map with any uncertainty."""
    lenient, bending = run.changed({"scale.max_relative_stddev": _ANY_STDDEV}), bending_by_survey(run.survey, path)
    try:
        estimate = lenient.estimate_scale(path, bending)
    except (GeometryError, np.linalg.LinAlgError):
        return error
    return _with_cause(error, run.survey, _ranges_on_scaled(estimate, bending))


def _with_cause(error: GeometryError, survey: Survey, on_map: RangesOnMap | None) -> GeometryError:
    try:
        diagnosis = _diagnose(survey, on_map)
    except np.linalg.LinAlgError:
        return error
    return (
        GeometryError(f"{error}; {causes_in_words(diagnosis.causes)}")
        if diagnosis is not None and diagnosis.causes
        else error
    )


def _ranges_on_scaled(estimate: ScaleEstimate, bending: MapBending | None) -> RangesOnMap | None:
    """Return the ranges on the scaled map; a path without points is bent to the ranges. None without ranges."""
    if (ranges := estimate.find(RangeScale)) is None:
        return None
    bending = bending or WalkBending(in_first_camera(ranges.posed.trajectory))
    return bent_to_ranges(ranges_on_map(ranges.posed, ranges.solution, bending), ranges.solution.rivals)


def _diagnose(survey: Survey, on_map: RangesOnMap | None) -> Diagnosis | None:
    return None if on_map is None else diagnose_ranges(on_map, seed=survey.output.seed)


def _by_rivals(run: SurveyRun, path: PathOfModel, estimate: ScaleEstimate) -> Rivals | None:
    """Return what other likely time offsets of ranges or positions would change; None without any."""
    found, offset, track = [], path.time_offset, run.inputs.positions.antenna

    def at_ranges_offset(other: TimeOffset) -> ScaleEstimate:
        timestamp_s = run.inputs.log.timestamp_s
        assert timestamp_s is not None, "clocks belong to a log with times"
        return run.estimate_scale(replace(path, observations=run.ranges_on(path.trajectory, other.at(timestamp_s))))

    def at_positions_offset(other: TimeOffset) -> ScaleEstimate:
        antenna = track and replace(track, offset_s=other.value_s)
        positions = replace(run.inputs.positions, antenna=antenna)
        return replace(run, inputs=replace(run.inputs, positions=positions)).estimate_scale(path)

    if offset is not None and offset.rivals:
        found.append(scale_by_rivals(estimate, path.trajectory, offset, at_ranges_offset, "", REMEDY))
    if track is not None and track.search is not None and track.search.rivals:
        found.append(
            scale_by_rivals(
                estimate, path.trajectory, track.search, at_positions_offset, " of the positions", POSITIONS.remedy
            )
        )
    return (
        Rivals(sum((each.doubts for each in found), ()), math.hypot(*(each.stddev for each in found)))
        if found
        else None
    )


def scale_by_rivals(
    estimate: ScaleEstimate,
    path: Trajectory,
    offset: TimeOffset,
    estimate_at: Callable[[TimeOffset], ScaleEstimate],
    whose: str,
    remedy: str,
) -> Rivals:
    """Estimate the scale for every other likely time offset.

    Args:
        estimate: at this offset. path: of the unscaled model.
        offset: of the clocks, with its rivals.
        estimate_at: returns the estimate at another offset, or raises GeometryError.
        whose: the offset is, in words. remedy: what the user can do.

    Returns:
        Doubts in words, and the relative stddev of the scale that comes from the choice among the offsets: the larger
        of their stddev by their probabilities, and that whose 95 % interval holds the scales of all. Offsets with very
        different scales are left out of it; they are hardly likely, or there is an error.

    Raises:
        GeometryError: a very different scale follows from other offsets, and they are not unlikely.
    """
    doubts, far_apart = [], []
    far_probability, variance, farthest = 0.0, 0.0, 0.0
    for rival in offset.rivals:
        said = f"{rival.value_s:+.2f} s ({rival.probability:.0%})"
        try:
            other = estimate_at(offset.of_rival(rival))
        except GeometryError:
            doubts.append(f"the time offset{whose} may also be {said}, which gives no scale")
            continue
        change = other.value / estimate.value - 1
        doubt = f"the time offset{whose} may also be {said}, which gives a scale of {other.value:.6g} ({change:+.1%})"
        if "site" == estimate.frame == other.frame:
            apart_m = other.metric_from_sfm.apply(path.centers) - estimate.metric_from_sfm.apply(path.centers)
            doubt += f" and puts photos up to {np.linalg.norm(apart_m, axis=1).max():.2g} m elsewhere"
        doubts.append(doubt)
        if abs(change) > _MAX_SPREAD:
            far_apart.append(f"{said} gives {other.value:.6g} ({change:+.1%})")
            far_probability += rival.probability
        else:
            apart = abs(float(np.log1p(change)))
            variance, farthest = variance + rival.probability * apart**2, max(farthest, apart)
    if far_probability > _HARDLY_LIKELY:
        raise GeometryError(
            f"the motion does not determine the time offset{whose}, nor the scale that depends on it: "
            f"{offset.value_s:+.2f} s ({offset.probability:.0%}) gives {estimate.value:.6g} m per unit, "
            f"{', '.join(far_apart)}: {remedy}"
        )
    return Rivals(tuple(doubts), max(float(np.sqrt(variance)), farthest / NORMAL_95))


def refine_map(run: SurveyRun, metric: MetricResult) -> RefinedMap:
    """Refine a scaled map with all that was measured. Where that breaks the map, the scaled map stays the result.

    Raises:
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    run = _with_open_clock(run, metric)
    measured = _measured(run, metric)
    with at_most(run.survey.mapper.num_threads):
        problem = _problem(run, metric, measured, metric.scaled, is_refined=is_refined_model(run.survey.images.model))
        return _finished(run, metric, refine(problem, measured.markers))


def refine_closed_map(
    run: SurveyRun, refined: RefinedMap, loops: LoopPoses, merge_tracks: Callable[[pycolmap.Reconstruction], None]
) -> RefinedMap:
    """Close the loops of a refined map, and refine it again.

    Args:
        loops: measured relative poses, by ids of frames. merge_tracks: makes one of points that two passes saw apart,
            in place.

    Raises:
        SolverError: as for ``refine_map``.
    """
    metric, run = refined.metric, _with_open_clock(run, refined.metric)
    measured = _measured(run, metric)
    with at_most(run.survey.mapper.num_threads):
        problem = _problem(run, metric, measured, metric.final, is_refined=True)
        known = problem.like(refined.at_rest.problem)
        rest = refine_with_loops(problem, known, measured.markers, loops, merge_tracks)
        return _finished(run, metric, rest)


def _with_open_clock(run: SurveyRun, metric: MetricResult) -> SurveyRun:
    """Return the survey with the time offset to be estimated where it is not certain."""
    offset = metric.time_offset
    if offset is None or offset.is_certain or run.survey.refine.time_offset_stddev_s:
        return run
    return run.changed({"refine.time_offset_stddev_s": offset.stddev_s})


def _measured(run: SurveyRun, metric: MetricResult) -> Measured:
    """Return all that was measured of a scaled map."""
    estimate, inputs, tape = metric.estimate, run.inputs, metric.tape
    if inputs.anchor_frame == "site" and estimate.frame != "site":
        # Too few anchors are surveyed to place the map in the site, but the distances between them are known.
        tape = tape.with_more(surveyed_distances(inputs.anchors))
    kinds = () if estimate.on_map is None else estimate.on_map.kinds
    gravity = upward_by(kinds, gravity_of(run.survey.scale.up_in_first_camera)) if estimate.frame == "site" else None
    return Measured((RadioLog(_given_ranges(run, metric)), *sources_in_map(tape, estimate.on_map, gravity)))


def _given_ranges(run: SurveyRun, metric: MetricResult) -> Ranges:
    """Return the ranges of a scaled map, with the errors that all other measurements may correct."""
    estimate = metric.estimate
    ranges = _ranges(run, metric.trajectory, estimate, metric.anchors)
    return replace(ranges, shared_errors_m=estimate.ranges.shared_errors_m)


def _ranges(run: SurveyRun, path: Trajectory, estimate: ScaleEstimate, anchors: Sequence[AnchorEstimate]) -> Ranges:
    return ranges_of_map(
        path,
        estimate.observations,
        estimate.metric_from_sfm,
        run.inputs.tag_in_cam_m,
        anchors,
        estimate.errors,
        run.survey.refine,
    )


def _problem(
    run: SurveyRun, metric: MetricResult, measured: Measured, model: pycolmap.Reconstruction, *, is_refined: bool
) -> MapProblem:
    survey = run.survey
    return map_problem(
        pycolmap.Reconstruction(model),
        measured,
        metric.trajectory,
        camera=survey.camera,
        options=survey.refine,
        first_pose_is_fixed=metric.estimate.frame != "site",
        is_refined=is_refined,
        num_threads=survey.mapper.num_threads,
    )


def _finished(run: SurveyRun, metric: MetricResult, rest: MapAtRest) -> RefinedMap:
    """Learn the errors at a map at rest, and return it as a result with its covariance."""
    survey, estimate = run.survey, metric.estimate
    at, factor = _measured_at_rest(run, metric, rest), 1.0
    if at is not None:
        if survey.refine.time_offset_stddev_s and at.find(RangeScale) is not None:
            at = at.without(RANGES, CLOCKS)
        factor = at.problem.bending_factor
        at = at.concluded()
        for kind in at.kinds:
            rest = rest.with_learnt(kind.learnt_errors(at))
    covariance = None
    if survey.refine.covariance:
        # Measurements too coarse to see any bending do not make it smaller than the noise of the features does.
        covariance = joint_errors(rest, max(factor, 1.0))
        if covariance is None:
            run.journal.warn(
                "no covariance of the poses: too many keyframes, or photos and ranges do not determine all poses"
            )
    refined = rest.problem.metric
    refined.update_point_3d_errors()
    summary = summarize(rest, _given_ranges(run, metric), covariance, factor)
    broken = why_broken(metric.scaled, refined, metric.trajectory, estimate, summary, survey.refine.range_loss_scale)
    if broken and not point_errors(metric.scaled).fit:
        raise SolverError(
            f"the refinement broke the map: {'; '.join(broken)}; nor do the points of the model before it fit the "
            "photos: check that model, photos and camera parameters belong together (rangesfm scale gives the path "
            "alone)"
        )
    return RefinedMap(
        replace(
            metric,
            refined=refined,
            refinement=summary,
            why_broken=broken,
            at_refined=at,
        ),
        rest,
    )


def _with_anchors_on_likelier_sides(run: SurveyRun, start: MetricResult, refined: RefinedMap) -> RefinedMap:
    """Return the refined map, refined again if the ranges say that an unknown anchor is on the other side of the path.

    If that breaks the map, the first refinement stays.

    Args:
        start: the scaled map.
    """
    metric = refined.metric
    at = None if metric.kept_refinement is None else metric.find(RangeScale)
    if at is None or metric.kept_refinement is None:
        return refined
    sides = likelier_sides(ranges_on_map(at.posed, at.solution, at.bending))
    estimate = start.estimate.with_anchors(sides.applied_to(start.estimate.anchors))
    if sides.has_crossed:
        again = refine_map(run, replace(start, estimate=estimate))
        return refined if again.metric.kept_refinement is None else again
    refinement = replace(metric.kept_refinement, anchors=sides.applied_to(metric.kept_refinement.anchors))
    return replace(refined, metric=replace(metric, estimate=estimate, refinement=refinement))


def _bending_at_rest(rest: MapAtRest, path: Trajectory, metres_per_unit: float) -> MapBending:
    """Return the bending of a refined map; ``metres_per_unit``: of the model to which the measurements refer."""
    if rest.equations is not None:
        try:
            return by_photos(
                rest.equations, rest.pixel_stddev_at_rest, path, metres_per_unit, rest.firm_ids, is_at_optimum=False
            )
        except GeometryError:
            pass
    return WalkBending(in_first_camera(path, metres_per_unit))


def _metres_per_unit(unscaled: Trajectory, path: Trajectory, firm_ids: Indices) -> float:
    """Return the scale of the similarity that fits the centres of the firm frames of two paths best."""
    is_firm = np.isin(path.frame_ids, firm_ids)
    return align_points(unscaled.centers[is_firm], path.centers[is_firm]).scale


def _measured_at_rest(run: SurveyRun, metric: MetricResult, rest: MapAtRest) -> JointMap | None:
    """Return a map at rest with all that is measured in it; None where nothing is known of the scale's error."""
    start, model = metric.estimate.on_map, rest.problem.metric
    if start is None:
        return None
    path = metric.trajectory.as_in(model)
    scale = _metres_per_unit(metric.trajectory, path, rest.firm_ids)
    bending = _bending_at_rest(rest, path, scale)
    inputs = replace(run.inputs, tape=metric.tape, positions=metric.positions)
    of_model = MapOfPhotos(model, path, bending, run.survey, metric.observations, scale, start.kinds, rest)
    located, _ = kinds_in_map(inputs, of_model)
    others = tested_kinds(
        [each for each in located if isinstance(each, KindOnMap)], IDENTITY, MAX_NUM_OBSERVATIONS, is_last=True
    )
    joined = join_kinds(beside_others(located, others), path, IDENTITY, bending, is_at_rest=True)
    return replace(joined, metres_per_unit=scale)


def judge_map(run: SurveyRun, metric: MetricResult, known_doubts: Sequence[Doubt]) -> MetricResult:
    """Judge the final map: add the final estimate of the scale, the tests of mistakes, all doubts and the place.

    The doubts also go to the journal as warnings, except for those that were known before.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    survey, journal = run.survey, run.journal
    metric, on_map = _estimated(survey, metric)
    path = metric.trajectory.as_in(metric.final)
    bent_by_m = np.zeros(0) if on_map is None else bends_m(on_map)
    place_is_tested, others = _tested_without_ranges(metric, path.centers, bent_by_m)
    diagnosis, of_place = Diagnosis(), tuple(reason for each in place_is_tested for reason in each.reasons)
    try:
        if (of_ranges := _diagnose(survey, on_map)) is not None:
            diagnosis = of_ranges
            if any(cause.correction.anchors_m for cause in of_ranges.causes):  # the anchors are elsewhere
                of_place = (causes_in_words(of_ranges.causes), *of_place)
    except np.linalg.LinAlgError as error:
        journal.warn(f"mistakes were not tested, because the ranges determine too little: {error}")
    for tested in (*place_is_tested, *others):
        diagnosis = diagnosis.with_more(tested)
    journal.warn(*(metric.estimate.reasons if metric.estimate.verdict != "good" else ()), *diagnosis.reasons)
    by_rivals = () if metric.rivals is None else metric.rivals.doubts
    doubts: list[Doubt] = []
    if metric.why_broken:
        reason = f"the refinement broke the map, so the scaled map is the result: {'; '.join(metric.why_broken)}"
        doubts.append(Doubt(reason, "check the model's points and cameras, clocks, lever arm and anchors"))
    doubts += doubts_of_map(metric.kept_refinement, point_errors(metric.final))
    advice = "let the offset be searched for ([positions] time_offset)"
    doubts += [Doubt(reason, advice) for reason in metric.positions.doubts_of_clock()]
    of_lens = _doubts_of_lens(metric)
    of_clocks = (*metric.positions.doubts_of_found_clock(), *by_rivals)
    journal.warn(*(doubt.reason for doubt in (*of_lens, *doubts)), *of_clocks)
    doubts += known_doubts
    against = (*(doubt.reason for doubt in of_lens), *of_place, *of_clocks, *(doubt.reason for doubt in doubts))
    place = place_of_map(metric.estimate, metric.kept_refinement, path, against, bent_by_m)
    judged = replace(metric, place=place, diagnosis=diagnosis).doubted(by_rivals)
    judged = judged.doubted([doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts])
    # A lens that does not fit comes first, because it may look like other mistakes.
    judged = judged.doubted(diagnosis.reasons)
    return judged.doubted([doubt.reason for doubt in of_lens], [doubt.advice for doubt in of_lens])


def _doubts_of_lens(metric: MetricResult) -> tuple[Doubt, ...]:
    """Return a doubt if the photos fit far better with another camera model, and lengths change with it."""
    if not metric.final.num_points3D():
        return ()
    estimate, refinement = metric.estimate, metric.kept_refinement
    is_learnt = metric.find(RangeScale) is not None or metric.find(PositionScale) is not None
    factor = refinement.bending_factor if refinement is not None and is_learnt else None
    doubt = doubt_of_lens(fit_lens(metric.final), factor, estimate.uncertainty.half_width_95)
    return () if doubt is None else (doubt,)


def _tested_without_ranges(
    metric: MetricResult, centers_m: Array, bent_by_m: Array
) -> tuple[list[MistakeTests], list[MistakeTests]]:
    """Return the tests of other kinds than ranges: of those that place the map, and of the others.

    Points are tested against a map that ranges hold, too.

    Args:
        centers_m: (n, 3) keyframe centres in the final map. bent_by_m: (n,) as for ``place_of_map``.
    """
    estimate, on_map = metric.estimate, metric.all_measured
    if on_map is None:
        return [], []
    kinds = [each for each in on_map.kinds if not isinstance(each, RangeScale)]
    placing, others = ([each for each in kinds if each.places_map is does] for does in (True, False))
    of_place = [each.tests(on_map, estimate.by_kind) for each in placing]
    if len(kinds) < len(on_map.kinds) and estimate.placement is not None:
        positions = on_map.find(PositionScale)
        by_antenna = positions is not None and not positions.known.is_mark.all()
        placed = Placed(estimate.placement, centers_m[0], float(bent_by_m.max(initial=0.0)), by_antenna=by_antenna)
        stddev = estimate.uncertainty.empirical
        of_place.append(diagnose_points(metric.positions.points, metric.final, metric.map_errors, stddev, placed))
    return of_place, [each.tests(on_map, estimate.by_kind) for each in others]


def _moved(metric: MetricResult, at: JointMap) -> MetricResult:
    """Return the result with the refined map bent and moved as a whole to its best estimate."""
    bent = _likely_bend(metric, at)
    refinement, before, after = metric.kept_refinement, at.find(RangeScale), find_kind(at.moved(bent), RangeScale)
    assert metric.refined is not None, "a refined map"
    if before is not None and after is not None and refinement is not None:
        longer_m, state = after.predicted_m - before.predicted_m, after.solution.fit.state
        refinement = refinement.moved(at.estimate, state.anchors_m, after.posed.rows, longer_m)
    refined = pycolmap.Reconstruction(metric.refined)
    if len(bent.frame_ids):
        bend(refined, bent)
    return replace(metric, refined=rescale(refined, at.estimate), refinement=refinement)


def _likely_bend(metric: MetricResult, at: JointMap) -> FrameSteps:
    """Return the steps of ``likely_bend`` with the scale of the similarity to the unscaled model left as it is."""
    assert metric.refined is not None, "a refined map"
    bent, path, unscaled = likely_bend(at), at.path, metric.trajectory
    if not len(bent.frame_ids):
        return bent
    bent_m, centers_m = path.centers + bent.at(path.frame_ids)[1], model_poses(metric.refined, bent.frame_ids).centers
    scale = _metres_per_unit(unscaled, replace(path, centers=bent_m), frames_of_largest_part(metric.refined))
    first_m, size = path.centers[0], at.metres_per_unit / scale
    return bent._replace(shifts_m=first_m + size * (centers_m + bent.shifts_m - first_m) - centers_m)


def _estimated(survey: Survey, metric: MetricResult) -> tuple[MetricResult, RangesOnMap | None]:
    """Return the result with the estimate of the final map's scale, and the ranges on the map before it is moved to it.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    start, at = metric.estimate, metric.at_refined
    ranges = None if at is None or metric.kept_refinement is None else at.find(RangeScale)
    if ranges is not None:
        on_map: RangesOnMap | None = ranges_on_map(ranges.posed, ranges.solution, ranges.bending)
    else:
        on_map = metric.on_map or _ranges_on_scaled(start, None)
    try:
        if at is not None and metric.kept_refinement is not None:
            estimate, metric = start.at_rest(at, survey.scale), _moved(metric, at)
        else:
            if start.method != "two-candidate":  # which has no interval
                refuse_unknown(start.uncertainty.half_width_95, start.reasons, start.advice, survey.scale)
            estimate = replace(start, refined_value=None if metric.kept_refinement is None else metric.refined_scale)
    except GeometryError as error:
        raise _with_cause(error, survey, on_map) from None
    if metric.rivals is not None:
        estimate = replace(estimate, uncertainty=estimate.uncertainty.beside(CLOCKS, metric.rivals.stddev))
    return replace(metric, estimate=estimate), on_map
