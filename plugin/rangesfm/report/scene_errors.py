"""Data with which the 3-D view computes the precision of distances between cameras and anchors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rangesfm.report.packing import pack
from rangesfm.result.summary import ResultSummary
from rangesfm.util.geometry.map_errors import Kind, MapErrors
from rangesfm.util.geometry.trajectory import Trajectory

# Shifts by a mode are stored as whole steps, of which the largest shift by that mode has this number.
_NUM_STEPS = 32767
_SHIFT = slice(3, 6)


def errors_of_scene(
    errors: MapErrors, summary: ResultSummary, path: Trajectory, anchor_ids: Sequence[str]
) -> dict[str, Any]:
    """Return how the centres of cameras and the anchors err together, cameras first; empty if it is not known.

    It is the same as in MapErrors, with as many modes as the shifts of these points need, and no more.
    """
    if not errors.are_known or not len(path) or summary.scale.interval_95 is None:
        return {}
    found = []
    points: tuple[tuple[Kind, Sequence[int | str], slice], ...] = (
        ("frame", path.frame_ids.tolist(), _SHIFT),
        ("anchor", anchor_ids, slice(0, 3)),
    )
    try:
        for kind, ids, shift in points:
            if len(ids):
                parts = errors.parts[kind]
                rows = [parts.row_of[id_] for id_ in ids]
                found.append((parts.modes[rows, shift], parts.rests[rows, shift, shift], parts.by_scale[rows, shift]))
    except KeyError:  # the model is of another run
        return {}
    modes, rests, by_scale = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    left, sizes, _ = np.linalg.svd(modes.reshape(3 * len(modes), -1), full_matrices=False)
    shifts = left * sizes
    steps = np.maximum(np.abs(shifts).max(axis=0), 1e-12) / _NUM_STEPS
    up = summary.up
    return {
        "num_modes": len(steps),
        "modes": pack(np.round(shifts / steps), "int16"),
        "steps": pack(steps, "float32"),
        "rests": pack(rests, "float32"),
        "by_scale": pack(by_scale, "float32"),
        "scale_variance_change": summary.scale.relative_stddev_empirical**2 - errors.scale_stddev**2,
        "up": None if up is None else up[0].tolist(),
        "tilt_stddev": None if up is None else up[1],
    }
