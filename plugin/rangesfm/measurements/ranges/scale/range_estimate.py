"""What the scale stage says of the ranges of a log besides the scale: of each anchor, and of what errors would do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.errors.range_bins import RangeBins
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    RangeState,
    predicted_ranges,
    solve,
)
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.scale_problem import MIN_RANGES
from rangesfm.measurements.ranges.scale.sensitivity import NOT_KNOWN, ScaleSensitivity
from rangesfm.measurements.ranges.scale.starts import choose_sides
from rangesfm.measurements.ranges.scale.two_candidate import TwoCandidate
from rangesfm.options import RangeModelOptions
from rangesfm.solver.posterior import Posterior
from rangesfm.util.geometry.numerics import ROUNDING
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE, MIN_COST_GAP
from rangesfm.util.geometry.similarity import Similarity


def scale_sensitivity(on_map: RangesOnMap, by_bins: Array, bins: RangeBins) -> ScaleSensitivity:
    """Return the changes of the scale in percent, to first order.

    Args:
        by_bins: (c,) change of the scale's logarithm per metre that each bin is longer.
        bins: of the ranges.
    """
    problem = on_map.problem

    def percent(range_error_m: Array) -> float:
        return 100 * float(by_bins @ bins.mean(range_error_m))

    distance, centimetre = predicted_ranges(problem, on_map.state), 0.01
    along_x, along_y, along_z = on_map.gradient.by_tag_in_cam(on_map.world_from_cam).T
    return ScaleSensitivity(
        common_bias_per_cm=percent(np.full(len(distance), centimetre)),
        # Rounding spreads ranges of one length, of which none is a shorter one.
        short_range_per_cm=percent(np.where(distance < (1 - ROUNDING) * np.median(distance), centimetre, 0.0)),
        anchor_bias_per_cm={
            anchor_id: percent(np.where(problem.anchor_index == k, centimetre, 0.0))
            for k, anchor_id in enumerate(on_map.anchor_ids)
        },
        range_slope_per_percent=percent(0.01 * distance),
        # A tag further out than assumed lengthens the measured ranges, which then stretch the map.
        lever_arm_per_cm=(percent(centimetre * along_x), percent(centimetre * along_y), percent(centimetre * along_z)),
    )


@dataclass(frozen=True)
class RangeEstimate:
    """What an estimate of the scale says of the n ranges of a log, which may be none.

    Attributes:
        observations: all ranges of the log, with their status by final weight.
        errors: of all n ranges, as weighted; their inflation widens the formal standard deviation.
        noise_stddev_m: standard deviation of an ordinary range.
        error_stddevs: learnt standard deviations of the components of the errors, by name; empty before.
        median_off_m: median of the absolute differences of ranges and map; NaN if no range took part.
        anchors: estimates in the order of the log.
        per_anchor: scale from each anchor alone, by id; anchors that do not determine one are missing.
        sensitivity: change of the scale per error of the range model.
        two_candidate: the paper's table; None where too few ranges have candidates.
        shared_errors_m: (n, k) errors that the log's ranges share, for k independent standard deviations: what other
            kinds of measurement may correct. k is 0 where there are only ranges.
    """

    observations: RangeObservations
    errors: RangeErrors
    noise_stddev_m: float = np.nan
    error_stddevs: Mapping[str, float] = field(default_factory=dict)
    median_off_m: float = np.nan
    anchors: tuple[AnchorEstimate, ...] = ()
    per_anchor: Mapping[str, float] = field(default_factory=dict)
    sensitivity: ScaleSensitivity = NOT_KNOWN
    two_candidate: TwoCandidate | None = None
    shared_errors_m: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def begun(cls, observations: RangeObservations, range_model: RangeModelOptions) -> RangeEstimate:
        """Return what is known of a log before its ranges are used."""
        return cls(observations, RangeErrors.begin(observations, observations.placed_rows, range_model))

    def predicted_m(self, metric_from_sfm: Similarity) -> Array:
        """Return the (n,) ranges that a placement of the unscaled path predicts, metres; NaN without a place."""
        anchors_m = np.array([anchor.position_m for anchor in self.anchors]).reshape(-1, 3)
        biases_m = np.array([anchor.range_bias_m for anchor in self.anchors])
        return self.observations.predicted_m(metric_from_sfm, anchors_m, biases_m)


# An anchor gives no scale of its own if the standard deviation of the scale's logarithm is larger than this.
_MAX_LOG_SCALE_STDDEV = 0.5


def scale_per_anchor(on_map: RangesOnMap) -> dict[str, float]:
    """Estimate the scale from the ranges of one anchor at a time; by anchor id.

    With a known anchor the path is stretched about its centre, or about the first camera where that is the frame's
    origin. An unknown anchor is estimated along with the scale.
    """
    problem, state, scales = on_map.weighted, on_map.state, {}
    middle = problem.centers.mean(axis=0) if problem.frame_is_free else np.zeros(3)
    placed = replace(state.metric_from_model, translation=state.metric_from_model.apply(middle))
    for k, anchor_id in enumerate(on_map.anchor_ids):
        part = problem.of_anchor(k)
        if len(part.range_m) < MIN_RANGES:
            continue
        alone = replace(part, centers=part.centers - middle)
        start = RangeState(placed, state.anchors_m[k : k + 1], state.bias_m[k : k + 1])
        fit = solve(alone, start, loss=GEMAN_MCCLURE)
        if fit.log_scale_stddev * on_map.errors.inflation < _MAX_LOG_SCALE_STDDEV:
            scales[anchor_id] = fit.state.metric_from_model.scale
    return scales


def anchor_estimates(on_map: RangesOnMap, known: Posterior) -> tuple[AnchorEstimate, ...]:
    """Return the estimates of all anchors of the log, mirror places included, on the map moved to a posterior."""
    problem, state, mirrors = on_map.problem, on_map.state, _mirror_places(on_map)
    common_bias_m, estimates = _common_bias(problem, state), []
    for k, (anchor_id, column) in enumerate(zip(on_map.anchor_ids, known.columns.anchor.tolist(), strict=True)):
        covariance_m2 = known.covariance[column : column + 3, column : column + 3] if column >= 0 else np.zeros((3, 3))
        heard = bool(np.any(problem.anchor_index == k))
        estimates.append(
            AnchorEstimate(
                anchor_id=anchor_id,
                position_m=state.anchors_m[k] if heard else problem.anchor_mean_m[k],
                position_stddev_m=float(np.sqrt(np.trace(covariance_m2) / 3)),
                prior_position_m=problem.anchor_mean_m[k] if np.isfinite(problem.anchor_mean_m[k]).all() else None,
                prior_position_stddev_m=float(problem.anchor_stddev_m[k]),
                range_bias_m=float(state.bias_m[k] if heard else problem.bias_mean_m[k] + common_bias_m),
                prior_bias_m=float(problem.bias_mean_m[k]),
                prior_bias_stddev_m=float(problem.bias_stddev_m[k]),
                mirror_position_m=mirrors.get(k),
                position_covariance_m2=covariance_m2,
            )
        )
    return tuple(estimates)


def _common_bias(problem: RangeProblem, state: RangeState) -> float:
    """Return the most likely bias, metres, that all free biases share, given their deviations from the prior means."""
    free = problem.bias_stddev_m > 0
    if not free.any() or problem.common_bias_stddev_m == 0:
        return 0.0
    weights = 1 / problem.bias_stddev_m[free] ** 2
    off = (state.bias_m - problem.bias_mean_m)[free]
    return float(weights @ off / (weights.sum() + 1 / problem.common_bias_stddev_m**2))


def _mirror_places(on_map: RangesOnMap) -> dict[int, Array]:
    """Return the mirror places, by index, of unknown anchors that may stand on either side of the path's plane."""
    chosen, others_m, rise = choose_sides(on_map.weighted, on_map.state)
    sides_m = np.stack([chosen.anchors_m, others_m])
    is_open = rise / on_map.errors.inflation**2 < MIN_COST_GAP
    farther = np.argmax(np.linalg.norm(sides_m - on_map.state.anchors_m, axis=2), axis=0)
    return {int(k): sides_m[farther[k], k] for k in np.flatnonzero(is_open)}
