"""Scale initialisation: metres per SfM unit, and their uncertainty, from all that is measured in an unscaled map.

These are steps 1 and 2 of section 5 of ``model.md``, and what follows from them for a map that is only scaled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate, judge_map_of_kinds
from rangesfm.measurements.joint_map import (
    JointMap,
    KindOnMap,
    Located,
    beside_others,
    compared,
    fit_kinds,
    place_first,
    tested_kinds,
)
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_distances import NO_DISTANCES, AnchorDistances
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.range_estimate import RangeEstimate
from rangesfm.measurements.ranges.scale.range_start import RangesOnPath
from rangesfm.measurements.ranges.scale.sensitivity import NOT_KNOWN
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.solver.bending import MapBending, WalkBending
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.gravity import gravity_of
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import with_one_blas_thread


@with_one_blas_thread
def initialize_scale(
    observations: RangeObservations,
    trajectory: Trajectory,
    anchors: Sequence[Anchor],
    *,
    anchor_frame: str,
    options: ScaleOptions = ScaleOptions(),
    range_model: RangeModelOptions = RangeModelOptions(),
    distances: AnchorDistances = NO_DISTANCES,
    others: Sequence[Located] = (),
    bending: MapBending | None = None,
    site: Site = Site(),
    seed: int = 0,
) -> ScaleEstimate:
    """Estimate scale and frame of an unscaled path from ranges, from measurements of other kinds, or from all of them.

    Args:
        observations: ranges on ``trajectory``; may be empty if there are other measurements.
        trajectory: the unscaled path.
        anchors: every anchor of the log, with its prior knowledge.
        anchor_frame: "site" (positions in a site frame: the map is carried there), "first_camera" (positions in the
            first keyframe's camera frame, metres) or "unknown" (positions are ignored; the map stays in the first
            camera's frame).
        distances: measured ones between anchors, by their indices in the log.
        others: measurements of other kinds on ``trajectory``, those first that decide what is doubtful.
        bending: how the map is bent; None: it drifts as a map of poses does.
        site: frame of the anchors' positions.

    Raises:
        InputError: an anchor of the log is not among ``anchors``.
        GeometryError: the scale is not determined.
    """
    bending = bending or WalkBending(trajectory)
    ranges = RangesOnPath(
        *(observations, bending, anchors, anchor_frame, range_model, distances),
        gravity=gravity_of(options.up_in_first_camera),
        camera_side=options.camera_side,
        site=site,
        seed=seed,
    )
    log = RangeEstimate.begun(observations, range_model)
    located = (ranges, *others) if len(observations.log) else others
    return estimate_scale(located, bending, options, log)


def estimate_scale(
    located: Sequence[Located], bending: MapBending, options: ScaleOptions, log: RangeEstimate
) -> ScaleEstimate:
    """Estimate scale and frame of an unscaled path from all that is measured in its map.

    Args:
        located: measurements of all kinds in the map, in the order of the table. bending: of the map.
        log: what is known of the ranges before, which may be none.

    Raises:
        GeometryError: the scale is not determined.
    """
    on_map, by_kind = _started(located, bending)
    on_map = on_map.concluded()
    judged, known = judge_map_of_kinds(on_map, options), on_map.posterior
    used = [each for each in on_map.kinds if each.is_used]
    estimate = ScaleEstimate(
        on_map.estimate,
        on_map.estimate.scale,
        frame="site" if place_first(used).places_map else "first_camera",
        method=used[0].method,
        uncertainty=known.uncertainty,
        verdict=judged.verdict,
        reasons=judged.reasons,
        advice=judged.advice,
        ranges=on_map.of_log(log),
        on_map=on_map,
        placement=known.placement,
        by_kind=by_kind,
    ).remarked(tuple(note for each in on_map.kinds for note in each.notes))
    if options.method == "robust" or not len(log.observations.log):
        return estimate
    return _by_paper(estimate, is_checked=options.method == "two-candidate")


def _started(located: Sequence[Located], bending: MapBending) -> tuple[JointMap, Mapping[str, ScaleByKind]]:
    """Return the map fitted as one piece to all kinds, without what contradicts all else, and the scale by each alone.

    What is left out is first found without the kinds that are solved beside the others, and then once more with them.
    """
    others = tuple(each for each in located if isinstance(each, KindOnMap))
    if used := [each for each in others if each.is_used]:
        others = tested_kinds(others, place_first(used).start, MAX_NUM_OBSERVATIONS, is_last=False)
    for is_last in (False, True):
        kinds = beside_others(located, others)
        used = [each for each in kinds if each.is_used]
        if not used:
            nothing = "nothing in the map is measured but for comparison, as check points and check lengths are"
            why = [note for each in kinds for note in each.notes] or [nothing]
            raise GeometryError(f"the scale is not determined: {'; '.join(why)}")
        # One kind that gives both the map's scale and its place is no scale beside others.
        is_all = len(used) == 1 and (used[0].places_map or used[0].is_solved)
        by_kind = {} if is_all else {each.kind: each.alone.scale for each in used}
        if len(used) == 1:
            alone = used[0].alone
            if len(compared(kinds)) > 1:
                return alone.rejoined(kinds, alone.placed), by_kind
            return replace(alone, kinds=kinds), by_kind
        kinds = tuple(each.with_their_share() for each in kinds)
        placed = place_first([each for each in kinds if each.is_used]).start
        if len(others) == len(kinds):
            break
        kinds, before = tested_kinds(kinds, placed, 120, is_last=is_last), others
        others = tuple(each for each in kinds if not each.is_solved)
        if [each.left_out for each in others] == [each.left_out for each in before]:
            break
    return fit_kinds(kinds, placed, bending), by_kind


def _by_paper(robust: ScaleEstimate, *, is_checked: bool) -> ScaleEstimate:
    """Return the estimate with the paper's scale, of whose error nothing is known.

    Raises:
        GeometryError: the scale is not positive, or, if it is checked, outside the interval of the robust estimate.
    """
    table, (low, high) = robust.ranges.two_candidate, robust.interval_95
    if table is None or not table.scale > 0:
        raise GeometryError("two-candidate found no positive scale: use the robust method")
    if is_checked and not low <= table.scale <= high:
        raise GeometryError(
            f"two-candidate gives {table.scale:.4g} m per unit, outside the 95 % interval of the robust estimate, "
            f"{low:.4g} to {high:.4g}: use the robust method, or ask for it all the same (--scale_method "
            "two-candidate-unchecked)"
        )
    return replace(
        robust,
        metric_from_sfm=replace(robust.metric_from_sfm, scale=table.scale),
        value=table.scale,
        method="two-candidate",
        uncertainty=ScaleUncertainty(np.inf, {}),
        verdict="doubtful",
        reasons=("two-candidate, for comparison: nothing is known of its error", *robust.remarks),
        advice=("use the robust method",),
        ranges=replace(robust.ranges, median_off_m=np.nan, sensitivity=NOT_KNOWN, per_anchor={}),
        by_kind={},
        on_map=replace(robust.on_map, kinds=()),
        placement=None,
    )
