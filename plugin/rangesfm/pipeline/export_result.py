"""Export of a result to the formats of other programs, and transformation of files made from its unscaled model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export import MetricMap, apply_to, best_similarity, check_formats, export_map, sfm_from_files
from rangesfm.export.metric_map import in_frame, near_origin
from rangesfm.export.offset import write_offset
from rangesfm.options import ExportOptions
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.result_tables import CenterCovariances
from rangesfm.sfm.steps import DATABASE_NAME
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.similarity import IDENTITY


def export_result(
    output_path: AnyPath,
    formats: Iterable[str],
    destination: AnyPath,
    *,
    options: ExportOptions = ExportOptions(),
    images_path: AnyPath | None = None,
) -> tuple[Path, ...]:
    """Export the final metric model of a result folder: the refined one, else the scaled one.

    Args:
        output_path: result folder of a run.
        formats: names of export formats.
        destination: folder to write to.
        options: all options but the formats.
        images_path: folder of the photos; None: that of the run, if it is beside the result.

    Returns:
        Paths of the files or folders written.

    Raises:
        InputError: as in ``export_model``; or the folder is not a result with a metric model; or a run is writing to
            the destination.
    """
    options = options.changed(formats=tuple(formats))
    check_formats(options.formats)
    result, folder = read_result_folder(Path(output_path)), Path(destination)
    with sole_writer(folder):
        map_ = _read_map(result)
        if images_path is not None:
            map_ = replace(map_, images_path=Path(images_path))
        return export_map(map_, folder, options)


def apply_result(
    output_path: Path, paths: Iterable[Path], destination: Path, *, options: ExportOptions
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Transform files that were made from the unscaled model of a run into the frame of its metric model.

    Args:
        output_path: result folder of the run.
        paths: meshes and point clouds (PLY, OBJ), camera files (JSON), folders of COLMAP models.
        destination: folder to write to.
        options: of the frame.

    Returns:
        Paths of the files written, and notes for the user.

    Raises:
        InputError: a file cannot be transformed, is in metres already, or lies on none of the maps; or the result lacks
            its models.
    """
    paths = list(paths)
    result = read_result_folder(output_path)
    map_ = _read_map(result)
    notes = list[str]()
    sfm = result.read_model("sparse")
    if result.read_model("sparse_metric") is not None and sfm is not None:
        similarity, residual_m = best_similarity(sfm, map_.reconstruction)
        map_ = replace(map_, metric_from_sfm=similarity)
        # It is not zero, because the refinement has bent the map, which a similarity cannot do.
        if float(fitted := f"{residual_m:.3f}"):  # smaller bends than a millimetre are rounding
            notes.append(f"they fit the refined cameras to {fitted} m (rms), as the refinement changed the map's shape")
    wanted = in_frame(map_, options)
    if map_.metric_from_sfm is None or wanted.metric_from_sfm is None:
        raise InputError("the result has no similarity from the unscaled model to the metric one", output_path)
    metric = [each.reconstruction for each in (map_, wanted, near_origin(map_), *_in_other_frames(map_, options))]
    placed = sfm_from_files(paths, sfm or rescale(map_.reconstruction, map_.metric_from_sfm.inverse()), metric)
    notes += [
        f"{path}: the program that made it had moved the scene and rescaled it by {1 / found.scale:.6g}; its cameras "
        "show how, and it is undone"
        for path, found in placed.items()
        if found is not IDENTITY
    ]
    with sole_writer(destination):
        written = apply_to({path: wanted.metric_from_sfm @ found for path, found in placed.items()}, destination)
        if options.frame == "level":
            write_offset(wanted.offset_m, (path.name for path in written), destination)
        return written, tuple(notes)


def _in_other_frames(map_: MetricMap, options: ExportOptions) -> Iterator[MetricMap]:
    """Yield the map in those frames in which it may have been exported, as far as they are determined."""
    for frame in ("level", "enu"):
        with suppress(InputError):
            yield in_frame(map_, options.changed(frame=frame))


def _read_map(result: ResultFolder) -> MetricMap:
    reconstruction = result.read_metric_model()
    if reconstruction is None:
        raise InputError("there is no metric model (sparse_metric/0 or sparse_scaled/0) to export", result.output_path)
    result.path_in(reconstruction)  # raises an error where no photo has a time: the trajectory would be empty
    return map_of_result(result, reconstruction, result.read(CenterCovariances).by_photo_m2)


def map_of_result(
    result: ResultFolder, reconstruction: pycolmap.Reconstruction, center_covariance_m2: Mapping[str, Array]
) -> MetricMap:
    """Return the map of a result, given its final model and the covariances of its keyframes (as of ``MetricMap``)."""
    summary = result.summary
    return MetricMap(
        reconstruction,
        timestamps_s=result.timestamps_s,
        anchors_m=result.anchor_positions_m,
        metric_from_sfm=summary.metric_from_sfm.similarity,
        relative_scale_stddev=summary.scale.relative_stddev_empirical,
        images_path=result.images_path,
        database_path=result.output_path / DATABASE_NAME,
        is_site=summary.frame == "site",
        upward=None if summary.up is None else summary.up[0],
        georeference=None if summary.georeference is None else summary.georeference.georeference,
        center_covariance_m2=center_covariance_m2,
    )
