"""The data of the 3-D view: what stands where, in metres."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.observations import RangeStatus
from rangesfm.report.thumbnails import thumbnails
from rangesfm.result.ranges_as_used import RangesAsUsed

MAX_NUM_POINTS = 500_000
MAX_NUM_RANGES = 20_000
NUM_STEPS = 65535
"""Positions of points are whole steps of the largest side of their box."""

_FAR_QUANTILE = 0.005
_SEEN_QUANTILE = 0.05
_RADIUS_OF_95_PERCENT = 2.80
"""Of a three-dimensional normal distribution, in stddevs."""


@dataclass(frozen=True)
class ScenePath:
    """One path of cameras.

    Attributes:
        id: of its layer.
        name: as the reader sees it.
        color: name of a colour of the page's style.
        trajectory: in the scene's frame, metres.
        has_orientations: whether frusta can be drawn.
    """

    id: str
    name: str
    color: str
    trajectory: Trajectory
    has_orientations: bool = True


@dataclass(frozen=True)
class SceneAnchor:
    """One anchor: (3,) position, stddev of each coordinate, and the mirror image if there is one; metres."""

    anchor_id: str
    position_m: Array
    stddev_m: Array
    mirror_position_m: Array | None


@dataclass(frozen=True)
class Scene:
    """What the view shows, in one metric frame.

    Attributes:
        frame: "site" (z up) or any other (a camera's: y down).
        paths: the last is the result, on which cameras are chosen.
        points_m, points_rgb: (m, 3) of the map.
        anchors: where the ranges end.
        ranges: with times (n,) in seconds; or None.
        tags_in_cam_m: (n, 3) where each begins, in the camera's frame; or None.
        frustum_shape: half width and half height of a camera's picture at unit distance.
        images_path: folder of the photos; None where it is not known.
        true_ranges_m: (n,) by a reference, NaN where unknown; or None.
        scale_interval: the scale's 95 % interval relative to the scale; None if not known.
    """

    frame: str
    paths: tuple[ScenePath, ...]
    points_m: Array
    points_rgb: npt.NDArray[np.uint8]
    anchors: tuple[SceneAnchor, ...] = ()
    ranges: RangesAsUsed | None = None
    range_times_s: Array | None = None
    true_ranges_m: Array | None = None
    tags_in_cam_m: Array | None = None
    frustum_shape: tuple[float, float] = (0.6, 0.4)
    images_path: Path | None = None
    scale_interval: tuple[float, float] | None = None

    @property
    def result(self) -> Trajectory:
        return self.paths[-1].trajectory


def scene_data(scene: Scene) -> dict[str, Any]:
    """What the page's script reads."""
    box = _box(scene)
    return {
        "up": [0, 0, 1] if scene.frame == "site" else [0, -1, 0],
        "box": box,
        "paths": [_path(path) for path in scene.paths],
        "points": _points(scene),
        "anchors": [_anchor(anchor) for anchor in scene.anchors],
        "ranges": _ranges(scene),
        "frustum_size": _frustum_size(scene.result, box["radius"]),
        "frustum_shape": list(scene.frustum_shape),
        "thumbnails": thumbnails(scene.images_path, scene.result.image_names),
        "scale_interval": None if scene.scale_interval is None else list(scene.scale_interval),
    }


def num_points_drawn(scene: Scene) -> int:
    """How many of the map's points the view shows."""
    return len(_chosen_points(scene))


def range_stride(ranges: RangesAsUsed) -> int:
    """Every how many-th range the view shows."""
    return max(1, -(-len(ranges.status) // MAX_NUM_RANGES))


def _path(path: ScenePath) -> dict[str, Any]:
    trajectory = path.trajectory
    times = trajectory.timestamps_s
    return {
        "id": path.id,
        "name": path.name,
        "color": path.color,
        "names": list(trajectory.image_names),
        "times": None if times is None else pack(times - times[0], "float32"),
        "centers": pack(trajectory.centers, "float32"),
        "rotations": pack(trajectory.world_from_cam, "float32") if path.has_orientations else None,
    }


def _points(scene: Scene) -> dict[str, Any] | None:
    chosen = _chosen_points(scene)
    if len(chosen) == 0:
        return None
    points = scene.points_m[chosen]
    origin, extent = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-9)
    return {
        "num": len(points),
        "origin": origin.tolist(),
        "extent": extent,
        "steps": pack(np.round((points - origin) / extent * NUM_STEPS), "uint16"),
        "colors": pack(scene.points_rgb[chosen], "uint8"),
    }


def _chosen_points(scene: Scene) -> npt.NDArray[np.int64]:
    """Points to draw, in random order. A few strays far away would coarsen the steps of all others."""
    points = scene.points_m
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(points, [_FAR_QUANTILE, 1 - _FAR_QUANTILE], axis=0)
    around = _around(scene)
    low, high = np.minimum(low, around.min(axis=0)), np.maximum(high, around.max(axis=0))
    margin = 0.5 * (high - low).max()
    inside = np.flatnonzero(np.all((points >= low - margin) & (points <= high + margin), axis=1))
    return np.random.default_rng(0).permutation(inside)[:MAX_NUM_POINTS]


def _around(scene: Scene) -> Array:
    """All positions beside the map's points."""
    anchors = [anchor.position_m[None] for anchor in scene.anchors]
    return np.concatenate([*(path.trajectory.centers for path in scene.paths), *anchors])


def _box(scene: Scene) -> dict[str, Any]:
    """Corners and radius of what is to be seen at first, and the height of the ground."""
    seen = [_around(scene)]
    if len(scene.points_m):
        seen.append(np.quantile(scene.points_m, [_SEEN_QUANTILE, 1 - _SEEN_QUANTILE], axis=0))
    corners = np.concatenate(seen)
    low, high = corners.min(axis=0), corners.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    ground = float(low[2]) if scene.frame == "site" else float(high[1])
    return {"low": low.tolist(), "high": high.tolist(), "radius": radius, "ground": ground}


def _frustum_size(path: Trajectory, radius: float) -> float:
    """About the distance to the next camera, but neither dust nor a wall."""
    steps = np.linalg.norm(np.diff(path.centers, axis=0), axis=1)
    typical = float(np.median(steps)) if len(steps) else radius
    return float(np.clip(0.7 * typical, 0.012 * radius, 0.05 * radius))


def _anchor(anchor: SceneAnchor) -> dict[str, Any]:
    known = np.isfinite(anchor.stddev_m).all() and np.any(anchor.stddev_m > 0)
    mirror = anchor.mirror_position_m
    return {
        "id": anchor.anchor_id,
        "position": anchor.position_m.tolist(),
        "ellipsoid": (_RADIUS_OF_95_PERCENT * anchor.stddev_m).tolist() if known else None,
        "mirror": None if mirror is None else mirror.tolist(),
    }


def _ranges(scene: Scene) -> dict[str, Any] | None:
    ranges = scene.ranges
    if ranges is None or len(ranges.status) == 0:
        return None
    rows = np.arange(0, len(ranges.status), range_stride(ranges))
    index_of = {name: i for i, name in enumerate(scene.result.image_names)}
    before = _indices(ranges.keyframe_before, index_of, rows)
    after = _indices(ranges.keyframe_after, index_of, rows)
    weight = ranges.weight[rows]
    has_place = (before >= 0) & (after >= 0) & np.isfinite(weight)
    anchor_ids, anchor = np.unique(np.array(ranges.anchor_id, dtype=str), return_inverse=True)
    statuses = _statuses_in_order(ranges)
    status = np.array([statuses.index(label) for label in ranges.status])
    times = scene.range_times_s
    is_refined = bool(np.isfinite(ranges.residual_refined_m).any())
    final = ranges.residual_refined_m if is_refined else ranges.residual_scaled_m
    weight = np.where(has_place, weight, 0.0)
    of_ranges = np.zeros((len(ranges.status), 3)) if scene.tags_in_cam_m is None else scene.tags_in_cam_m
    tags, tag = np.unique(of_ranges[rows], axis=0, return_inverse=True)
    return {
        "num": len(rows),
        "anchor_ids": anchor_ids.tolist(),
        "anchor": pack(anchor[rows], "uint16"),
        "tags_in_cam_m": tags.tolist(),
        "tag": pack(tag.reshape(-1), "uint8"),
        "statuses": statuses,
        "status": pack(status[rows], "uint8"),
        "time": pack(np.full(len(rows), np.nan) if times is None else times[rows], "float32"),
        "measured": pack(ranges.range_m[rows], "float32"),
        "residual_scaled": pack(ranges.residual_scaled_m[rows], "float32"),
        "residual_refined": pack(ranges.residual_refined_m[rows], "float32"),
        "final": "residual_refined" if is_refined else "residual_scaled",
        "residual_limit_m": _residual_limit(final[ranges.is_used]),
        "true": None if scene.true_ranges_m is None else pack(scene.true_ranges_m[rows], "float32"),
        "has_place": pack(has_place, "uint8"),
        "before": pack(np.maximum(before, 0), "int32"),
        "after": pack(np.maximum(after, 0), "int32"),
        "weight": pack(np.round(255 * weight), "uint8"),
        "camera": pack(np.where(has_place, np.where(weight < 0.5, before, after), -1), "int32"),
    }


def _statuses_in_order(ranges: RangesAsUsed) -> list[str]:
    """Those that there are, the used first."""
    present = set(ranges.status)
    known = [status.label for status in RangeStatus if status.label in present]
    return [*known, *sorted(present.difference(known))]


def _indices(names: Sequence[str], index_of: dict[str, int], rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.array([index_of.get(names[row], -1) for row in rows], dtype=np.int64)


def _residual_limit(residuals: Array) -> float:
    """The residual that has the full colour: all but a twentieth of the used are below."""
    known = np.abs(residuals[np.isfinite(residuals)])
    return max(float(np.quantile(known, 0.95)), 1e-3) if len(known) else 1.0


def pack(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """An array as the page's script reads it, row by row.

    Args:
        kind: "uint8", "uint16", "int32" or "float32".
    """
    array = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
    return {"type": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}
