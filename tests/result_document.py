"""A whole ``result.json`` as plain values, for tests that need a result folder without a run."""

from __future__ import annotations

import copy
from typing import Any

_RESIDUALS = {"num": 0, "num_used": 0, "num_rejected": 0, "rms_m": None, "median_abs_m": None}
_SCALE = {
    "value": 1.5,
    "stddev_formal": 0.005,
    "stddev_empirical": 0.015,
    "interval_95": [1.47, 1.53],
    "relative_stddev": {
        "formal": 0.003,
        "components": {"time": 0.004, "curve": 0.009},
    },
    "error_stddevs": {"time": 0.02, "curve": 0.04},
    "method": "robust",
    "verdict": "good",
    "reasons": ["the scale is known to 2 % (95 % interval)"],
    "advice": [],
    "sensitivity": {
        "common_bias_per_cm": 0.01,
        "short_range_per_cm": -0.1,
        "anchor_bias_per_cm": {},
        "range_slope_per_percent": 1.0,
        "lever_arm_per_cm": [0.0, 0.1, -0.2],
    },
    "per_anchor": {},
    "range_noise_stddev_m": 0.06,
    "correlation_inflation": 1.0,
    "two_candidate": None,
}
_RESULT: dict[str, Any] = {
    "scale": _SCALE,
    "place": None,
    "metric_from_sfm": {"scale": 1.5, "rotation_xyzw": [0.0, 0.0, 0.0, 1.0], "translation_m": [1.0, 2.0, 3.0]},
    "frame": "site",
    "map": {"num_photos": 40, "num_points3D": 900},
    "anchors": {},
    "time_offset": {"value_s": 2.0, "stddev_s": 0.0, "estimated": False, "note": None},
    "ranges": {**_RESIDUALS, "num_anchor_anchor": 0, "num_tag_tag": 0, "per_anchor": {}},
    "check_ranges": {"num": 0, "rms_m": None, "median_m": None, "per_anchor": {}},
    "refine": None,
    "models": [],
    "distances": [],
    "georeference": None,
    "versions": {"rangesfm": "0.1.0"},
    "settings": {
        "images": {"path": None},
        "ranges": {"max_interpolation_gap_s": 2.0, "max_time_difference_s": 0.02},
        "anchors": {"path": None, "frame": "site", "crs": None},
        "tag": {"tag_in_cam_m": [0.0, 0.0, 0.1], "lever_arms_m": {}},
    },
    "inputs": [],
    "seconds": {},
    "warnings": [],
}
REFINE = {
    "kept": True,
    "why_not_kept": [],
    "iterations": 23,
    "keyframe_graph_steps": 4,
    "bend_m": 0.01,
    "initial_cost": 8123.2,
    "final_cost": 5120.9,
    "reprojection_rms_px": 0.83,
    "pixel_stddev": 0.61,
    "correlation_inflation": 1.2,
    "seconds": 12.3,
    "converged": True,
    "message": "Function tolerance reached.",
    "scale_value": 1.501,
    "relative_scale_stddev": 0.009,
    "tag_in_cam_m": {"tag": [0.0, 0.0, 0.1]},
    "time_offset_change_s": None,
    "short_range_error_m": None,
}


def anchor_entry(position_m: list[float] | None, **others: Any) -> dict[str, Any]:
    unknown = {"stddev_m": 0.02, "range_bias_m": 0.0, "mirror_position_m": None, "surveyed_position_m": None}
    return {"position_m": position_m, **unknown, **others}


def result_document(**changes: Any) -> dict[str, Any]:
    """Return the document with ``changes``: objects are merged, and other values are replaced."""
    return merged(copy.deepcopy(_RESULT), changes)


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Merge ``changes`` into ``base`` in place, as ``result_document`` says."""
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        base[key] = merged(base[key], value) if both else value
    return base
