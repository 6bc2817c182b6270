"""Records and tables of a result, made from what the stages found.

``rangesfm.result`` has them as plain data, so that reading a result loads none of the stages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Mask, median, rms
from rangesfm.diagnostics.scale_bound import RISK, scale_bound
from rangesfm.errors import number_text
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.lengths.lengths_on_map import BENDING
from rangesfm.measurements.lengths.locate_lengths import locate_distances
from rangesfm.measurements.lengths.tape import CHECK, CONTROL
from rangesfm.measurements.mistake_words import CHECKED_KINDS, mistake_in_words
from rangesfm.measurements.positions.control_points import locate_points
from rangesfm.measurements.positions.entry import PointErrors3d, PointRow, PointsEntry
from rangesfm.measurements.ranges.range_log import RangeKind
from rangesfm.measurements.ranges.range_observations import USED, RangeStatus
from rangesfm.measurements.ranges.scale.starts import agreeing_intervals
from rangesfm.pipeline.metric_result import MetricResult, ModelVerdict
from rangesfm.result import entries
from rangesfm.result.result_tables import (
    CenterCovariances,
    LoopPairs,
    PhotoTimes,
    RangesAsUsed,
    ScaleCandidates,
    ScaleConsensus,
    TableFile,
    TagCorners,
    TimeOffsetCurve,
)
from rangesfm.result.summary import ResultSummary
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import Trajectory


def summary_of(found: MetricResult, **others: Any) -> ResultSummary:
    """Return the content of ``result.json``.

    Args:
        found: what the stages found.
        others: entries that do not follow from it, from ``versions`` on, and ``comparison``.
    """
    estimate, on_map, on_earth = found.estimate, found.all_measured, found.georeference
    of_kinds: dict[str, Any] = {kind.kind: entry for kind in on_map.kinds if (entry := kind.entry(on_map))}
    return ResultSummary(
        scale=entries.ScaleEntry.model_validate(estimate),
        place=found.place,
        metric_from_sfm=_similarity(estimate.metric_from_sfm),
        frame="site" if estimate.frame == "site" else "first_camera",
        map=entries.MapEntry(num_photos=found.final.num_reg_images(), num_points3D=found.final.num_points3D()),
        anchors={anchor.anchor_id: entries.AnchorEntry.model_validate(anchor) for anchor in found.anchors},
        time_offset=_time_offset(found),
        ranges=_ranges(found),
        check_ranges=_check_ranges(found),
        refine=_refinement(found),
        loops=_loops(found),
        distances=tuple(distance_rows(found)),
        points=points_entry(found),
        georeference=None if on_earth is None else entries.GeoreferenceEntry.model_validate(on_earth),
        tests=tuple(map(entries.MistakeEntry.model_validate, found.diagnosis.tests)),
        reliability=_reliability(found),
        models=tuple(_model(model, estimate.metric_from_sfm) for model in found.models),
        **of_kinds,
        **others,
    )


def _similarity(similarity: Similarity) -> entries.SimilarityEntry:
    return entries.SimilarityEntry(
        scale=similarity.scale,
        rotation_xyzw=Rotation.from_matrix(similarity.rotation).as_quat().tolist(),
        translation_m=similarity.translation.tolist(),
    )


def _model(model: ModelVerdict, metric_from_joined: Similarity) -> entries.ModelEntry:
    refused = {"value": None, "stddev_empirical": None, "interval_95": None, "verdict": "refused"}
    joined = model.joined_from_sfm
    return entries.ModelEntry(
        name=model.name,
        num_images=model.num_images,
        joined=joined is not None,
        reason=model.reason or None,
        scale=entries.ModelScaleEntry.model_validate(model.estimate or {**refused, "reasons": [model.reason]}),
        metric_from_sfm=None if joined is None else _similarity(metric_from_joined @ joined),
    )


def _time_offset(found: MetricResult) -> entries.TimeOffsetEntry:
    offset = found.path.time_offset
    if isinstance(found.observations.log.moments, ByPhoto):
        return entries.TimeOffsetEntry(value_s=None, stddev_s=None, estimated=False, note=None)
    if offset.is_given:
        return entries.TimeOffsetEntry(value_s=offset.value_s, stddev_s=0.0, estimated=False, note=None)
    in_ppm = {"drift_ppm": 1e6 * offset.drift, "drift_stddev_ppm": 1e6 * offset.drift_stddev}
    return entries.TimeOffsetEntry.model_validate(
        {**vars(offset), **in_ppm, "note": offset.note or None, "estimated": True}
    )


def _ranges(found: MetricResult) -> entries.RangesEntry:
    kind, used = found.observations.log.kind, np.isin(found.observations.status, USED)

    def residuals(rows: Mask) -> dict[str, Any]:
        chosen = found.ranges.residuals_m[used & rows]
        nums = {"num": rows.sum(), "num_used": (used & rows).sum(), "num_rejected": (~used & rows).sum()}
        return {**nums, "rms_m": rms(chosen), "median_abs_m": median(np.abs(chosen))}

    others = {RangeKind.ANCHOR_ANCHOR: "num_anchor_anchor", RangeKind.TAG_TAG: "num_tag_tag"}
    return entries.RangesEntry.model_validate(
        {
            **residuals(kind == RangeKind.TAG_ANCHOR),
            **{name: np.count_nonzero(kind == other) for other, name in others.items()},
            "per_anchor": {id_: residuals(rows) for id_, rows in _by_anchor(found, kind == RangeKind.TAG_ANCHOR)},
        }
    )


def _check_ranges(found: MetricResult) -> entries.CheckRangesEntry:
    held_out = found.observations.status == RangeStatus.CHECK

    def residuals(rows: Mask) -> dict[str, Any]:
        chosen = found.ranges.residuals_m[rows & np.isfinite(found.ranges.residuals_m)]
        return {"num": len(chosen), "rms_m": rms(chosen), "median_m": median(chosen)}

    per_anchor = {id_: residuals(rows) for id_, rows in _by_anchor(found, held_out) if rows.any()}
    return entries.CheckRangesEntry.model_validate({**residuals(held_out), "per_anchor": per_anchor})


def _by_anchor(found: MetricResult, chosen: Mask) -> Iterator[tuple[str, Mask]]:
    """Yield the id of each anchor and the mask (n,) of the chosen ranges to it."""
    log = found.observations.log
    for k, anchor_id in enumerate(log.anchor_ids):
        yield anchor_id, chosen & (log.anchor_index == k)


def _loops(found: MetricResult) -> entries.LoopsEntry | None:
    if found.refined is None or (loops := found.refined.loops) is None:
        return None
    return entries.LoopsEntry(
        num_proposed=len(loops.proposed),
        num_verified=len(loops.verified),
        num_closed=len(loops.closed),
        num_contradicted=len(loops.contradicted),
        moved_m=loops.moved_m(found.trajectory.as_in(found.final)),
    )


def _refinement(found: MetricResult) -> entries.RefineEntry | None:
    if found.refined is None:
        return None
    refined, ranges = found.refined, found.refined.ranges
    others = {
        "kept": not refined.why_broken,
        "why_not_kept": refined.why_broken,
        "iterations": refined.num_iterations,
        "keyframe_graph_steps": refined.num_graph_steps,
        "bending_factor": refined.bending_factor,
        "correlation_inflation": ranges.errors.inflation,
        "scale_value": refined.scale,
        "relative_scale_stddev": refined.covariance.scale_stddev,
        "tag_in_cam_m": dict(zip(ranges.observations.log.tag_ids, ranges.tags_in_cam_m, strict=True)),
        "time_offset_change_s": ranges.time_shift_s,
        "short_range_error_m": ranges.short_range_error_m,
    }
    return entries.RefineEntry.model_validate({**vars(refined), **others})


def _reliability(found: MetricResult) -> entries.ReliabilityEntry | None:
    """Return the entry; None where no mistakes were tested."""
    diagnosis = found.diagnosis
    if not diagnosis.hidden:
        return None
    bound, limited_by = scale_bound(found.estimate.uncertainty, diagnosis.hidden)
    is_found = any(test.rejected for test in diagnosis.tests)
    given = [test for test in diagnosis.tests if test.name in CHECKED_KINDS and test.is_checked is False]
    return entries.ReliabilityEntry(
        scale_within=None if is_found else float(np.expm1(bound)),
        risk=RISK,
        limited_by=limited_by,
        unchecked=tuple(mistake_in_words(test.name, test.subject) for test in given),
    )


def points_entry(found: MetricResult) -> PointsEntry | None:
    """Return control and check points in the final map; None without any, or where the map is not in the site."""
    known = found.inputs.positions.points
    if not known.points or found.estimate.frame != "site":
        return None
    located = locate_points(known, found.final, found.trajectory.as_in(found.final))
    places = dict(zip(located.names, located.predicted_m(IDENTITY), strict=True))
    rows = []
    for point in known.points:
        at = places.get(point.name)
        off = None if at is None else at - point.position_m
        rows.append(
            PointRow(
                marker=point.name,
                kind=point.kind,
                known_m=point.position_m.tolist(),
                stddev_m=point.stddev_m,
                estimated_m=None if at is None else at.tolist(),
                residual_m=None if off is None else off.tolist(),
                distance_m=None if off is None else float(np.linalg.norm(off)),
            )
        )
    return PointsEntry(control=_rmse(rows, CONTROL), check=_rmse(rows, CHECK), points=tuple(rows))


def _rmse(rows: Sequence[PointRow], kind: str) -> PointErrors3d:
    off = np.array([row.residual_m for row in rows if row.kind == kind and row.residual_m is not None])
    if not len(off):
        return PointErrors3d(num=0, rmse_m=None, rmse_3d_m=None)
    squares = np.mean(off**2, axis=0)
    return PointErrors3d(num=len(off), rmse_m=np.sqrt(squares).tolist(), rmse_3d_m=math.sqrt(squares.sum()))


def distance_rows(found: MetricResult) -> list[entries.DistanceRow]:
    """Return a row for each measured length, in the order of its file; empty without any."""
    if not found.inputs.tape.distances:
        return []
    located = locate_distances(found.inputs.tape, found.final, [anchor.anchor_id for anchor in found.anchors])
    lengths_m = located.lengths_m(1.0, np.array([anchor.position_m for anchor in found.anchors]).reshape(-1, 3))
    return [
        entries.DistanceRow(
            from_=taped.ends[0],
            to=taped.ends[1],
            kind=taped.kind,
            measured_m=taped.distance_m,
            stddev_m=taped.stddev_m,
            estimated_m=length_m,
            residual_m=length_m - taped.distance_m,
        )
        for taped, length_m in zip(found.inputs.tape.distances, lengths_m.tolist(), strict=True)
    ]


def disagreements(rows: Iterable[entries.DistanceRow], relative_scale_stddev: float) -> Iterator[Doubt]:
    """Yield a doubt for each check length that differs from the map by more than tape, scale and bending explain.

    A control length is tested as an observation of the map, whose bending is known better there (``MistakeTests``).

    Args:
        relative_scale_stddev: relative standard deviation of the scale.
    """
    for row in rows:
        stddev_m = math.hypot(row.stddev_m, relative_scale_stddev * row.measured_m, BENDING * row.measured_m)
        if row.kind == CHECK and row.residual_m is not None and abs(row.residual_m) > SIGNIFICANT_STDDEVS * stddev_m:
            yield Doubt(
                f"check distance from {row.from_} to {row.to}: {row.estimated_m:.3f} m in the map, "
                f"{row.measured_m:.3f} m by tape ({number_text(row.residual_m, '+.3f')} m, expected within "
                f"{SIGNIFICANT_STDDEVS * stddev_m:.3f} m)"
            )


def tables_of(found: MetricResult) -> Iterator[TableFile]:
    """Yield the tables of a result; some are left out where it has nothing for them."""
    times = found.trajectory.timestamps_s
    if times is not None:
        yield PhotoTimes(found.trajectory.image_names, times)
    by_photo = found.center_covariance_m2
    if by_photo:
        rows, columns = np.triu_indices(3)
        yield CenterCovariances(tuple(by_photo), *np.array(list(by_photo.values()))[:, rows, columns].T)
    if found.refined is not None and (loops := found.refined.loops) is not None:
        kinds = {"closed": loops.closed, "contradicted": loops.contradicted}
        name_of = {id_: image.name for id_, image in found.final.images.items()}
        pairs = [(name_of[a], name_of[b], kind) for kind, of_kind in kinds.items() for a, b in sorted(of_kind)]
        yield LoopPairs(*(zip(*pairs) if pairs else ((), (), ())))
    if not (offset := found.path.time_offset).is_given:
        yield TimeOffsetCurve(offset.curve.offsets_s, offset.curve.costs)
    markers = found.inputs.tape.found_markers
    if markers:
        names = [name for name, marker in markers.items() for _ in marker.image_names]
        photos = [name for marker in markers.values() for name in marker.image_names]
        pixels = np.concatenate([marker.pixels for marker in markers.values()])
        yield TagCorners(tuple(names), tuple(photos), *pixels.T)
    if len(found.observations.log):
        yield ranges_as_used(found)
        yield from _tables_of_scale(found.estimate, found.trajectory)


def _tables_of_scale(estimate: ScaleEstimate, path: Trajectory) -> Iterator[TableFile]:
    """Yield the paper's candidates, and how many ranges agree with each scale, with anchors and rotation held fixed.

    Args:
        path: of the unscaled model.
    """
    ranges, placed = estimate.ranges, estimate.metric_from_sfm
    observations, log = ranges.observations, ranges.observations.log
    anchors = np.array([anchor.position_m for anchor in ranges.anchors], dtype=np.float64)[log.anchor_index]
    rows = np.flatnonzero(np.isfinite(ranges.errors.stddev_m) & np.isfinite(anchors).all(axis=1))
    tags, range_m = observations.tag_from_center[rows] @ placed.rotation.T, log.range_m[rows]
    table = ranges.two_candidate
    seen, duplets = (rows[:0], np.zeros((0, 2))) if table is None else (table.rows, table.duplets)
    yield ScaleCandidates(log.timestamp_s[seen], tuple(log.anchor_ids[k] for k in log.anchor_index[seen]), *duplets.T)
    # The path is stretched about a fixed point: its middle in a site, otherwise the first camera.
    held = path.centers.mean(axis=0) if estimate.frame == "site" else path.centers[0]
    centers, anchor_m = (observations.centers[rows] - held) @ placed.rotation.T, anchors[rows] - placed.apply(held)
    bias = np.array([anchor.range_bias_m for anchor in ranges.anchors])[log.anchor_index[rows]]
    tolerance = SIGNIFICANT_STDDEVS * ranges.errors.stddev_m[rows]
    starts, ends = agreeing_intervals(centers, tags - anchor_m, range_m - bias, tolerance)
    # From a third of the estimate to three times it.
    scales = placed.scale * np.geomspace(1 / 3, 3, 601)
    num_begun = np.searchsorted(np.sort(starts), scales, side="right")
    num_agreeing = num_begun - np.searchsorted(np.sort(ends), scales, side="left")
    yield ScaleConsensus(scales, num_agreeing.astype(np.float64))


def ranges_as_used(found: MetricResult) -> RangesAsUsed:
    """Return the table of all ranges."""
    observations, log = found.observations, found.observations.log
    unknown = np.full(len(log), np.nan)
    has_say = np.isin(observations.status, (*USED, RangeStatus.OUTLIER))
    labels = {int(status): status.label for status in RangeStatus}
    names = (*found.trajectory.image_names, "")
    tag_ids, anchor_ids = log.end_ids()
    return RangesAsUsed(
        timestamp_s=log.timestamp_s,
        image_name=log.image_name,
        anchor_id=tuple(anchor_ids),
        tag_id=tuple(tag_ids),
        range_m=log.range_m,
        range_stddev_m=found.ranges.errors.stddev_m,
        keyframe_before=tuple(names[i] for i in observations.before),
        keyframe_after=tuple(names[i] for i in observations.after),
        weight=np.where(observations.before >= 0, observations.fraction, np.nan),
        predicted_scaled_m=found.scaled_ranges.predicted_m,
        predicted_refined_m=unknown if found.kept is None else found.kept.ranges.predicted_m,
        residual_m=found.ranges.residuals_m,
        robust_weight=np.where(has_say, found.ranges.weights, np.nan),
        status=tuple(labels[status] for status in observations.status.tolist()),
    )
