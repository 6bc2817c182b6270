"""Ranges on a map, which are solved beside measurements of other kinds, and the scale by the ranges alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import BentMap, JointMap, KindOnMap, join_kinds
from rangesfm.measurements.kind import Block, Doubt
from rangesfm.measurements.mistakes import MistakeTests
from rangesfm.measurements.ranges.errors.components import CLOCKS
from rangesfm.measurements.ranges.errors.range_bins import RangeBins
from rangesfm.measurements.ranges.mistakes.bent_path import AnchorSides, bends_m, bent_to_ranges, drifts, likelier_sides
from rangesfm.measurements.ranges.mistakes.diagnosis import diagnose_ranges
from rangesfm.measurements.ranges.mistakes.linearized import linearized
from rangesfm.measurements.ranges.range_observations import RangeStatus, status_by_weight
from rangesfm.measurements.ranges.scale.binned_ranges import BinnedRanges, binned_ranges, moved, shared_errors_m
from rangesfm.measurements.ranges.scale.doubts import (
    doubts_of_ranges,
    levelled_places,
    remarks_on_anchors,
    remarks_on_places,
)
from rangesfm.measurements.ranges.scale.range_estimate import (
    RangeEstimate,
    anchor_estimates,
    scale_per_anchor,
    scale_sensitivity,
)
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.solution import with_unknown_anchors
from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate, two_candidate
from rangesfm.measurements.ranges.words import RANGE_WORDS, RANGES
from rangesfm.solver.bending import NO_STEPS, FrameSteps
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import JointProblem, Posterior, ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.numerics import ROUNDING
from rangesfm.util.geometry.similarity import Similarity, rmse


@dataclass(frozen=True)
class RangeScale(KindOnMap):
    """Ranges on a map, at the solution of their problem beside the other kinds.

    Attributes:
        solved: the ranges at their solution.
        told: what is said of the ranges, as far as it is known.
        notes: as of ``KindOnMap``.
    """

    solved: RangesOnMap
    told: RangeEstimate
    notes: tuple[str, ...] = ()

    kind, words = RANGES, RANGE_WORDS.words
    method = "robust"
    clock = CLOCKS
    is_solved = shows_bending = True
    remedy = "calibrate the radio (rangesfm ranges calibrate)"

    @classmethod
    def begun(cls, solved: RangesOnMap, notes: tuple[str, ...] = ()) -> RangeScale:
        """Return ranges at a solution on the path of the unscaled model."""
        given = solved.posed.given
        told = RangeEstimate.begun(given.observations, given.range_model)
        return cls(solved, told, notes)

    @property
    def places_map(self) -> bool:
        """Whether the frame is that of surveyed anchors."""
        return self.solved.problem.frame_is_free

    def observed(
        self, placed: Similarity, *, in_site: bool = False, max_num: int = MAX_NUM_OBSERVATIONS
    ) -> BinnedRanges:
        """Linearise the ranges about their solution, which is at the placement."""
        del placed, in_site
        return binned_ranges(self.solved, max_num)

    @property
    def start(self) -> Similarity:
        """The placement of the solution."""
        return self.solved.metric_from_path

    @cached_property
    def alone(self) -> JointMap:
        """The map by the ranges alone, solved anew; from here, if they alone leave it open."""
        own = replace(self, solved=self._without_others)
        return join_kinds((own,), own.start, self.solved.posed.bending)

    @cached_property
    def _without_others(self) -> RangesOnMap:
        problem = self.solved.problem
        if problem.placement is None and not problem.scales:
            return self.solved
        # Others that are wrong may have led the ranges to where they no longer find back.
        try:
            return self.solved.posed.given.beside(()).solved
        except GeometryError:
            is_free = problem.frame_is_free if problem.placement is None else problem.has_known_anchors
        return self.solved.solved(replace(problem.without_others(), frame_is_free=is_free))

    def with_their_share(self) -> RangeScale:
        """Return the ranges solved beside other kinds with all of them weighted by how well they know the scale.

        That is the formal over the learnt variance of the scale by ranges alone, at most 1. Where ranges alone say
        nothing of the scale, they keep a share that has no effect: with none at all, nothing would place the anchors.
        """
        alone, known = self._without_others, self.alone.scale
        formal = alone.log_scale_stddev * alone.errors.inflation
        share = float(np.clip((formal * known.value / known.stddev) ** 2, ROUNDING, 1.0))
        problem = self.solved.problem
        return replace(self, solved=self.solved.solved(replace(problem, share=share * problem.share)))

    def posterior(self, problem: JointProblem) -> Posterior:
        """Return what they say of the map, which is where their robust weights have it."""
        return problem.posterior(formal=self.solved.log_scale_stddev)

    def moved(self, known: Posterior, bent: FrameSteps = NO_STEPS) -> RangeScale:
        """Return the ranges on the map that was bent and moved to the estimate of a posterior; weights stay."""
        path = self.solved.posed.bending.path
        turns, shifts_m = bent.at(path.frame_ids)
        in_world = Rotation.from_rotvec(np.einsum("kij,kj->ki", path.world_from_cam, turns))
        posed = self.solved.posed.carried(in_world.as_matrix(), shifts_m)
        return replace(self, solved=moved(replace(self.solved, posed=posed), known))

    def concluded(self, on_map: JointMap) -> RangeScale:
        """Return the ranges with what the whole map says of them."""
        solved, posed, told = self.solved, self.solved.posed, self.told
        log, bins, noise = posed.observations.log, bins_on(on_map), on_map.problem.noise_of(RANGES)
        if on_map.is_at_rest:
            stddevs = noise.stddev_of_component
            return replace(self, told=replace(told, noise_stddev_m=solved.noise_stddev_m, error_stddevs=stddevs))
        known, after = on_map.posterior, moved(solved, on_map.posterior)
        has_others = any(each.is_used for each in on_map.kinds if each.kind != self.kind)
        status = posed.observations.status.copy()
        status[posed.observations.has_place] = RangeStatus.UNKNOWN_ANCHOR
        status[posed.rows] = status_by_weight(solved.weights)
        found = RangeEstimate(
            replace(posed.observations, status=status),
            solved.errors.spread(posed.rows, len(log)),
            solved.noise_stddev_m,
            noise.stddev_of_component,
            float(np.median(np.abs(solved.fit_residual_m))),
            anchor_estimates(after, known),
            scale_per_anchor(solved),
            scale_sensitivity(after, on_map.problem.of_kind(RANGES, known.gains), bins),
            _paper_table(solved),
            shared_errors_m(solved, noise, bins) if has_others else np.zeros((len(log), 0)),
        )
        return replace(self, told=found, notes=(*self.notes, *levelled_places(solved, found.anchors)))

    def of_log(self, before: RangeEstimate) -> RangeEstimate:
        """Return what is said of the ranges."""
        del before
        return self.told

    def on(self, on_map: JointMap) -> RangesOnMap:
        """Return the ranges for tests: where they are on a map at rest, or where they bend one that is only scaled."""
        return self.solved if on_map.is_at_rest else self._where_bent.on_map

    @cached_property
    def _where_bent(self) -> AnchorSides:
        return likelier_sides(bent_to_ranges(self.solved, self.solved.rivals))

    def sides(self, on_map: JointMap) -> Iterator[AnchorSides]:
        """Yield on which sides of the path the unknown anchors stand."""
        yield likelier_sides(self.on(on_map)) if on_map.is_at_rest else self._where_bent

    def bends_m(self, on_map: JointMap) -> Array:
        """Return how far the ranges bend each keyframe."""
        return bends_m(self.on(on_map))

    def bent(self, on_map: JointMap) -> Iterator[BentMap]:
        """Yield the path bent to the ranges, if that is by more than the scatter of the ranges.

        A rigid path fits as well otherwise.
        """
        bent, told = self.on(on_map), self.told
        if not len(bent_by_m := bends_m(bent)):
            return
        problem = linearized(bent).with_learnt_errors()
        if not drifts(problem):
            return
        weights, rows = problem.bins.robust_weight, self.solved.posed.rows
        known = problem.posterior(formal=on_map.posterior.uncertainty.formal)
        solved = replace(self.solved, state=bent.state, weights=weights)
        status, stddev_m = told.observations.status.copy(), told.errors.stddev_m.copy()
        status[rows], stddev_m[rows] = status_by_weight(weights), problem.scatter_m
        places = zip(told.anchors, bent.state.anchors_m, strict=True)
        drift = f"the path drifts by {rmse(bent_by_m[:, None]):.2g} m (root mean square) from where the ranges have it"
        remarks = (*remarks_on_anchors(solved, told.anchors), Doubt(drift))
        told = replace(
            told,
            observations=replace(told.observations, status=status),
            errors=replace(told.errors, stddev_m=stddev_m),
            anchors=tuple(replace(anchor, position_m=at_m) for anchor, at_m in places),
        )
        doubts = tuple(doubts_of_ranges(solved, known.uncertainty, {}))
        yield BentMap(replace(self, told=told), bent.metric_from_path, known, doubts, remarks)

    def tests(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> MistakeTests:
        """Return the tests of all mistakes that ranges can show."""
        del by_kind
        return diagnose_ranges(self.on(on_map), seed=self.solved.posed.given.seed)

    @property
    def blocks(self) -> Mapping[Block, Array]:
        """Positions of the anchors."""
        at_m = zip(self.solved.anchor_ids, self.solved.state.anchors_m, strict=True)
        return {("anchor", name): position_m for name, position_m in at_m}

    def doubts(self, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
        """Yield the faults of the path, of the anchors and of the ranges."""
        return doubts_of_ranges(self.solved, uncertainty, self.told.per_anchor)

    def remarks(self, on_map: JointMap) -> Iterator[Doubt]:
        """Yield what is not determined, and that the anchors' coordinates widen the interval."""
        yield from remarks_on_anchors(self.solved, self.told.anchors)
        if self.solved.problem.has_known_anchors:
            unknown = replace(self, solved=with_unknown_anchors(self.solved))
            others = [unknown if each is self else each for each in on_map.kinds]
            unplaced = on_map.rejoined(others, unknown.start).posterior.uncertainty
            yield from remarks_on_places(on_map.posterior.uncertainty, unplaced)


def bins_on(on_map: JointMap) -> RangeBins:
    """Return the bins in which the ranges are observations of a map."""
    observed = on_map.observed[RANGES]
    assert isinstance(observed, BinnedRanges), "ranges come in bins"
    return observed.bins


def _paper_table(on_map: RangesOnMap) -> TwoCandidate | None:
    """Return the paper's table of the ranges of the log, with the anchors carried into the first camera's frame."""
    problem, placed = on_map.problem, on_map.state.metric_from_model
    anchors = (on_map.state.anchors_m - placed.translation) @ placed.rotation
    anchor_m = anchors[problem.anchor_index]
    table = two_candidate(problem.centers, problem.tag_from_center, anchor_m, problem.range_m)
    return table and replace(table, rows=on_map.posed.rows[table.rows])
