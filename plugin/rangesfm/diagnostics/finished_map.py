"""Faults of a finished map that its scale's interval does not show, and the uncertainty of its place.

A refined map is first compared with the scaled map that the refinement started from, because the refinement may have
broken it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.pieces import LoosePiece
from rangesfm.colmap.reprojection import MISMATCHED, PointErrors, point_errors
from rangesfm.diagnostics.place import Place, by_similarity, place_in_words
from rangesfm.errors import number_text
from rangesfm.estimation.map_posterior import sizes_of_parts
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.with_ranges import RangesInMap, RefineSummary
from rangesfm.measurements.joint_map import JointMap
from rangesfm.measurements.kind import Doubt
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95
from rangesfm.util.geometry.similarity import path_shape
from rangesfm.util.geometry.trajectory import Trajectory

# Allowance for comparing medians: ``_max_growth`` bounds sums of squares, while medians ignore a few large errors.
_OF_MEDIANS = 1.5
# An error is large if it exceeds this many typical errors before the refinement. An increase of the share of points
# with large errors by more than the second number is not due to a few points.
_LARGE, _MANY_MORE = 10.0, 0.05
# Largest growth of the median distance of the points from the middle of the path.
_MAX_POINTS_GROWTH = 2.0
# Largest growth of the median residual of the ranges, or of their standard deviation; a refinement should reduce it.
_MAX_RESIDUAL_GROWTH = 2.0
# A keyframe hangs loose on the map if it is this many times less certain than the median one.
_LOOSE = 10.0


def doubts_of_points(points: PointErrors) -> tuple[Doubt, ...]:
    """Return a doubt if the points of a map do not fit the photos."""
    return () if points.fit else (Doubt(points.apart("the map"), MISMATCHED),)


def doubts_of_refinement(summary: RefineSummary) -> Iterator[Doubt]:
    """Yield doubts about a refinement."""
    if not summary.converged:
        remedy = "allow more iterations ([refine] max_num_iterations), or remove wrong points from the map"
        yield Doubt(f"the refinement stopped before it converged: {summary.message}", remedy)
    for misfit in summary.misfits:
        yield Doubt(f"after the refinement {misfit.reason}", misfit.advice)


def doubts_of_pieces(pieces: Sequence[LoosePiece], on_map: JointMap, num_images: int) -> Iterator[Doubt]:
    """Yield a doubt for each part of a model whose size beside the rest is not as photos and measurements tell it.

    Args:
        pieces: the parts that share few points with the rest. on_map: all that is measured in the map.
    """
    advice = (
        "match more pairs of photos across that gap ([mapper] matching, [mapper.pairing]) and reconstruct again, or "
        "survey the parts apart and join them by their ranges (rangesfm join)"
    )
    sizes = sizes_of_parts(on_map)
    for piece in pieces:
        is_part = np.isin(on_map.bending.path.image_names, piece.image_names)
        size = next((each for each in sizes if np.array_equal(each.part, is_part)), None)
        if size is not None and size.half_width_95 < DOUBTFUL_ABOVE:
            continue
        known = "so that the two parts may differ in scale and place"
        if size is not None and size.is_determined:
            off = f"it is too large by {number_text(100 * size.off, '.1f')} %" if size.off else "its size is known"
            known += f"; beside the others, {off}, +- {100 * NORMAL_95 * size.stddev:.1f} % (95 %)"
        yield Doubt(
            f"the photos do not hold the map together: {len(piece.image_names)} of its {num_images} photos "
            f"({piece.image_names[0]} to {piece.image_names[-1]}) share only {piece.num_shared} points with the "
            f"others, {known}",
            advice,
        )


def place_of_map(
    estimate: ScaleEstimate,
    errors: MapErrors,
    path: Trajectory,
    doubts: Sequence[str],
    bent_by_m: Array,
) -> Place | None:
    """Return the map's place in the site's frame with its uncertainty; None if the frame is the first camera's.

    Args:
        errors: of the refined map; not known for a map that is only scaled.
        path: of the n keyframes in the final map, the first in time first.
        doubts: about the map, in words; with any of them its place is doubtful too.
        bent_by_m: (n,) how far the ranges would bend each keyframe of a map that is only scaled; (0,) if unknown.
    """
    if estimate.placement is None:
        return None
    centers_m = path.centers
    of_map, of_keyframes = by_similarity(estimate.placement, centers_m)
    if errors.are_known:
        of_keyframes = errors.centers_m2(path.frame_ids)
    keyframes_m2 = np.trace(of_keyframes, axis1=1, axis2=2)
    stddevs = np.sqrt(np.maximum(np.diag(of_map), 0.0))
    bent_m2 = np.square(bent_by_m) if not errors.are_known and len(bent_by_m) else 0.0
    keyframes_m = np.sqrt(keyframes_m2 + bent_m2)
    worst_m = float(keyframes_m.max())
    surveyed = [a.prior_position_m for a in estimate.ranges.anchors if a.prior_position_m is not None]
    size_m = float(np.linalg.norm(np.ptp(np.vstack([centers_m, *surveyed]), axis=0)))
    in_words, is_wide = place_in_words(stddevs, worst_m, size_m)
    loose = _loose_ones(path, keyframes_m) if is_wide else ()
    reasons = (*((in_words,) if is_wide or not doubts else ()), *loose, *doubts)
    return Place(
        verdict="doubtful" if is_wide or doubts else "good",
        reasons=reasons,
        stddev_m=stddevs[4:].tolist(),
        heading_stddev_deg=float(np.rad2deg(stddevs[3])),
        worst_keyframe_stddev_m=worst_m,
    )


def _loose_ones(path: Trajectory, keyframes_m: Array) -> Iterator[str]:
    """Yield which keyframes are far less certain than the others, as those that see next to nothing of them are."""
    is_loose = keyframes_m > _LOOSE * np.median(keyframes_m)
    if not is_loose.any():
        return
    least, more = int(keyframes_m.argmax()), np.count_nonzero(is_loose) - 1
    loose = f"{path.image_names[least]}" + (f" (and {more} more)" if more else "")
    others_m = NORMAL_95 * keyframes_m[~is_loose].max()
    yield (
        f"the photos hardly tie keyframe {loose} to the map; each other keyframe is known to {others_m:.2g} m or "
        "better (95 %)"
    )


def why_broken(
    scaled: pycolmap.Reconstruction,
    refined: pycolmap.Reconstruction,
    trajectory: Trajectory,
    estimate: ScaleEstimate,
    summary: RefineSummary,
    range_loss_scale: float,
) -> tuple[str, ...]:
    """Return the signs that a refinement broke the map; empty if there are none.

    Args:
        scaled, refined: the map before and after, in the same metric world.
        trajectory: of the keyframes, in any world.
        range_loss_scale: as in the refinement's options.
    """
    before, after = point_errors(scaled), point_errors(refined)
    old, new = (trajectory.as_in(model).centers for model in (scaled, refined))
    return (
        *_out_of_line(before, after, summary, _max_growth(scaled, summary, range_loss_scale)),
        *_elsewhere(before.points - old.mean(axis=0), after.points - new.mean(axis=0)),
        *_apart_from_ranges(estimate, summary.ranges, old),
    )


def _max_growth(scaled: pycolmap.Reconstruction, summary: RefineSummary, range_loss_scale: float) -> float:
    """Return the factor by which the typical reprojection error may grow.

    The solver only reduces the cost, and the loss of a range is bounded by half the square of its scale c. So n ranges
    can outweigh at most n c^2 in squared pixel standard deviations, spread over the 2 N coordinates of N observations.
    """
    num_ranges = int(np.count_nonzero(summary.ranges.observations.has_place))
    num_coordinates = 2 * max(scaled.compute_num_observations(), 1)
    return _OF_MEDIANS * float(np.sqrt(1 + num_ranges * range_loss_scale**2 / num_coordinates))


def _out_of_line(before: PointErrors, after: PointErrors, summary: RefineSummary, max_growth: float) -> Iterator[str]:
    if not after.fit:
        yield after.apart("the refined map")
        return
    typical_px = max(before.median_px, summary.pixel_stddev if before.fit else 0.0)
    if after.median_px > max_growth * typical_px:
        yield (
            f"the reprojection error grew from {before.median_px:.2f} to {after.median_px:.2f} px (median), by more "
            f"than the factor {max_growth:.1f} that the ranges can cause"
        )
    shares = [float(np.mean(of.error_px > _LARGE * max_growth * typical_px)) for of in (before, after)]
    if shares[1] > shares[0] + _MANY_MORE:
        yield (
            f"{100 * shares[1]:.0f} % of the points are far from where the photos show them, {100 * shares[0]:.0f} % "
            "before"
        )


def _elsewhere(old_points: Array, new_points: Array) -> Iterator[str]:
    """Yield a reason if points moved away; both sets are relative to the path's middle, metres."""
    # Points near the horizon may move far, but not half of all points.
    old_m, new_m = (np.median(np.linalg.norm(of, axis=1)) if len(of) else 0.0 for of in (old_points, new_points))
    if len(old_points) and new_m > _MAX_POINTS_GROWTH * old_m:
        yield f"the points moved away from the path: from {old_m:.3g} to {new_m:.3g} m (median)"


def _apart_from_ranges(estimate: ScaleEstimate, ranges: RangesInMap, path_m: Array) -> Iterator[str]:
    """Yield reasons if the ranges no longer fit, or a surveyed anchor moved by more than the extent of the path."""
    if np.isfinite(old_m := estimate.ranges.median_off_m):
        new_m = float(np.nanmedian(np.abs(ranges.residuals_m)))
        if new_m > _MAX_RESIDUAL_GROWTH * max(old_m, estimate.ranges.noise_stddev_m):
            yield f"the difference of ranges and map grew from {old_m:.2g} to {new_m:.2g} m (median)"
    size_m = float(np.linalg.norm(path_shape(path_m).stddevs))
    for anchor in ranges.anchors:
        if anchor.prior_position_m is not None and np.isfinite(anchor.prior_position_stddev_m):
            far_m = float(np.linalg.norm(anchor.position_m - anchor.prior_position_m))
            if far_m > max(size_m, 10 * anchor.prior_position_stddev_m):
                yield f"anchor {anchor.anchor_id} was moved {far_m:.3g} m from its surveyed position"
