"""The files of a result folder, and the summary for people."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.errors import InputError
from rangesfm.export import COVARIANCE_FORMATS, MetricMap, export_map, write_model
from rangesfm.files.atomic import new_file
from rangesfm.geometry.georeference import Georeference
from rangesfm.options import ExportOptions
from rangesfm.ranging.observations import RangeStatus
from rangesfm.result.content import USED
from rangesfm.result.folder import COVARIANCE_COLUMNS
from rangesfm.result.metric_result import MetricResult
from rangesfm.scale.diagnostics import scale_diagnostics
from rangesfm.scale.estimate import ScaleSensitivity

Array = npt.NDArray[np.float64]

_SCALE_TABLES = ("scale_candidates.csv", "scale_consensus.csv", "scale_bootstrap.csv")
_CURVES = (*_SCALE_TABLES, "time_offset_curve.csv")
# Percents of the scale for a centimetre that the summary mentions.
_NOTABLE_PERCENT = 0.5
# The first says that a result is whole: it is the last to be written and the first to go.
_RESULT_FILES = (
    "result.json",
    "report.html",
    "ranges.csv",
    "images.csv",
    "reference.csv",
    "pose_covariance.csv",
    *_CURVES,
)
# Stands in the place of result.json while the files beside it belong to no result.
_UNFINISHED = ".result.unfinished"
_WRITTEN = (*_RESULT_FILES, "trajectory.tum", "points.ply", "sparse_scaled/0", "sparse_metric/0")


def refuse_to_overwrite(inputs: Iterable[Path | None], folder: Path) -> None:
    """Raise InputError for an input that stands where a result will be written."""
    written = {(folder / name).resolve() for name in _WRITTEN}
    for path in inputs:
        if path is not None and path.resolve() in written:
            raise InputError("the results would overwrite this input, expected another output path", path)


def forget_result(folder: Path) -> None:
    """Take away what an earlier run wrote about models that are about to change.

    Killed at any moment, it leaves a whole result or none; the next call goes on where it stopped.
    """
    result, unfinished = (folder / name for name in (_RESULT_FILES[0], _UNFINISHED))
    if result.is_file():
        os.replace(result, unfinished)
    if unfinished.is_file():
        for name in _RESULT_FILES:
            (folder / name).unlink(missing_ok=True)
        unfinished.unlink()


@contextmanager
def replacing_result(folder: Path) -> Iterator[None]:
    """Forget the result before the block, which writes a new one; none of its files stay if it fails.

    Whoever is killed inside it leaves a mark, by which the next run knows the files for what they are.
    """
    forget_result(folder)
    unfinished = folder / _UNFINISHED
    unfinished.touch()
    try:
        yield
        # Now there is a result. Should this be the last that happens, the next run takes it for one that is whole.
        unfinished.unlink()
    finally:
        if unfinished.is_file():
            forget_result(folder)


def write_outputs(
    survey: MetricResult,
    export: ExportOptions,
    folder: Path,
    *,
    images_path: Path | None = None,
    georeference: Georeference | None = None,
) -> None:
    """Models, ranges.csv, images.csv and the formats asked for; each whole or not at all."""
    write_model(survey.scaled, folder / "sparse_scaled" / "0")
    if survey.refined is None:
        # An earlier run's refined model would not belong to this result.
        shutil.rmtree(folder / "sparse_metric", ignore_errors=True)
    else:
        write_model(survey.refined, folder / "sparse_metric" / "0")
    _write_ranges(survey, folder / "ranges.csv")
    _write_time_offset_curve(survey, folder / "time_offset_curve.csv")
    _write_pose_covariance(survey, folder / "pose_covariance.csv")
    times = survey.trajectory.timestamps_s
    by_name = None
    if times is not None:
        by_name = dict(zip(survey.trajectory.image_names, times.tolist(), strict=True))
        write_csv(folder / "images.csv", ["image_name", "timestamp_s"], ((n, repr(t)) for n, t in by_name.items()))
    map_ = MetricMap(
        survey.final,
        timestamps_s=by_name,
        anchors_m={a.anchor_id: a.position_m for a in survey.anchors if np.isfinite(a.position_m).all()},
        metric_from_sfm=survey.estimate.metric_from_sfm,
        relative_scale_stddev=survey.estimate.uncertainty.empirical,
        images_path=images_path,
        is_site=survey.estimate.frame == "site",
        georeference=georeference,
        center_covariance_m2=survey.center_covariance_m2,
    )
    impossible = [] if survey.final.num_points3D() else ["ply"]
    impossible += [] if survey.center_covariance_m2 else COVARIANCE_FORMATS
    formats = tuple(name for name in export.formats if name not in impossible)
    export_map(map_, folder, export.changed(formats=formats))


def write_scale_tables(survey: MetricResult, folder: Path) -> None:
    """The paper's candidates, the consensus curve and the resampled scales, each as a small CSV."""
    found, log = scale_diagnostics(survey.estimate, survey.trajectory), survey.observations.log
    candidates, consensus, bootstrap = (folder / name for name in _SCALE_TABLES)
    rows = found.candidate_rows.tolist()
    times = [""] * len(rows) if log.timestamp_s is None else [repr(log.timestamp_s[row].item()) for row in rows]
    ids = [log.anchor_ids[log.anchor_index[row]] for row in rows]
    columns = [times, ids, *(_texts(values) for values in found.candidates.T)]
    write_csv(candidates, ["timestamp_s", "anchor_id", "alpha0", "alpha1"], zip(*columns, strict=True))
    counts = map(str, found.num_agreeing.tolist())
    write_csv(consensus, ["scale", "num_agreeing"], zip(_texts(found.curve_scales), counts, strict=True))
    write_csv(bootstrap, ["scale"], zip(_texts(found.resampled_scales)))


