"""A metric map with its ranges, treated as a solved scale problem: learnt errors and uncertainty at that map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import ScaleOptions
from rangesfm.ranging.errors.bending import BendingOfBins, MapBending
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_bins import RangeBins
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.scale.placement_prior import PlacementPrior
from rangesfm.scale.range_equation import RangeState, fit_at, predicted_ranges
from rangesfm.scale.scale_by_lengths import LengthScale
from rangesfm.scale.scale_by_positions import PositionScale
from rangesfm.scale.scale_estimate import ScaleEstimate, ScaleUncertainty
from rangesfm.scale.scale_problem import ScaleProblem, first_camera_from
from rangesfm.scale.scale_verdict import judge, judge_positions
from rangesfm.scale.solution import Solution, weighted, with_unknown_anchors
from rangesfm.scale.uncertainty import KnownMap, bending_of_bins, known_map, learned_errors


@dataclass(frozen=True)
class MapWithRanges:
    """A map estimated from photos and ranges together.

    Attributes:
        posed: the scale problem of its ranges, on the path of the map, in the unit of the unscaled model.
        solution: the state of the map, with its errors. bending: of the map.
    """

    posed: ScaleProblem
    solution: Solution
    bending: MapBending

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
        shared_m: Array,
        bending: MapBending,
        *,
        placement: PlacementPrior | None = None,
        lengths: LengthScale | None = None,
    ) -> MapWithRanges:
        """Transfer the ranges of a scale estimate to another map.

        Args:
            start: the scale estimate. trajectory_m: of the other map, in the metric world.
            scale: of the other map, metres per unit of the unscaled model.
            tags_m, centers_m: (k, 3) positions of tag and camera at each of the k ranges.
            anchors_m: (m, 3). biases_m: (m,). errors: of the k ranges, as weighted.
            shared_m: (k,) by how much the map takes them to be too long because of shared errors.
            placement: what known positions say of the other map's first camera; None without any.
            lengths: what measured lengths say of the other map's scale; None without any.
        """
        assert start.problem is not None, "a map with ranges"
        trajectory = trajectory_m.transformed(1 / scale, np.eye(3), np.zeros(3))
        from_map = first_camera_from(trajectory)
        placed = Similarity(scale, from_map.rotation.T, trajectory_m.centers[0])
        distances = start.problem.ranges.distances
        if distances is not None and lengths is not None:
            distances = lengths.scaled_by(1 / scale).beside_ranges(distances, with_bending=True)
        problem = replace(
            start.problem.ranges,
            centers=placed.inverse().apply(centers_m),
            tag_from_center=(tags_m - centers_m) @ placed.rotation,
            distances=distances,
            placement=placement,
        )
        posed = replace(start.problem, ranges=problem, trajectory=trajectory)
        state = RangeState(placed, anchors_m, biases_m)
        by_errors = weighted(problem, errors)
        robust = errors.robust_weights(predicted_ranges(problem, state) + shared_m - problem.range_m)
        fit = fit_at(by_errors, state, robust)
        solution = Solution(by_errors, fit, errors, float(np.median(errors.stddev_m)))
        return cls(posed, solution, bending)

    @property
    def metric_from_model(self) -> Similarity:
        return self.solution.fit.state.metric_from_model

    @property
    def predicted_m(self) -> Array:
        """Return the (k,) predicted ranges."""
        return predicted_ranges(self.solution.problem, self.solution.fit.state)

    def change_to(self, moved: MapWithRanges) -> Similarity:
        """Return the change of the world by which this map becomes the same one moved as a whole."""
        return moved.metric_from_model @ self.metric_from_model.inverse()

    def learned(self) -> LearnedErrors:
        """Estimate the errors of the ranges and of the map from the residuals at this map."""
        return learned_errors(self.posed, self.solution, self.bending)

    def bending_factor(self, learned: LearnedErrors) -> float:
        """Return the learnt bending over the bending expected from the photos' residuals; 1 if that is unknown."""
        bending = self._bending_of(learned.bins)
        mean_m = 0.0 if bending is None else float(np.sqrt(np.trace(bending.formal_m2) / len(learned.bins)))
        return learned.stddev_of_component["bending"] / mean_m if mean_m > 0 else 1.0

    def known(self, learned: LearnedErrors, shared_errors_m: Array) -> KnownMap:
        """Return the uncertainty of the map as a whole: scale, placement and anchors.

        Args:
            shared_errors_m: of all ranges of the log, as in ``ScaleEstimate``, with which the map was made.
        """
        shared_m = shared_errors_m[self.posed.rows]
        return known_map(self.posed, self.solution, learned, self._bending_of(learned.bins), shared_m)

    def with_unknown_anchors(self, shared_errors_m: Array) -> ScaleUncertainty | None:
        """Return the uncertainty if no anchor were known; None where none is. Arguments as for ``known``."""
        if not np.isfinite(self.posed.ranges.anchor_stddev_m).any():
            return None
        posed, solution = with_unknown_anchors(self.posed, self.solution.fit.state)
        unknown = replace(self, posed=posed, solution=solution)
        return unknown.known(unknown.learned(), shared_errors_m).uncertainty

    def _bending_of(self, bins: RangeBins) -> BendingOfBins | None:
        return bending_of_bins(self.bending, bins, self.posed, self.solution.fit.state)


def half_way(on_map: MapWithRanges, learned: LearnedErrors, start: ScaleEstimate) -> tuple[KnownMap, MapWithRanges]:
    """Return what is known of a refined map, and the map moved as a whole to where its estimates are half-way.

    Arguments as for ``estimate_at``.
    """
    known = on_map.known(learned, start.shared_errors_m)
    return known, replace(on_map, solution=known.moved(on_map.solution))


def estimate_at(
    on_map: MapWithRanges, learned: LearnedErrors, start: ScaleEstimate, options: ScaleOptions
) -> tuple[ScaleEstimate, MapWithRanges]:
    """Return the scale estimate of a refined map, and the map moved as a whole to this scale.

    Args:
        start: the estimate before the refinement; everything that is no judgement is taken from it.

    Raises:
        GeometryError: refused, as the scale is less certain than ``options.max_relative_stddev``.
    """
    known, moved = half_way(on_map, learned, start)
    unplaced = on_map.with_unknown_anchors(start.shared_errors_m)
    judged = judge(moved.posed, moved.solution, known.uncertainty, {}, start.anchors, options, unplaced)
    estimate = start.judged(
        judged,
        refined_value=moved.metric_from_model.scale,
        uncertainty=known.uncertainty,
        placement=known.columns.placement(known.covariance),
        errors=replace(start.errors, learned=learned.spread(on_map.posed.rows, len(start.observations.log))),
        noise_stddev_m=moved.solution.noise_stddev_m,
    )
    return estimate, moved


def estimate_by_positions_at(
    positions: PositionScale, value: float | None, start: ScaleEstimate, options: ScaleOptions
) -> ScaleEstimate:
    """Return the scale estimate of a map that was refined with known positions alone, judged at that map.

    Args:
        positions: at the refined map. value: its scale. start: the estimate before the refinement.

    Raises:
        GeometryError: as for ``estimate_at``.
    """
    judged = judge_positions(positions.num_used, positions.uncertainty, options, has_check=positions.has_check)
    return start.judged(judged, refined_value=value, uncertainty=positions.uncertainty, placement=positions.covariance)
