"""Data with which the 3-D view computes the precision of distances between cameras and anchors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.map_errors import MapErrors, PartErrors
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.report.packing import pack
from rangesfm.result.summary import ResultSummary

# Shifts by a mode are stored as whole steps, of which the largest shift by that mode has this number.
_NUM_STEPS = 32767
_SHIFT = slice(3, 6)


def errors_of_scene(
    errors: MapErrors | None, summary: ResultSummary, path: Trajectory, anchor_ids: Sequence[str]
) -> dict[str, Any] | None:
    """Return how the centres of cameras and the anchors err together, cameras first; None if it is not known.

    It is the same as in MapErrors, with as many modes as the shifts of these points need, and no more.
    """
    if errors is None or not len(path) or summary.scale.interval_95 is None:
        return None
    try:
        modes, rests, by_scale = _of_points(errors, path, anchor_ids)
    except KeyError:  # the model is of another run
        return None
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


def _of_points(errors: MapErrors, path: Trajectory, anchor_ids: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return the modes (n, 3, r), rests (n, 3, 3) and changes by scale (n, 3) of the shifts of cameras and anchors."""
    frames, anchors = errors.parts["frame"], errors.parts.get("anchor")
    found = [_shifts(frames, path.frame_ids.tolist(), _SHIFT)]
    if anchor_ids:
        found.append(_shifts(errors.parts["anchor"] if anchors is None else anchors, anchor_ids, slice(0, 3)))
    modes, rests, by_scale = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    return modes, rests, by_scale


def _shifts(parts: PartErrors, ids: Sequence[int | str], shift: slice) -> tuple[Array, Array, Array]:
    rows = [parts.row_of[id_] for id_ in ids]
    return parts.modes[rows, shift], parts.rests[rows, shift, shift], parts.by_scale[rows, shift]
