"""Figures of the path and the map: plan, elevation, and the scale along the path."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rangesfm.arrays import Array
from rangesfm.report.content import Content
from rangesfm.report.facts import frame_in_words
from rangesfm.report.plot import (
    WIDE_SIZE,
    Figure,
    Limits,
    Panel,
    Pixels,
    Series,
    View,
    equal_view,
    figure_of,
    views_of,
)
from rangesfm.util.geometry.similarity import align_points
from rangesfm.util.geometry.trajectory import Trajectory

PICTURE_WIDTH_PX = 900

_SEEN_QUANTILE = 0.02
_MIN_WINDOW = 3
_NUM_WINDOWS = 20


def trajectory_views(content: Content) -> Iterator[Figure]:
    """Yield plan and elevation of the path: with the true scale, scaled, and refined."""
    if not content.final:
        return
    frame = content.summary.frame
    views = tuple(_trajectory_view(content, view) for view in views_of(content.final.centers, frame))
    caption = (
        f"The camera's path in metres, in {frame_in_words(content)}. Scaled: the unscaled map with the scale found. "
    )
    caption += "Refined: after photos and measurements were adjusted together."
    if content.true_scale:
        caption += " True scale: the unscaled map with the scale of the reference, so that only its drift is left."
    yield Figure("trajectory", caption, views, layout="views")


def map_views(content: Content) -> Iterator[Figure]:
    """Yield plan and elevation of the map's points in their own colours."""
    if not content.final or len(content.points_m) == 0:
        return
    path = content.final.centers
    views = tuple(_map_view(content, path, view) for view in views_of(path, content.summary.frame))
    caption = "The map's points in the photos' colours, seen from above and from the side."
    yield Figure("map_points", caption, views, layout="views", table="points")


def local_scale(content: Content) -> Iterator[Figure]:
    """Yield the figure of the local scale of the scaled map along the path, which shows its drift in scale."""
    path = content.scaled
    if not path or not content.refined:
        return
    known = [content.reference_by_photo.get(name, [np.nan] * 3) for name in path.image_names]
    series = [
        Series("refined, relative to scaled", "after", _local_scales(path, content.refined.centers), "line"),
        Series(
            "reference, relative to scaled",
            "reference",
            _local_scales(path, np.array(known, dtype=np.float64)),
            "dashed",
        ),
    ]
    series = [one for one in series if len(one.points)]
    if not series:
        return
    yield figure_of(
        "local_scale",
        f"Scale of parts of the path of {2 * _window(path) + 1} photos, relative to that of the scaled map. A level "
        "line away from zero is an error of the whole scale; a slope is drift.",
        "Local scale along the path",
        ("photo" if path.timestamps_s is None else "time s", "local scale %"),
        series,
        zero_line=True,
        size=WIDE_SIZE,
    )


def _trajectory_view(content: Content, view: View) -> Panel:
    paths = [("true scale", "true-scale", content.true_scale), ("scaled", "before", content.scaled)]
    paths.append(("refined", "after", content.refined))
    lines = [Series(name, color, view.seen(path.centers), "line") for name, color, path in paths if path]
    if len(content.reference_m):
        lines.append(Series("reference", "reference", view.seen(content.reference_m), "dashed"))
    places, marks = view.anchors(content.result.anchor_positions_m)
    limits = equal_view(np.concatenate([*(line.points for line in lines), places]))
    return view.panel("the camera's path with the anchors", " m", lines, limits, marks=marks)


def _map_view(content: Content, path: Array, view: View) -> Panel:
    points, line = view.seen(content.points_m), Series("path", "after", view.seen(path), "line")
    corners = np.quantile(points, [_SEEN_QUANTILE, 1 - _SEEN_QUANTILE], axis=0)
    limits = equal_view(np.concatenate([corners, line.points]))
    # Points nearer to the reader are drawn last, over the others: seen from above, the higher ones.
    (across,) = {0, 1, 2} - set(view.axes)
    towards_reader = 1.0 if content.summary.frame == "site" and across == 2 else -1.0
    order = np.argsort(towards_reader * content.points_m[:, across])
    picture = _raster(points[order], content.points_rgb[order], limits)
    return view.panel("the map's points", " m", [line], limits, picture=picture)


def _raster(points: Array, colors: Pixels, limits: Limits) -> Pixels:
    """Return the points as an RGBA picture (h, w, 4), each two pixels wide."""
    (x_low, x_high), (y_low, y_high), size = limits
    width, height = PICTURE_WIDTH_PX, max(round(PICTURE_WIDTH_PX * size[1] / size[0]), 1)
    pixels = np.zeros((height, width, 4), dtype=np.uint8)
    last = np.array([width - 1, height - 1])
    places = (points - (x_low, y_high)) / (x_high - x_low, y_low - y_high) * last
    inside = np.all((places >= 0) & (places < last), axis=1)
    column, row = places[inside].astype(np.int64).T
    rgba = np.insert(colors[inside], 3, 255, axis=1)
    for down, right in np.ndindex(2, 2):
        pixels[row + down, column + right] = rgba
    return pixels


def _window(path: Trajectory) -> int:
    return max(_MIN_WINDOW, len(path) // _NUM_WINDOWS)


def _local_scales(path: Trajectory, target: Array) -> Array:
    """Return the local scale along a path, relative to target positions.

    Args:
        path: of n keyframes.
        target: (n, 3) positions of the same keyframes; NaN where unknown.

    Returns:
        (k, 2): time in seconds since the first keyframe (or number of the keyframe) at the middle of a window, and the
        percentage by which the target is larger than the path there. Windows in which the camera hardly moves are left
        out.
    """
    times, half, points = path.timestamps_s, _window(path), []
    along = np.arange(len(path), dtype=np.float64) if times is None else times - times[0]
    least = 0.02 * float(np.linalg.norm(np.ptp(path.centers, axis=0)))
    for middle in range(len(path) if len(target) == len(path) else 0):
        inside = slice(max(middle - half, 0), middle + half + 1)
        known = np.isfinite(target[inside]).all(axis=1)
        source, goal = path.centers[inside][known], target[inside][known]
        if len(source) > _MIN_WINDOW and np.linalg.norm(np.ptp(source, axis=0)) > least:
            points.append([along[middle], 100.0 * (align_points(source, goal).scale - 1.0)])
    return np.array(points, dtype=np.float64).reshape(-1, 2)
