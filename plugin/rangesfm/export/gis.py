"""Export for GIS programs: points as LAZ; cameras and anchors as GeoPackage, GeoJSON and KML, through GDAL."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from rangesfm.export.metric_map import MetricMap, colored_points
from rangesfm.installed_versions import missing_extra
from rangesfm.util.files.atomic import new_file
from rangesfm.util.geometry.georeference import GEOGRAPHIC, is_geographic

_STEP_M = 1e-4
_STEP_DEG = 1e-9
_POINT_FORMAT_WITH_COLOR = 7
_WKB_POINT_Z = 1001
# The ninth decimal of a degree is a tenth of a millimetre.
_OPTIONS = {"GeoJSON": {"COORDINATE_PRECISION": "9"}}


def write_laz(map_: MetricMap, path: Path) -> Path:
    """Write the 3-D points with their colours, rounded to a tenth of a millimetre.

    Raises:
        InputError: laspy, or the package with which it compresses, is not installed.
    """
    try:
        import laspy
    except ImportError:
        raise missing_extra("the format 'laz' needs laspy", "geo") from None
    if not laspy.LazBackend.detect_available():
        raise missing_extra("the format 'laz' needs lazrs besides laspy", "geo")
    places, colors = colored_points(map_.reconstruction)
    xyz, steps = places, [_STEP_M] * 3
    if map_.georeference is not None:
        xyz = map_.georeference.projected(places)
        steps = [_STEP_DEG] * 2 + [_STEP_M] if is_geographic(map_.georeference.crs) else steps
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT_WITH_COLOR)
    header.scales = np.array(steps)
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    if map_.georeference is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(map_.georeference.crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.red, las.green, las.blue = colors.T * np.uint16(257)  # colours of LAS go up to 65535 = 257 * 255
    with new_file(path) as temporary:
        las.write(str(temporary))
    return path


def write_features(map_: MetricMap, path: Path, driver: str) -> Path:
    """Write one point for each photo and each anchor, with ``kind``, ``name`` and the photo's ``timestamp_s``.

    A GeoPackage has the coordinate reference system of the map; the other formats always have longitude and latitude.

    Raises:
        InputError: the map is not georeferenced, or pyogrio is not installed.
    """
    georeference = map_.georeference_for(f"the format {path.suffix[1:]!r} needs a georeferenced map")
    try:
        import pyogrio.raw
    except ImportError:
        raise missing_extra(f"the format {path.suffix[1:]!r} needs pyogrio", "geo") from None
    anchors = map_.anchors_m
    trajectory = map_.trajectory
    places = np.concatenate([trajectory.centers, np.array(list(anchors.values())).reshape(-1, 3)])
    is_projected = driver == "GPKG"
    coordinates = georeference.projected(places) if is_projected else georeference.geographic(places)
    times = np.full(len(trajectory), np.nan) if trajectory.timestamps_s is None else trajectory.timestamps_s
    names = np.array([*trajectory.image_names, *anchors], dtype=object)
    kinds = np.array(["camera"] * len(trajectory) + ["anchor"] * len(anchors), dtype=object)
    points = [struct.pack("<BI3d", 1, _WKB_POINT_Z, *row) for row in coordinates.tolist()]
    with new_file(path) as temporary:
        pyogrio.raw.write(
            temporary,
            geometry=np.array(points, dtype=object),
            field_data=[kinds, names, np.concatenate([times, np.full(len(anchors), np.nan)])],
            fields=np.array(["kind", "name", "timestamp_s"]),
            layer="survey",
            driver=driver,
            geometry_type="Point Z",
            crs=georeference.crs if is_projected else GEOGRAPHIC,
            **_OPTIONS.get(driver, {}),
        )
    return path
