"""Whether a refinement did what one does, or broke the map: it is compared with the scaled map that it began with."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.reprojection import PointErrors, point_errors
from rangesfm.geometry.similarity import IDENTITY, align_most, path_shape
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.observations import RangeStatus
from rangesfm.refine.with_ranges import RefineSummary
from rangesfm.scale.estimate import ScaleEstimate

# What the solver may pay in pixels is bounded (see ``_max_growth``); that bound is of sums of squares, and compared are
# medians, which know nothing of a few large ones.
_OF_MEDIANS = 1.5
# In errors typical before: of one that is large. Of so many more points, it is not a matter of a few.
_LARGE, _MANY_MORE = 10.0, 0.05
# Of the median distance of the points from the middle of the path.
_MAX_POINTS_GROWTH = 2.0
# Of the median residual of the ranges, or of their stddev: a refinement brings them nearer.
_MAX_RESIDUAL_GROWTH = 2.0
# Half widths of the scale's 95 % interval: beyond them it is no longer the same map.
_MAX_HALF_WIDTHS = 3.0


def why_broken(
    scaled: pycolmap.Reconstruction,
    refined: pycolmap.Reconstruction,
    trajectory: Trajectory,
    estimate: ScaleEstimate,
    summary: RefineSummary,
    range_loss_scale: float,
) -> tuple[str, ...]:
    """What a refined map cannot be; empty if nothing speaks against it.

    Args:
        scaled, refined: before and after, in the same metric world.
        trajectory: of the keyframes, in any world.
        range_loss_scale: of the refinement's options.
    """
    before, after = point_errors(scaled), point_errors(refined)
    old, new = (trajectory.as_in(model).centers for model in (scaled, refined))
    return (
        *_out_of_line(before, after, summary, _max_growth(scaled, summary, range_loss_scale)),
        *_elsewhere(before.points - old.mean(axis=0), after.points - new.mean(axis=0), old, new, estimate),
        *_apart_from_ranges(estimate, summary, old),
    )


def _max_growth(scaled: pycolmap.Reconstruction, summary: RefineSummary, range_loss_scale: float) -> float:
    """By how much the typical reprojection error may grow.

    The solver only goes down, and the loss of a range is bounded by half the square of its scale c: so n ranges can pay
    for at most n c^2 in squared pixel stddevs, which spread over the 2 N coordinates of N observations.
    """
    num_ranges = int(np.count_nonzero(summary.observations.status <= RangeStatus.OUTLIER))
    num_coordinates = 2 * max(scaled.compute_num_observations(), 1)
    return _OF_MEDIANS * float(np.sqrt(1 + num_ranges * range_loss_scale**2 / num_coordinates))


def _out_of_line(before: PointErrors, after: PointErrors, summary: RefineSummary, max_growth: float) -> Iterator[str]:
    if not after.fit:
        yield (
            f"the refined map's points lie {after.median_px:.3g} px (median) from where the photos show them, "
            f"expected below {after.max_median_px:.3g} px"
        )
        return
    typical_px = max(before.median_px, summary.pixel_stddev if before.fit else 0.0)
    if after.median_px > max_growth * typical_px:
        yield (
            f"the reprojection error grew from {before.median_px:.2f} to {after.median_px:.2f} px (median); the ranges "
            f"account for {max_growth:.1f} times at most"
        )
    shares = [float(np.mean(of.error_px > _LARGE * max_growth * typical_px)) for of in (before, after)]
    if shares[1] > shares[0] + _MANY_MORE:
        yield (
            f"{100 * shares[1]:.0f} % of the points are far from where the photos show them, {100 * shares[0]:.0f} % "
            "before"
        )


def _elsewhere(old_points: Array, new_points: Array, old: Array, new: Array, estimate: ScaleEstimate) -> Iterator[str]:
    """Points, from the path's middle, and keyframes."""
    # Those on the horizon may go where they like, half of all may not.
    old_m, new_m = (np.median(np.linalg.norm(of, axis=1)) if len(of) else 0.0 for of in (old_points, new_points))
    if len(old_points) and new_m > _MAX_POINTS_GROWTH * old_m:
        yield f"the points were thrown away from the path: from {old_m:.3g} to {new_m:.3g} m (median)"
    if len(old) < 3:
        return
    change = align_most(old, new, IDENTITY).scale
    half_width = estimate.uncertainty.half_width_95
    if not change > 0 or abs(np.log(change)) > _MAX_HALF_WIDTHS * half_width:
        yield (
            f"the refinement changed the scale by {100 * (change - 1):+.1f} %, where it was known to "
            f"{100 * half_width:.1f} % (95 % interval)"
        )


def _apart_from_ranges(estimate: ScaleEstimate, summary: RefineSummary, path_m: Array) -> Iterator[str]:
    """Ranges that were lost, and surveyed anchors that ended elsewhere altogether: by more than the path is large."""
    if estimate.solution is not None:
        old_m = float(np.median(np.abs(estimate.solution.fit.residuals_m)))
        new_m = float(np.nanmedian(np.abs(summary.predicted_m - summary.observations.log.range_m)))
        if new_m > _MAX_RESIDUAL_GROWTH * max(old_m, estimate.noise_stddev_m):
            yield f"ranges and map are {new_m:.2g} m apart (median), where they were {old_m:.2g} m"
    size_m = float(np.linalg.norm(path_shape(path_m).stddevs))
    for anchor in summary.anchors:
        prior_m, stddev_m = anchor.prior_position_m, anchor.prior_position_stddev_m
        if prior_m is None or not 0 < stddev_m < np.inf:
            continue
        moved_m = float(np.linalg.norm(anchor.position_m - prior_m))
        if moved_m > max(size_m, 10 * stddev_m):
            yield f"anchor {anchor.anchor_id} went {moved_m:.3g} m from where it was surveyed"
