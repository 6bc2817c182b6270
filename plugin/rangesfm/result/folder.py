"""The result folder: what a run leaves there, what the next one takes away first, and how it is read back."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.model_files import read_model
from rangesfm.errors import BAD_INPUT, InputError
from rangesfm.export import COVARIANCE_FORMATS, MetricMap, export_map, write_model
from rangesfm.files.atomic import path_of
from rangesfm.geometry.georeference import Georeference
from rangesfm.geometry.reference import Reference, read_reference
from rangesfm.options import ExportOptions
from rangesfm.result.metric_result import MetricResult
from rangesfm.result.summary import ResultSummary
from rangesfm.result.tables import TABLES, PhotoTimes, TableFile
from rangesfm.survey.settings import InputPath

_Table = TypeVar("_Table", bound=TableFile)

REPORT_NAME = "report.html"
DATABASE_NAME = "database.db"
REFERENCE_NAME = "reference.csv"
# The first says that a result is whole: it is the last to be written and the first to go.
RESULT_FILES = (ResultSummary.NAME, REPORT_NAME, REFERENCE_NAME, *(table.NAME for table in TABLES))
# Stands in the place of result.json while the files beside it belong to no result.
_UNFINISHED = ".result.unfinished"
_WRITTEN = (*RESULT_FILES, "trajectory.tum", "points.ply", "sparse_scaled/0", "sparse_metric/0")


def refuse_to_overwrite(inputs: Iterable[InputPath], folder: Path) -> None:
    """Raise InputError for an input that stands where a result will be written, or that results would stand among."""
    written = {(folder / name).resolve() for name in _WRITTEN}
    for item in inputs:
        path = item.path.resolve()
        if not written.isdisjoint((path, *path.parents)):
            raise InputError("the results would overwrite this input, expected another output path", item.path)
        if path.is_dir() and path == folder.resolve():
            raise InputError("the results would stand among this input, expected another output path", item.path)


def forget_result(folder: Path) -> None:
    """Take away what an earlier run wrote about models that are about to change.

    Killed at any moment, it leaves a whole result or none; the next call goes on where it stopped.
    """
    result, unfinished = (folder / name for name in (ResultSummary.NAME, _UNFINISHED))
    if result.is_file():
        os.replace(result, unfinished)
    if unfinished.is_file():
        for name in RESULT_FILES:
            (folder / name).unlink(missing_ok=True)
        unfinished.unlink()


@contextmanager
def replacing_result(folder: Path) -> Iterator[None]:
    """Forget the result before the block, which writes a new one; none of its files stay if it fails.

    Whoever is killed inside it leaves a mark, by which the next run knows the files for what they are.
    """
    forget_result(folder)
    unfinished = folder / _UNFINISHED
    unfinished.touch()
    try:
        yield
        # Now there is a result. Should this be the last that happens, the next run takes it for one that is whole.
        unfinished.unlink()
    finally:
        if unfinished.is_file():
            forget_result(folder)


def write_models_and_tables(
    found: MetricResult,
    export: ExportOptions,
    folder: Path,
    *,
    images_path: Path | None = None,
    georeference: Georeference | None = None,
) -> InputError | None:
    """Write a result's models, its tables and the formats that were asked for beside them, each whole or not at all.

    What an earlier run left of those that are not written goes.

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


@dataclass(frozen=True)
class ResultFolder:
    """A run's output folder, read back for comparison, export, report and joining.

    Attributes:
        path: of the folder.
        summary: ``result.json``.
        timestamps_s: time of each photo by name; None where the photos have no times.
    """

    path: Path
    summary: ResultSummary
    timestamps_s: dict[str, float] | None

    @property
    def anchor_positions_m(self) -> dict[str, Array]:
        """(3,) position by anchor id, in the metric models' world; anchors without one are left out."""
        return {
            anchor_id: np.array(anchor.position_m)
            for anchor_id, anchor in self.summary.anchors.items()
            if anchor.position_m is not None
        }

    @property
    def images_path(self) -> Path | None:
        """Folder of the photos, as the run was told; None if it had none."""
        path = self.summary.settings.images.path
        return None if path is None else path_of(path)

    def lever_arms_m(self, tag_ids: Sequence[str]) -> Array:
        """(n, 3) antenna in the camera's frame of each tag of a list; of one the settings do not name, the common."""
        settings = self.summary.settings.tag
        arms = [settings.lever_arms_m.get(tag_id, settings.tag_in_cam_m) for tag_id in tag_ids]
        return np.array(arms, dtype=np.float64).reshape(-1, 3)

    def read(self, table: type[_Table]) -> _Table | None:
        """One of TABLES; None if it is not there."""
        return table.read(self.path)

    def read_reference(self) -> Reference | None:
        """The reference at the photos, in the metric models' world; None if it is not there."""
        path = self.path / REFERENCE_NAME
        return read_reference(path) if path.is_file() else None

    def read_model(self, stage: str) -> pycolmap.Reconstruction | None:
        """The model ``stage``/0 ("sparse", "sparse_scaled" or "sparse_metric"); None if it is not there."""
        path = self.path / stage / "0"
        return read_model(path) if path.is_dir() else None

    def read_metric_model(self) -> pycolmap.Reconstruction | None:
        """The best one: refined, else scaled; None if neither is there."""
        return self.read_model("sparse_metric") or self.read_model("sparse_scaled")


def read_result_folder(path: Path) -> ResultFolder:
    """Read what is small; models and other tables are read when asked for.

    Raises:
        InputError: the folder is missing, has no ``result.json``, or that is not what a run writes.
    """
    result_path = path / ResultSummary.NAME
    if not result_path.is_file():
        raise InputError("not a result folder: it has no result.json (expected the output_path of a run)", path)
    summary, times = ResultSummary.read(result_path), PhotoTimes.read(path)
    return ResultFolder(path, summary, None if times is None else times.by_name)