def _write_ranges(survey: MetricResult, path: Path) -> None:
    """ranges.csv as used: every range of the log, in its order; a peer of its kind stands in a range's other column."""
    observations, log = survey.observations, survey.observations.log
    refined = np.full(len(log), np.nan) if survey.refinement is None else survey.refinement.predicted_m
    has_say = np.isin(observations.status, (*USED, RangeStatus.OUTLIER))
    numbers = {
        "weight": np.where(observations.before >= 0, observations.weight, np.nan),
        "predicted_scaled_m": survey.predicted_scaled_m,
        "predicted_refined_m": refined,
        "residual_m": survey.residuals_m,
        "robust_weight": np.where(has_say, survey.weights, np.nan),
    }
    labels = {int(status): status.label for status in RangeStatus}
    names = (*survey.trajectory.image_names, "")
    tag_ids, anchor_ids = log.end_ids()
    columns: dict[str, Iterable[str]] = {
        "timestamp_s": [""] * len(log) if log.timestamp_s is None else [repr(t) for t in log.timestamp_s.tolist()],
        "image_name": [""] * len(log) if log.image_name is None else log.image_name,
        "anchor_id": anchor_ids,
        "tag_id": tag_ids,
        "range_m": [repr(r) for r in log.range_m.tolist()],
        "range_stddev_m": _texts(survey.range_stddev_m),
        "keyframe_before": [names[i] for i in observations.before],
        "keyframe_after": [names[i] for i in observations.after],
        **{name: _texts(values) for name, values in numbers.items()},
        "status": [labels[status] for status in observations.status.tolist()],
    }
    write_csv(path, list(columns), zip(*columns.values(), strict=True))


def _write_time_offset_curve(survey: MetricResult, path: Path) -> None:
    """What offsets of the clocks cost, metres, where the offset was searched for; see ``CostCurve``."""
    if survey.time_offset is None:
        # An earlier run's curve would not belong to this result.
        path.unlink(missing_ok=True)
        return
    curve = survey.time_offset.curve
    offsets = [repr(offset_s) for offset_s in curve.offsets_s.tolist()]
    write_csv(path, ["time_offset_s", "cost"], zip(offsets, _texts(curve.costs_m), strict=True))


def _write_pose_covariance(survey: MetricResult, path: Path) -> None:
    """Covariance of each keyframe's projection centre by the refinement, square metres, in the result's frame."""
    covariance_m2 = survey.center_covariance_m2
    if not covariance_m2:
        # An earlier run's would not belong to this result.
        path.unlink(missing_ok=True)
        return
    upper = np.triu_indices(3)
    rows = ([name, *(f"{entry:.9g}" for entry in of[upper].tolist())] for name, of in covariance_m2.items())
    write_csv(path, ["image_name", *COVARIANCE_COLUMNS], rows)


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with new_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _texts(values: Array) -> list[str]:
    return [f"{value:.6g}" if math.isfinite(value) else "" for value in values.tolist()]


def write_result(result: dict[str, Any], path: Path) -> None:
    """result.json; numbers that are not finite become null, as JSON has no others.

    Of paths that are no UTF-8, what is none becomes JSON's own escapes, by which they are read as they were.
    """
    with new_file(path) as temporary:
        text = json.dumps(_plain(result), indent=2, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _notable_sensitivity(sensitivity: ScaleSensitivity) -> Iterator[str]:
    """What to measure to the centimetre: where one is worth much of the scale."""
    values = {
        "of bias in short ranges": sensitivity.short_range_per_cm,
        "of bias in all ranges": sensitivity.common_bias_per_cm,
        **{f"of lever arm in {axis}": value for axis, value in zip("xyz", sensitivity.lever_arm_per_cm)},
    }
    notable = [f"{value:+.2f} % per cm {what}" for what, value in values.items() if abs(value) > _NOTABLE_PERCENT]
    if notable:
        yield f"the scale is sensitive: {', '.join(notable)}"


def summary_lines(survey: MetricResult, result: dict[str, Any], table: str | None, folder: Path) -> Iterator[str]:
    """What a user wants to know at the end of a run."""
    estimate, ranges = survey.estimate, result["ranges"]
    low, high = estimate.interval_95
    yield f"scale: {estimate.value:.6g} m per SfM unit, 95 % interval {low:.6g} to {high:.6g}"
    yield f"verdict: {estimate.verdict}: {'; '.join(estimate.reasons)}"
    for advice in estimate.advice:
        yield f"next time: {advice}"
    yield from _notable_sensitivity(estimate.sensitivity)
    if survey.refinement is not None:
        refined = survey.refined_scale
        yield f"refined: {refined:.6g} m per SfM unit after {survey.refinement.num_iterations} iterations"
    residuals = f", rms {ranges['rms_m']:.3f} m, median {ranges['median_abs_m']:.3f} m" if ranges["num_used"] else ""
    yield f"ranges: {ranges['num_used']} of {ranges['num']} used{residuals}"
    if survey.time_offset is not None:
        offset = survey.time_offset
        yield f"time offset: image time = range time {offset.value_s:+.3f} s, +- {offset.stddev_s:.3f} s"
    yield f"map: {survey.final.num_reg_images()} photos, {survey.final.num_points3D()} points, frame {estimate.frame}"
    if table is not None:
        yield from ("", *table.splitlines(), "")
    model = "sparse_scaled/0" if survey.refined is None else "sparse_metric/0"
    yield f"metric model: {folder / model}"
    yield f"all results: {folder / 'result.json'}"
