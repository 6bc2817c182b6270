"""What the page says around the 3-D view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rangesfm.ranging.observations import RangeStatus
from rangesfm.report.scene import Scene, range_stride, scene_data
from rangesfm.report.text import count

SHOWN_STATUSES = (RangeStatus.USED.label, RangeStatus.DOWN_WEIGHTED.label)


@dataclass(frozen=True)
class View:
    """The 3-D view on the page.

    Attributes:
        data: what its script reads.
        layers: id, name, colour and shape of the swatch of what can be taken away.
        statuses: of ranges, and whether those are drawn at first.
        num_photos: to choose from; 0 where photos have no orientation.
        note: what one can do, and what is not drawn.
    """

    data: dict[str, Any]
    layers: list[tuple[str, str, str, str]]
    statuses: list[tuple[str, bool]]
    num_photos: int
    note: str


def view_of(scene: Scene) -> View:
    """The view of a scene."""
    data = scene_data(scene)
    statuses = data["ranges"]["statuses"] if data["ranges"] else []
    layers = [("points", "Map points", "map", "dots")] if len(scene.points_m) else []
    layers += [(path.id, path.name, path.color, "line" if path.has_orientations else "dashed") for path in scene.paths]
    layers += [("anchors", "Anchors", "anchor", "triangle")] if data["anchors"] else []
    layers += [("grid", "Grid", "muted", "box")]
    return View(
        data=data,
        layers=layers,
        statuses=[(name, name in SHOWN_STATUSES) for name in statuses],
        num_photos=len(scene.result) if scene.paths[-1].has_orientations else 0,
        note=_note(scene, data),
    )


def _note(scene: Scene, data: dict[str, Any]) -> str:
    sentences = [
        "Drag to turn, wheel or pinch to zoom, right drag or two fingers to move; click a camera for its photo."
    ]
    if num_left_out := len(scene.points_m) - (data["points"] or {"num": 0})["num"]:
        sentences.append(f"{count(num_left_out)} points far away or beyond the view's limit are not drawn.")
    ranges = None if scene.content is None else scene.content.ranges
    if ranges is not None and (stride := range_stride(ranges)) > 1:
        sentences.append(f"One in {stride} ranges is drawn and listed; ranges.csv holds all.")
    num_thumbnails, num_photos = len(data["thumbnails"]), len(scene.result)
    if 0 < num_thumbnails < num_photos:
        sentences.append(f"{count(num_thumbnails)} of {count(num_photos)} photos have a picture: the page stays small.")
    if data["anchors"]:
        sentences.append("Ellipsoids around the anchors hold 95 %, at their true size.")
    return " ".join(sentences)
