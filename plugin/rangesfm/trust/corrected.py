"""Ranges on a map as they would be without a mistake."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
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
    problem = replace(problem, anchor_mean_m=mean_m)
    on_map = replace(on_map, problem=problem, state=replace(on_map.state, anchors_m=anchors_m))
    if on_map.velocity is not None and np.any(correction.time_shift_s):
        on_map = _taken_later(on_map, np.broadcast_to(correction.time_shift_s, len(on_map.time_s)), on_map.velocity)
    problem = on_map.problem
    if correction.longer_m is not None:
        problem = replace(problem, range_m=problem.range_m - correction.longer_m)
    if correction.tag_moves_m:
        moves = np.array([correction.tag_moves_m.get(tag, np.zeros(3)) for tag in on_map.tag_ids])
        turned = np.einsum("nij,nj->ni", on_map.model_from_cam, moves[on_map.tag_index])
        problem = replace(problem, tag_from_center=problem.tag_from_center + turned)
    return replace(on_map, problem=problem)


def _taken_later(on_map: RangesOnMap, shift_s: Array, velocity: Array) -> RangesOnMap:
    """Each range where the one was taken that is nearest to its own time, and on by the velocity (n, 3) there."""
    problem, taken_s = on_map.problem, on_map.time_s + shift_s
    order = np.argsort(on_map.time_s, kind="stable")
    rising_s = on_map.time_s[order]
    after = np.clip(np.searchsorted(rising_s, taken_s), 1, len(order) - 1)
    at = order[np.where(taken_s - rising_s[after - 1] < rising_s[after] - taken_s, after - 1, after)]
    arms = np.einsum("nji,nj->ni", on_map.model_from_cam, problem.tag_from_center)
    turned = on_map.model_from_cam[at]
    centers = problem.centers[at] + velocity[at] * (taken_s - on_map.time_s[at])[:, None]
    return replace(
        on_map,
        problem=replace(problem, centers=centers, tag_from_center=np.einsum("nij,nj->ni", turned, arms)),
        model_from_cam=turned,
        velocity=velocity[at],
    )
