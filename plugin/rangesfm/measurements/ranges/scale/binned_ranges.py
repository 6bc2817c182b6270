"""Ranges as observations of a map: averaged in bins, with the errors of a radio (sections 2, 4 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.errors.components import CLOCKS, OtherError
from rangesfm.measurements.ranges.errors.learned import widened
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, noisiness
from rangesfm.measurements.ranges.scale.range_equation import (
    prior_jacobian,
    prior_residuals,
    state_after,
)
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.words import RANGES
from rangesfm.solver.bending import BENDS
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS, Noise
from rangesfm.solver.posterior import Observations, Posterior


@dataclass(frozen=True)
class BinnedRanges(Observations):
    """Ranges in bins, about a solution of their problem; the biases of anchors are among their errors.

    Attributes:
        bins: of the ranges.
    """

    bins: RangeBins = field(kw_only=True)


def binned_ranges(on_map: RangesOnMap, max_num_bins: int = MAX_NUM_OBSERVATIONS) -> BinnedRanges:
    """Average ranges in bins, and linearise them about their solution.

    Args:
        max_num_bins: fewer bins are coarser and take less time.
    """
    own, others_m2 = on_map.with_problem(on_map.problem.without_others()), dict[OtherError, Array]()
    noise_of_anchor = noisiness(own.problem.anchor_index, own.fit_residual_m, own.problem.num_anchors)
    # A range of which the log states the noise counts by that.
    precision = np.where(own.errors.is_estimated, own.noise_stddev_m, own.errors.given_m) ** -2.0
    bins = own.bins(own.weights * (precision / np.median(precision)), noise_of_anchor, max_num_bins)
    if own.posed.velocity is not None and (clock_s := own.posed.observations.time_offset_stddev_s):
        rates = bins.mean(own.by_time)
        others_m2[CLOCKS] = clock_s**2 * np.outer(rates, rates)
    alone_m2 = 1 / np.maximum(bins.total(own.weights / own.errors.stddev_m**2), 1e-12)
    return in_bins(own, bins, own.noise_stddev_m, others_m2, alone_m2)


def in_bins(
    on_map: RangesOnMap, bins: RangeBins, noise_m: float, others_m2: Mapping[OtherError, Array], alone_m2: Array
) -> BinnedRanges:
    """Average ranges in bins, and linearise them about their state.

    Args:
        noise_m: standard deviation of single ranges. others_m2: as of ``RangesOnMap.errors_of``.
        alone_m2: (c,) variances of the bins as if each single range erred independently.
    """
    return BinnedRanges(
        **vars(on_map.linearized(bins)),
        kind=RANGES,
        by_pose=bins.by_pose(on_map.by_poses, len(on_map.posed.bending.path)),
        components=widened(on_map.errors_of(bins, others_m2), noise_m),
        alone_m2=np.diag(alone_m2),
        is_used=np.ones(len(bins), dtype=bool),
        bins=bins,
    )


def moved(on_map: RangesOnMap, known: Posterior) -> RangesOnMap:
    """Return the ranges at the estimate of a posterior about their state, with the same robust weights.

    The estimate is linear. An anchor that moves by much across a length that was surveyed would change it, so that the
    anchors make one more step to where the priors are as the estimate has them.
    """
    problem, before, columns = on_map.weighted.without_others(), on_map.state, known.columns
    problem = replace(problem, bias_stddev_m=np.zeros(problem.num_anchors))
    slopes = prior_jacobian(problem, columns, before)
    state = state_after((columns,), before, known.step)
    linear = prior_residuals(problem, columns, before) + slopes @ known.step
    again = known.covariance @ slopes.T @ (linear - prior_residuals(problem, columns, state))
    again[columns.of_map] = 0.0
    return replace(on_map, state=state_after((columns,), before, known.step + again))


def shared_errors_m(on_map: RangesOnMap, noise: Noise, bins: RangeBins) -> Array:
    """Return the errors (n, k) that all n ranges of the log share, for k independent standard deviations.

    They are the principal axes of the learnt errors, in units of what a bin's ranges scatter by themselves; axes along
    which the errors are smaller than that are noise to the bins anyway.

    Args:
        noise: of their bins; the errors of the map are left out, as photos see them.
    """
    covariance_m2, errors = noise.without("white", *BENDS).covariance_m2, on_map.errors
    worth = bins.total(errors.worth * on_map.weights / errors.stddev_m**2)
    scatter_m = 1 / np.sqrt(np.maximum(worth, 1e-12))
    variances, axes = np.linalg.eigh(covariance_m2 / np.outer(scatter_m, scatter_m))
    matters = variances > 1
    of_bins = scatter_m[:, None] * axes[:, matters] * np.sqrt(variances[matters])
    of_log = np.zeros((len(on_map.posed.observations.log), of_bins.shape[1]))
    of_log[on_map.posed.rows] = of_bins[bins.of_range]
    return of_log
