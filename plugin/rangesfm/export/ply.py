"""Points, cameras and anchors as binary little-endian PLY vertices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array
from rangesfm.files.atomic import new_file
from rangesfm.geometry.trajectory import Trajectory

CAMERA_COLOR = (37, 99, 235)
ANCHOR_COLOR = (162, 28, 175)
PLY_TYPES = {"f8": "double", "f4": "float", "u1": "uchar"}


def write_points(reconstruction: pycolmap.Reconstruction, path: Path) -> Path:
    """Write the 3-D points with their colours, in order of their ids."""
    points = [reconstruction.point3D(point_id) for point_id in sorted(reconstruction.point3D_ids())]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    return _write_vertices(path, xyz, colors)


def write_cameras(trajectory: Trajectory, path: Path) -> Path:
    """Write one vertex at each camera centre; its normal is the viewing direction."""
    colors = np.tile(np.array(CAMERA_COLOR, dtype=np.uint8), (len(trajectory), 1))
    return _write_vertices(path, trajectory.centers, colors, normals=trajectory.world_from_cam[:, :, 2])


def write_anchors(anchors_m: Mapping[str, Array], path: Path) -> Path:
    """Write one vertex for each anchor, in the mapping's order; a comment names them."""
    xyz = np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3)
    colors = np.tile(np.array(ANCHOR_COLOR, dtype=np.uint8), (len(xyz), 1))
    names = " ".join(anchor_id.encode("ascii", "backslashreplace").decode() for anchor_id in anchors_m)
    return _write_vertices(path, xyz, colors, comment=f"anchors {' '.join(names.split())}")


def _write_vertices(
    path: Path, xyz: Array, colors: npt.NDArray[np.uint8], normals: Array | None = None, comment: str | None = None
) -> Path:
    """Positions as doubles, so that coordinates far from the origin keep their millimetres."""
    columns: list[tuple[str, str, npt.NDArray[Any]]] = [(name, "f8", xyz[:, i]) for i, name in enumerate("xyz")]
    if normals is not None:
        columns += [(name, "f4", normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    columns += [(name, "u1", colors[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    vertices = np.empty(len(xyz), dtype=[(name, "<" + code) for name, code, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    header = ["ply", "format binary_little_endian 1.0", "comment metres"]
    header += [f"comment {comment}"] if comment else []
    header += [f"element vertex {len(xyz)}"]
    header += [f"property {PLY_TYPES[code]} {name}" for name, code, _ in columns]
    with new_file(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + vertices.tobytes())
    return path
