"""What a run left, in other programs' formats, and what was made from its unscaled model carried into metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.export import MetricMap, apply_to, best_similarity, check_formats, export_map
from rangesfm.export.metric_map import in_frame
from rangesfm.files.atomic import sole_writer
from rangesfm.options import ExportOptions
from rangesfm.result.folder import ResultFolder, read_result_folder
from rangesfm.result.model_path import path_of_model
from rangesfm.result.tables import CenterCovariances
from rangesfm.vision.steps import DATABASE_NAME


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
        images_path: folder of the photos; None: those of the run, if they are beside the result.

    Raises:
        InputError: as ``export_model``, the folder is not a result with a metric model, or a run is writing to the
            destination.
    """
    options = (options or ExportOptions()).changed(formats=tuple(formats))
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
    reconstruction, summary = result.read_metric_model(), result.summary
    if reconstruction is None:
        raise InputError("there is no metric model (sparse_metric/0 or sparse_scaled/0) to export", result.path)
    path_of_model(reconstruction, result)  # or nobody would be told of trajectories without poses
    covariances = result.read(CenterCovariances)
    return MetricMap(
        reconstruction,
        timestamps_s=result.timestamps_s,
        anchors_m=result.anchor_positions_m,
        metric_from_sfm=summary.metric_from_sfm.similarity,
        relative_scale_stddev=summary.scale.relative_stddev_empirical,
        images_path=images_path or result.images_path,
        database_path=result.path / DATABASE_NAME,
        is_site=summary.frame == "site",
        georeference=None if summary.georeference is None else summary.georeference.georeference,
        center_covariance_m2=None if covariances is None else covariances.by_photo_m2,
    )
