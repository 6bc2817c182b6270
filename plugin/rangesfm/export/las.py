"""The points as LAZ, for survey and GIS programs; with the coordinate system where the map is georeferenced."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap
from rangesfm.files.atomic import new_file
from rangesfm.geometry.georeference import is_geographic

_STEP_M = 1e-4
_STEP_DEG = 1e-9
_POINT_FORMAT_WITH_COLOR = 7


def write_laz(map_: MetricMap, path: Path) -> Path:
    """Write the 3-D points with their colours, in tenths of a millimetre.

    Raises:
        InputError: laspy is not installed.
    """
    try:
        import laspy
    except ImportError:
        raise InputError("the format 'laz' needs laspy: pip install 'rangesfm[geo]'") from None
    model = map_.reconstruction
    points = [model.point3D(point_id) for point_id in sorted(model.point3D_ids())]
    xyz, steps = _coordinates(map_, np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3))
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT_WITH_COLOR)
    header.scales = steps
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    if map_.georeference is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(map_.georeference.crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    # LAS counts colours to 65535.
    colors = np.array([point.color for point in points], dtype=np.uint16).reshape(-1, 3) * np.uint16(257)
    las.red, las.green, las.blue = colors.T
    with new_file(path) as temporary:
        las.write(str(temporary))
    return path


def _coordinates(map_: MetricMap, xyz: Array) -> tuple[Array, Array]:
    """Coordinates to write and the step in which they are counted."""
    if map_.georeference is None:
        return xyz, np.full(3, _STEP_M)
    step = _STEP_DEG if is_geographic(map_.georeference.crs) else _STEP_M
    return map_.georeference.projected(xyz), np.array([step, step, _STEP_M])
