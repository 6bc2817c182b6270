"""The result folder: what a run leaves there, what the next one takes away first, and how it is read back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.model_files import read_model
from rangesfm.errors import BAD_INPUT, InputError
from rangesfm.export import COVARIANCE_FORMATS, EXPORTED_NAMES, MetricMap, export_map, write_model
from rangesfm.files.atomic import path_of, scratch_folder, sole_writer
from rangesfm.geometry.georeference import Georeference
from rangesfm.geometry.reference import Reference, read_reference
from rangesfm.options import ExportOptions
from rangesfm.result.metric_result import MetricResult
from rangesfm.result.places import path_in, photos_beside
from rangesfm.result.summary import ResultSummary
from rangesfm.result.tables import TABLES, PhotoTimes, TableFile
from rangesfm.survey.settings import Survey
from rangesfm.vision.steps import RECONSTRUCTION_NAMES

_Table = TypeVar("_Table", bound=TableFile)

REPORT_NAME = "report.html"
PHOTOS_NAMES = ("photos", "photos_2")
"""Folders of photos taken out of a video or a bag; an earlier result's stay in one while a new one's are made."""
REFERENCE_NAME = "reference.csv"
MODEL_NAMES = ("sparse_scaled", "sparse_metric")
RESULT_FILES = (ResultSummary.NAME, REPORT_NAME, REFERENCE_NAME, *(table.NAME for table in TABLES))
RESULT_NAMES = (*RESULT_FILES, *MODEL_NAMES)
"""What a result consists of; the first says that it is whole."""


def result_names(survey: Survey) -> set[str]:
    """Names in the output folder that a result of this survey takes, with the formats that are asked for."""
    return set(RESULT_NAMES).union(*(EXPORTED_NAMES[name] for name in survey.export.formats))


def refuse_to_overwrite(survey: Survey) -> None:
    """Raise InputError for an input that stands where a result will be written, or that results would stand among."""
    folder = survey.output.path.resolve()
    maps = survey.images.model is None
    places = {folder / name for name in result_names(survey)}
    places.update(folder / name for name in (*RECONSTRUCTION_NAMES, *PHOTOS_NAMES) if maps)
    for item in survey.input_paths():
        path = item.path.resolve()
        if not places.isdisjoint((path, *path.parents)):
            raise InputError("the results would overwrite this input, expected another output path", item.path)
        if path.is_dir() and path == folder:
            raise InputError("the results would stand among this input, expected another output path", item.path)


def places_for_photos(folder: Path) -> tuple[Path, Path]:
    """Return two folders for photos of a video, first the one that is free: the result that is there has the other."""
    first, second = (folder / name for name in PHOTOS_NAMES)
    try:
        used = ResultSummary.read(folder / ResultSummary.NAME).settings.images.path
    except (InputError, OSError):  # there is none
        return first, second
    return (second, first) if used is not None and path_of(used).name == first.name else (first, second)


@contextmanager
def new_result(folder: Path, images_path: Path | None = None) -> Iterator[Path]:
    """Yield a folder to write a whole result into; on success it takes the place of the earlier result, all at once.

    Whoever is killed inside it, or finds no room, leaves the earlier result as it was.

    Args:
        images_path: folder of the photos. If it is one of those that are taken out of a video, the other one, of an
            earlier result, goes with that.

    Raises:
        InputError: a file in the place of one of a result's is not this tool's own.
    """
    with sole_writer(folder) as output:
        places = [output.path / name for name in RESULT_NAMES]
        output.require_own(places)
        with scratch_folder(output.path / "result") as staged:
            yield staged
            new = {output.path / path.name: path for path in staged.iterdir()}
            removed = [place for place in places if place not in new]
            photos = [output.path / name for name in PHOTOS_NAMES]
            if images_path is not None and images_path.resolve() in photos:
                removed += [path for path in photos if path != images_path.resolve() and output.is_own(path)]
            output.publish(new, removed, last=output.path / ResultSummary.NAME)


def write_models_and_tables(
    found: MetricResult,
    export: ExportOptions,
    folder: Path,
    *,
    database_path: Path,
    images_path: Path | None = None,
    georeference: Georeference | None = None,
) -> InputError | None:
    """Write a result's models, its tables and the formats that were asked for into a new folder.

    Args:
        database_path: where the database of the photos' features will be.

    Returns:
        What is to be said of formats that cannot be written, which spoil nothing else.
    """
    write_model(found.scaled, folder / "sparse_scaled" / "0")
    if found.refined is not None:
        write_model(found.final, folder / "sparse_metric" / "0")
    for kind in TABLES:
        table = kind.of(found)
        if table is not None:
            table.write(folder)
    times = PhotoTimes.of(found)
    map_ = MetricMap(
        found.final,
        timestamps_s=None if times is None else times.by_name,
        anchors_m={a.anchor_id: a.position_m for a in found.anchors if np.isfinite(a.position_m).all()},
        metric_from_sfm=found.estimate.metric_from_sfm,
        relative_scale_stddev=found.estimate.uncertainty.empirical,
        images_path=images_path,
        database_path=database_path,
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
        """Folder of the run's photos; None if it had none, or had them outside of the folder around the result."""
        recorded = self.summary.settings.images.path
        return None if recorded is None else photos_beside(self.path, recorded)

    @property
    def anchors_path(self) -> Path | None:
        """File of the run's anchors; None if it had none."""
        recorded = self.summary.settings.anchors.path
        return None if recorded is None else path_in(self.path, recorded)

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
