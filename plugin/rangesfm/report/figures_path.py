"""Figures of the path and the map: plan, elevation, and the scale along the way."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import align_points
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.report.content import Content
from rangesfm.report.plot import WIDE_SIZE, Figure, Mark, Panel, Pixels, Range, Series, equal_view
from rangesfm.report.text import count

MAX_NUM_POINTS_DRAWN = 6000
PICTURE_WIDTH_PX = 900
AXES = ("x", "y", "z")

_SEEN_QUANTILE = 0.02
_MIN_WINDOW = 3
_NUM_WINDOWS = 20


def trajectory_views(content: Content) -> Figure | None:
    """The path in plan and in elevation: with the true, with the estimated scale, and refined."""
    if content.final is None or len(content.final) == 0:
        return None
    views = tuple(_trajectory_view(content, *of_view) for of_view in _views(content))
    caption = (
        f"The camera's path in metres, in the {'site' if content.summary.frame == 'site' else 'first camera'} frame."
    )
    if content.points_m is not None and len(content.points_m):
        drawn = min(len(content.points_m), MAX_NUM_POINTS_DRAWN)
        caption += f" {count(drawn)} of the map's {count(len(content.points_m))} points are drawn, those that are near."
    return Figure("trajectory", caption, views, layout="views")


def map_views(content: Content) -> Figure | None:
    """The map's points in plan and in elevation, in their own colours."""
    if content.final is None or content.points_m is None or len(content.points_m) == 0:
        return None
    views = tuple(_map_view(content, *of_view) for of_view in _views(content))
    caption = "The map's points in the photos' colours, seen from above and from the side."
    return Figure("map_points", caption, views, layout="views", table="points")


def local_scale(content: Content) -> Figure | None:
    """How the scale of the scaled map changes along the path: what one similarity cannot take away."""
    if content.scaled is None or content.refined is None:
        return None
    series = [_local_scale_series("refined over scaled", "after", "line", content.scaled, content.refined.centers)]
    if content.reference_by_photo:
        known = [content.reference_by_photo.get(name, [np.nan] * 3) for name in content.scaled.image_names]
        truth = np.array(known, dtype=np.float64)
        series.append(_local_scale_series("reference over scaled", "reference", "dashed", content.scaled, truth))
    known_series = tuple(one for one in series if len(one.points))
    if not known_series:
        return None
    label = "photo" if content.scaled.timestamps_s is None else "time s"
    panel = Panel(
        "", "Local scale along the path", label, "local scale %", known_series, zero_line=True, size=WIDE_SIZE
    )
    caption = (
        f"Scale of stretches of {2 * _window(content.scaled) + 1} photos, relative to that of the scaled map. A level "
        "line is a common error of the scale; a slope is drift."
    )
    return Figure("local_scale", caption, (panel,))


def _views(content: Content) -> list[tuple[str, tuple[int, int], tuple[int, int]]]:
    """Name, horizontal and vertical axis of each view, and their signs on the page."""
    path = content.final
    assert path is not None
    extents = np.ptp(path.centers, axis=0)
    if content.summary.frame == "site":
        along = 0 if extents[0] >= extents[1] else 1
        return [("Plan", (0, 1), (1, 1)), ("Elevation", (along, 2), (1, 1))]
    # A camera looks along +z and its y axis points down.
    along = 0 if extents[0] >= extents[2] else 2
    return [("Plan", (0, 2), (1, 1)), ("Elevation", (along, 1), (1, -1))]


def _labels(axes: tuple[int, int], signs: tuple[int, int]) -> tuple[str, str]:
    return f"{AXES[axes[0]]} m", f"{'−' if signs[1] < 0 else ''}{AXES[axes[1]]} m"


def _seen(points: Array, axes: tuple[int, int], signs: tuple[int, int]) -> Array:
    return np.asarray(points[:, axes] * np.array(signs, dtype=np.float64))


def _trajectory_view(content: Content, name: str, axes: tuple[int, int], signs: tuple[int, int]) -> Panel:
    paths = [("true scale", "true-scale", content.true_scale), ("estimated scale", "before", content.scaled)]
    paths.append(("refined", "after", content.refined))
    lines = [
        Series(label, color, _seen(path.centers, axes, signs), "line")
        for label, color, path in paths
        if path is not None
    ]
    if content.reference_m is not None:
        lines.append(Series("reference", "reference", _seen(content.reference_m, axes, signs), "dashed"))
    places = {anchor_id: _seen(position[None], axes, signs)[0] for anchor_id, position in content.anchors_m.items()}
    x_range, y_range, size = equal_view(
        np.concatenate([*(line.points for line in lines), *map(np.atleast_2d, places.values())])
    )
    if content.points_m is not None:
        near = _inside(_seen(_thinned(content.points_m), axes, signs), x_range, y_range)
        lines.insert(0, Series("map", "map", near, is_data=False))
    return Panel(
        name,
        f"{name} of the camera's path with the anchors",
        *_labels(axes, signs),
        tuple(lines),
        tuple(
            Mark("anchor", "anchor", "triangle", float(x), float(y), anchor_id, f"anchor {anchor_id}")
            for anchor_id, (x, y) in places.items()
        ),
        x_range,
        y_range,
        size,
        keeps_shape=True,
    )


