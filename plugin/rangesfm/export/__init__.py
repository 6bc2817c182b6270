"""Export of the metric map to the formats of other programs. ``EXPORTERS`` lists all formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import InputError, RangesfmError, failure_of
from rangesfm.export.apply import apply_to, best_similarity, sfm_from_files
from rangesfm.export.colmap import (
    write_camera_positions,
    write_model,
    write_pose_priors,
    write_project,
    write_transform,
    write_undistorted,
)
from rangesfm.export.gis import write_features, write_laz
from rangesfm.export.metric_map import MetricMap, in_frame, near_origin
from rangesfm.export.offset import OFFSET_NAME, write_offset
from rangesfm.export.photogrammetry import NERFSTUDIO_IMAGES, write_nerfstudio, write_opensfm, write_opf
from rangesfm.export.ply import write_anchor_vertices, write_cameras, write_points
from rangesfm.export.trajectories import COVARIANCE_FORMATS, write_covariances, write_kitti, write_trajectory
from rangesfm.options import ExportOptions
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.output_folder import make_output_folder
from rangesfm.util.geometry.similarity import Similarity

__all__ = [
    "COVARIANCE_FORMATS",
    "EXPORTED_NAMES",
    "EXPORTERS",
    "NERFSTUDIO_IMAGES",
    "OFFSET_NAME",
    "TRAINERS_FORMATS",
    "MetricMap",
    "apply_to",
    "best_similarity",
    "check_formats",
    "export_map",
    "export_model",
    "sfm_from_files",
    "write_camera_positions",
    "write_model",
    "write_points",
]

# Writes a map to the path with the first of the names of its format, and returns the paths of what it wrote.
Exporter = Callable[[MetricMap, Path], Path | tuple[Path, ...]]

_TUM, _KITTI, _COVARIANCE = "trajectory.tum", "trajectory.kitti", "trajectory_covariance.csv"
EXPORTERS: dict[str, tuple[tuple[str, ...], Exporter]] = {
    "colmap": (("colmap",), write_project),
    "colmap_text": (("colmap_text",), partial(write_project, as_text=True)),
    "undistorted": (("undistorted",), write_undistorted),
    "tum": ((_TUM,), lambda map_, path: write_trajectory(map_.trajectory, path)),
    "kitti": ((_KITTI,), lambda map_, path: write_kitti(map_.trajectory, path)),
    "tum_covariance": (
        (_COVARIANCE, _TUM),
        lambda map_, path: (write_covariances(map_, path), write_trajectory(map_.trajectory, path.with_name(_TUM))),
    ),
    "kitti_covariance": (
        (_COVARIANCE, _KITTI),
        lambda map_, path: (write_covariances(map_, path), write_kitti(map_.trajectory, path.with_name(_KITTI))),
    ),
    "ply": (("points.ply",), lambda map_, path: write_points(map_.reconstruction, path)),
    "ply_cameras": (("cameras.ply",), lambda map_, path: write_cameras(map_.trajectory, path)),
    "ply_anchors": (("anchors.ply",), lambda map_, path: write_anchor_vertices(map_.anchors_m, path)),
    "laz": (("points.laz",), write_laz),
    "gpkg": (("survey.gpkg",), partial(write_features, driver="GPKG")),
    "geojson": (("survey.geojson",), partial(write_features, driver="GeoJSON")),
    "kml": (("survey.kml",), partial(write_features, driver="KML")),
    "transform": (
        ("transform_colmap_4.txt", "transform_colmap_3.8.txt"),
        lambda map_, path: write_transform(map_, path.parent),
    ),
    "model_aligner": (("positions.txt",), lambda map_, path: write_camera_positions(map_.reconstruction, path)),
    "pose_priors": (("pose_priors.db",), write_pose_priors),
    "nerfstudio": (
        ("transforms.json", "transforms_points.ply", NERFSTUDIO_IMAGES),
        lambda map_, path: write_nerfstudio(map_, path.parent),
    ),
    "opensfm": (("reconstruction.json",), write_opensfm),
    "opf": (("opf",), write_opf),
}
"""By name of the format: the names of the files and folders that it writes into a folder, and who writes them."""

EXPORTED_NAMES = {name: names for name, (names, _) in EXPORTERS.items()}

TRAINERS_FORMATS = ("nerfstudio", "undistorted")
"""Formats for programs that compute with 32 bits, as trainers do. Their origin is near the cameras."""


def export_model(
    reconstruction: pycolmap.Reconstruction,
    formats: Iterable[str],
    output_path: AnyPath,
    *,
    timestamps_s: Mapping[str, float] = MappingProxyType({}),
    anchors_m: Mapping[str, Array] = MappingProxyType({}),
    metric_from_sfm: Similarity | None = None,
) -> tuple[Path, ...]:
    """Write a metric model in several formats.

    Args:
        reconstruction: model in metres.
        formats: names of formats, as in ``EXPORTERS``.
        output_path: folder to write into; it is made if needed.
        timestamps_s: time of each photo on the camera's clock, by name, for trajectories.
        anchors_m: position (3,) of each anchor by id, in the world of the model.
        metric_from_sfm: similarity from the world of the unscaled model to that of this model.

    Returns:
        Paths of the files or folders written, in the order of the formats.

    Raises:
        InputError: a format is unknown or needs something that is not given, or the folder cannot be written to.
    """
    map_ = MetricMap(reconstruction, timestamps_s, anchors_m, metric_from_sfm)
    return export_map(map_, Path(output_path), ExportOptions(formats=tuple(formats)))


def export_map(map_: MetricMap, output_path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write a map in the formats and the frame of the options. Otherwise as ``export_model``.

    Where the origin is moved near the cameras, ``OFFSET_NAME`` beside the files has the offset. A format that cannot be
    written does not stop those after it; the error at the end names all that failed.
    """
    chosen = list(dict.fromkeys(options.formats))
    check_formats(chosen)
    map_ = in_frame(map_, options)
    for_trainers = near_origin(map_)
    make_output_folder(output_path)
    written: dict[str, list[Path]] = {}
    failures: dict[str, Exception] = {}
    for name in chosen:
        names, write = EXPORTERS[name]
        try:
            paths = write(for_trainers if name in TRAINERS_FORMATS else map_, output_path / names[0])
            written[name] = [paths] if isinstance(paths, Path) else [*paths]
        except (RangesfmError, OSError) as error:
            failures[name] = error
    moved = [name for name in written if name in TRAINERS_FORMATS or options.frame == "level"]
    if moved:
        files = dict.fromkeys(file for name in moved for file in EXPORTED_NAMES[name] if file != NERFSTUDIO_IMAGES)
        write_offset(for_trainers.offset_m, files, output_path)
    if len(failures) == 1 == len(chosen):
        raise failures[chosen[0]]
    if failures:  # one error for all: a line for each, and a line with the formats that were written
        told = {name: failure_of(error) for name, error in failures.items()}
        lines = [f"{name}: {failure.message}" for name, failure in told.items()]
        all_failed = InputError(
            f"{len(failures)} of {len(chosen)} formats could not be written: {lines[0]}",
            advice=[*lines[1:], *(["these were written: " + ", ".join(written)] if written else [])],
        )
        all_failed.exit_status = max(failure.exit_status for failure in told.values())
        raise all_failed
    return tuple(dict.fromkeys(path for paths in written.values() for path in paths))


def check_formats(formats: Iterable[str]) -> None:
    """Check that all formats are known.

    Raises:
        InputError: one is not; the text lists all formats.
    """
    for name in formats:
        if name not in EXPORTERS:
            raise InputError(f"unknown export format {name!r}, expected one of: {', '.join(EXPORTERS)}")
