"""The files of a simulated survey."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap


def write_rows(path: Path, header: str, rows: Iterable[Iterable[object]]) -> None:
    """Write a table as CSV."""
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n", encoding="utf-8")


def write_model(sfm: pycolmap.Reconstruction, sparse: Path, timestamps_s: Mapping[str, float], images: Path) -> None:
    """Write a model into a folder, and the times of its photos into a file."""
    sparse.mkdir(parents=True)
    sfm.write_binary(sparse)
    write_rows(images, "image_name,timestamp_s", timestamps_s.items())


def write_marks(path: Path, model: pycolmap.Reconstruction, points: Mapping[str, int]) -> None:
    """Write the features of points, given by their ids, as marks of these names."""
    seen = {name: features_of(model, point_id) for name, point_id in points.items()}
    rows = ((name, photo, *xy) for name, of_photo in seen.items() for photo, xy in of_photo.items())
    write_rows(path, "marker,image_name,x_px,y_px", rows)


def features_of(model: pycolmap.Reconstruction, point_id: int) -> dict[str, list[float]]:
    """Return the feature of a point, [x, y], by photo; one of them where a real photo has several."""
    seen = ((model.image(each.image_id), each.point2D_idx) for each in model.point3D(point_id).track.elements)
    return {image.name: np.ravel(image.points2D[index].xy).tolist() for image, index in seen}


def write_anchors(path: Path, anchors_m: Mapping[str, Iterable[float]]) -> None:
    write_rows(path, "anchor_id,x_m,y_m,z_m", ((name, *map(float, at)) for name, at in anchors_m.items()))
