"""Transformation of files that other programs made from the unscaled model, into the metric world.

These are meshes and point clouds (PLY, OBJ), camera files (``transforms.json`` of nerfstudio, ``cameras.json`` of
Gaussian splatting) and COLMAP models. A file that is in metres already is recognized by where its content lies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial import KDTree

from rangesfm.arrays import Array
from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export.colmap import write_model
from rangesfm.export.metric_map import colored_points, registered_images
from rangesfm.export.ply import read_ply, says_metres, transform_ply
from rangesfm.files.atomic import make_output_folder, require_apart, write_text
from rangesfm.files.records import read_json, write_json
from rangesfm.files.text_tables import read_text
from rangesfm.geometry.similarity import IDENTITY, Similarity, align_points, overflow_raised, rmse

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
    chosen = [(path, _kind_of(path)) for path in paths]
    for path in paths:
        require_apart(paths, folder / path.name)
    if len({path.name for path in paths}) < len(paths):
        raise InputError("two of the files to transform have the same name, expected different names")
    make_output_folder(folder)
    return tuple(kind.transform(path, metric_from_sfm, folder / path.name) for path, kind in chosen)


def refuse_metric(
    paths: Sequence[Path], sfm: pycolmap.Reconstruction, metric: Sequence[pycolmap.Reconstruction]
) -> None:
    """Refuse files that lie on a metric map rather than on the unscaled one: they must not be scaled a second time.

    Cameras are compared with the cameras of the maps, vertices with their points. How far apart two sets of places are
    is the median distance from each to the nearest of the other, both ways, over the size of the map.

    Args:
        sfm: the unscaled model. metric: the metric one, in all frames in which a file may be.

    Raises:
        InputError: a file is in metres already, or cannot be read.
    """
    for path in paths:
        kind = _kind_of(path)
        if kind.says_metres(path):
            raise InputError(f"says that it is in metres already, {_UNSCALED}", path)
        places = kind.places(path)
        places = places[np.isfinite(places).all(axis=1)]
        of_map = _centers if kind.has_cameras else _points
        if not len(places) or not len(of_map(sfm)):
            continue
        from_sfm, from_metric = _apart(places, of_map(sfm)), min(_apart(places, of_map(each)) for each in metric)
        if from_metric < from_sfm:
            what = "cameras" if kind.has_cameras else "vertices"
            where = f"on the metric map ({100 * from_metric:.2g} % of its size away), not on the unscaled one"
            raise InputError(
                f"is in metres already: its {what} lie {where} ({100 * from_sfm:.2g} %), {_UNSCALED}", path
            )


_UNSCALED = "expected a file made from the unscaled model"
_MAX_NUM_COMPARED = 50_000


def _apart(places: Array, of_map: Array) -> float:
    """Return how far apart two sets of places are, over the median distance of those of the map from their middle."""
    places, of_map = (each[:: 1 + len(each) // _MAX_NUM_COMPARED] for each in (places, of_map))
    size = float(np.median(np.linalg.norm(of_map - np.median(of_map, axis=0), axis=1)))
    both_ways = (KDTree(to).query(of)[0] for to, of in ((places, of_map), (of_map, places)))
    return sum(float(np.median(distances)) for distances in both_ways) / max(size, np.finfo(np.float64).tiny)


def _centers(model: pycolmap.Reconstruction) -> Array:
    return np.array([image.projection_center() for image in registered_images(model)]).reshape(-1, 3)


def _points(model: pycolmap.Reconstruction) -> Array:
    return colored_points(model)[0]


@dataclass(frozen=True)
class _Kind:
    """A kind of file: how to transform it, where its content lies (n, 3), and whether that is cameras or vertices."""

    transform: Callable[[Path, Similarity, Path], Path]
    places: Callable[[Path], Array]
    has_cameras: bool
    says_metres: Callable[[Path], bool] = lambda path: False


def _kind_of(path: Path) -> _Kind:
    if path.is_dir():
        return _KIND_OF_FOLDER
    if not path.is_file():
        raise InputError("there is no such file", path)
    if path.suffix.lower() not in _KINDS:
        raise InputError(f"cannot be transformed, expected {', '.join(_KINDS)} or the folder of a COLMAP model", path)
    return _KINDS[path.suffix.lower()]


_IN_METRES = "# metres"


def _transform_obj(path: Path, metric_from_sfm: Similarity, target: Path) -> Path:
    """Transform vertices and normals of an OBJ file; faces, colours and all else are copied unchanged."""
    lines = [_IN_METRES]
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words[:1] in (["v"], ["vn"]):
            at = _vector_of_obj(words, path, number, line)
            try:
                with overflow_raised():
                    moved = metric_from_sfm.apply(at) if words[0] == "v" else metric_from_sfm.rotation @ at
            except FloatingPointError:
                raise _no_vertex(path, number, line) from None
            line = " ".join([words[0], *(f"{value:.10g}" for value in moved), *words[4:]])
        lines.append(line)
    write_text("\n".join(lines) + "\n", target)
    return target


def _vector_of_obj(words: Sequence[str], path: Path, number: int, line: str) -> Array:
    try:
        at = np.array([float(word) for word in words[1:4]]).reshape(3)
    except ValueError:
        raise _no_vertex(path, number, line) from None
    if not np.isfinite(at).all():
        raise _no_vertex(path, number, line)
    return at


def _no_vertex(path: Path, number: int, line: str) -> InputError:
    return InputError(f"'{line[:60]}' is not a vertex, expected three numbers", path, number)


def _vertices_of_obj(path: Path) -> Array:
    lines = [(number, line, line.split()) for number, line in enumerate(read_text(path).splitlines(), 1)]
    found = [_vector_of_obj(words, path, number, line) for number, line, words in lines if words[:1] == ["v"]]
    return np.array(found).reshape(-1, 3)


def _transform_json(path: Path, metric_from_sfm: Similarity, target: Path) -> Path:
    write_json(_moved_json(path, metric_from_sfm), target)
    return target


def _centers_of_json(path: Path) -> Array:
    content = _moved_json(path, IDENTITY)
    if isinstance(content, dict):
        return np.array([np.array(frame["transform_matrix"])[:3, 3] for frame in content["frames"]]).reshape(-1, 3)
    return np.array([camera["position"] for camera in content])


def _moved_json(path: Path, metric_from_sfm: Similarity) -> Json:
    """Return the content of a file of cameras, transformed."""
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
    return content


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


_KINDS = {
    ".ply": _Kind(transform_ply, read_ply, has_cameras=False, says_metres=says_metres),
    ".obj": _Kind(
        _transform_obj, _vertices_of_obj, has_cameras=False, says_metres=lambda path: _IN_METRES in read_text(path)
    ),
    ".json": _Kind(_transform_json, _centers_of_json, has_cameras=True),
}
_KIND_OF_FOLDER = _Kind(
    lambda path, similarity, target: write_model(rescale(read_model(path), similarity), target),
    lambda path: _centers(read_model(path)),
    has_cameras=True,
)
