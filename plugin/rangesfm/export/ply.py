"""PLY files: writing points, cameras and anchors, and transforming the vertices of any such file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import colored_points
from rangesfm.util.files.atomic import new_file
from rangesfm.util.files.contents import open_regular
from rangesfm.util.geometry.similarity import Similarity, overflow_raised
from rangesfm.util.geometry.trajectory import Trajectory

CAMERA_COLOR = (37, 99, 235)
ANCHOR_COLOR = (162, 28, 175)
PLY_TYPES = {"f8": "double", "f4": "float", "u1": "uchar"}
Vertices = npt.NDArray[np.void]
_CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_CODES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"}
_CODES |= {"uint32": "u4", "float32": "f4", "float64": "f8"}
_MAX_NUM_DIGITS = 18  # a number of vertices with more digits does not fit into 64 bits
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MAX_HEADER_BYTES = 1 << 16
# In metres. Further from the origin than this, single precision is coarser than a millimetre.
_MAX_SINGLE = 8192.0
_IN_METRES = "comment metres"


def write_points(reconstruction: pycolmap.Reconstruction, path: Path) -> Path:
    """Write the 3-D points with their colours, in order of their ids."""
    return _write_vertices(path, *colored_points(reconstruction))


def write_cameras(trajectory: Trajectory, path: Path) -> Path:
    """Write one vertex at each camera centre; its normal is the viewing direction."""
    normals = dict(zip(("nx", "ny", "nz"), trajectory.world_from_cam[:, :, 2].T.astype("<f4")))
    return _write_vertices(path, trajectory.centers, CAMERA_COLOR, **normals)


def write_anchor_vertices(anchors_m: Mapping[str, Array], path: Path) -> Path:
    """Write one vertex for each anchor, in the order of the mapping; a comment in the file names them in this order."""
    xyz = np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3)
    names = " ".join(anchor_id.encode("ascii", "backslashreplace").decode() for anchor_id in anchors_m)
    return _write_vertices(path, xyz, ANCHOR_COLOR, comment=f"anchors {' '.join(names.split())}")


def _write_vertices(
    path: Path, xyz: Array, colors: npt.ArrayLike, comment: str = "", **others: npt.NDArray[Any]
) -> Path:
    """Write vertices with positions (n, 3), colours (n, 3) or one for all, and other columns (n,) by name.

    Positions are written in double precision, because single precision loses millimetres far from the origin.
    """
    columns: dict[str, npt.NDArray[Any]] = dict(zip("xyz", xyz.T.astype("<f8")))
    columns |= others
    columns |= zip(("red", "green", "blue"), np.broadcast_to(np.asarray(colors, dtype=np.uint8), xyz.shape).T)
    kind = [(name, values.dtype) for name, values in columns.items()]
    vertices = np.rec.fromarrays(columns.values(), dtype=kind)
    header = ["ply", "format binary_little_endian 1.0", _IN_METRES]
    header += [f"comment {comment}"] if comment else []
    header += [f"element vertex {len(xyz)}"]
    header += [f"property {PLY_TYPES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    with new_file(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + vertices.tobytes())
    return path


@dataclass(frozen=True)
class _Header:
    """Header of a PLY file.

    Attributes:
        lines: of the header, "end_header" included.
        encoding: a key of ``_ORDERS``.
        columns: numpy type code of each property of a vertex, by name.
    """

    lines: list[str]
    num_bytes: int
    encoding: str
    num_vertices: int
    columns: dict[str, str]


def transform_ply(path: Path, new_from_old: Similarity, target: Path) -> Path:
    """Write a copy of a PLY file with transformed vertices (x, y, z) and turned normals (nx, ny, nz).

    All else is copied unchanged, but for a comment that the file is in metres.

    Raises:
        InputError: it is not a PLY file that begins with vertices, or it has Gaussian splats, whose colours depend on
            direction and would have to be turned, too.
    """
    header, vertices, rest = _read(path)
    try:
        with overflow_raised():
            written = _moved(vertices, new_from_old)
    except FloatingPointError:
        raise InputError(
            "some coordinates of vertices are infinite or too large, expected finite numbers", path
        ) from None
    format_line = 1 + next(n for n, line in enumerate(header.lines) if line.split()[:1] == ["format"])
    comments = [] if _IN_METRES in header.lines else [_IN_METRES]
    text = "\n".join([*header.lines[:format_line], *comments, *header.lines[format_line:]]) + "\n"
    if written.dtype != vertices.dtype:
        text = re.sub(r"^[ \t]*property[ \t].*[ \t]([xyz])[ \t]*$", r"property double \1", text, flags=re.MULTILINE)
    with new_file(target) as temporary:
        temporary.write_bytes(text.encode("latin-1") + _body(written, header) + rest)
    return target


def read_ply(path: Path) -> Array:
    """Return the vertices (n, 3) of a PLY file; they may be NaN. Raises as ``transform_ply``."""
    vertices = _read(path)[1]
    return np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)


def says_metres(path: Path) -> bool:
    """Return whether a comment of a PLY file says that it is in metres, as in all that this package writes."""
    with open_regular(path) as file:
        return _IN_METRES in _read_header(path, file.read(_MAX_HEADER_BYTES)).lines


def _read(path: Path) -> tuple[_Header, Vertices, bytes]:
    """Return the header, the vertices, and the bytes of all elements after them."""
    with open_regular(path) as file:
        content = file.read()
    header = _read_header(path, content)
    if "rot_0" in header.columns:
        raise InputError("Gaussian splats cannot be transformed: train them again on the metric model", path)
    return header, *_split(path, content, header)


def _moved(vertices: Vertices, new_from_old: Similarity) -> Vertices:
    """Return transformed vertices. Their coordinates become double precision if they are far from the origin."""
    moved = new_from_old.apply(_vectors(vertices, ("x", "y", "z")))
    is_far, order = np.abs(moved).max(initial=0.0) > _MAX_SINGLE, vertices.dtype[0].byteorder
    names = vertices.dtype.names or ()
    double = np.dtype(np.float64).newbyteorder(order)
    written = vertices.astype([(name, double if is_far and name in "xyz" else vertices.dtype[name]) for name in names])
    columns = dict(zip("xyz", moved.T, strict=True))
    if {"nx", "ny", "nz"} <= set(names):
        turned = _vectors(vertices, ("nx", "ny", "nz")) @ new_from_old.rotation.T
        columns |= zip(("nx", "ny", "nz"), turned.T, strict=True)
    for name, column in columns.items():
        written[name] = column
    return written


def _read_header(path: Path, content: bytes) -> _Header:
    end = content.find(b"end_header", 0, _MAX_HEADER_BYTES)
    newline = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or newline < 0:
        raise InputError("not a PLY file, expected 'ply' and a header", path)
    lines = content[: newline + 1].decode("latin-1").splitlines()
    words = [line.split() for line in lines]
    encoding = next((w[1] for w in words if w[:1] == ["format"] and len(w) == 3), "")
    elements = [(number, w) for number, w in enumerate(words) if w[:1] == ["element"]]
    if encoding not in _ORDERS or not elements or elements[0][1][1:2] != ["vertex"] or len(elements[0][1]) != 3:
        raise InputError("expected a PLY file whose first element is vertex", path)
    first, stop = elements[0][0], elements[1][0] if len(elements) > 1 else len(words)
    columns = {}
    for number in range(first + 1, stop):
        if words[number][:1] == ["property"]:
            if len(words[number]) != 3 or words[number][1] not in _CODES:
                raise InputError(f"'{lines[number]}', expected a number for each vertex", path, number + 1)
            columns[words[number][2]] = _CODES[words[number][1]]
    if not {"x", "y", "z"} <= columns.keys():
        raise InputError("the vertices have no x, y and z", path)
    count = elements[0][1][2]
    if not (count.isascii() and count.isdigit() and len(count) <= _MAX_NUM_DIGITS):
        raise InputError(f"'{lines[first]}', expected a number of vertices", path, first + 1)
    return _Header(lines, newline + 1, encoding, int(count), columns)


def _split(path: Path, content: bytes, header: _Header) -> tuple[Vertices, bytes]:
    """Return the vertices, and the bytes of all elements after them."""
    kind = np.dtype([(name, _ORDERS[header.encoding] + code) for name, code in header.columns.items()])
    body = content[header.num_bytes :]
    if header.encoding != "ascii":
        size = kind.itemsize * header.num_vertices
        if len(body) < size:
            raise InputError(f"ends within its {header.num_vertices} vertices", path)
        return np.frombuffer(body[:size], dtype=kind), body[size:]
    lines = body.split(b"\n", header.num_vertices)
    if len(lines) < header.num_vertices:
        raise InputError(f"ends within its {header.num_vertices} vertices", path)
    vertices = np.empty(header.num_vertices, dtype=kind)
    with overflow_raised():
        for row, line in enumerate(lines[: header.num_vertices]):
            try:
                vertices[row] = tuple(float(word) for word in line.split())
            except (ValueError, ArithmeticError):
                message = f"not a vertex of {len(header.columns)} numbers"
                raise InputError(message, path, len(header.lines) + row + 1) from None
    return vertices, lines[header.num_vertices] if len(lines) > header.num_vertices else b""


def _vectors(vertices: Vertices, names: tuple[str, str, str]) -> Array:
    """Return three columns of the vertices as (n, 3).

    Raises:
        FloatingPointError: a number is infinite. NaN is allowed, because programs write it for missing points.
    """
    values: Array = np.column_stack([vertices[name] for name in names]).astype(np.float64).reshape(-1, 3)
    if np.isinf(values).any():
        raise FloatingPointError("infinite")
    return values


def _body(vertices: Vertices, header: _Header) -> bytes:
    if header.encoding != "ascii":
        return vertices.tobytes()
    is_whole = [code[0] in "iu" for code in header.columns.values()]
    lines = [
        " ".join(str(int(v)) if whole else f"{v:.10g}" for v, whole in zip(row, is_whole, strict=True))
        for row in vertices.tolist()
    ]
    return ("\n".join(lines) + "\n").encode("ascii") if lines else b""
