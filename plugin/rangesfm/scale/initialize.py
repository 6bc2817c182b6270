"""Scale initialisation: metres per SfM unit, and their uncertainty, from ranges and an unscaled path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.numerics import ROUNDING
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.processes.threads import both, with_one_blas_thread
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.site import Site
from rangesfm.ranging.errors.bending import MapBending, WalkBending
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus, status_by_weight
from rangesfm.scale.anchor_by_anchor import anchor_estimates, scale_per_anchor
from rangesfm.scale.range_equation import RangeProblem, solve
from rangesfm.scale.scale_by_lengths import LengthScale, ScaleByKind, scale_by_lengths
from rangesfm.scale.scale_by_positions import PositionScale, scale_by_positions
from rangesfm.scale.scale_estimate import NOT_KNOWN, ScaleEstimate, ScaleUncertainty
from rangesfm.scale.scale_problem import ScaleProblem, first_camera_from, scale_problem
from rangesfm.scale.scale_verdict import judge, judge_lengths, judge_positions, levelled_places
from rangesfm.scale.sensitivity import scale_sensitivity
from rangesfm.scale.solution import OpenPlaceError, Solution, solution_from, solve_scale, with_unknown_anchors
from rangesfm.scale.two_candidate import TwoCandidate, two_candidate
from rangesfm.scale.uncertainty import known_map, learned_errors, shared_errors_m


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
    site: Site | None = None,
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
        site: frame of the anchors' positions; None: that in which they were given.

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
    given = _Given(
        observations, trajectory, anchors, anchor_frame, options, range_model, distances, by_positions, lasting_s,
        bending, remarks, site, seed,
    )  # fmt: skip
    others = [] if by_positions is None else [by_positions.alone]
    lengths = scale_by_lengths(distances, trajectory.centers, others)
    if not len(observations.log):
        return given.without_ranges(lengths)
    found = given.with_ranges(lengths)
    if lengths is None:
        return found
    if found.by_kind:
        others.append(found.by_kind["ranges"])
    checked = scale_by_lengths(distances, trajectory.centers, others)
    assert checked is not None, "the lengths are the same"
    if np.array_equal(checked.is_kept, lengths.is_kept):
        return replace(found, lengths=checked)
    return given.with_ranges(checked)


@dataclass(frozen=True)
class _Given:
    """Arguments of ``initialize_scale``, with what the known positions say and the remarks on them."""

    observations: RangeObservations
    trajectory: Trajectory
    anchors: Sequence[Anchor]
    anchor_frame: str
    options: ScaleOptions
    range_model: RangeModelOptions
    distances: LocatedDistances | None
    by_positions: PositionScale | None
    lasting_s: Sequence[float]
    bending: MapBending
    remarks: tuple[str, ...]
    site: Site | None
    seed: int

    def without_ranges(self, lengths: LengthScale | None) -> ScaleEstimate:
        """Return the estimate by known positions in the site, or by lengths in the first camera's frame."""
        positions, options = self.by_positions, self.options
        by_kind = _by_kind(lengths, positions)
        if positions is not None:
            if lengths is not None and lengths.is_used:
                positions = scale_by_positions(
                    positions.known, self.trajectory, self.bending, lengths=lengths, lasting_s=self.lasting_s
                )
            metric_from_sfm, uncertainty = positions.site_from_model, positions.uncertainty
            judged = judge_positions(positions.num_used, uncertainty, options, has_check=positions.has_check)
        elif lengths is not None:
            metric_from_sfm = replace(IDENTITY, scale=lengths.value) @ first_camera_from(self.trajectory)
            uncertainty = ScaleUncertainty(lengths.relative_stddev, lengths.components)
            by_kind = {"lengths": lengths.alone}
            judged = judge_lengths(lengths, uncertainty, options)
        else:
            no_length = "measured length has both its ends in the map"
            what = "known position is used" if self.distances is None else no_length
            raise GeometryError(f"the scale is not determined: no {what}")
        return ScaleEstimate(
            metric_from_sfm,
            frame="first_camera" if positions is None else "site",
            method="lengths" if positions is None else "positions",
            uncertainty=uncertainty,
            verdict=judged.verdict,
            reasons=(*judged.reasons, *self.remarks),
            advice=judged.advice,
            observations=self.observations,
            errors=RangeErrors.begin(self.observations, self.observations.placed_rows, self.range_model),
            placement=None if positions is None else positions.covariance,
            positions=positions,
            lengths=lengths,
            by_kind=by_kind if "lengths" in by_kind else {},
            remarks=self.remarks,
        )

    def with_ranges(self, lengths: LengthScale | None) -> ScaleEstimate:
        """Return the estimate by ranges, and by lengths and positions, if there are any."""
        observations, trajectory, options = self.observations, self.trajectory, self.options
        by_positions, distances = self.by_positions, self.distances
        if lengths is not None and distances is not None:
            distances = lengths.beside_ranges(distances)
        gravity = gravity_of(options.up_in_first_camera)
        placement = None if by_positions is None else by_positions.prior(trajectory, first_camera_from(trajectory))
        posing = (observations, trajectory, self.anchors, self.anchor_frame, self.range_model, distances, gravity)
        problem, open_place = scale_problem(*posing, placement, site=self.site), tuple[str, ...]()
        try:
            solution = solve_scale(problem, camera_side=options.camera_side, seed=self.seed)
        except OpenPlaceError as error:
            open_place = (f"the map gets metres, but no place in the site: {error}",)
            problem = scale_problem(*posing, placement, place_is_open=True, site=self.site)
            solution = solution_from(problem, error.in_first_camera)
        table = _paper_table(solution)
        by_kind = _by_kind(lengths, by_positions)
        if by_kind:
            alone = _by_ranges_alone(solution)
            by_kind = {"ranges": _by_ranges(problem, alone, learned_errors(problem, solution, self.bending)), **by_kind}
            solution = _with_share(solution, _range_share(alone, by_kind["ranges"]))
        learned, per_anchor = both(
            lambda: learned_errors(problem, solution, self.bending),
            lambda: scale_per_anchor(solution, observations.log.anchor_ids),
        )
        posed = problem if lengths is None else _bent(problem, lengths)
        known = known_map(posed, solution, learned)
        uncertainty = known.uncertainty
        moved = known.moved(solution)
        found = anchor_estimates(moved, observations.log.anchor_ids, known.covariance)
        unplaced = self._with_unknown_anchors(posed, solution)
        judged = judge(problem, solution, uncertainty, per_anchor, found, options, unplaced)
        remarks = (*open_place, *self.remarks)
        if gravity is not None and problem.frame == "first_camera" and self.anchor_frame == "site":
            remarks = (*remarks, *levelled_places(gravity, self.anchors, found))
        errors = replace(solution.errors, learned=learned).spread(problem.rows, len(observations.log))
        status = observations.status.copy()
        status[observations.has_place] = RangeStatus.UNKNOWN_ANCHOR
        status[problem.rows] = status_by_weight(solution.fit.weights)
        robust = ScaleEstimate(
            metric_from_sfm=moved.fit.state.metric_from_model @ problem.first_camera_from_sfm,
            frame=problem.frame,
            method="robust",
            uncertainty=uncertainty,
            verdict=judged.verdict,
            reasons=(*judged.reasons, *remarks),
            advice=judged.advice,
            sensitivity=scale_sensitivity(moved, problem, known, learned.bins),
            per_anchor=per_anchor,
            two_candidate=table,
            anchors=found,
            observations=replace(observations, status=status),
            errors=errors,
            noise_stddev_m=solution.noise_stddev_m,
            problem=posed,
            solution=solution,
            placement=known.columns.placement(known.covariance),
            remarks=remarks,
            lengths=lengths,
            positions=by_positions,
            by_kind=by_kind,
            shared_errors_m=shared_errors_m(solution, learned, errors.learned.of_range)
            if by_kind and errors.learned
            else np.zeros((len(observations.log), 0)),
        )
        return robust if options.method == "robust" else _by_paper(robust, is_checked=options.method == "two-candidate")

    def _with_unknown_anchors(self, posed: ScaleProblem, solution: Solution) -> ScaleUncertainty | None:
        """Return the uncertainty if no place of an anchor were known; None where none is."""
        if not np.isfinite(solution.problem.anchor_stddev_m).any():
            return None
        unknown = with_unknown_anchors(posed, solution.fit.state)
        return known_map(*unknown, learned_errors(*unknown, self.bending)).uncertainty


