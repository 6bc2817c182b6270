"""Faults of a radio survey that make the interval of its scale doubtful, and what is to be said of its anchors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.solution import MANY_OUTLIERS, WHY_SCALE_IS_OPEN
from rangesfm.solver.bending import BENDS
from rangesfm.solver.posterior import ScaleUncertainty
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95, NOTHING_KNOWN
from rangesfm.util.geometry.similarity import NEARLY_FLAT, NEARLY_STRAIGHT, path_kind, path_shape

FEW_RANGES = 50
"""Number of ranges below which outliers and noise can hardly be told apart."""
# Scatter of the scales from single anchors above which they disagree. Antennas and short paths alone cause less.
_MAX_ANCHOR_SPREAD = 0.05
# How much wider the interval is with the anchors' coordinates, where that is said; less is chance.
_WIDENED = 1.1
CALIBRATE = "calibrate the radio at the distances of this survey (rangesfm ranges calibrate)"


def doubts_of_ranges(
    on_map: RangesOnMap, uncertainty: ScaleUncertainty, per_anchor: Mapping[str, float]
) -> Iterator[Doubt]:
    """Yield the faults of the path, of the anchors and of the ranges; ``per_anchor``: scales, by anchor id."""
    problem, weights, half_width = on_map.problem, on_map.weights, uncertainty.half_width_95
    kind = path_kind(problem.centers)
    is_round = kind in ("circular", "spherical") and not problem.has_known_anchors
    # On these paths the scale is uncertain because of their shape: a longer walk of the same shape would not help.
    if half_width > DOUBTFUL_ABOVE and is_round:
        yield Doubt(*WHY_SCALE_IS_OPEN[kind])
    elif np.linalg.norm([uncertainty.components.get(name, 0.0) for name in BENDS]) > NOTHING_KNOWN:
        overlap = "take photos that overlap more, and range more often"
        yield Doubt("ranges and photos leave the shape of the map open", overlap)
    elif half_width > NORMAL_95 * NOTHING_KNOWN:
        yield Doubt("the ranges do not show that the camera moved", "walk a loop of several metres")
    for note in on_map.posed.notes:
        yield Doubt(note, "survey three anchors or more that are not on one line")
    if ids := on_map.posed.left_out:
        which = f"anchor {ids[0]} has" if len(ids) == 1 else f"anchors {', '.join(ids)} have"
        reason = f"{which} too few ranges on the path to be placed: left out"
        yield Doubt(reason, "range more often, or survey them all")
    stddevs = path_shape(problem.centers).stddevs
    if stddevs[1] < NEARLY_STRAIGHT * stddevs[0]:
        if np.isinf(problem.anchor_stddev_m).any():
            yield Doubt("the path is nearly straight: an unknown anchor may stand anywhere on a circle around it")
        elif problem.frame_is_free:
            yield Doubt("the path is nearly straight: the map's roll about it is uncertain")
    if len(weights) < FEW_RANGES:
        reason = f"only {len(weights)} ranges lie on the path"
        yield Doubt(reason, "range more often, and all along the path")
    outliers = float(np.mean(weights < OUTLIER_BELOW))
    if outliers > MANY_OUTLIERS:
        reason = f"{100 * outliers:.0f} % of the ranges do not fit the map: blocked, reflected, or of another anchor"
        yield Doubt(reason, "place the anchors where nothing stands between them and the path")
    if len(per_anchor) > 1:
        spread = float(np.std(np.log(np.array(list(per_anchor.values()))), ddof=1))
        if spread > _MAX_ANCHOR_SPREAD:
            reason = f"the anchors disagree: the scales found with each of them alone scatter by {100 * spread:.1f} %"
            yield Doubt(reason, "check the anchors' positions and antenna delays, and place them in the open")


def remarks_on_anchors(on_map: RangesOnMap, anchors: Sequence[AnchorEstimate]) -> Iterator[Doubt]:
    """Yield what is not determined but does not affect the scale."""
    stddevs = path_shape(on_map.problem.centers).stddevs
    if stddevs[2] >= NEARLY_FLAT * stddevs[0] or all(a.mirror_position_m is None for a in anchors):
        return
    reason = "the path is nearly flat: nothing tells on which side of it the unknown anchors stand (the scale is right)"
    yield Doubt(reason, "raise and lower the camera on the way, or survey the anchors")


def remarks_on_places(uncertainty: ScaleUncertainty, with_unknown_anchors: ScaleUncertainty) -> Iterator[Doubt]:
    """Yield that the anchors' coordinates widen the interval, as they do where they contradict the ranges.

    Args:
        with_unknown_anchors: uncertainty if no place of an anchor were known.
    """
    if not uncertainty.half_width_95 > _WIDENED * with_unknown_anchors.half_width_95:
        return
    yield Doubt(
        "the anchors' coordinates do not quite fit the ranges, which makes the scale less certain: with the anchors "
        f"unknown it would be known to {100 * with_unknown_anchors.half_width_95:.1f} %",
        "measure the coordinates of the anchors' antennas, not of their stands or housings, and give their stddev "
        "(position_stddev_m)",
    )


def levelled_places(on_map: RangesOnMap, found: Sequence[AnchorEstimate]) -> tuple[str, ...]:
    """Describe where gravity puts the first camera if the site's anchors do not fix the map's heading, in words.

    Args:
        found: anchors in the first camera's frame.
    """
    given, gravity = on_map.posed.given, on_map.posed.given.gravity
    if gravity is None or given.anchor_frame != "site" or on_map.problem.frame_is_free:
        return ()
    height_of = {anchor.anchor_id: anchor.position_m[2] for anchor in given.anchors if anchor.position_m is not None}
    texts = []
    for anchor in found:
        if anchor.anchor_id not in height_of or not np.isfinite(anchor.position_m).all():
            continue
        wheres = []
        for place in (anchor.position_m, anchor.mirror_position_m):
            if place is not None:
                rise = float(place @ gravity.up_in_first_camera)
                away = float(np.linalg.norm(place - rise * gravity.up_in_first_camera))
                wheres.append(f"at site height {height_of[anchor.anchor_id] - rise:.2f} m, {away:.2f} m horizontally")
        # An anchor on the path's plane is its own mirror image.
        where = " or ".join(dict.fromkeys(wheres))
        texts.append(
            f"the first camera was {where} from anchor {anchor.anchor_id}; in which direction is not determined"
        )
    return tuple(texts)
