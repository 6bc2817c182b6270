"""Scale initialisation: metres per SfM unit, and their uncertainty, from ranges and an unscaled path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.processes.threads import both, with_one_blas_thread
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.errors.bending import MapBending, WalkBending
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus, status_by_weight
from rangesfm.scale.anchor_by_anchor import anchor_estimates, scale_per_anchor
from rangesfm.scale.range_equation import RangeProblem, solve
from rangesfm.scale.scale_by_kind import ScaleByKind
from rangesfm.scale.scale_by_lengths import LengthScale, scale_by_lengths
from rangesfm.scale.scale_by_positions import PositionScale, scale_by_positions
from rangesfm.scale.scale_estimate import ScaleEstimate, ScaleSensitivity, ScaleUncertainty
from rangesfm.scale.scale_problem import ScaleProblem, first_camera_from, scale_problem
from rangesfm.scale.scale_verdict import judge, judge_lengths, judge_positions, levelled_places
from rangesfm.scale.sensitivity import scale_sensitivity
from rangesfm.scale.solution import OpenPlaceError, Solution, solution_from, solve_scale
from rangesfm.scale.two_candidate import TwoCandidate, two_candidate
from rangesfm.scale.uncertainty import known_map, learned_errors, parameter_covariance, shared_errors_m

# Smallest factor on the weights of ranges beside other measurements, below which they would have no effect.
_LEAST_SHARE = 1e-4


@with_one_blas_thread
def initialize_scale(
    observations: RangeObservations,
    trajectory: Trajectory,
    anchors: Sequence[Anchor],
    *,
    anchor_frame: str,
    options: ScaleOptions | None = None,
    range_model: RangeModelOptions | None = None,
    distances: LocatedDistances | None = None,
    positions: KnownPositions | None = None,
    lasting_s: Sequence[float] = LASTING_S,
    bending: MapBending | None = None,
    seed: int = 0,
) -> ScaleEstimate:
    """Estimate scale and frame of an unscaled path from ranges, measured lengths, known positions, or several of them.

    Args:
        observations: ranges on ``trajectory``; may be empty if there are measured lengths.
        trajectory: the unscaled path.
        anchors: every anchor of the log, with its prior knowledge.
        anchor_frame: "site" (positions in a site frame: the map is carried there), "first_camera" (positions in the
            first keyframe's camera frame, metres) or "unknown" (positions are ignored; the map stays in the first
            camera's frame).
        distances: measured ones, located in the model of ``trajectory``; those that are only checks are not used.
        positions: known in the site and located in the model of ``trajectory``.
        lasting_s: for how long errors of an antenna's positions last.
        bending: how the map is bent; None: it drifts as a map of poses does.

    Raises:
        InputError: an anchor of the log is not among ``anchors``.
        GeometryError: the scale is not determined.
    """
    options, range_model = options or ScaleOptions(), range_model or RangeModelOptions()
    bending = bending or WalkBending(in_first_camera(trajectory))
    by_positions, remarks = None, tuple[str, ...]()
    try:
        if positions is not None and not (len(observations.log) and positions.is_check.all()):
            by_positions = scale_by_positions(positions, trajectory, bending, lasting_s=lasting_s)
    except GeometryError as error:
        if not len(observations.log) and scale_by_lengths(distances, trajectory.centers) is None:
            raise GeometryError(f"the scale is not determined: {error}") from None
        remarks = (f"the known positions are not used: {error}",)
    others = [] if by_positions is None else [by_positions.alone]
    lengths = scale_by_lengths(distances, trajectory.centers, others)
    if not len(observations.log):
        if by_positions is not None:
            return _by_positions_alone(
                by_positions, lengths, observations, trajectory, bending, lasting_s, range_model, options
            )
        if lengths is None:
            what = "known position is used" if distances is None else "measured length has both its ends in the map"
            raise GeometryError(f"the scale is not determined: no {what}")
        alone = _by_lengths_alone(lengths, observations, trajectory, range_model, options)
        return replace(alone, reasons=(*alone.reasons, *remarks), remarks=remarks)
    given = _Given(
        observations, trajectory, anchors, anchor_frame, options, range_model, distances, by_positions, bending,
        remarks, seed,
    )  # fmt: skip
    found = _with_ranges(given, lengths)
    if lengths is None:
        return found
    if found.by_kind:
        others.append(found.by_kind["ranges"])
    checked = scale_by_lengths(distances, trajectory.centers, others)
    assert checked is not None, "the lengths are the same"
    return (
        replace(found, lengths=checked)
        if np.array_equal(checked.is_kept, lengths.is_kept)
        else _with_ranges(given, checked)
    )


@dataclass(frozen=True)
class _Given:
    """Input of the scale by ranges and all else, as for ``initialize_scale``.

    Attributes:
        by_positions: what the known positions say.
        remarks: reasons that are known before.
    """

    observations: RangeObservations
    trajectory: Trajectory
    anchors: Sequence[Anchor]
    anchor_frame: str
    options: ScaleOptions
    range_model: RangeModelOptions
    distances: LocatedDistances | None
    by_positions: PositionScale | None
    bending: MapBending
    remarks: tuple[str, ...]
    seed: int


def _with_ranges(given: _Given, lengths: LengthScale | None) -> ScaleEstimate:
    """Return the estimate by ranges, and by lengths and positions, if there are any."""
    observations, trajectory, anchors, options = given.observations, given.trajectory, given.anchors, given.options
    by_positions, distances, anchor_frame = given.by_positions, given.distances, given.anchor_frame
    if lengths is not None and distances is not None:
        distances = lengths.beside_ranges(distances)
    gravity = gravity_of(options.up_in_first_camera)
    placement = None if by_positions is None else by_positions.prior(trajectory, first_camera_from(trajectory))
    posing = (observations, trajectory, anchors, anchor_frame, given.range_model, distances, gravity, placement)
    problem, open_place = scale_problem(*posing), tuple[str, ...]()
    try:
        solution = solve_scale(problem, camera_side=options.camera_side, seed=given.seed)
    except OpenPlaceError as error:
        open_place = (f"scale only, in the first camera's frame: {error}",)
        problem = scale_problem(*posing, place_is_open=True)
        solution = solution_from(problem, error.in_first_camera)
    table = _paper_table(solution)
    by_kind = _by_other_kinds(lengths, by_positions)
    if by_kind:
        alone = _by_ranges_alone(solution)
        by_kind = {"ranges": _by_ranges(problem, alone, learned_errors(problem, solution, given.bending)), **by_kind}
        solution = _with_share(solution, _range_share(alone, by_kind["ranges"]))
    learned, per_anchor = both(
        lambda: learned_errors(problem, solution, given.bending),
        lambda: scale_per_anchor(solution, observations.log.anchor_ids),
    )
    posed = problem if lengths is None else _bent(problem, lengths)
    known = known_map(posed, solution, learned, lengths.components["bending"] if lengths else 0.0)
    uncertainty = known.uncertainty
    covariance = parameter_covariance(solution, learned)
    found = anchor_estimates(solution, observations.log.anchor_ids, covariance)
    judged = judge(problem, solution, uncertainty, per_anchor, found, options)
    verdict, remarks = judged.verdict, (*open_place, *given.remarks)
    if gravity is not None and problem.frame == "first_camera" and anchor_frame == "site":
        remarks = (*remarks, *levelled_places(gravity, anchors, found))
    reasons = (*judged.reasons, *remarks)
    if options.method == "two-candidate":
        robust = solution.fit.state.metric_from_model.scale
        verdict = "doubtful"
        reasons = (f"two-candidate, as asked for; the stddevs are of the robust scale, {robust:.6g}", *reasons)
    errors = replace(solution.errors, learned=learned).spread(problem.rows, len(observations.log))
    status = observations.status.copy()
    status[observations.has_place] = RangeStatus.UNKNOWN_ANCHOR
    status[problem.rows] = status_by_weight(solution.fit.weights)
    return ScaleEstimate(
        metric_from_sfm=_by_method(options.method, solution, table) @ problem.first_camera_from_sfm,
        frame=problem.frame,
        method=options.method,
        uncertainty=uncertainty,
        verdict=verdict,
        reasons=reasons,
        advice=judged.advice,
        sensitivity=scale_sensitivity(solution, problem),
        per_anchor=per_anchor,
        two_candidate=table,
        anchors=found,
        observations=replace(observations, status=status),
        errors=errors,
        noise_stddev_m=solution.noise_stddev_m,
        problem=posed,
        solution=solution,
        placement=solution.fit.columns[0].placement(covariance),
        remarks=remarks,
        lengths=lengths,
        positions=by_positions,
        by_kind=by_kind,
        shared_errors_m=shared_errors_m(solution, learned, errors.learned.of_range)
        if by_kind and errors.learned
        else np.zeros((len(observations.log), 0)),
    )


def _by_lengths_alone(
    lengths: LengthScale,
    observations: RangeObservations,
    trajectory: Trajectory,
    range_model: RangeModelOptions,
    options: ScaleOptions,
) -> ScaleEstimate:
    """Return the estimate in the first camera's frame from measured lengths; everything about ranges stays empty."""
    uncertainty = ScaleUncertainty(lengths.relative_stddev, lengths.components)
    judged = judge_lengths(lengths, uncertainty, options)
    return replace(
        _without_ranges(observations, range_model),
        metric_from_sfm=replace(IDENTITY, scale=lengths.value) @ first_camera_from(trajectory),
        uncertainty=uncertainty,
        verdict=judged.verdict,
        reasons=judged.reasons,
        advice=judged.advice,
        lengths=lengths,
        by_kind=_by_lengths(lengths),
    )


def _without_ranges(observations: RangeObservations, range_model: RangeModelOptions) -> ScaleEstimate:
    """Return an estimate about whose ranges nothing is known, as there are none; the rest is to be filled in."""
    return ScaleEstimate(
        metric_from_sfm=IDENTITY,
        frame="first_camera",
        method="lengths",
        uncertainty=ScaleUncertainty(np.inf, {}),
        verdict="doubtful",
        reasons=(),
        advice=(),
        sensitivity=ScaleSensitivity(0.0, 0.0, {}, 0.0, (0.0, 0.0, 0.0)),
        per_anchor={},
        two_candidate=None,
        anchors=(),
        observations=observations,
        errors=RangeErrors.begin(observations, observations.placed_rows, range_model),
        noise_stddev_m=np.nan,
    )


def _by_positions_alone(
    alone: PositionScale,
    lengths: LengthScale | None,
    observations: RangeObservations,
    trajectory: Trajectory,
    bending: MapBending,
    lasting_s: Sequence[float],
    range_model: RangeModelOptions,
    options: ScaleOptions,
) -> ScaleEstimate:
    """Return the estimate in the site's frame from known positions and measured lengths; nothing is said of ranges.

    Args:
        alone: what the positions say without the lengths.
    """
    found, by_kind = alone, dict[str, ScaleByKind]()
    if lengths is not None and lengths.is_used:
        found = scale_by_positions(alone.known, trajectory, bending, lengths=lengths, lasting_s=lasting_s)
        by_kind = {"positions": alone.alone, **_by_lengths(lengths)}
    judged = judge_positions(found.num_used, found.uncertainty, options, has_check=found.has_check)
    return replace(
        _without_ranges(observations, range_model),
        metric_from_sfm=found.site_from_model,
        frame="site",
        method="positions",
        uncertainty=found.uncertainty,
        verdict=judged.verdict,
        reasons=judged.reasons,
        advice=judged.advice,
        placement=found.covariance,
        positions=found,
        lengths=lengths,
        by_kind=by_kind,
    )


def _bent(problem: ScaleProblem, lengths: LengthScale) -> ScaleProblem:
    """Return the problem with the lengths' uncertainty widened by the bending of the map.

    The solver leaves the bending out, because it is no reason to trust the ranges more.
    """
    if problem.ranges.distances is None:
        return problem
    distances = lengths.beside_ranges(problem.ranges.distances, with_bending=True)
    return replace(problem, ranges=replace(problem.ranges, distances=distances))


def _by_lengths(lengths: LengthScale) -> dict[str, ScaleByKind]:
    return {"lengths": ScaleByKind(lengths.value, lengths.value * lengths.relative_stddev)}


def _by_other_kinds(lengths: LengthScale | None, positions: PositionScale | None) -> dict[str, ScaleByKind]:
    """Return the scale by each kind of measurement besides ranges, if it takes part."""
    return {
        **({} if lengths is None or not lengths.is_used else _by_lengths(lengths)),
        **({} if positions is None else {"positions": positions.alone}),
    }


def _range_share(alone: Solution, ranges: ScaleByKind) -> float:
    """Return the formal over the learnt variance of the scale by ranges alone, at most 1."""
    formal = alone.fit.log_scale_stddev * alone.errors.inflation
    return float(np.clip((formal * ranges.value / ranges.stddev) ** 2, _LEAST_SHARE, 1.0))


def _with_share(solution: Solution, range_share: float) -> Solution:
    """Return the solution of a rigid map with all ranges weighted by a further factor."""
    problem = solution.problem
    share = range_share * (np.ones(len(problem.range_m)) if problem.share is None else problem.share)
    return _solved(solution, replace(problem, share=share))


def _by_ranges_alone(solution: Solution) -> Solution:
    """Return the solution without lengths between points and known positions, starting from that with them."""
    return _solved(solution, _ranges_alone(solution.problem))


def _solved(solution: Solution, problem: RangeProblem) -> Solution:
    """Return the solution of another problem of the same ranges, starting from this one."""
    return replace(solution, problem=problem, fit=solve(problem, solution.fit.state, loss=solution.errors.loss))


def _by_ranges(posed: ScaleProblem, alone: Solution, learned: LearnedErrors) -> ScaleByKind:
    known = known_map(replace(posed, ranges=_ranges_alone(posed.ranges)), alone, learned)
    return known.uncertainty.about(alone.fit.state.metric_from_model.scale)


def _ranges_alone(problem: RangeProblem) -> RangeProblem:
    distances = None if problem.distances is None else problem.distances.subset(~problem.distances.is_between_points)
    if problem.placement is None:
        return replace(problem, distances=distances)
    is_placed = bool(np.isfinite(problem.anchor_stddev_m).any())
    return replace(problem, distances=distances, placement=None, frame_is_free=is_placed)


def _paper_table(solution: Solution) -> TwoCandidate | None:
    """Return the paper's table, with the anchors carried into the first camera's frame."""
    state, problem = solution.fit.state, solution.problem
    placed = state.metric_from_model
    anchors = (state.anchors_m - placed.translation) @ placed.rotation
    return two_candidate(problem.centers, problem.tag_from_center, anchors[problem.anchor_index], problem.range_m)


def _by_method(method: str, solution: Solution, table: TwoCandidate | None) -> Similarity:
    """Return metric_from_first_camera with the scale of the chosen method."""
    robust = solution.fit.state.metric_from_model
    if method == "robust":
        return robust
    if table is None or not table.scale > 0:
        raise GeometryError("two-candidate found no positive scale: use the robust method")
    return replace(robust, scale=table.scale)
