"""Data of the 3-D view: positions relative to a nearby origin, and texts of the page around the view."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.report.content import Content
from rangesfm.report.packing import pack
from rangesfm.report.plot import every_nth
from rangesfm.report.scene_errors import errors_of_scene
from rangesfm.report.text import count
from rangesfm.result.entries import AnchorEntry
from rangesfm.result.places import is_within
from rangesfm.result.result_tables import USED_LABELS
from rangesfm.sfm.photo_files import UNREADABLE, opened_image
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import side_by_side

MAX_NUM_POINTS = 500_000
MAX_NUM_RANGES = 20_000
NUM_STEPS = 65535
"""Number of steps into which the largest side of the points' box is divided; positions are stored as whole steps."""

MAX_NUM_THUMBNAILS, MAX_THUMBNAIL_BYTES = 160, 600_000
"""Largest number of thumbnails, and of bytes of all thumbnails together as they are stored in the page."""

# A photo in another format than JPEG is decoded at full size, with three bytes a pixel. Larger ones get no thumbnail.
_MAX_DECODED_PIXELS = 100_000_000
_WIDTHS_PX, _QUALITY = (256, 208, 160, 128), 60
_FAR_QUANTILE = 0.005
_SEEN_QUANTILE = 0.05
_RADIUS_OF_95_PERCENT = 2.80
"""Radius, in stddevs, of the sphere that holds 95 % of a three-dimensional normal distribution.

It is the root of the 0.95 quantile of the chi-square distribution with three degrees of freedom, 7.81.
"""


@dataclass(frozen=True)
class ScenePath:
    """One path of cameras in the scene.

    Attributes:
        id: of its layer.
        color: name of a colour of the page's style.
        trajectory: in the frame of the scene, metres.
        has_orientations: whether camera orientations are known, so that frusta can be drawn.
        is_shown: whether it is drawn before the reader chooses.
    """

    id: str
    name: str
    color: str
    trajectory: Trajectory
    has_orientations: bool = True
    is_shown: bool = True


def view_of_result(content: Content) -> dict[str, Any]:
    """Return the data of the view of a result, as ``view_of`` does; empty where the result has no model."""
    summary, result = content.summary, content.final
    if not result:
        return {}
    paths = []
    if n := len(content.reference_m):
        nowhere = np.tile(np.eye(3), (n, 1, 1))
        reference = Trajectory(np.arange(n), tuple(map(str, range(n))), None, content.reference_m, nowhere)
        paths.append(ScenePath("reference", "Reference", "reference", reference, False))
    if content.scaled:
        # Often it is hardly apart from the refined path, and the colours of both would be mixed.
        is_result = not content.refined
        paths.append(ScenePath("scaled", "Cameras, scaled", "before", content.scaled, is_shown=is_result))
    if content.refined:
        paths.append(ScenePath("refined", "Cameras, refined", "after", content.refined))
    photos, pictures = result.image_names, thumbnails(content.images_path, result.image_names)
    stride, known = every_nth(len(content.ranges), MAX_NUM_RANGES), f"{count(len(pictures))} of {count(len(photos))}"
    notes = (
        f"One in {stride} ranges is drawn and listed; ranges.csv has all." if stride > 1 else "",
        f"To keep the page small, only {known} photos have a picture here." if 0 < len(pictures) < len(photos) else "",
    )
    anchors, points = summary.anchors, (content.points_m, content.points_rgb, content.point_ids)
    view = view_of(summary.frame, paths, *points, anchors=anchors, notes=notes)
    of_result: dict[str, Any] = {
        "ranges": _ranges(content, result) or None,
        "thumbnails": pictures,
        "errors": errors_of_scene(
            content.result.read_map_errors(), summary, result, [anchor["id"] for anchor in view["anchors"]]
        )
        or None,
        "scale_interval": [end / summary.scale.value for end in summary.scale.interval_95 or ()] or None,
    }
    for camera in [*(content.refined_cameras or content.scaled_cameras).values()][:1]:
        focal_px = camera.mean_focal_length()
        of_result["frustum_shape"] = camera.width / (2 * focal_px), camera.height / (2 * focal_px)
    return view | of_result


