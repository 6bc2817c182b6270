"""What a run left in its output folder, read back for comparison, export and report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.files.atomic import path_of
from rangesfm.files.json_files import read_json
from rangesfm.files.tables import read_table
from rangesfm.geometry.georeference import Georeference
from rangesfm.geometry.similarity import Similarity
from rangesfm.options import AssociationOptions
from rangesfm.ranging.observations import RangeStatus

if TYPE_CHECKING:
    import pycolmap

Array = npt.NDArray[np.float64]

RANGES_COLUMNS = (
    "timestamp_s",
    "image_name",
    "anchor_id",
    "range_m",
    "predicted_scaled_m",
    "predicted_refined_m",
    "status",
)
TAG_COLUMN = "tag_id"
COVARIANCE_COLUMNS = tuple(f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
PLACE_COLUMNS = ("keyframe_before", "keyframe_after", "weight")
USED_STATUSES = (RangeStatus.USED.label, RangeStatus.DOWN_WEIGHTED.label)


@dataclass(frozen=True)
class RangesAsUsed:
    """``ranges.csv`` of a result: n ranges with what became of them.

    Attributes:
        timestamp_s: (n,) on the radio's clock, NaN where the log gives photos instead.
        image_name: n names, empty where the log gives times.
        anchor_id: n ids.
        tag_id: n ids.
        range_m: (n,) measured.
        residual_scaled_m, residual_refined_m: (n,) predicted minus measured with the
            scaled and with the refined model; NaN where not applicable.
        status: n labels of RangeStatus.
        keyframe_before, keyframe_after: n photos between which each range was taken; empty without a place.
        weight: (n,) of the later one, in [0, 1]; NaN without a place.
    """

    timestamp_s: Array
    image_name: tuple[str, ...]
    anchor_id: tuple[str, ...]
    tag_id: tuple[str, ...]
    range_m: Array
    residual_scaled_m: Array
    residual_refined_m: Array
    status: tuple[str, ...]
    keyframe_before: tuple[str, ...]
    keyframe_after: tuple[str, ...]
    weight: Array

    @property
    def is_used(self) -> npt.NDArray[np.bool_]:
        """(n,) ranges with a say in the final model, however small."""
        return np.isin(np.array(self.status, dtype=str), USED_STATUSES)


@dataclass(frozen=True)
class ResultAnchor:
    """(3,) position in the metric models' world, and what its ranges read too long; metres."""

    position_m: Array
    range_bias_m: float


