"""The content of result.json, in the contract's names."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.geometry.similarity import Similarity
from rangesfm.join.models import ModelVerdict
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.log import RangeKind
from rangesfm.ranging.observations import RangeStatus
from rangesfm.result.metric_result import MetricResult
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.two_candidate import TwoCandidate

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

USED = (RangeStatus.USED, RangeStatus.DOWN_WEIGHTED)


def survey_result(survey: MetricResult) -> dict[str, Any]:
    """All entries that follow from the stages' results."""
    return {
        "scale": _scale(survey.estimate),
        "metric_from_sfm": _similarity(survey.estimate.metric_from_sfm),
        "frame": survey.estimate.frame,
        "map": {"num_photos": survey.final.num_reg_images(), "num_points3D": survey.final.num_points3D()},
        "anchors": {anchor.anchor_id: _anchor(anchor) for anchor in survey.anchors},
        "time_offset": _time_offset(survey),
        "ranges": _ranges(survey),
        "check_ranges": _check_ranges(survey),
        "refine": _refine(survey),
        "models": [_model(model, survey.estimate.metric_from_sfm) for model in survey.models],
    }


def _scale(estimate: ScaleEstimate) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "stddev_formal": estimate.stddev_formal,
        "stddev_empirical": estimate.stddev_empirical,
        "interval_95": estimate.interval_95,
        "relative_stddev": asdict(estimate.uncertainty),
        "method": estimate.method,
        "verdict": estimate.verdict,
        "reasons": estimate.reasons,
        "advice": estimate.advice,
        "cutoff_test": [asdict(test) for test in estimate.cutoff_test],
        "sensitivity": asdict(estimate.sensitivity),
        "per_anchor": estimate.per_anchor,
        "range_noise_stddev_m": estimate.noise_stddev_m,
        "correlation_inflation": estimate.errors.inflation,
        "two_candidate": _two_candidate(estimate.two_candidate),
    }


def _model(model: ModelVerdict, metric_from_joined: Similarity) -> dict[str, Any]:
    """One of several models: its own scale, and its place in the joined map."""
    own, joined = model.estimate, model.joined_from_sfm
    return {
        "name": model.name,
        "num_images": model.num_images,
        "joined": joined is not None,
        "reason": model.reason or None,
        "scale": {
            "value": None if own is None else own.value,
            "stddev_empirical": None if own is None else own.stddev_empirical,
            "interval_95": None if own is None else own.interval_95,
            "verdict": "refused" if own is None else own.verdict,
            "reasons": [model.reason] if own is None else own.reasons,
        },
        "metric_from_sfm": None if joined is None else _similarity(metric_from_joined @ joined),
    }


def _similarity(similarity: Similarity) -> dict[str, Any]:
    return {
        "scale": similarity.scale,
        "rotation_xyzw": Rotation.from_matrix(similarity.rotation).as_quat(),
        "translation_m": similarity.translation,
    }


def _two_candidate(table: TwoCandidate | None) -> dict[str, Any] | None:
    if table is None:
        return None
    return {
        "alpha0": asdict(table.alpha0),
        "alpha1": asdict(table.alpha1),
        "chosen": table.chosen,
        "num_without_root": table.num_without_root,
    }


def _anchor(anchor: AnchorEstimate) -> dict[str, Any]:
    return {
        "position_m": anchor.position_m if np.isfinite(anchor.position_m).all() else None,
        "stddev_m": anchor.position_stddev_m,
        "range_bias_m": anchor.range_bias_m,
        "mirror_position_m": anchor.mirror_position_m,
        "surveyed_position_m": anchor.prior_position_m,
    }


def _time_offset(survey: MetricResult) -> dict[str, Any]:
    found = survey.time_offset
    if found is not None:
        return {
            "value_s": found.value_s,
            "stddev_s": found.stddev_s,
            "estimated": True,
            "offset_matters": found.offset_matters,
            "drift_ppm": 1e6 * found.drift,
            "drift_stddev_ppm": 1e6 * found.drift_stddev,
            "drift_is_followed": found.drift_is_followed,
            "note": found.note,
        }
    given = survey.time_offset_s
    return {"value_s": given, "stddev_s": None if given is None else 0.0, "estimated": False, "note": None}


def _ranges(survey: MetricResult) -> dict[str, Any]:
    """Of the ranges between tag and anchor; the others are only counted."""
    log = survey.observations.log
    used = np.isin(survey.observations.status, USED)
    is_of_camera = log.kind == RangeKind.TAG_ANCHOR
    return {
        **_residual_summary(survey.residuals_m, used, is_of_camera),
        "num_anchor_anchor": int(np.count_nonzero(log.kind == RangeKind.ANCHOR_ANCHOR)),
        "num_tag_tag": int(np.count_nonzero(log.kind == RangeKind.TAG_TAG)),
        "per_anchor": {
            anchor_id: _residual_summary(survey.residuals_m, used, is_of_camera & (log.anchor_index == k))
            for k, anchor_id in enumerate(log.anchor_ids)
        },
    }


def _residual_summary(residuals_m: Array, used: Mask, of: Mask) -> dict[str, Any]:
    chosen = residuals_m[used & of]
    return {
        "num": int(of.sum()),
        "num_used": int((used & of).sum()),
        "num_rejected": int((~used & of).sum()),
        "rms_m": _rms(chosen),
        "median_abs_m": float(np.median(np.abs(chosen))) if len(chosen) else None,
    }


def _check_ranges(survey: MetricResult) -> dict[str, Any]:
    log, held_out = survey.observations.log, survey.observations.status == RangeStatus.CHECK
    anchors = {anchor_id: held_out & (log.anchor_index == k) for k, anchor_id in enumerate(log.anchor_ids)}
    return {
        **_check_summary(survey.residuals_m[held_out]),
        "per_anchor": {i: _check_summary(survey.residuals_m[of]) for i, of in anchors.items() if of.any()},
    }


def _check_summary(residuals_m: Array) -> dict[str, Any]:
    residuals_m = residuals_m[np.isfinite(residuals_m)]
    return {
        "num": len(residuals_m),
        "rms_m": _rms(residuals_m),
        "median_m": float(np.median(residuals_m)) if len(residuals_m) else None,
    }


def _rms(residuals_m: Array) -> float | None:
    return float(np.sqrt(np.mean(residuals_m**2))) if len(residuals_m) else None


def _refine(survey: MetricResult) -> dict[str, Any] | None:
    summary = survey.refinement
    if summary is None:
        return None
    return {
        "iterations": summary.num_iterations,
        "keyframe_graph_steps": summary.num_graph_steps,
        "bend_m": summary.bend_m,
        "initial_cost": summary.initial_cost,
        "final_cost": summary.final_cost,
        "reprojection_rms_px": summary.reprojection_rms_px,
        "pixel_stddev": summary.pixel_stddev,
        "correlation_inflation": summary.errors.inflation,
        "seconds": summary.seconds,
        "converged": summary.converged and not summary.misfits,
        "message": "; ".join(summary.misfits) or summary.message,
        "scale_value": survey.refined_scale,
        "relative_scale_stddev": None if summary.covariance is None else summary.covariance.relative_scale_stddev,
        "tag_in_cam_m": dict(zip(survey.observations.log.tag_ids, summary.tags_in_cam_m.tolist(), strict=True)),
        "time_offset_change_s": summary.time_shift_s,
        "short_range_error_m": summary.short_range_error_m,
    }