def view_of(
    frame: str,
    paths: Sequence[ScenePath],
    points_m: Array,
    points_rgb: npt.NDArray[np.uint8],
    point_ids: npt.NDArray[np.int64],
    *,
    anchors: Mapping[str, AnchorEntry],
    unit: str = "m",
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the data of the view on the page.

    They are what the script draws, the layers (id, name, colour and shape of the swatch, whether each is drawn at
    first), and a note for the reader.

    Args:
        frame: of all positions: "site" (z up), or any other name for the frame of a camera (y down).
        paths: of cameras. The last one is the result; the reader chooses cameras on it.
        points_m, points_rgb, point_ids: (m, 3) positions and colours of the map's points, and (m,) their ids in the
            model; no ids if they are not known.
        anchors: by id; those without a position are not shown.
        unit: of all lengths; "m" unless nobody knows the scale.
        notes: for the reader, about ranges and photos.
    """
    shown = {id_: anchor for id_, anchor in anchors.items() if anchor.position_m is not None}
    around = np.concatenate([*(path.trajectory.centers for path in paths), *([a.position_m] for a in shown.values())])
    seen = [around]
    if len(points_m):
        seen.append(np.quantile(points_m, [_SEEN_QUANTILE, 1 - _SEEN_QUANTILE], axis=0))
    corners = np.concatenate(seen)
    low, high = corners.min(axis=0), corners.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    # A graphics card computes with 32 bits, which resolve only half a metre in a national grid 5400000 m from its
    # origin. The origin is at round numbers, so that the lines of the grid are at round coordinates.
    step = 10.0 ** math.floor(math.log10(radius))
    origin_m = step * np.round((low + high) / 2 / step)
    low, high = low - origin_m, high - origin_m
    ground, result = float(low[2]) if frame == "site" else float(high[1]), paths[-1]
    chosen, of_anchors = _chosen_points(points_m, around), [_anchor(*each, origin_m) for each in shown.items()]
    points = _points(points_m[chosen] - origin_m, points_rgb[chosen], point_ids[chosen] if len(point_ids) else None)
    layers = [("points", "Map points", "map", "dots", True)] if points else []
    layers += [
        (path.id, path.name, path.color, "line" if path.has_orientations else "dashed", path.is_shown) for path in paths
    ]
    layers += [("anchors", "Anchors", "anchor", "triangle", True)] if shown else []
    num_left_out = len(points_m) - len(chosen)
    note = (
        "Drag to turn, wheel or pinch to zoom, right drag or two fingers to move; click a camera for its photo.",
        f"{count(num_left_out)} points are not drawn, because they are far away or too many." if num_left_out else "",
        *notes,
        "Ellipsoids around the anchors are their 95 % regions, at true size." if shown else "",
    )
    return {
        "unit": unit,
        "up": [0, 0, 1] if frame == "site" else [0, -1, 0],
        "origin": origin_m.tolist(),
        "box": {"low": low.tolist(), "high": high.tolist(), "radius": radius, "ground": ground},
        "paths": [_path(path, origin_m) for path in paths],
        "points": points or None,
        "anchors": of_anchors,
        "ranges": None,
        "frustum_size": _frustum_size(result.trajectory, radius),
        "frustum_shape": (0.6, 0.4),
        "thumbnails": {},
        "errors": None,
        "scale_interval": None,
        "layers": [*layers, ("grid", "Grid", "muted", "box", True)],
        "num_photos": len(result.trajectory) if result.has_orientations else 0,
        "note": " ".join(filter(None, note)),
    }


def _path(path: ScenePath, origin_m: Array) -> dict[str, Any]:
    trajectory = path.trajectory
    times = trajectory.timestamps_s
    return {
        "id": path.id,
        "name": path.name,
        "color": path.color,
        "names": list(trajectory.image_names),
        "times": None if times is None else pack(times - times[0], "float32"),
        "centers": pack(trajectory.centers - origin_m, "float32"),
        "rotations": pack(trajectory.world_from_cam, "float32") if path.has_orientations else None,
    }


def _points(points: Array, colors: npt.NDArray[np.uint8], ids: npt.NDArray[np.int64] | None) -> dict[str, Any]:
    if len(points) == 0:
        return {}
    origin, extent = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-9)
    return {
        "num": len(points),
        "origin": origin.tolist(),
        "extent": extent,
        "steps": pack(np.round((points - origin) / extent * NUM_STEPS), "uint16"),
        "colors": pack(colors, "uint8"),
        "ids": None if ids is None else pack(ids, "int32"),
    }


def _chosen_points(points: Array, around: Array) -> npt.NDArray[np.int64]:
    """Return the indices of the points to draw, in random order.

    Points far away from all others are left out: they would make the box, and with it the steps of all points, coarse.

    Args:
        points: (m, 3) of the map. around: (n, 3) positions of cameras and anchors.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(points, [_FAR_QUANTILE, 1 - _FAR_QUANTILE], axis=0)
    low, high = np.minimum(low, around.min(axis=0)), np.maximum(high, around.max(axis=0))
    margin = 0.5 * (high - low).max()
    inside = np.flatnonzero(np.all((points >= low - margin) & (points <= high + margin), axis=1))
    return np.random.default_rng(0).permutation(inside)[:MAX_NUM_POINTS]


def _frustum_size(path: Trajectory, radius: float) -> float:
    """Return the size of a frustum, metres: about the distance between cameras, but neither too small nor too large."""
    steps = np.linalg.norm(np.diff(path.centers, axis=0), axis=1)
    typical = float(np.median(steps)) if len(steps) else radius
    return float(np.clip(0.7 * typical, 0.012 * radius, 0.05 * radius))


def _anchor(anchor_id: str, anchor: AnchorEntry, origin_m: Array) -> dict[str, Any]:
    places = {"position": anchor.position_m, "mirror": anchor.mirror_position_m}
    at = {name: None if place is None else np.subtract(place, origin_m).tolist() for name, place in places.items()}
    return {
        "id": anchor_id,
        "position": at["position"],
        "ellipsoid": [_RADIUS_OF_95_PERCENT * anchor.stddev_m] * 3 if anchor.stddev_m else None,
        "mirror": at["mirror"],
    }


def _ranges(content: Content, path: Trajectory) -> dict[str, Any]:
    ranges = content.ranges
    if not ranges:
        return {}
    rows = np.arange(0, len(ranges.status), every_nth(len(ranges.status), MAX_NUM_RANGES))
    before, after, has_place = (of_all[rows] for of_all in ranges.places_on(path.image_names))
    fraction = np.where(has_place, ranges.weight[rows], 0.0)
    anchor_ids, anchor = np.unique(np.array(ranges.anchor_id, dtype=str), return_inverse=True)
    present = set(ranges.status)
    known = [status.label for status in RangeStatus if status.label in present]
    statuses = [*known, *sorted(present.difference(known))]  # ranges that are used come first
    status = np.array([statuses.index(label) for label in ranges.status])
    residuals_m = ranges.residuals_by_model_m
    final = next(reversed(residuals_m))
    unknown = np.full(len(ranges.status), np.nan)
    tags, tag = np.unique(content.tags_in_cam_m[rows], axis=0, return_inverse=True)
    return {
        "num": len(rows),
        "anchor_ids": anchor_ids.tolist(),
        "anchor": pack(anchor[rows], "uint16"),
        "tags_in_cam_m": tags.tolist(),
        "tag": pack(tag.reshape(-1), "uint8"),
        "statuses": statuses,
        "shown_at_first": [name in USED_LABELS for name in statuses],
        "status": pack(status[rows], "uint8"),
        "time": pack(content.range_times_s[rows], "float32"),
        "measured": pack(ranges.range_m[rows], "float32"),
        "residual_scaled": pack(residuals_m["scaled"][rows], "float32"),
        "residual_refined": pack(residuals_m.get("refined", unknown)[rows], "float32"),
        "final": f"residual_{final}",
        "residual_limit_m": _residual_limit(residuals_m[final][ranges.is_used]),
        "true": pack(content.true_ranges_m[rows], "float32") if np.isfinite(content.true_ranges_m).any() else None,
        "has_place": pack(has_place, "uint8"),
        "before": pack(np.maximum(before, 0), "int32"),
        "after": pack(np.maximum(after, 0), "int32"),
        "weight": pack(np.round(255 * fraction), "uint8"),
        "camera": pack(np.where(has_place, np.where(fraction < 0.5, before, after), -1), "int32"),
    }


def _residual_limit(residuals: Array) -> float:
    """Return the residual in metres that is drawn in full colour: 95 % of the used ranges have smaller ones."""
    known = np.abs(residuals[np.isfinite(residuals)])
    return max(float(np.quantile(known, 0.95)), 1e-3) if len(known) else 1.0


def thumbnails(folder: Path | None, image_names: Sequence[str]) -> dict[str, str]:
    """Return thumbnails as JPEG data URIs by photo name, of photos evenly spaced along the path.

    Photos that cannot be read are left out. So are photos that a name or a link would take from outside the folder,
    because the page is given to others. All thumbnails have the largest width with which they fit into
    ``MAX_THUMBNAIL_BYTES``; if they do not fit even with the smallest width, there are fewer.
    """
    if folder is None or not folder.is_dir():
        return {}
    image_names = [name for name in image_names if is_within(folder / name, folder)]
    if not image_names:
        return {}
    chosen = np.unique(np.linspace(0, len(image_names) - 1, MAX_NUM_THUMBNAILS).round().astype(int))
    names = [image_names[i] for i in chosen]
    photos = dict(zip(names, side_by_side(_small_copy, [folder / name for name in names]), strict=True))
    made: dict[str, str] = {}
    for width in _WIDTHS_PX:
        made, num_bytes = {}, 0
        for name, photo in photos.items():
            if photo is not None:
                uri = data_uri(ImageOps.contain(photo, (width, width)), "JPEG", quality=_QUALITY)
                num_bytes += len(uri)
                if num_bytes > MAX_THUMBNAIL_BYTES:
                    break
                made[name] = uri
        else:
            break
    return made


def _small_copy(path: Path) -> Image.Image | None:
    width = _WIDTHS_PX[0]
    try:
        with opened_image(path) as photo:
            photo.draft("RGB", (2 * width, 2 * width))  # a JPEG is then decoded at about this size only
            if photo.width * photo.height > _MAX_DECODED_PIXELS:
                return None
            return ImageOps.contain(photo.convert("RGB"), (width, width))
    except UNREADABLE:
        return None


def data_uri(picture: Image.Image, kind: str, **options: Any) -> str:
    """Return a picture as a data URI, which a page can hold itself; kind: "PNG" or "JPEG"."""
    file = io.BytesIO()
    picture.save(file, kind, optimize=True, **options)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
