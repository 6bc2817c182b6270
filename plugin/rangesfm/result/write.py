"""Models and tables of a result, and the formats that were asked for beside them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from rangesfm.errors import BAD_INPUT, InputError
from rangesfm.export import COVARIANCE_FORMATS, MetricMap, export_map, write_model
from rangesfm.geometry.georeference import Georeference
from rangesfm.options import ExportOptions
from rangesfm.result.folder import DATABASE_NAME, TABLES
from rangesfm.result.metric_result import MetricResult
from rangesfm.result.tables import PhotoTimes


def write_models_and_tables(
    found: MetricResult,
    export: ExportOptions,
    folder: Path,
    *,
    images_path: Path | None = None,
    georeference: Georeference | None = None,
) -> InputError | None:
    """Write them, each whole or not at all; what an earlier run left of those that are not written goes.

    Returns:
        What is to be said of formats that cannot be written, which spoil nothing else.
    """
    write_model(found.scaled, folder / "sparse_scaled" / "0")
    if found.refined is None:
        shutil.rmtree(folder / "sparse_metric", ignore_errors=True)
    else:
        write_model(found.final, folder / "sparse_metric" / "0")
    for kind in TABLES:
        table = kind.of(found)
        if table is None:
            (folder / kind.NAME).unlink(missing_ok=True)
        else:
            table.write(folder)
    times = PhotoTimes.of(found)
    map_ = MetricMap(
        found.final,
        timestamps_s=None if times is None else times.by_name,
        anchors_m={a.anchor_id: a.position_m for a in found.anchors if np.isfinite(a.position_m).all()},
        metric_from_sfm=found.estimate.metric_from_sfm,
        relative_scale_stddev=found.estimate.uncertainty.empirical,
        images_path=images_path,
        database_path=folder / DATABASE_NAME,
        is_site=found.estimate.frame == "site",
        georeference=georeference,
        center_covariance_m2=found.center_covariance_m2,
    )
    impossible = [] if found.final.num_points3D() else ["ply"]
    impossible += [] if found.center_covariance_m2 else COVARIANCE_FORMATS
    formats = tuple(name for name in export.formats if name not in impossible)
    try:
        export_map(map_, folder, export.changed(formats=formats))
    except InputError as error:
        if error.exit_status != BAD_INPUT:  # a full disk, of which the rest has no more
            raise
        return error
    return None
