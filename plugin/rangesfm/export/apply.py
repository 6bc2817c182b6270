"""Transformation of files that other programs made from the unscaled model, into the metric world.

These are meshes and point clouds (PLY, OBJ), camera files (``transforms.json`` of nerfstudio, ``cameras.json`` of
Gaussian splatting) and COLMAP models. Where the content of a file lies shows whether it is in the unscaled model's
world, in metres already, or in a world of its own, as trainers that move and rescale the scene have it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export.colmap import write_model
from rangesfm.export.metric_map import colored_points, registered_images
from rangesfm.export.ply import read_ply, says_metres, transform_ply
from rangesfm.util.files.atomic import require_apart, write_text
from rangesfm.util.files.output_folder import make_output_folder
from rangesfm.util.files.photo_names import rows_of_photos
from rangesfm.util.files.records import read_json, write_json
from rangesfm.util.files.text_tables import read_text
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points, overflow_raised, rmse

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


def apply_to(metric_from_files: Mapping[Path, Similarity], folder: Path) -> tuple[Path, ...]:
    """Write each file or model folder, transformed into the metric world, into ``folder`` under its own name.

    Raises:
        InputError: a file has none of the known formats, or would be overwritten.
    """
    paths = list(metric_from_files)
    kinds = [_kind_of(path) for path in paths]
    for path in paths:
        require_apart(paths, folder / path.name)
    if len({path.name for path in paths}) < len(paths):
        raise InputError("two of the files to transform have the same name, expected different names")
    make_output_folder(folder)
    return tuple(kind.transform(path, metric_from_files[path], folder / path.name) for path, kind in zip(paths, kinds))


def sfm_from_files(
    paths: Sequence[Path], sfm: pycolmap.Reconstruction, metric: Sequence[pycolmap.Reconstruction]
) -> dict[Path, Similarity]:
    """Return for each file the similarity from its world to that of the unscaled model; most lie in that world.

    Cameras of photos of the model are compared with theirs. If all of them are one similarity away, as a trainer has
    moved and rescaled the scene, it is returned. Other content is compared by where it lies, cameras with the cameras
    of the maps and vertices with their points.

    Args:
        sfm: the unscaled model. metric: the metric one, in all frames in which a file may be.

    Raises:
        InputError: a file is in metres already, lies on no map, or cannot be read.
    """
    return {path: _sfm_from_file(path, sfm, metric) for path in paths}


# Cameras are the same if they are nearer to each other than this share of the size of the map (root mean square).
_SAME = 0.01
_MIN_NUM_CAMERAS = 3
_UNSCALED = "expected a file made from the unscaled model"
_MAX_NUM_COMPARED, _MAX_NUM_MOVED = 50_000, 3000
# Size of the motions that are tried to see whether a file lies on a map: radians, or shares of the map's size.
_SMALL = 0.1
# Distance from a place of the map, in spacings of these places, from which on a vertex is beside it.
_REACH = 2.0


def _sfm_from_file(path: Path, sfm: pycolmap.Reconstruction, metric: Sequence[pycolmap.Reconstruction]) -> Similarity:
    kind = _kind_of(path)
    if kind.says_metres(path):
        raise InputError(f"says that it is in metres already, {_UNSCALED}", path)
    if (cameras := kind.cameras(path)).names:
        of_sfm = _cameras_of(sfm)
        if len(pairs := cameras.pairs_with(of_sfm)) >= _MIN_NUM_CAMERAS:
            return _by_cameras(path, cameras, of_sfm, pairs, [_cameras_of(each) for each in metric])
        places, what = cameras.centers, "cameras"
        of_unscaled, of_metric = of_sfm.centers, [_cameras_of(each).centers for each in metric]
    else:
        places, what = kind.vertices(path), "vertices"
        of_unscaled, of_metric = colored_points(sfm)[0], [colored_points(each)[0] for each in metric]
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places) or not len(of_unscaled):
        return IDENTITY
    from_unscaled = _apart(places, of_unscaled)
    from_metric, on = min(((_apart(places, each), k) for k, each in enumerate(of_metric)), default=(np.inf, 0))
    is_metric = from_metric < from_unscaled
    if not _lies_on(places, of_metric[on] if is_metric else of_unscaled):
        raise _on_neither(what, from_unscaled, from_metric, path)
    if is_metric:
        raise _in_metres(what, from_metric, from_unscaled, path)
    return IDENTITY


def _by_cameras(
    path: Path, cameras: _Cameras, of_sfm: _Cameras, pairs: Indices, of_metric: Sequence[_Cameras]
) -> Similarity:
    """Return the similarity from the world of a file to the unscaled model, by the cameras of the same photos.

    Args:
        pairs: (k, 2) indices of the same photo in ``cameras`` and ``of_sfm``.
    """
    given, known = cameras.subset(pairs[:, 0]), of_sfm.subset(pairs[:, 1])
    from_unscaled = rmse(given.centers - known.centers) / known.size
    from_metric = np.inf
    for each in of_metric:
        common = given.pairs_with(each)
        if len(common) >= _MIN_NUM_CAMERAS:
            off = given.centers[common[:, 0]] - each.centers[common[:, 1]]
            from_metric = min(from_metric, rmse(off) / each.size)
    if min(from_unscaled, from_metric) <= _SAME:
        if from_metric < from_unscaled:
            raise _in_metres("cameras", from_metric, from_unscaled, path)
        return IDENTITY
    scale = known.size / max(given.size, np.finfo(np.float64).tiny)
    scaled = _Cameras(given.names, scale * given.centers, given.world_from_cam)
    known_from_scaled = align_points(scaled.marks(known.size), known.marks(known.size))
    left = rmse(known_from_scaled.apply(scaled.marks(known.size)) - known.marks(known.size)) / known.size
    if not left <= _SAME:
        raise _on_neither("cameras", from_unscaled, from_metric, path)
    return known_from_scaled @ Similarity(scale, np.eye(3), np.zeros(3))


def _percent(share: float) -> str:
    return f"{100 * share:{'.2g' if share < 0.1 else '.0f'}} %"


def _in_metres(what: str, from_metric: float, from_unscaled: float, path: Path) -> InputError:
    where = f"on the metric map ({_percent(from_metric)} of its size away), not on the unscaled one"
    return InputError(f"is in metres already: its {what} lie {where} ({_percent(from_unscaled)}), {_UNSCALED}", path)


def _on_neither(what: str, from_unscaled: float, from_metric: float, path: Path) -> InputError:
    where = f"{_percent(from_unscaled)} of the map's size away from the one and {_percent(from_metric)} from the other"
    return InputError(
        f"lies on neither the unscaled model nor the metric map: its {what} are {where}; another program has moved, "
        f"turned or rescaled the scene, or it is another scene; {_UNSCALED}, in the coordinates of that",
        path,
    )


def _apart(places: Array, of_map: Array) -> float:
    """Return how far apart two sets of places are, over the size of the map.

    This is the sum of the median distances from each place to the nearest one of the other set, both ways.
    """
    places, of_map = _some(places, _MAX_NUM_COMPARED), _some(of_map, _MAX_NUM_COMPARED)
    both_ways = (KDTree(to).query(of)[0] for to, of in ((places, of_map), (of_map, places)))
    return sum(float(np.median(distances)) for distances in both_ways) / _size(of_map)


def _lies_on(places: Array, of_map: Array) -> bool:
    """Return whether places lie on a map, or on a part of it.

    They do if those of the map are as near to them as to each other. Otherwise, as with a part of the map, they do if
    no small motion or change of size brings more of them near to those of the map.
    """
    places, of_map = _some(places, _MAX_NUM_COMPARED), _some(of_map, _MAX_NUM_COMPARED)
    tree, middle, size = KDTree(of_map), np.median(of_map, axis=0), _size(of_map)
    neighbours = tree.query(of_map, k=2)[0][:, 1] if len(of_map) > 1 else np.zeros(1)
    spacing = max(float(np.median(neighbours)), 1e-3 * size)
    if np.median(KDTree(places).query(of_map)[0]) <= spacing:
        return True
    from_middle, reach = _some(places, _MAX_NUM_MOVED) - middle, _REACH * spacing

    def near(similarity: Similarity) -> float:
        distances = tree.query(middle + similarity.apply(from_middle), distance_upper_bound=reach)[0]
        return float(np.mean(np.maximum(1 - distances / reach, 0.0)))

    small = [Similarity((1 + _SMALL) ** sign, np.eye(3), np.zeros(3)) for sign in (-1, 1)]
    for axis in _SMALL * np.vstack([np.eye(3), -np.eye(3)]):
        small.append(Similarity(1.0, Rotation.from_rotvec(axis).as_matrix(), np.zeros(3)))
        small.append(Similarity(1.0, np.eye(3), size * axis))
    as_it_is = near(IDENTITY)
    return as_it_is > 0 and as_it_is >= max(map(near, small))


def _some(places: Array, num: int) -> Array:
    return places[:: 1 + len(places) // num]


def _size(places: Array) -> float:
    """Return the median distance of places (n, 3) from their middle."""
    size = np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))
    return max(float(size), np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class _Cameras:
    """n cameras: names of their photos (empty where there is none), centres (n, 3) and rotations (n, 3, 3)."""

    names: Sequence[str]
    centers: Array
    world_from_cam: Array

    @property
    def size(self) -> float:
        """Root mean square distance of the cameras from their mean."""
        return max(rmse(self.centers - self.centers.mean(axis=0)), np.finfo(np.float64).tiny)

    def subset(self, rows: Indices) -> _Cameras:
        return _Cameras([self.names[k] for k in rows.tolist()], self.centers[rows], self.world_from_cam[rows])

    def marks(self, distance: float) -> Array:
        """Return the centres, and points at a distance from each along its axes: together they show where it looks."""
        ends = self.centers[:, None] + distance * np.swapaxes(self.world_from_cam, 1, 2)
        return np.concatenate([self.centers, ends.reshape(-1, 3)])

    def pairs_with(self, other: _Cameras) -> Indices:
        """Return (k, 2) indices of cameras of the same photo."""
        named = [row for row, name in enumerate(self.names) if name]
        found = rows_of_photos([self.names[row] for row in named], other.names)
        return np.column_stack([named, found])[found >= 0].astype(np.int64)


def _cameras_of(model: pycolmap.Reconstruction) -> _Cameras:
    images = registered_images(model)
    world_from_cam = [image.cam_from_world().inverse() for image in images]
    return _Cameras(
        [image.name for image in images],
        np.array([pose.translation for pose in world_from_cam]).reshape(-1, 3),
        np.array([pose.rotation.matrix() for pose in world_from_cam]).reshape(-1, 3, 3),
    )


@dataclass(frozen=True)
class _Kind:
    """A kind of file: how to transform it, and its cameras or, if it has none, its vertices (n, 3)."""

    transform: Callable[[Path, Similarity, Path], Path]
    vertices: Callable[[Path], Array] = lambda path: np.zeros((0, 3))
    cameras: Callable[[Path], _Cameras] = lambda path: _Cameras((), np.zeros((0, 3)), np.zeros((0, 3, 3)))
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


def _lines_of_obj(path: Path, new_from_old: Similarity) -> Iterator[tuple[str, Array]]:
    """Yield each line of an OBJ file, with the transformed vertex or normal (3,), or (0,) if it is neither."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words[:1] not in (["v"], ["vn"]):
            yield line, np.zeros(0)
            continue
        try:
            at: Array = np.array([float(word) for word in words[1:4]]).reshape(3)
            with overflow_raised():
                at = new_from_old.apply(at) if words[0] == "v" else new_from_old.rotation @ at
            if not np.isfinite(at).all():
                raise ValueError
        except (ValueError, FloatingPointError):
            raise InputError(f"'{line[:60]}' is not a vertex, expected three numbers", path, number) from None
        yield line, at