def _bent(problem: ScaleProblem, lengths: LengthScale) -> ScaleProblem:
    """Return the problem with the lengths' uncertainty widened by the bending of the map.

    The solver leaves the bending out, because it is no reason to trust the ranges more.
    """
    if problem.ranges.distances is None:
        return problem
    distances = lengths.beside_ranges(problem.ranges.distances, with_bending=True)
    return replace(problem, ranges=replace(problem.ranges, distances=distances))


def _by_kind(lengths: LengthScale | None, positions: PositionScale | None) -> dict[str, ScaleByKind]:
    """Return the scale by each kind of measurement besides ranges, if it takes part."""
    by_lengths = {} if lengths is None or not lengths.is_used else {"lengths": lengths.alone}
    return by_lengths if positions is None else {**by_lengths, "positions": positions.alone}


def _range_share(alone: Solution, ranges: ScaleByKind) -> float:
    """Return the formal over the learnt variance of the scale by ranges alone, at most 1.

    Where ranges alone say nothing of the scale, they keep a share that has no effect: with none at all, nothing would
    place the anchors.
    """
    formal = alone.fit.log_scale_stddev * alone.errors.inflation
    return float(np.clip((formal * ranges.value / ranges.stddev) ** 2, ROUNDING, 1.0))


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
    return known.uncertainty.about(known.moved(alone).fit.state.metric_from_model.scale)


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


def _by_paper(robust: ScaleEstimate, *, is_checked: bool) -> ScaleEstimate:
    """Return the estimate with the paper's scale, of whose error nothing is known.

    Raises:
        GeometryError: the scale is not positive, or, if it is checked, outside the interval of the robust estimate.
    """
    table, (low, high) = robust.two_candidate, robust.interval_95
    if table is None or not table.scale > 0:
        raise GeometryError("two-candidate found no positive scale: use the robust method")
    if is_checked and not low <= table.scale <= high:
        raise GeometryError(
            f"two-candidate gives {table.scale:.4g} m per unit, outside the 95 % interval of the robust estimate, "
            f"{low:.4g} to {high:.4g}: use the robust method, or ask for it all the same (--scale_method "
            "two-candidate-unchecked)"
        )
    return replace(
        robust,
        metric_from_sfm=replace(robust.metric_from_sfm, scale=table.scale),
        method="two-candidate",
        uncertainty=ScaleUncertainty(np.inf, {}),
        verdict="doubtful",
        reasons=("two-candidate, for comparison: nothing is known of its error", *robust.remarks),
        advice=("use the robust method",),
        sensitivity=NOT_KNOWN,
        per_anchor={},
        by_kind={},
        problem=None,
        solution=None,
        placement=None,
    )