@dataclass(frozen=True)
class ResultFolder:
    """A run's output folder.

    Attributes:
        path: of the folder.
        summary: ``result.json``.
        timestamps_s: time of each photo by name; None where the photos have no times.
    """

    path: Path
    summary: dict[str, Any]
    timestamps_s: dict[str, float] | None

    @property
    def frame(self) -> str:
        """The world of the metric models: "site" or "first_camera"."""
        return str(self.summary.get("frame", "first_camera"))

    @property
    def anchors(self) -> dict[str, ResultAnchor]:
        """By id; those without a position are left out."""
        with self._expecting("anchors"):
            return {
                str(anchor_id): ResultAnchor(
                    np.array(anchor["position_m"], dtype=np.float64).reshape(3), float(anchor.get("range_bias_m") or 0)
                )
                for anchor_id, anchor in (self.summary.get("anchors") or {}).items()
                if anchor.get("position_m") is not None
            }

    @property
    def anchor_positions_m(self) -> dict[str, Array]:
        """(3,) position by anchor id, in the metric models' world; anchors without one are left out."""
        return {anchor_id: anchor.position_m for anchor_id, anchor in self.anchors.items()}

    @property
    def metric_from_sfm(self) -> Similarity | None:
        """World of ``sparse/0`` to world of ``sparse_scaled/0``; None if not said."""
        given = self.summary.get("metric_from_sfm")
        if given is None:
            return None
        with self._expecting("metric_from_sfm"):
            return Similarity(
                float(given["scale"]),
                Rotation.from_quat(given["rotation_xyzw"]).as_matrix(),
                np.array(given["translation_m"], dtype=np.float64).reshape(3),
            )

    @property
    def relative_scale_stddev(self) -> float | None:
        """Of every length in the metric models, by the scale alone; None if not said."""
        scale = self.summary.get("scale")
        if scale is None:
            return None
        with self._expecting("scale"):
            return float(scale["stddev_empirical"]) / float(scale["value"])

    @property
    def images_path(self) -> Path | None:
        """Folder of the photos, as the run was told; None if it had none."""
        with self._expecting("settings"):
            path = ((self.summary.get("settings") or {}).get("images") or {}).get("path")
            return None if path is None else path_of(path)

    @property
    def georeference(self) -> Georeference | None:
        """Where the metric models' world lies on the Earth; None if the anchors did not say."""
        given = self.summary.get("georeference")
        if given is None:
            return None
        with self._expecting("georeference"):
            lat_deg, lon_deg, height_m = (float(given[key]) for key in ("lat_deg", "lon_deg", "height_m"))
            return Georeference(lat_deg, lon_deg, height_m, str(given["crs"]))

    @contextmanager
    def _expecting(self, key: str) -> Iterator[None]:
        """Whatever goes wrong inside is the fault of the file."""
        try:
            yield
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"'{key}' is not what a run writes", self.path / "result.json") from error

    def read_model(self, stage: str) -> pycolmap.Reconstruction | None:
        """The model ``stage``/0 ("sparse", "sparse_scaled" or "sparse_metric"); None if not there."""
        from rangesfm.colmap.model_files import read_model

        path = self.path / stage / "0"
        return read_model(path) if path.is_dir() else None

    def read_ranges(self) -> RangesAsUsed | None:
        """``ranges.csv``; None if not there."""
        path = self.path / "ranges.csv"
        if not path.is_file():
            return None
        table = read_table(path, RANGES_COLUMNS, (*PLACE_COLUMNS, TAG_COLUMN))
        range_m = table.numbers("range_m")
        nowhere = [""] * len(table)
        before, after = (table.text(name, empty="") if name in table else nowhere for name in PLACE_COLUMNS[:2])
        return RangesAsUsed(
            timestamp_s=table.numbers("timestamp_s", empty=np.nan),
            image_name=tuple(table.text("image_name", empty="")),
            anchor_id=tuple(table.text("anchor_id")),
            tag_id=tuple(table.text(TAG_COLUMN) if TAG_COLUMN in table else nowhere),
            range_m=range_m,
            residual_scaled_m=table.numbers("predicted_scaled_m", empty=np.nan) - range_m,
            residual_refined_m=table.numbers("predicted_refined_m", empty=np.nan) - range_m,
            status=tuple(table.text("status")),
            keyframe_before=tuple(before),
            keyframe_after=tuple(after),
            weight=table.numbers("weight", empty=np.nan) if "weight" in table else np.full(len(table), np.nan),
        )

    def read_center_covariance_m2(self) -> dict[str, Array] | None:
        """(3, 3) of each keyframe's projection centre, by its photo (``pose_covariance.csv``); None if not there."""
        path = self.path / "pose_covariance.csv"
        if not path.is_file():
            return None
        table = read_table(path, ["image_name", *COVARIANCE_COLUMNS])
        upper = np.column_stack([table.numbers(name) for name in COVARIANCE_COLUMNS])
        matrices = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        return dict(zip(table.text("image_name"), matrices, strict=True))

    def lever_arms_m(self, tag_ids: Sequence[str]) -> Array:
        """(n, 3) antenna in the camera's frame of each tag of a list; of one that the settings do not name, the common.

        Raises:
            InputError: the settings are not what a run writes.
        """
        with self._expecting("settings"):
            settings = (self.summary.get("settings") or {}).get("tag") or {}
            common = np.array(settings.get("tag_in_cam_m") or (0.0, 0.0, 0.0), dtype=np.float64).reshape(3)
            given = settings.get("lever_arms_m") or {}
            arms = {str(id_): np.array(arm, dtype=np.float64).reshape(3) for id_, arm in given.items()}
        return np.array([arms.get(tag_id, common) for tag_id in tag_ids], dtype=np.float64).reshape(-1, 3)

    @property
    def association(self) -> AssociationOptions:
        """How the run put ranges on the path."""
        with self._expecting("settings"):
            given = (self.summary.get("settings") or {}).get("ranges") or {}
            known = (name for name in AssociationOptions.model_fields if name in given)
            return AssociationOptions(**{name: float(given[name]) for name in known})

    def read_numbers(self, name: str, columns: Sequence[str]) -> dict[str, Array] | None:
        """Columns of numbers of ``name``.csv, NaN where a cell is empty; None if not there."""
        path = self.path / f"{name}.csv"
        if not path.is_file():
            return None
        table = read_table(path, columns)
        return {column: table.numbers(column, empty=np.nan) for column in columns}


def read_result_folder(path: Path) -> ResultFolder:
    """Read what is small; models and ranges are read when asked for.

    Raises:
        InputError: the folder is missing, has no ``result.json``, or that is not what a run writes.
    """
    result_path = path / "result.json"
    if not result_path.is_file():
        raise InputError("not a result folder: it has no result.json (expected the output_path of a run)", path)
    summary = read_json(result_path)
    if not isinstance(summary, dict):
        raise InputError("expected a JSON object", result_path, 1)
    return ResultFolder(path, summary, _read_image_times(path / "images.csv"))


def _read_image_times(path: Path) -> dict[str, float] | None:
    if not path.is_file():
        return None
    table = read_table(path, ["image_name", "timestamp_s"])
    return dict(zip(table.text("image_name"), table.numbers("timestamp_s").tolist())) or None
