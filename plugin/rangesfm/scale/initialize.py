"""Scale initialisation: metres per SfM unit, and their uncertainty, from ranges and an unscaled path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Mask
from rangesfm.distances.lengths_on_map import LENGTHS
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, ROUNDING
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.inference.bending import MapBending, WalkBending
from rangesfm.inference.posterior import (
    JointProblem,
    Observations,
    Posterior,
    ScaleByKind,
    ScaleUncertainty,
    joined,
)
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.processes.threads import both, with_one_blas_thread
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.site import Site
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_bins import MAX_NUM_BINS
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus, status_by_weight
from rangesfm.scale.anchor_by_anchor import anchor_estimates, scale_per_anchor
from rangesfm.scale.binned_ranges import RANGES, BinnedRanges, binned_ranges, moved, shared_errors_m
from rangesfm.scale.range_equation import RangeProblem, solve
from rangesfm.scale.scale_by_lengths import KnownLengths, LengthScale, scale_by_lengths
from rangesfm.scale.scale_by_positions import PositionScale, moved_similarity, scale_by_positions
from rangesfm.scale.scale_estimate import NOT_KNOWN, ScaleEstimate
from rangesfm.scale.scale_problem import ScaleProblem, first_camera_from, scale_problem
from rangesfm.scale.scale_verdict import judge, judge_lengths, judge_positions, levelled_places
from rangesfm.scale.sensitivity import scale_sensitivity
from rangesfm.scale.solution import OpenPlaceError, Solution, solution_from, solve_scale, with_unknown_anchors
from rangesfm.scale.two_candidate import TwoCandidate, two_candidate

# Number of bins of ranges, and of coordinates of known positions, with which lengths are tested one by one.
_NUM_BINS_OF_TESTS = 120


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
    lengths = KnownLengths.of(distances, trajectory, bending)
    by_positions, remarks = None, tuple[str, ...]()
    try:
        if positions is not None and not (len(observations.log) and positions.is_check.all()):
            by_positions = scale_by_positions(positions, trajectory, bending, lasting_s=lasting_s)
    except GeometryError as error:
        if not len(observations.log) and lengths is None:
            raise GeometryError(f"the scale is not determined: {error}") from None
        remarks = (f"the known positions are not used: {error}",)
    given = _Given(
        observations, trajectory, anchors, anchor_frame, options, range_model, distances, by_positions, lengths,
        bending, remarks, site, seed,
    )  # fmt: skip
    others = [] if by_positions is None else [by_positions.observed]
    at = None if by_positions is None else by_positions.fit.similarity.scale
    by_lengths = scale_by_lengths(lengths, at, others)
    return given.with_ranges(by_lengths) if len(observations.log) else given.without_ranges(by_lengths)


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
    lengths: KnownLengths | None
    bending: MapBending
    remarks: tuple[str, ...]
    site: Site | None
    seed: int

    def without_ranges(self, lengths: LengthScale | None) -> ScaleEstimate:
        """Return the estimate by known positions in the site, or by lengths in the first camera's frame."""
        positions, options = self.by_positions, self.options
        by_kind = _by_kind(lengths, positions)
        if positions is not None:
            if self.lengths is not None and lengths is not None and lengths.is_used:
                positions = self._with_lengths(positions, self.lengths, lengths.is_kept)
            metric_from_sfm, uncertainty = positions.site_from_model, positions.uncertainty
            judged = judge_positions(positions.num_used, uncertainty, options, has_check=positions.has_check)
        elif lengths is not None:
            metric_from_sfm = replace(IDENTITY, scale=lengths.value) @ first_camera_from(self.trajectory)
            uncertainty = lengths.uncertainty
            by_kind = {LENGTHS: lengths.alone}
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
            by_kind=by_kind if LENGTHS in by_kind else {},
            remarks=self.remarks,
        )

    def _with_lengths(self, positions: PositionScale, lengths: KnownLengths, is_kept: Mask) -> PositionScale:
        """Return the estimate by known positions and measured lengths together."""
        at = positions.fit.similarity
        for _ in range(MAX_NUM_ROUNDS):  # the equations of the lengths are not linear in the logarithm of the scale
            observed = positions.fit.at(at)
            problem = joined([observed, lengths.observed(at.scale, is_kept)], self.bending).learnt()
            known = problem.posterior(is_fitted=False)
            at = moved_similarity(at, known.step, self.trajectory)
            if abs(known.step[0]) < NEGLIGIBLE_STDDEVS**2 * known.uncertainty.empirical:
                break
        return replace(positions, site_from_model=at, observed=observed, problem=problem, posterior=known)

    def with_ranges(self, lengths: LengthScale | None, *, is_checked: bool = False) -> ScaleEstimate:
        """Return the estimate by ranges, and by lengths and positions, if there are any.

        Args:
            is_checked: whether the ranges had their say on which lengths are left out.
        """
        observations, trajectory, options = self.observations, self.trajectory, self.options
        by_positions, distances = self.by_positions, self.distances
        if lengths is not None and distances is not None:
            distances = lengths.beside_ranges(distances)
        gravity = gravity_of(options.up_in_first_camera)
        placement = None if by_positions is None else by_positions.prior(first_camera_from(trajectory))
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
            by_kind = {RANGES: self._by_ranges(problem, alone), **by_kind}
            solution = _with_share(solution, _range_share(alone, by_kind[RANGES]))
        if lengths is not None:
            tested = self._tested(problem, solution, lengths.is_kept if is_checked else None)
            if not np.array_equal(tested.is_kept, lengths.is_kept):
                return self.with_ranges(tested, is_checked=True)
            lengths = tested
        joint, per_anchor = both(
            lambda: self._joined(problem, solution, lengths),
            lambda: scale_per_anchor(solution, observations.log.anchor_ids),
        )
        ranges, positions, all_kinds = joint
        known = _known(all_kinds, solution)
        learned = LearnedErrors.of(all_kinds.noise_of(RANGES), ranges.bins)
        uncertainty, after = known.uncertainty, moved(solution, known)
        found = anchor_estimates(after, observations.log.anchor_ids, known.covariance)
        unplaced = self._with_unknown_anchors(problem, solution, lengths)
        judged = judge(problem, solution, uncertainty, per_anchor, found, options, unplaced)
        remarks = (*open_place, *self.remarks)
        if gravity is not None and problem.frame == "first_camera" and self.anchor_frame == "site":
            remarks = (*remarks, *levelled_places(gravity, self.anchors, found))
        errors = replace(solution.errors, learned=learned).spread(problem.rows, len(observations.log))
        status = observations.status.copy()
        status[observations.has_place] = RangeStatus.UNKNOWN_ANCHOR
        status[problem.rows] = status_by_weight(solution.fit.weights)
        metric_from_sfm = after.fit.state.metric_from_model @ problem.first_camera_from_sfm
        if positions is not None:
            positions = replace(positions, site_from_model=metric_from_sfm, problem=all_kinds, posterior=known)
        robust = ScaleEstimate(
            metric_from_sfm=metric_from_sfm,
            frame=problem.frame,
            method="robust",
            uncertainty=uncertainty,
            verdict=judged.verdict,
            reasons=(*judged.reasons, *remarks),
            advice=judged.advice,
            sensitivity=scale_sensitivity(after, problem, all_kinds.of_kind(RANGES, known.gains), learned.bins),
            per_anchor=per_anchor,
            two_candidate=table,
            anchors=found,
            observations=replace(observations, status=status),
            errors=errors,
            noise_stddev_m=solution.noise_stddev_m,
            problem=problem,
            solution=solution,
            placement=known.placement,
            remarks=remarks,
            lengths=lengths,
            positions=positions,
            by_kind=by_kind,
            shared_errors_m=shared_errors_m(solution, learned, errors.learned.of_range)
            if by_kind and errors.learned
            else np.zeros((len(observations.log), 0)),
        )
        return robust if options.method == "robust" else _by_paper(robust, is_checked=options.method == "two-candidate")

    def _joined(
        self, problem: ScaleProblem, solution: Solution, lengths: LengthScale | None, most: int = MAX_NUM_BINS
    ) -> tuple[BinnedRanges, PositionScale | None, JointProblem]:
        """Return the ranges, the positions, and the problem of all kinds about a solution, with learnt errors.

        Args:
            most: number of bins of the ranges, and of coordinates of an antenna's positions.
        """
        placed, positions, others = solution.fit.state.metric_from_model, self.by_positions, list[Observations]()
        if positions is not None:
            most //= 2
            at = positions.fit.at(placed @ problem.first_camera_from_sfm, most)
            positions, others = replace(positions, observed=at), [at]
        if self.lengths is not None and lengths is not None and lengths.is_used:
            others.append(self.lengths.observed(placed.scale, lengths.is_kept))
        ranges = binned_ranges(problem, solution, max_num_bins=most)
        return ranges, positions, joined([ranges, *others], self.bending, *ranges.priors).learnt()

    def _tested(self, problem: ScaleProblem, solution: Solution, is_kept: Mask | None) -> LengthScale:
        """Return the lengths, with those left out that contradict all else; ``is_kept``: as of ``scale_by_lengths``."""
        ranges, positions, _ = self._joined(problem, solution, None, _NUM_BINS_OF_TESTS)
        others = [ranges] if positions is None else [ranges, positions.observed]
        at = solution.fit.state.metric_from_model.scale
        tested = scale_by_lengths(self.lengths, at, others, ranges.priors, is_kept)
        assert tested is not None, "the lengths are the same"
        return tested

    def _by_ranges(self, problem: ScaleProblem, alone: Solution) -> ScaleByKind:
        """Return the scale by ranges alone, given their solution."""
        posed = replace(problem, ranges=_ranges_alone(problem.ranges))
        ranges = binned_ranges(posed, alone)
        known = _known(joined([ranges], self.bending, *ranges.priors).learnt(), alone)
        return known.uncertainty.about(moved(alone, known).fit.state.metric_from_model.scale)

    def _with_unknown_anchors(
        self, posed: ScaleProblem, solution: Solution, lengths: LengthScale | None
    ) -> ScaleUncertainty | None:
        """Return the uncertainty if no place of an anchor were known; None where none is."""
        if not np.isfinite(solution.problem.anchor_stddev_m).any():
            return None
        unknown = with_unknown_anchors(posed, solution.fit.state)
        return _known(self._joined(*unknown, lengths)[2], unknown[1]).uncertainty


def _known(problem: JointProblem, solution: Solution) -> Posterior:
    """Return the posterior of a map at the solution of its ranges."""
    is_alone = len(problem.rows) == 1
    return problem.posterior(is_fitted=is_alone, formal=solution.fit.log_scale_stddev if is_alone else None)


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
