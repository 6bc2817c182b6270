"""The files of a simulated survey."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

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
    rows = []
    for name, point_id in points.items():
        for element in model.point3D(point_id).track.elements:
            image = model.image(element.image_id)
            rows.append((name, image.name, *map(float, image.points2D[element.point2D_idx].xy)))
    write_rows(path, "marker,image_name,x_px,y_px", rows)


def write_anchors(path: Path, anchors_m: Mapping[str, Iterable[float]]) -> None:
    write_rows(path, "anchor_id,x_m,y_m,z_m", ((name, *map(float, at)) for name, at in anchors_m.items()))
