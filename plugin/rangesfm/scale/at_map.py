"""A refined map with all that is measured in it: the joint problem at that map, its posterior, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.inference.bending import MapBending
from rangesfm.inference.posterior import JointProblem, Observations, Posterior, joined
from rangesfm.options import ScaleOptions
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_bins import MAX_NUM_BINS, RangeBins
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.scale.binned_ranges import RANGES, binned_ranges, moved
from rangesfm.scale.range_equation import RangeState, fit_at, predicted_ranges
from rangesfm.scale.scale_by_lengths import KnownLengths, LengthScale, scale_by_lengths
from rangesfm.scale.scale_by_positions import PositionScale, moved_similarity
from rangesfm.scale.scale_estimate import ScaleEstimate
from rangesfm.scale.scale_problem import ScaleProblem, first_camera_from
from rangesfm.scale.scale_verdict import judge, judge_lengths, judge_positions
from rangesfm.scale.solution import Solution, weighted, with_unknown_anchors


@dataclass(frozen=True)
class MapWithRanges:
    """A map estimated from photos and ranges together.

    Attributes:
        posed: the scale problem of its ranges, on the path of the map, in the unit of the unscaled model.
        solution: the state of the map, with its errors. bending: of the map.
        shared_m: (k, j) errors of the ranges that the refinement took for shared ones, as ``shared_errors_m``.
    """

    posed: ScaleProblem
    solution: Solution
    bending: MapBending
    shared_m: Array

    @classmethod
    def of(
        cls,
        start: ScaleEstimate,
        trajectory_m: Trajectory,
        scale: float,
        tags_m: Array,
        centers_m: Array,
        anchors_m: Array,
        biases_m: Array,
        errors: RangeErrors,
        off_m: Array,
        bending: MapBending,
        *,
        positions: PositionScale | None = None,
        lengths: LengthScale | None = None,
    ) -> MapWithRanges:
        """Transfer the ranges of a scale estimate to another map.

        Args:
            start: the scale estimate. trajectory_m: of the other map, in the metric world.
            scale: of the other map, metres per unit of the unscaled model.
            tags_m, centers_m: (k, 3) positions of tag and camera at each of the k ranges.
            anchors_m: (m, 3). biases_m: (m,). errors: of the k ranges, as weighted.
            off_m: (k,) by how much the map takes them to be too long because of shared errors.
            positions: known ones on the other map; None without any.
            lengths: measured ones on the other map; None without any.
        """
        assert start.problem is not None, "a map with ranges"
        trajectory = trajectory_m.transformed(1 / scale, np.eye(3), np.zeros(3))
        from_map = first_camera_from(trajectory)
        placed = Similarity(scale, from_map.rotation.T, trajectory_m.centers[0])
        distances = start.problem.ranges.distances
        if distances is not None and lengths is not None:
            distances = lengths.beside_ranges(distances, scale)
        # The model's frame is that of the first camera, in the unit of the unscaled model.
        model_from_map = replace(IDENTITY, scale=1 / scale) @ first_camera_from(trajectory_m)
        problem = replace(
            start.problem.ranges,
            centers=placed.inverse().apply(centers_m),
            tag_from_center=(tags_m - centers_m) @ placed.rotation,
            distances=distances,
            placement=None if positions is None else positions.prior(model_from_map),
        )
        posed = replace(start.problem, ranges=problem, trajectory=trajectory)
        state = RangeState(placed, anchors_m, biases_m)
        by_errors = weighted(problem, errors)
        robust = errors.robust_weights(predicted_ranges(problem, state) + off_m - problem.range_m)
        fit = fit_at(by_errors, state, robust)
        solution = Solution(by_errors, fit, errors, float(np.median(errors.stddev_m)))
        return cls(posed, solution, bending, start.shared_errors_m[posed.rows])

    @property
    def metric_from_model(self) -> Similarity:
        return self.solution.fit.state.metric_from_model

    @property
    def predicted_m(self) -> Array:
        """Return the (k,) predicted ranges."""
        return predicted_ranges(self.solution.problem, self.solution.fit.state)

    def change_to(self, other: MapWithRanges) -> Similarity:
        """Return the change of the world by which this map becomes the same one moved as a whole."""
        return other.metric_from_model @ self.metric_from_model.inverse()

    def joined(self, others: tuple[Observations, ...]) -> tuple[JointProblem, RangeBins]:
        """Join the ranges with observations of other kinds, and learn all errors; return the ranges' bins, too."""
        most = max(MAX_NUM_BINS - sum(len(each.residual_m) for each in others), MAX_NUM_BINS // 2)
        ranges = binned_ranges(self.posed, self.solution, self.shared_m, most)
        return joined([ranges, *others], self.bending, *ranges.priors).learnt(), ranges.bins


@dataclass(frozen=True)
class MeasuredMap:
    """A refined map, and all that is measured in it.

    Attributes:
        problem: of all measurements about this map, with learnt errors.
        path: of the map, in the metric world. scale: metres per unit of the unscaled model.
        others: observations of other kinds than ranges.
        ranges: on this map; None without any. bins: of these.
        positions, lengths: on this map; None without any.
    """

    problem: JointProblem
    path: Trajectory
    scale: float
    others: tuple[Observations, ...]
    ranges: MapWithRanges | None
    bins: RangeBins | None
    positions: PositionScale | None
    lengths: LengthScale | None

    @classmethod
    def of(
        cls,
        path: Trajectory,
        scale: float,
        bending: MapBending,
        ranges: MapWithRanges | None,
        positions: PositionScale | None,
        lengths: KnownLengths | None,
        tested: LengthScale | None,
    ) -> MeasuredMap:
        """Join all measurements at a refined map.

        Args:
            positions: by these alone. lengths: measured ones, in metres.
            tested: by the lengths alone; it says which take part.
        """
        others: tuple[Observations, ...] = () if positions is None else (positions.observed,)
        if lengths is not None and tested is not None and tested.is_used:
            others = (*others, lengths.observed(1.0, tested.is_kept))
        bins = None
        if ranges is not None:
            if positions is not None:
                positions = positions.with_at_most(MAX_NUM_BINS // 2)
                others = (positions.observed, *others[1:])
            problem, bins = ranges.joined(others)
        else:
            problem = joined(others, bending).learnt()
        return cls(problem, path, scale, others, ranges, bins, positions, tested)

    @property
    def posterior(self) -> Posterior:
        """What is known of the map."""
        return self.problem.posterior(is_fitted=True, is_refined=True)

    @property
    def learned(self) -> LearnedErrors | None:
        """Errors of the ranges, with those of the map; None without any."""
        return None if self.bins is None else LearnedErrors.of(self.problem.noise_of(RANGES), self.bins)

    def change(self, known: Posterior) -> Similarity:
        """Return the change of the world that moves the map as a whole to the estimate of its posterior."""
        if self.ranges is not None:
            return self.ranges.change_to(self._moved_ranges(self.ranges, known))
        step = np.zeros(7)
        step[: len(known.columns.of_map)] = known.step[known.columns.of_map]
        return moved_similarity(IDENTITY, step, self.path)

    @staticmethod
    def _moved_ranges(ranges: MapWithRanges, known: Posterior) -> MapWithRanges:
        return replace(ranges, solution=moved(ranges.solution, known))

    def moved(self, known: Posterior) -> MeasuredMap:
        """Return the map, with what is measured in it, at the estimate of its posterior."""
        change = self.change(known)
        positions = self.positions
        if positions is not None:
            positions = replace(positions, site_from_model=change, problem=self.problem, posterior=known)
        ranges = None if self.ranges is None else self._moved_ranges(self.ranges, known)
        return replace(self, ranges=ranges, positions=positions, scale=change.scale * self.scale)

    def judged(self, start: ScaleEstimate, options: ScaleOptions) -> tuple[ScaleEstimate, MeasuredMap]:
        """Return the scale estimate, and the map moved as a whole to this scale.

        Args:
            start: the estimate before the refinement; everything that is no judgement is taken from it.

        Raises:
            GeometryError: refused, as the scale is less certain than ``options.max_relative_stddev``.
        """
        known = self.posterior
        after, uncertainty, positions = self.moved(known), known.uncertainty, self.positions
        estimate = replace(start, lengths=self.lengths or start.lengths)
        if after.ranges is not None:
            on_map, learned = after.ranges, self.learned
            unplaced = None
            if np.isfinite(on_map.posed.ranges.anchor_stddev_m).any():
                unplaced = self._with_unknown_anchors().uncertainty
            judged = judge(on_map.posed, on_map.solution, uncertainty, {}, start.anchors, options, unplaced)
            assert learned is not None, "ranges have learnt errors"
            estimate = replace(
                estimate,
                errors=replace(start.errors, learned=learned.spread(on_map.posed.rows, len(start.observations.log))),
                noise_stddev_m=on_map.solution.noise_stddev_m,
            )
        elif positions is not None:
            judged = judge_positions(positions.num_used, uncertainty, options, has_check=positions.has_check)
        else:
            assert self.lengths is not None, "something is measured"
            judged = judge_lengths(self.lengths, uncertainty, options)
        return (
            estimate.judged(judged, refined_value=after.scale, uncertainty=uncertainty, placement=known.placement),
            after,
        )

    def _with_unknown_anchors(self) -> Posterior:
        """Return what would be known if no place of an anchor were known."""
        assert self.ranges is not None
        posed, solution = with_unknown_anchors(self.ranges.posed, self.ranges.solution.fit.state)
        problem, _ = replace(self.ranges, posed=posed, solution=solution).joined(self.others)
        return problem.posterior(is_fitted=True, is_refined=True)


def tested_lengths(
    lengths: KnownLengths | None, positions: PositionScale | None, start: LengthScale | None
) -> LengthScale | None:
    """Return what lengths on a refined map say, with those left out that were so before; None without any."""
    if lengths is None or start is None:
        return None
    others = [] if positions is None else [positions.observed]
    return scale_by_lengths(lengths, 1.0, others, is_kept=start.is_kept)