def _inside(points: Array, x_range: Range, y_range: Range) -> Array:
    low, high = np.transpose([x_range, y_range])
    return np.asarray(points[np.all((points > low) & (points < high), axis=1)])


def _thinned(points: Array) -> Array:
    """An even sample of what may be very many."""
    if len(points) <= MAX_NUM_POINTS_DRAWN:
        return points
    return points[np.random.default_rng(0).choice(len(points), MAX_NUM_POINTS_DRAWN, replace=False)]


def _map_view(content: Content, name: str, axes: tuple[int, int], signs: tuple[int, int]) -> Panel:
    assert content.points_m is not None
    assert content.points_rgb is not None
    assert content.final is not None
    points, path = _seen(content.points_m, axes, signs), _seen(content.final.centers, axes, signs)
    corners = np.quantile(points, [_SEEN_QUANTILE, 1 - _SEEN_QUANTILE], axis=0)
    x_range, y_range, size = equal_view(np.concatenate([corners, path]))
    order = np.argsort(_depth(content, axes))
    pixels = _raster(points[order], content.points_rgb[order], x_range, y_range, size[1] / size[0])
    return Panel(
        name,
        f"{name} of the map's points",
        *_labels(axes, signs),
        (Series("path", "after", path, "line"),),
        x_range=x_range,
        y_range=y_range,
        size=size,
        keeps_shape=True,
        picture=pixels,
    )


def _depth(content: Content, axes: tuple[int, int]) -> Array:
    """What is nearer to the reader comes last: from above, what is higher."""
    assert content.points_m is not None
    (across,) = {0, 1, 2} - set(axes)
    towards_reader = 1.0 if content.summary.frame == "site" and across == 2 else -1.0
    return np.asarray(towards_reader * content.points_m[:, across])


def _raster(
    points: Array,
    colors: Pixels,
    x_range: Range,
    y_range: Range,
    aspect: float,
) -> Pixels:
    """(h, w, 4) pixels with each point two pixels wide."""
    width, height = PICTURE_WIDTH_PX, max(round(PICTURE_WIDTH_PX * aspect), 1)
    pixels = np.zeros((height, width, 4), dtype=np.uint8)
    column = (points[:, 0] - x_range[0]) / (x_range[1] - x_range[0]) * (width - 1)
    row = (y_range[1] - points[:, 1]) / (y_range[1] - y_range[0]) * (height - 1)
    inside = (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1)
    i, j = row[inside].astype(np.int64), column[inside].astype(np.int64)
    rgba = np.column_stack([colors[inside], np.full(len(i), 255, dtype=np.uint8)])
    for down in (0, 1):
        for right in (0, 1):
            pixels[i + down, j + right] = rgba
    return pixels


def _window(path: Trajectory) -> int:
    return max(_MIN_WINDOW, len(path) // _NUM_WINDOWS)


def _local_scale_series(name: str, color: str, kind: str, path: Trajectory, target: Array) -> Series:
    """Percent by which stretches of the path are too short for the target; none where it stands still."""
    half, points = _window(path), []
    along = (
        np.arange(len(path), dtype=np.float64)
        if path.timestamps_s is None
        else path.timestamps_s - path.timestamps_s[0]
    )
    if len(target) != len(path):
        return Series(name, color, np.zeros((0, 2)), kind)
    least = 0.02 * float(np.linalg.norm(np.ptp(path.centers, axis=0)))
    for middle in range(len(path)):
        inside = slice(max(middle - half, 0), middle + half + 1)
        known = np.isfinite(target[inside]).all(axis=1)
        source, goal = path.centers[inside][known], target[inside][known]
        if len(source) > _MIN_WINDOW and np.linalg.norm(np.ptp(source, axis=0)) > least:
            points.append([along[middle], 100.0 * (align_points(source, goal).scale - 1.0)])
    return Series(name, color, np.array(points, dtype=np.float64).reshape(-1, 2), kind)