def _transform_obj(path: Path, metric_from_sfm: Similarity, target: Path) -> Path:
    """Transform vertices and normals of an OBJ file; faces, colours and all else are copied unchanged."""
    lines = [_IN_METRES]
    for line, moved in _lines_of_obj(path, metric_from_sfm):
        if len(moved):
            name, _, _, _, *others = line.split()
            line = " ".join([name, *(f"{value:.10g}" for value in moved), *others])
        lines.append(line)
    write_text("\n".join(lines) + "\n", target)
    return target


def _vertices_of_obj(path: Path) -> Array:
    rows = [at for line, at in _lines_of_obj(path, IDENTITY) if line.split()[:1] == ["v"]]
    return np.array(rows).reshape(-1, 3)


def _transform_json(path: Path, metric_from_sfm: Similarity, target: Path) -> Path:
    write_json(_moved_json(path, metric_from_sfm), target)
    return target


def _cameras_of_json(path: Path) -> _Cameras:
    content = _moved_json(path, IDENTITY)
    if isinstance(content, dict):
        frames = content["frames"]
        poses = np.array([frame["transform_matrix"] for frame in frames]).reshape(-1, 4, 4)
        # Cameras of nerfstudio look along their -z axis, with y up.
        rotations, names = poses[:, :3, :3] * [1.0, -1.0, -1.0], [str(frame.get("file_path", "")) for frame in frames]
        return _Cameras(names, poses[:, :3, 3], rotations)
    names = [str(camera.get("img_name", "")) for camera in content]
    centers, rotations = (np.array([camera[name] for camera in content]) for name in ("position", "rotation"))
    return _Cameras(names, centers, rotations)


def _moved_json(path: Path, metric_from_sfm: Similarity) -> Json:
    """Return the content of a file of cameras, transformed."""
    content = read_json(path)
    try:
        with overflow_raised():
            if isinstance(content, dict) and "frames" in content:
                _move_nerfstudio(content, metric_from_sfm)
            elif isinstance(content, list) and content and "position" in content[0]:
                for camera in content:
                    position: Array = np.array(camera["position"], dtype=np.float64).reshape(3)
                    rotation: Array = np.array(camera["rotation"], dtype=np.float64).reshape(3, 3)
                    camera["position"] = metric_from_sfm.apply(position).tolist()
                    camera["rotation"] = (metric_from_sfm.rotation @ rotation).tolist()
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


_KINDS = {
    ".ply": _Kind(transform_ply, vertices=read_ply, says_metres=says_metres),
    ".obj": _Kind(_transform_obj, vertices=_vertices_of_obj, says_metres=lambda path: _IN_METRES in read_text(path)),
    ".json": _Kind(_transform_json, cameras=_cameras_of_json),
}
_KIND_OF_FOLDER = _Kind(
    lambda path, similarity, target: write_model(rescale(read_model(path), similarity), target),
    cameras=lambda path: _cameras_of(read_model(path)),
)
