"""Scale initialisation: metres per SfM unit, and their uncertainty, from ranges and an unscaled path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.scale.scale_verdict import judge_map_of_kinds
from rangesfm.measurements.joint_map import KindOnMap, fit_kinds, join_kinds, tested_kinds, upward_by
from rangesfm.measurements.lengths.locate_lengths import NO_DISTANCES, LocatedDistances
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus, status_by_weight
from rangesfm.measurements.ranges.scale.anchor_by_anchor import anchor_estimates, scale_per_anchor
from rangesfm.measurements.ranges.scale.binned_ranges import RANGES, shared_errors_m
from rangesfm.measurements.ranges.scale.doubts import levelled_places
from rangesfm.measurements.ranges.scale.range_scale import RangeScale, placement_by, with_lengths
from rangesfm.measurements.ranges.scale.scale_problem import scale_problem
from rangesfm.measurements.ranges.scale.sensitivity import NOT_KNOWN, scale_sensitivity
from rangesfm.measurements.ranges.scale.solution import OpenPlaceError, Solution, solution_from, solve_scale
from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate, two_candidate
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.solver.bending import MapBending, WalkBending
from rangesfm.solver.posterior import MAX_NUM_OBSERVATIONS, ScaleUncertainty
from rangesfm.util.geometry.gravity import gravity_of
from rangesfm.util.geometry.trajectory import Trajectory, first_camera_from, in_first_camera
from rangesfm.util.processes.threads import both, with_one_blas_thread

# Number of observations with which it is tested which of them contradict the others.
_NUM_OF_TESTS = 120


@with_one_blas_thread
def initialize_scale(
    observations: RangeObservations,
    trajectory: Trajectory,
    anchors: Sequence[Anchor],
    *,
    anchor_frame: str,
    options: ScaleOptions = ScaleOptions(),
    range_model: RangeModelOptions = RangeModelOptions(),
    distances: LocatedDistances = NO_DISTANCES,
    others: Sequence[KindOnMap] = (),
    bending: MapBending | None = None,
    site: Site = Site(),
    seed: int = 0,
) -> ScaleEstimate:
    """Estimate scale and frame of an unscaled path from ranges, from measurements of other kinds, or from all of them.

    Args:
        observations: ranges on ``trajectory``; may be empty if there are other measurements.
        trajectory: the unscaled path.
        anchors: every anchor of the log, with its prior knowledge.
        anchor_frame: "site" (positions in a site frame: the map is carried there), "first_camera" (positions in the
            first keyframe's camera frame, metres) or "unknown" (positions are ignored; the map stays in the first
            camera's frame).
        distances: measured ones, of which those between anchors are used beside ranges.
        others: measurements of other kinds on ``trajectory``, those first that decide what is doubtful.
        bending: how the map is bent; None: it drifts as a map of poses does.
        site: frame of the anchors' positions.

    Raises:
        InputError: an anchor of the log is not among ``anchors``.
        GeometryError: the scale is not determined.
    """
    bending = bending or WalkBending(in_first_camera(trajectory))
    if not len(observations.log):
        return _without_ranges(observations, trajectory, others, bending, options, range_model)
    start = _RangeStart(
        observations, trajectory, anchors, anchor_frame, options, range_model, distances, bending, site, seed
    )
    return start.estimate(_tested_without_ranges(others))


def _without_ranges(
    observations: RangeObservations,
    trajectory: Trajectory,
    given: Sequence[KindOnMap],
    bending: MapBending,
    options: ScaleOptions,
    range_model: RangeModelOptions,
) -> ScaleEstimate:
    """Return the estimate in the site if a kind places the map there, or else in the first camera's frame."""
    kinds = _tested_without_ranges(given)
    used = [each for each in kinds if each.is_used]
    if not used:
        raise GeometryError("the scale is not determined: nothing that was measured is in the map")
    if len(used) == 1:
        on_map = replace(used[0].alone, kinds=kinds)
    else:
        on_map = fit_kinds(kinds, trajectory, _first(used).start, bending)
    judged = judge_map_of_kinds(on_map, options)
    return ScaleEstimate(
        on_map.estimate,
        frame="site" if _first(used).places_map else "first_camera",
        method=used[0].kind,
        uncertainty=on_map.posterior.uncertainty,
        verdict=judged.verdict,
        reasons=judged.reasons,
        advice=judged.advice,
        observations=observations,
        errors=RangeErrors.begin(observations, observations.placed_rows, range_model),
        placement=on_map.posterior.placement,
        on_map=on_map,
        by_kind={} if len(used) == 1 and used[0].places_map else {each.kind: each.alone.scale for each in used},
    )


def _tested_without_ranges(kinds: Sequence[KindOnMap]) -> tuple[KindOnMap, ...]:
    """Return the kinds with that left out which contradicts all others, before ranges have their say."""
    return tested_kinds(kinds, _first(kinds).start, MAX_NUM_OBSERVATIONS, is_last=False) if kinds else ()


def _first(kinds: Sequence[KindOnMap]) -> KindOnMap:
    """Return the kind at whose placement a map starts: the first that places it, or the first of all."""
    return next((each for each in kinds if each.places_map), kinds[0])


@dataclass(frozen=True)
class _RangeStart:
    """Arguments of ``initialize_scale`` with ranges."""

    observations: RangeObservations
    trajectory: Trajectory
    anchors: Sequence[Anchor]
    anchor_frame: str
    options: ScaleOptions
    range_model: RangeModelOptions
    distances: LocatedDistances
    bending: MapBending
    site: Site
    seed: int

    def estimate(self, others: tuple[KindOnMap, ...], *, is_last: bool = False) -> ScaleEstimate:
        """Return the estimate by ranges and the other kinds.

        Args:
            is_last: whether the ranges had their say on what is left out of the other kinds.
        """
        observations, options = self.observations, self.options
        solved, open_place = self._solved(others)
        ranges, used = solved, [each for each in others if each.is_used]
        by_kind = {each.kind: each.alone.scale for each in used}
        if used:
            by_kind = {RANGES: solved.alone.scale, **by_kind}
            ranges = solved.with_their_share
            others, before = tested_kinds([ranges, *others], ranges.placed, _NUM_OF_TESTS, is_last=is_last)[1:], others
            if [each.left_out for each in others] != [each.left_out for each in before]:
                return self.estimate(others, is_last=True)
        on_map, per_anchor = both(
            lambda: join_kinds((ranges, *others), self.trajectory, ranges.placed, self.bending),
            lambda: scale_per_anchor(ranges.solution, observations.log.anchor_ids),
        )
        known, after = on_map.posterior, ranges.moved(on_map.posterior)
        found = anchor_estimates(after.solution, observations.log.anchor_ids, known.covariance)
        judged_ranges = replace(ranges, per_anchor=per_anchor, anchors=found)
        on_map = replace(on_map, kinds=(judged_ranges, *others))
        judged, problem, solution = judge_map_of_kinds(on_map, options), ranges.posed, ranges.solution
        gravity, remarks = upward_by(others, gravity_of(options.up_in_first_camera)), open_place
        if gravity is not None and problem.frame == "first_camera" and self.anchor_frame == "site":
            remarks = (*remarks, *levelled_places(gravity, self.anchors, found))
        learned = ranges.learnt(on_map)
        errors = replace(solution.errors, learned=learned).spread(problem.rows, len(observations.log))
        status = observations.status.copy()
        status[observations.has_place] = RangeStatus.UNKNOWN_ANCHOR
        status[problem.rows] = status_by_weight(solution.fit.weights)
        robust = ScaleEstimate(
            metric_from_sfm=after.placed,
            frame=problem.frame,
            method="robust",
            uncertainty=known.uncertainty,
            verdict=judged.verdict,
            reasons=judged.reasons,
            advice=judged.advice,
            sensitivity=scale_sensitivity(
                after.solution, problem, on_map.problem.of_kind(RANGES, known.gains), learned.bins
            ),
            per_anchor=per_anchor,
            two_candidate=_paper_table(solution),
            anchors=found,
            observations=replace(observations, status=status),
            errors=errors,
            noise_stddev_m=solution.noise_stddev_m,
            placement=known.placement,
            on_map=on_map,
            by_kind=by_kind,
            shared_errors_m=shared_errors_m(solution, learned, errors.learned.of_range)
            if by_kind and errors.learned
            else np.zeros((len(observations.log), 0)),
        ).remarked(remarks)
        return robust if options.method == "robust" else _by_paper(robust, is_checked=options.method == "two-candidate")

    def _solved(self, others: Sequence[KindOnMap]) -> tuple[RangeScale, tuple[str, ...]]:
        """Return the ranges at the best solution of their problem, and why the map's place is open, if it is."""
        path, gravity = self.trajectory, upward_by(others, gravity_of(self.options.up_in_first_camera))
        posing = (
            *(self.observations, path, self.anchors, self.anchor_frame, self.range_model),
            *(with_lengths(self.distances, others), gravity, placement_by(others, first_camera_from(path))),
        )
        problem, why_open = scale_problem(*posing, site=self.site), tuple[str, ...]()
        try:
            solution = solve_scale(problem, camera_side=self.options.camera_side, seed=self.seed)
        except OpenPlaceError as error:
            why_open = (f"the map gets metres, but no place in the site: {error}",)
            problem = scale_problem(*posing, place_is_open=True, site=self.site)
            solution = solution_from(problem, error.in_first_camera)
        return RangeScale(problem, solution, path, 1.0, self.bending), why_open


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
        on_map=None,
        placement=None,
    )
