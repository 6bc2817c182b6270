"""Transformation of files that other programs made from the unscaled model, into the metric world.

These are meshes and point clouds (PLY, OBJ), camera files (``transforms.json`` of nerfstudio, ``cameras.json`` of
Gaussian splatting) and COLMAP models.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export.colmap import write_model
from rangesfm.export.ply import transform_ply
from rangesfm.files.atomic import make_output_folder, require_apart, write_text
from rangesfm.files.records import read_json, write_json
from rangesfm.files.text_tables import read_text
from rangesfm.geometry.similarity import Similarity, align_points, overflow_raised, rmse

Json = Any


def best_similarity(sfm: pycolmap.Reconstruction, metric: pycolmap.Reconstruction) -> tuple[Similarity, float]:
    """Estimate the similarity that brings the cameras of an unscaled model closest to those of a refined model.

    Returns:
        The similarity metric_from_sfm, and the root mean square distance of the cameras in metres that is left. It is
        not zero, because the refinement has bent the map.

    Raises:
        InputError: fewer than three photos are in both.
    """
    places = [{i.name: i.projection_center() for i in model.images.values() if i.has_pose} for model in (sfm, metric)]
    names = sorted(places[0].keys() & places[1].keys())
    if len(names) < 3:
        raise InputError(f"{len(names)} photos are in both the unscaled and the metric model, expected three or more")
    source, target = (np.array([centers[name] for name in names]) for centers in places)
    similarity = align_points(source, target)
    return similarity, rmse(similarity.apply(source) - target)


def apply_to(paths: list[Path], metric_from_sfm: Similarity, folder: Path) -> tuple[Path, ...]:
    """Write each file or model folder, transformed into the metric world, into ``folder`` under its own name.

    Raises:
        InputError: a file has none of the known formats, or would be overwritten.
    """
    chosen = [(path, _transformer_of(path)) for path in paths]
    for path in paths:
        require_apart(paths, folder / path.name)
    if len({path.name for path in paths}) < len(paths):
        raise InputError("two of the files to transform have the same name, expected different names")
    make_output_folder(folder)
    return tuple(transform(path, metric_from_sfm, folder / path.name) for path, transform in chosen)


Transform = Callable[[Path, Similarity, Path], Path]


def _transformer_of(path: Path) -> Transform:
    if path.is_dir():
        return lambda path, similarity, target: write_model(rescale(read_model(path), similarity), target)
    if not path.is_file():
        raise InputError("there is no such file", path)
    known: dict[str, Transform] = {".ply": transform_ply, ".obj": _transform_obj, ".json": _transform_json}
    if path.suffix.lower() not in known:
        raise InputError(f"cannot be transformed, expected {', '.join(known)} or the folder of a COLMAP model", path)
    return known[path.suffix.lower()]


def _transform_obj(path: Path, metric_from_sfm: Similarity, target: Path) -> Path:
    """Transform vertices and normals of an OBJ file; faces, colours and all else are copied unchanged."""
    lines = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words[:1] in (["v"], ["vn"]):
            try:
                at = np.array([float(word) for word in words[1:4]]).reshape(3)
                with overflow_raised():
                    moved = metric_from_sfm.apply(at) if words[0] == "v" else metric_from_sfm.rotation @ at
                if not np.isfinite(moved).all():
                    raise ValueError("infinite")
            except (ValueError, FloatingPointError):
                raise InputError(f"'{line[:60]}' is not a vertex, expected three numbers", path, number) from None
            line = " ".join([words[0], *(f"{value:.10g}" for value in moved), *words[4:]])
        lines.append(line)
    write_text("\n".join(lines) + "\n", target)
    return target


def _transform_json(path: Path, metric_from_sfm: Similarity, target: Path) -> Path:
    content = read_json(path)
    try:
        with overflow_raised():
            if isinstance(content, dict) and "frames" in content:
                _move_nerfstudio(content, metric_from_sfm)
            elif isinstance(content, list) and content and "position" in content[0]:
                _move_splatting(content, metric_from_sfm)
            else:
                expected = "expected nerfstudio's transforms.json or a splatting cameras.json"
                raise InputError(f"has no cameras, {expected}", path)
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"a camera is not as expected ({error!r})", path) from error
    write_json(content, target)
    return target


def _move_nerfstudio(content: Json, metric_from_sfm: Similarity) -> None:
    """Transform the poses of a ``transforms.json`` in place.

    They are in a world that ``applied_transform`` has turned away from that of COLMAP. This turn is undone first, so
    that the result needs no ``applied_transform``.
    """
    applied = np.eye(4)
    if "applied_transform" in content:
        applied[:3] = np.array(content["applied_transform"], dtype=np.float64).reshape(-1, 4)[:3]
    sfm_from_world = np.linalg.inv(applied)
    stretch = float(np.cbrt(abs(np.linalg.det(sfm_from_world[:3, :3]))))
    for frame in content["frames"]:
        pose = sfm_from_world @ np.array(frame["transform_matrix"], dtype=np.float64).reshape(4, 4)
        pose[:3, :3] = metric_from_sfm.rotation @ pose[:3, :3] / stretch
        pose[:3, 3] = metric_from_sfm.apply(pose[:3, 3])
        frame["transform_matrix"] = pose.tolist()
    if "applied_transform" in content:
        content["applied_transform"] = np.eye(4)[:3].tolist()
    # nerfstudio wrote this scale for the old poses; it would be wrong for the new ones.
    content.pop("applied_scale", None)


def _move_splatting(content: Json, metric_from_sfm: Similarity) -> None:
    for camera in content:
        position: Array = np.array(camera["position"], dtype=np.float64).reshape(3)
        rotation: Array = np.array(camera["rotation"], dtype=np.float64).reshape(3, 3)
        camera["position"] = metric_from_sfm.apply(position).tolist()
        camera["rotation"] = (metric_from_sfm.rotation @ rotation).tolist()
