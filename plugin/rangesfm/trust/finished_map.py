"""What speaks against a finished map, whatever its scale's interval says; and how far to trust its place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.colmap.reprojection import PointErrors
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.observations import RangeObservations, RangeStatus
from rangesfm.refine.with_ranges import RefineSummary
from rangesfm.scale.estimate import NORMAL_95, ScaleEstimate

DOUBTFUL_ABOVE = 0.04
"""Half of the 95 % interval from which a place is called doubtful: of the site's size, or of a radian for the heading;
the scale's own limit, so that no length in the map and no place in it is worse."""

# Prior stddevs that a coordinate may be off: by chance one in two thousand is.
_MAX_STDDEVS = 3.5
# Noise of UWB radios in the open is 0.02 to 0.3 m.
_MAX_NOISE_M = 0.4
# Share of an anchor's ranges below which it had no say, and how many it takes to speak of a share.
_MIN_USED, _MIN_RANGES = 0.5, 10
_CHECK_ANCHOR = "measure the anchors again, and see that each stands in the open and has its own label"


@dataclass(frozen=True)
class Doubt:
    """What speaks against a map, and what to do about it."""

    reason: str
    advice: str


@dataclass(frozen=True)
class Place:
    """Where the map is in the site's frame, and how far to trust that.

    Attributes:
        verdict: "good" or "doubtful".
        reasons: why, in words.
        stddev_m: (3,) of the map's middle, in x, y, z.
        heading_stddev_deg: of the map's turn about z.
        worst_keyframe_stddev_m: of the keyframe whose position is least certain: root of its summed variances.
    """

    verdict: str
    reasons: tuple[str, ...]
    stddev_m: tuple[float, float, float]
    heading_stddev_deg: float
    worst_keyframe_stddev_m: float


def doubts_of_map(
    estimate: ScaleEstimate,
    summary: RefineSummary | None,
    refined_scale: float | None,
    points: PointErrors,
    *,
    noise_is_given: bool,
) -> tuple[Doubt, ...]:
    """What speaks against a finished map, each with its numbers; empty if nothing does.

    Args:
        estimate: of the scale.
        summary, refined_scale: of the refinement; None for a map that is only scaled.
        points: of the final model.
        noise_is_given: somebody said how much the ranges scatter.
    """
    stage = estimate if summary is None else summary
    noise_m = np.full(len(stage.observations.log), np.nan) if noise_is_given else stage.errors.stddev_m
    return (
        *_of_fit(estimate, summary, refined_scale, points),
        *_of_say(stage.observations),
        *_of_positions(stage.anchors),
        *_of_noise(stage.observations, noise_m),
    )


def _of_fit(
    estimate: ScaleEstimate, summary: RefineSummary | None, refined_scale: float | None, points: PointErrors
) -> Iterator[Doubt]:
    """Of points that do not fit the photos, of the solver, and of a scale that the refinement took elsewhere."""
    if not points.fit:
        reason = (
            f"the map's points lie {points.median_px:.3g} px (median) from where the photos show them, expected below "
            f"{points.max_median_px:.3g} px"
        )
        yield Doubt(reason, "check that model, photos and the camera's parameters belong together")
    if summary is not None and not summary.converged:
        remedy = "give it more iterations ([refine] max_num_iterations), or the map fewer wrong points"
        yield Doubt(f"the refinement stopped before it converged: {summary.message}", remedy)
    for misfit in () if summary is None else summary.misfits:
        yield Doubt(f"after the refinement {misfit}", "check clocks, lever arm and anchors")
    low, high = estimate.interval_95
    if refined_scale is not None and not low <= refined_scale <= high:
        reason = (
            f"the refined scale, {refined_scale:.5g}, lies outside the scale's own interval, {low:.5g} to {high:.5g}"
        )
        yield Doubt(reason, "photos and ranges disagree: check clocks, lever arm and anchors")


def _of_say(observations: RangeObservations) -> Iterator[Doubt]:
    """Anchors of whose ranges most were left out."""
    log, took_part = observations.log, observations.has_place
    for k, anchor_id in enumerate(log.anchor_ids):
        of_anchor = took_part & (log.anchor_index == k)
        num, num_used = of_anchor.sum(), (of_anchor & (observations.status < RangeStatus.OUTLIER)).sum()
        if num >= _MIN_RANGES and num_used < _MIN_USED * num:
            yield Doubt(f"anchor {anchor_id}: {num_used} of {num} ranges used", _CHECK_ANCHOR)


