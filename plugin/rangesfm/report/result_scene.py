"""The 3-D scene of a result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.report.content import Content
from rangesfm.report.scene import Scene, SceneAnchor, ScenePath
from rangesfm.result.summary import ResultSummary


def scene_of(content: Content) -> Scene | None:
    """What the view shows of a result; None without a model."""
    paths = _paths(content)
    if content.final is None or len(content.final) == 0:
        return None
    interval, value = content.summary.scale.interval_95, content.summary.scale.value
    return Scene(
        frame=content.summary.frame,
        paths=paths,
        points_m=_or_empty(content.points_m, np.float64),
        points_rgb=_or_empty(content.points_rgb, np.uint8),
        anchors=anchors_in_scene(content.summary, content.anchors_m),
        ranges=content.ranges,
        range_times_s=content.range_times_s,
        true_ranges_m=content.true_ranges_m,
        tags_in_cam_m=content.tags_in_cam_m,
        frustum_shape=content.cameras[0].half_angles if content.cameras else (0.6, 0.4),
        images_path=content.images_path,
        scale_interval=None if interval is None or not value else (interval[0] / value, interval[1] / value),
    )


def _paths(content: Content) -> tuple[ScenePath, ...]:
    paths = []
    if content.reference_m is not None:
        paths.append(ScenePath("reference", "Reference", "reference", _of_positions(content.reference_m), False))
    if content.scaled is not None and len(content.scaled):
        paths.append(ScenePath("scaled", "Cameras, scaled only", "before", content.scaled))
    if content.refined is not None and len(content.refined):
        paths.append(ScenePath("refined", "Cameras, refined", "after", content.refined))
    return tuple(paths)


def _of_positions(positions_m: Array) -> Trajectory:
    n = len(positions_m)
    nowhere = np.tile(np.eye(3), (n, 1, 1))
    return Trajectory(np.arange(n), tuple(map(str, range(n))), None, positions_m, nowhere)


def anchors_in_scene(summary: ResultSummary, positions_m: Mapping[str, Array]) -> tuple[SceneAnchor, ...]:
    """Anchors at their positions, with what is known of their errors and mirror images."""
    found = []
    for anchor_id, position_m in positions_m.items():
        entry = summary.anchors[anchor_id]
        stddev_m = np.full(3, np.nan if entry.stddev_m is None else entry.stddev_m)
        mirror_m = None if entry.mirror_position_m is None else np.array(entry.mirror_position_m)
        found.append(SceneAnchor(anchor_id, position_m, stddev_m, mirror_m))
    return tuple(found)


def _or_empty(values: Any, kind: Any) -> Any:
    return np.zeros((0, 3), dtype=kind) if values is None else values
