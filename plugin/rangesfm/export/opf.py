"""Scale for other photogrammetry programs: distances between points of the map, as the Open Photogrammetry Format.

Pairs of well-seen points are written as manual tie points with their marks, and each pair's distance as a scale
constraint with the uncertainty of the scale: a program that maps the same photos then gets our scale.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap
from rangesfm.files.atomic import new_folder
from rangesfm.files.json_files import write_json

_NUM_CONSTRAINTS = 10
_MIN_TRACK_LENGTH = 3
# Of marks that a feature detector made; a person's click is of 1.
_MARK_ACCURACY = 1.0


def write_opf(map_: MetricMap, folder: Path) -> Path:
    """Write ``camera_list.json``, ``input_control_points.json`` and ``constraints.json`` into ``folder``.

    Raises:
        InputError: the map has no two points that three photos see, or its scale's stddev is not known.
    """
    model, stddev = map_.reconstruction, map_.relative_scale_stddev
    if stddev is None:
        raise InputError("the format 'opf' needs the stddev of the scale, which is not known of this model")
    pairs = _distant_pairs(model)
    point_ids = [point_id for pair in pairs for point_id in pair]
    files = {
        "camera_list.json": _file("camera-list", cameras=_cameras(model)),
        "input_control_points.json": _file(
            "input-control-points", gcps=[], mtps=[_tie_point(model, point_id) for point_id in point_ids]
        ),
        "constraints.json": _file(
            "constraints",
            scale_constraints=[_constraint(model, number, pair, stddev) for number, pair in enumerate(pairs)],
            orientation_constraints=[],
        ),
    }
    with new_folder(folder) as temporary:
        for name, content in files.items():
            write_json(content, temporary / name)
    return folder


def _file(kind: str, **content: Any) -> dict[str, Any]:
    return {"format": f"application/opf-{kind}+json", "version": "1.0", **content}


def _distant_pairs(model: pycolmap.Reconstruction) -> list[tuple[int, int]]:
    """Pairs of points that many photos see, far from each other; each point in one pair only."""
    seen = sorted(
        (i for i, point in model.points3D.items() if point.track.length() >= _MIN_TRACK_LENGTH),
        key=lambda i: (-model.point3D(i).track.length(), i),
    )[: 20 * _NUM_CONSTRAINTS]
    if len(seen) < 2:
        raise InputError("the format 'opf' needs two points that three photos see, and the map has none")
    places = np.array([model.point3D(i).xyz for i in seen])
    pairs: list[tuple[int, int]] = []
    left = np.ones(len(seen), dtype=bool)
    while left.sum() >= 2 and len(pairs) < _NUM_CONSTRAINTS:
        first = int(np.argmax(left))
        left[first] = False
        second = int(np.argmax(np.where(left, np.linalg.norm(places - places[first], axis=1), -1.0)))
        left[second] = False
        pairs.append((seen[first], seen[second]))
    return pairs


def _cameras(model: pycolmap.Reconstruction) -> list[dict[str, Any]]:
    return [
        {"id": _uid(image.name), "uri": image.name} for image in sorted(model.images.values(), key=lambda i: i.name)
    ]


def _uid(name: str) -> int:
    """64 bits that depend on the photo's name alone."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


def _tie_point(model: pycolmap.Reconstruction, point_id: int) -> dict[str, Any]:
    marks = []
    for element in model.point3D(point_id).track.elements:
        image = model.image(element.image_id)
        at = image.points2D[element.point2D_idx].xy
        marks.append({"camera_id": _uid(image.name), "position_px": at.tolist(), "accuracy": _MARK_ACCURACY})
    return {"id": f"point{point_id}", "marks": marks, "is_checkpoint": False}


def _constraint(
    model: pycolmap.Reconstruction, number: int, pair: tuple[int, int], relative_stddev: float
) -> dict[str, Any]:
    first, second = (model.point3D(point_id).xyz for point_id in pair)
    distance = float(np.linalg.norm(first - second))
    return {
        "id": f"distance{number}",
        "id_from": f"point{pair[0]}",
        "id_to": f"point{pair[1]}",
        "distance": distance,
        "sigma": distance * relative_stddev,
    }