def _of_positions(anchors: Sequence[AnchorEstimate]) -> Iterator[Doubt]:
    for anchor in anchors:
        prior_m, stddev_m = anchor.prior_position_m, anchor.prior_position_stddev_m
        if prior_m is None or not 0 < stddev_m < np.inf:
            continue
        moved_m = anchor.position_m - prior_m
        worst = int(np.argmax(np.abs(moved_m)))
        if abs(moved_m[worst]) > _MAX_STDDEVS * stddev_m:
            reason = (
                f"anchor {anchor.anchor_id} fits {abs(moved_m[worst]):.2f} m from where it was surveyed (along "
                f"{'xyz'[worst]}), {abs(moved_m[worst]) / stddev_m:.2g} of its stddevs"
            )
            yield Doubt(reason, _CHECK_ANCHOR)


def _of_noise(observations: RangeObservations, noise_m: Array) -> Iterator[Doubt]:
    log = observations.log
    used = (observations.status < RangeStatus.OUTLIER) & np.isfinite(noise_m)
    of_anchors = {
        anchor_id: float(np.median(noise_m[rows]))
        for k, anchor_id in enumerate(log.anchor_ids)
        if (rows := used & (log.anchor_index == k)).sum() >= _MIN_RANGES
    }
    noisy = {anchor_id: stddev_m for anchor_id, stddev_m in of_anchors.items() if stddev_m > _MAX_NOISE_M}
    if not noisy:
        return
    whose = "the ranges" if len(noisy) == len(of_anchors) else f"the ranges to {', '.join(noisy)}"
    reason = f"{whose} scatter by {max(noisy.values()):.2f} m, where UWB radios do by 0.02 to 0.3 m"
    remedy = "check the unit of the ranges and the radio's calibration (rangesfm ranges calibrate)"
    yield Doubt(reason, f"{remedy}; if this radio is so coarse, say so (range_stddev_m)")


def place_of_map(
    estimate: ScaleEstimate, summary: RefineSummary | None, centers_m: Array, doubts: Sequence[Doubt]
) -> Place | None:
    """How far to trust the place of a map in the site's frame; None where its frame is the first camera's.

    Args:
        summary: of the refinement; None for a map that is only scaled.
        centers_m: (n, 3) of the keyframes in the final map, the first in time first.
        doubts: of the map; its place is no better.
    """
    if estimate.placement is None:
        return None
    found = None if summary is None else summary.covariance
    if found is None:
        of_map, of_keyframes = by_similarity(estimate.placement, centers_m)
    else:
        of_map, of_keyframes = found.similarity, found.centers
    stddevs = np.sqrt(np.maximum(np.diag(of_map), 0.0))
    heading_deg = float(np.rad2deg(stddevs[3]))
    worst_m = float(np.sqrt(np.trace(of_keyframes, axis1=1, axis2=2).max()))
    surveyed = [a.prior_position_m for a in estimate.anchors if a.prior_position_m is not None]
    size_m = float(np.linalg.norm(np.ptp(np.vstack([centers_m, *surveyed]), axis=0)))
    summary_of_place = (
        f"the map's place is known to {np.linalg.norm(stddevs[4:]):.2g} m, its heading to {heading_deg:.2g} deg, each "
        f"keyframe to {worst_m:.2g} m or better (1 stddev)"
    )
    is_wide = NORMAL_95 * worst_m > DOUBTFUL_ABOVE * size_m or NORMAL_95 * stddevs[3] > DOUBTFUL_ABOVE
    reasons = (*((summary_of_place,) if is_wide or not doubts else ()), *(doubt.reason for doubt in doubts))
    x_m, y_m, z_m = stddevs[4:].tolist()
    return Place("doubtful" if is_wide or doubts else "good", reasons, (x_m, y_m, z_m), heading_deg, worst_m)


def by_similarity(placement: Array, centers_m: Array) -> tuple[Array, Array]:
    """(7, 7) about the middle of the centres and (n, 3, 3) of each, of a map that is one piece."""
    from_first = similarity_motions(centers_m - centers_m[0])
    to_middle = np.eye(7)
    to_middle[4:] = from_first.mean(axis=0)
    return to_middle @ placement @ to_middle.T, from_first @ placement @ np.swapaxes(from_first, 1, 2)
