"""Ranges on a map as they would be without a mistake."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.trust.hypothesis import Correction
from rangesfm.trust.ranges_on_map import RangesOnMap


def corrected(on_map: RangesOnMap, correction: Correction) -> RangesOnMap:
    """The same ranges, with anchors, lever arms, times and lengths as they would be; none is left out."""
    problem, mean_m = on_map.problem, on_map.problem.anchor_mean_m.copy()
    anchors_m = on_map.state.anchors_m.copy()
    for name, position in correction.anchors_m.items():
        k = on_map.anchor_ids.index(name)
        mean_m[k] = np.full(3, np.nan) if position is None else position
        anchors_m[k] = anchors_m[k] if position is None else position
    moves = np.array([correction.tag_moves_m.get(tag, np.zeros(3)) for tag in on_map.tag_ids])
    turned = np.einsum("nij,nj->ni", on_map.model_from_cam, moves[on_map.tag_index])
    centers, range_m = problem.centers, problem.range_m
    if on_map.velocity is not None:
        centers = centers + on_map.velocity * np.reshape(correction.time_shift_s, (-1, 1))
    if correction.longer_m is not None:
        range_m = range_m - correction.longer_m
    problem = replace(
        problem,
        anchor_mean_m=mean_m,
        tag_from_center=problem.tag_from_center + turned,
        centers=centers,
        range_m=range_m,
    )
    return replace(on_map, problem=problem, state=replace(on_map.state, anchors_m=anchors_m))
