"""The result folder: what a run writes into it, what the next run removes, and how it is read back."""

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
from rangesfm.errors import InputError
from rangesfm.result.joint_covariance import JOINT_COVARIANCE_NAME, read_map_errors
from rangesfm.result.places import input_beside, path_in
from rangesfm.result.result_tables import RESULT_TABLES, PhotoTimes, TableFile
from rangesfm.result.summary import ResultSummary
from rangesfm.util.files.atomic import path_of, scratch_folder
from rangesfm.util.files.folders import real_path
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.reference import NO_REFERENCE, Reference, read_reference
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

_Table = TypeVar("_Table", bound=TableFile)

REPORT_NAME = "report.html"
PHOTOS_NAMES = ("photos", "photos_2")
"""Folders of photos taken from a video or a bag. There are two, because the photos of an earlier result stay in one of
them while those of a new result are made."""
REFERENCE_NAME = "reference.csv"
MODEL_NAMES = ("sparse_scaled", "sparse_metric")
RESULT_FILES = (
    *(ResultSummary.NAME, REPORT_NAME, REFERENCE_NAME, JOINT_COVARIANCE_NAME),
    *(table.NAME for table in RESULT_TABLES),
)
RESULT_NAMES = (*RESULT_FILES, *MODEL_NAMES)
"""Names of all files and folders of a result. The first one is written last: where it is there, the result is whole."""


def places_for_photos(folder: Path) -> tuple[Path, Path]:
    """Return two folders for photos of a video, the free one first; an existing result may use the other one."""
    first, second = (folder / name for name in PHOTOS_NAMES)
    try:
        used = ResultSummary.read(folder / ResultSummary.NAME).settings.images.path
    except (InputError, OSError):  # there is no earlier result
        return first, second
    return (second, first) if used is not None and path_of(used).name == first.name else (first, second)


@contextmanager
def new_result(folder: Path, images_path: Path | None = None) -> Iterator[Path]:
    """Yield a temporary folder for a whole result; on success its content replaces the earlier result at once.

    If the process is killed inside the block, or the disk is full, the earlier result stays as it was.

    Args:
        folder: the result folder.
        images_path: folder of the photos. If it is one of ``PHOTOS_NAMES``, the other one belongs to the earlier result
            and is removed with it.

    Raises:
        InputError: a file that the result would replace was not written by this tool.
    """
    with sole_writer(folder) as output:
        places = [output.path / name for name in RESULT_NAMES]
        output.require_own(places)
        with scratch_folder(output.path / "result") as staged:
            yield staged
            new = {output.path / path.name: path for path in staged.iterdir()}
            removed = [place for place in places if place not in new]
            photos = [output.path / name for name in PHOTOS_NAMES]
            if images_path is not None and real_path(images_path) in photos:
                removed += [path for path in photos if path != real_path(images_path) and output.is_own(path)]
            output.publish(new, removed, last=output.path / ResultSummary.NAME)


@dataclass(frozen=True)
class ResultFolder:
    """The output folder of a run, with what it found. Models and tables are read on demand.

    Attributes:
        output_path: the folder.
        summary: content of ``result.json``.
        timestamps_s: time of each photo by name; empty where the photos have no times.
    """

    output_path: Path
    summary: ResultSummary
    timestamps_s: dict[str, float]

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the result as lines of text for the user."""
        report = self.output_path / REPORT_NAME
        return (*self.summary.lines(self.output_path), *([f"report: {report}"] if report.is_file() else []))

    def __repr__(self) -> str:
        """Return these lines."""
        return "\n".join(self.lines)

    @property
    def anchor_positions_m(self) -> dict[str, Array]:
        """Return the positions (3,) of anchors by id, in the world of the metric models; unknown ones are left out."""
        return {
            anchor_id: np.array(anchor.position_m)
            for anchor_id, anchor in self.summary.anchors.items()
            if anchor.position_m is not None
        }

    @property
    def images_path(self) -> Path | None:
        """Return the folder of the run's photos; None without one, or if it is not in the folder around the result."""
        recorded = self.summary.settings.images.path
        return None if recorded is None else input_beside(self.output_path, recorded)

    @property
    def anchors_path(self) -> Path | None:
        """Return the file of the run's anchors; None if it had none."""
        recorded = self.summary.settings.anchors.path
        return None if recorded is None else path_in(self.output_path, recorded)

    def lever_arms_m(self, tag_ids: Sequence[str]) -> Array:
        """Return the lever arm of each tag, (n, 3) metres in the camera frame: its own, else the common one."""
        settings = self.summary.settings.tag
        arms = [settings.lever_arms_m.get(tag_id, settings.tag_in_cam_m) for tag_id in tag_ids]
        return np.array(arms, dtype=np.float64).reshape(-1, 3)

    def read(self, table: type[_Table]) -> _Table:
        """Read one of ``RESULT_TABLES``; without its file it has no rows."""
        return table.read(self.output_path)

    def read_map_errors(self) -> MapErrors:
        """Read how the parts of the refined map err together."""
        return read_map_errors(self.output_path)

    def read_reference(self) -> Reference:
        """Read the reference positions of the photos, in the world of the metric models; empty if there are none."""
        path = self.output_path / REFERENCE_NAME
        return read_reference(path) if path.is_file() else NO_REFERENCE

    def read_model(self, stage: str) -> pycolmap.Reconstruction | None:
        """Read the model ``stage``/0 ("sparse", "sparse_scaled" or "sparse_metric"); None if it is not there."""
        path = self.output_path / stage / "0"
        return read_model(path) if path.is_dir() else None

    def path_in(self, model: pycolmap.Reconstruction) -> Trajectory:
        """Return the camera's path in a model of this result, with the times of its photos.

        Raises:
            InputError: the result has photo times, but none for a photo of the model.
        """
        has_table = (self.output_path / PhotoTimes.NAME).is_file()  # which a result without times does not have
        path = trajectory_from_reconstruction(model, self.timestamps_s if has_table else None)
        if not len(path) and model.num_reg_images():
            raise InputError(f"none of the model's photos has a time in {PhotoTimes.NAME}", self.output_path)
        return path

    def read_metric_model(self) -> pycolmap.Reconstruction | None:
        """Read the refined model, else the scaled one; None if neither is there."""
        return self.read_model("sparse_metric") or self.read_model("sparse_scaled")


def is_refined_model(path: Path) -> bool:
    """Return whether a model's folder is that of a result whose map was refined with ranges."""
    stage = path.resolve().parent
    if stage.name != "sparse_metric":
        return False
    try:
        refine = read_result_folder(stage.parent).summary.refine
    except InputError:  # a folder of another program, or a result of another version
        return False
    return refine is not None and refine.kept


def read_result_folder(path: Path) -> ResultFolder:
    """Read the summary and the photo times of a result folder; models and other tables are read on demand.

    Raises:
        InputError: the folder is missing, has no ``result.json``, or that file was not written by a run.
    """
    result_path = path / ResultSummary.NAME
    if not result_path.is_file():
        raise InputError("not a result folder: it has no result.json (expected the output_path of a run)", path)
    summary, times = ResultSummary.read(result_path), PhotoTimes.read(path)
    return ResultFolder(path, summary, dict(zip(times.image_name, times.timestamp_s.tolist(), strict=True)))
