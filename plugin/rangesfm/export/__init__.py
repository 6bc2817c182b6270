"""The metric map in other programs' formats: one file per format, one registry."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.errors import InputError
from rangesfm.export.apply import apply_to, best_similarity
from rangesfm.export.colmap import write_model
from rangesfm.export.features import write_features
from rangesfm.export.frames import in_frame
from rangesfm.export.kitti import write_kitti
from rangesfm.export.las import write_laz
from rangesfm.export.metric_map import MetricMap
from rangesfm.export.model_aligner import write_positions
from rangesfm.export.nerfstudio import write_nerfstudio
from rangesfm.export.opensfm import write_opensfm
from rangesfm.export.opf import write_opf
from rangesfm.export.ply import write_anchors, write_cameras, write_points
from rangesfm.export.pose_covariance import COVARIANCE_FORMATS, write_kitti_covariance, write_tum_covariance
from rangesfm.export.transform import write_transform
from rangesfm.export.tum import write_trajectory
from rangesfm.export.undistorted import write_undistorted
from rangesfm.files import make_output_folder
from rangesfm.options import ExportOptions
from rangesfm.result_folder import ResultFolder, read_result_folder
from rangesfm.sole_writer import sole_writer

if TYPE_CHECKING:
    import pycolmap

    from rangesfm.export.metric_map import Array
    from rangesfm.geometry import Similarity

__all__ = [
    "COVARIANCE_FORMATS",
    "EXPORTERS",
    "MetricMap",
    "apply_result",
    "apply_to",
    "best_similarity",
    "export_map",
    "export_model",
    "export_result",
    "write_anchors",
    "write_cameras",
    "write_features",
    "write_kitti",
    "write_laz",
    "write_model",
    "write_nerfstudio",
    "write_opensfm",
    "write_opf",
    "write_points",
    "write_positions",
    "write_trajectory",
    "write_transform",
    "write_undistorted",
]

Exporter = Callable[[MetricMap, Path], Path]

EXPORTERS: dict[str, Exporter] = {
    "colmap": lambda map_, folder: write_model(map_.reconstruction, folder / "colmap"),
    "colmap_text": lambda map_, folder: write_model(map_.reconstruction, folder / "colmap_text", as_text=True),
    "undistorted": lambda map_, folder: write_undistorted(map_, folder / "undistorted"),
    "tum": lambda map_, folder: write_trajectory(map_.trajectory, folder / "trajectory.tum"),
    "kitti": lambda map_, folder: write_kitti(map_.trajectory, folder / "trajectory.kitti"),
    "tum_covariance": lambda map_, folder: write_tum_covariance(map_, folder / "trajectory_covariance.tum"),
    "kitti_covariance": lambda map_, folder: write_kitti_covariance(map_, folder / "trajectory_covariance.kitti"),
    "ply": lambda map_, folder: write_points(map_.reconstruction, folder / "points.ply"),
    "ply_cameras": lambda map_, folder: write_cameras(map_.trajectory, folder / "cameras.ply"),
    "ply_anchors": lambda map_, folder: write_anchors(map_.anchors_m or {}, folder / "anchors.ply"),
    "laz": lambda map_, folder: write_laz(map_, folder / "points.laz"),
    "gpkg": lambda map_, folder: write_features(map_, folder / "survey.gpkg", "GPKG"),
    "geojson": lambda map_, folder: write_features(map_, folder / "survey.geojson", "GeoJSON"),
    "kml": lambda map_, folder: write_features(map_, folder / "survey.kml", "KML"),
    "transform": lambda map_, folder: write_transform(map_.metric_from_sfm, folder / "transform.txt"),
    "model_aligner": lambda map_, folder: write_positions(map_.reconstruction, folder / "positions.txt"),
    "nerfstudio": lambda map_, folder: write_nerfstudio(map_, folder),
    "opensfm": lambda map_, folder: write_opensfm(map_, folder / "reconstruction.json"),
    "opf": lambda map_, folder: write_opf(map_, folder / "opf"),
}
"""Each writes one format of a map into a folder and returns the path written."""


def export_model(
    reconstruction: pycolmap.Reconstruction,
    formats: Iterable[str],
    output_path: Path,
    *,
    timestamps_s: Mapping[str, float] | None = None,
    anchors_m: Mapping[str, Array] | None = None,
    metric_from_sfm: Similarity | None = None,
) -> tuple[Path, ...]:
    """Write a metric model in each of the formats (names as in EXPORTERS) under ``output_path``.

    Args:
        timestamps_s: camera-clock time of each photo by name, for trajectories.
        anchors_m: (3,) position by anchor id, in the model's world.
        metric_from_sfm: from the unscaled model's world to this one's.

    Returns:
        The files or folders written, in the order of the formats.

    Raises:
        InputError: a format is not known or needs what is not given, or the folder cannot be written to.
    """
    map_ = MetricMap(reconstruction, timestamps_s, anchors_m, metric_from_sfm)
    return export_map(map_, output_path, ExportOptions(formats=tuple(formats)))


def export_map(map_: MetricMap, output_path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """The same of a map with all that is known of it, in the frame that the options ask for."""
    chosen = list(dict.fromkeys(options.formats))
    check_formats(chosen)
    map_ = in_frame(map_, options)
    make_output_folder(output_path)
    return tuple(EXPORTERS[name](map_, output_path) for name in chosen)


def check_formats(formats: Iterable[str]) -> None:
    """Raise InputError for the first format that is not known."""
    for name in formats:
        if name not in EXPORTERS:
            raise InputError(f"unknown export format {name!r}, expected one of: {', '.join(EXPORTERS)}")


def export_result(
    output_path: Path,
    formats: Iterable[str],
    destination: Path,
    *,
    options: ExportOptions | None = None,
    images_path: Path | None = None,
) -> tuple[Path, ...]:
    """Export the best metric model of a run's output folder: the refined one, else the scaled one.

    Args:
        options: all but the formats.
        images_path: folder of the photos; None: where the run found them.

    Raises:
        InputError: as ``export_model``, the folder is not a result with a metric model, or a run is writing to the
            destination.
    """
    options = replace(options or ExportOptions(), formats=tuple(formats))
    check_formats(options.formats)
    result = read_result_folder(output_path)
    with sole_writer(destination):
        return export_map(_read_map(result, images_path), destination, options)


def apply_result(
    output_path: Path, paths: Iterable[Path], destination: Path, *, options: ExportOptions | None = None
) -> tuple[tuple[Path, ...], float]:
    """Carry what was made from a run's unscaled model into the frame of its metric one.

    Args:
        paths: meshes and clouds (PLY, OBJ), camera files (JSON), folders of COLMAP models.
        options: of the frame.

    Returns:
        The files written, and by how much the refined cameras are off what any similarity gives (root mean square,
        metres): a refinement bends the map, and a mesh cannot follow.

    Raises:
        InputError: a file cannot be carried over, or the result lacks its models.
    """
    result = read_result_folder(output_path)
    map_ = _read_map(result, None)
    residual_m = 0.0
    sfm = result.read_model("sparse")
    if result.read_model("sparse_metric") is not None and sfm is not None:
        similarity, residual_m = best_similarity(sfm, map_.reconstruction)
        map_ = replace(map_, metric_from_sfm=similarity)
    similarity_in_frame = in_frame(map_, options or ExportOptions()).metric_from_sfm
    if similarity_in_frame is None:
        raise InputError("the result does not say how its metric model follows from the unscaled one", output_path)
    with sole_writer(destination):
        return apply_to(list(paths), similarity_in_frame, destination), residual_m


def _read_map(result: ResultFolder, images_path: Path | None) -> MetricMap:
    reconstruction = result.read_model("sparse_metric") or result.read_model("sparse_scaled")
    if reconstruction is None:
        raise InputError("there is no metric model (sparse_metric/0 or sparse_scaled/0) to export", result.path)
    return MetricMap(
        reconstruction,
        timestamps_s=result.timestamps_s,
        anchors_m=result.anchor_positions_m,
        metric_from_sfm=result.metric_from_sfm,
        relative_scale_stddev=result.relative_scale_stddev,
        images_path=images_path or result.images_path,
        is_site=result.frame == "site",
        georeference=result.georeference,
        center_covariance_m2=result.read_center_covariance_m2(),
    )
