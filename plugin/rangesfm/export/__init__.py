"""Export of the metric map to the formats of other programs. ``EXPORTERS`` lists all formats."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

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
from rangesfm.files.atomic import make_output_folder
from rangesfm.files.contents import AnyPath
from rangesfm.geometry.similarity import Similarity
from rangesfm.options import ExportOptions

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

Exporter = Callable[[MetricMap, Path], Path | tuple[Path, ...]]

EXPORTERS: dict[str, Exporter] = {
    "colmap": lambda map_, folder: write_project(map_, folder / "colmap"),
    "colmap_text": lambda map_, folder: write_project(map_, folder / "colmap_text", as_text=True),
    "undistorted": lambda map_, folder: write_undistorted(map_, folder / "undistorted"),
    "tum": lambda map_, folder: write_trajectory(map_.trajectory, folder / "trajectory.tum"),
    "kitti": lambda map_, folder: write_kitti(map_.trajectory, folder / "trajectory.kitti"),
    "tum_covariance": lambda map_, folder: (
        write_covariances(map_, folder / "trajectory_covariance.csv"),
        write_trajectory(map_.trajectory, folder / "trajectory.tum"),
    ),
    "kitti_covariance": lambda map_, folder: (
        write_covariances(map_, folder / "trajectory_covariance.csv"),
        write_kitti(map_.trajectory, folder / "trajectory.kitti"),
    ),
    "ply": lambda map_, folder: write_points(map_.reconstruction, folder / "points.ply"),
    "ply_cameras": lambda map_, folder: write_cameras(map_.trajectory, folder / "cameras.ply"),
    "ply_anchors": lambda map_, folder: write_anchor_vertices(map_.anchors_m, folder / "anchors.ply"),
    "laz": lambda map_, folder: write_laz(map_, folder / "points.laz"),
    "gpkg": lambda map_, folder: write_features(map_, folder / "survey.gpkg", "GPKG"),
    "geojson": lambda map_, folder: write_features(map_, folder / "survey.geojson", "GeoJSON"),
    "kml": lambda map_, folder: write_features(map_, folder / "survey.kml", "KML"),
    "transform": lambda map_, folder: write_transform(map_.metric_from_sfm, folder),
    "model_aligner": lambda map_, folder: write_camera_positions(map_.reconstruction, folder / "positions.txt"),
    "pose_priors": lambda map_, folder: write_pose_priors(map_, folder / "pose_priors.db"),
    "nerfstudio": lambda map_, folder: write_nerfstudio(map_, folder),
    "opensfm": lambda map_, folder: write_opensfm(map_, folder / "reconstruction.json"),
    "opf": lambda map_, folder: write_opf(map_, folder / "opf"),
}
"""Functions by name of the format. Each writes a map into a folder and returns the paths of what it wrote."""

EXPORTED_NAMES: dict[str, tuple[str, ...]] = {
    "colmap": ("colmap",),
    "colmap_text": ("colmap_text",),
    "undistorted": ("undistorted",),
    "tum": ("trajectory.tum",),
    "kitti": ("trajectory.kitti",),
    "tum_covariance": ("trajectory_covariance.csv", "trajectory.tum"),
    "kitti_covariance": ("trajectory_covariance.csv", "trajectory.kitti"),
    "ply": ("points.ply",),
    "ply_cameras": ("cameras.ply",),
    "ply_anchors": ("anchors.ply",),
    "laz": ("points.laz",),
    "gpkg": ("survey.gpkg",),
    "geojson": ("survey.geojson",),
    "kml": ("survey.kml",),
    "transform": ("transform_colmap_4.txt", "transform_colmap_3.8.txt"),
    "model_aligner": ("positions.txt",),
    "pose_priors": ("pose_priors.db",),
    "nerfstudio": ("transforms.json", "transforms_points.ply", NERFSTUDIO_IMAGES),
    "opensfm": ("reconstruction.json",),
    "opf": ("opf",),
}
"""Names of the files and folders that each format writes into the folder."""

TRAINERS_FORMATS = ("nerfstudio", "undistorted")
"""Formats for programs that compute with 32 bits, as trainers do. Their origin is near the cameras."""


def export_model(
    reconstruction: pycolmap.Reconstruction,
    formats: Iterable[str],
    output_path: AnyPath,
    *,
    timestamps_s: Mapping[str, float] | None = None,
    anchors_m: Mapping[str, Array] | None = None,
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
    map_ = MetricMap(reconstruction, timestamps_s, anchors_m or {}, metric_from_sfm)
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
        try:
            paths = EXPORTERS[name](for_trainers if name in TRAINERS_FORMATS else map_, output_path)
            written[name] = [paths] if isinstance(paths, Path) else [*paths]
        except (RangesfmError, OSError) as error:
            failures[name] = error
    moved = [name for name in written if name in TRAINERS_FORMATS or options.frame == "level"]
    if moved:
        names = dict.fromkeys(file for name in moved for file in EXPORTED_NAMES[name] if file != NERFSTUDIO_IMAGES)
        write_offset(for_trainers.offset_m, names, output_path)
    if failures:
        raise _not_all(failures, written, num_chosen=len(chosen))
    return tuple(dict.fromkeys(path for paths in written.values() for path in paths))


def _not_all(failures: Mapping[str, Exception], written: Collection[str], num_chosen: int) -> Exception:
    """Return one error for all formats that failed: a line for each, and a line with the formats that were written."""
    if num_chosen == 1:
        return next(iter(failures.values()))
    told = [failure_of(error) for error in failures.values()]
    lines = [f"{name}: {failure.message}" for name, failure in zip(failures, told)]
    error = InputError(
        f"{len(failures)} of {num_chosen} formats could not be written: {lines[0]}",
        advice=[*lines[1:], *(["these were written: " + ", ".join(written)] if written else [])],
    )
    error.exit_status = max(failure.exit_status for failure in told)
    return error


def check_formats(formats: Iterable[str]) -> None:
    """Check that all formats are known.

    Raises:
        InputError: one is not; the text lists all formats.
    """
    for name in formats:
        if name not in EXPORTERS:
            raise InputError(f"unknown export format {name!r}, expected one of: {', '.join(EXPORTERS)}")
