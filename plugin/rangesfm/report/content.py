"""Content: all that a report shows, gathered from a result folder; what is missing is None."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.report.true_ranges import true_ranges_m
from rangesfm.result.folder import ResultFolder
from rangesfm.result.ranges_as_used import RangesAsUsed
from rangesfm.result.summary import ResultSummary
from rangesfm.result.tables import ScaleBootstrap, ScaleCandidates, ScaleConsensus, TimeOffsetCurve

if TYPE_CHECKING:
    import pycolmap


DEFAULT_FOLDER = "out"


@dataclass(frozen=True)
class CameraIntrinsics:
    """One camera of the models.

    Attributes:
        camera_id: COLMAP's.
        model: COLMAP's name of the camera model.
        size_px: width and height of its photos.
        parameters: name, value before the refinement, value after it (NaN without).
        half_angles: half width and half height of its picture at unit distance.
    """

    camera_id: int
    model: str
    size_px: tuple[int, int]
    parameters: tuple[tuple[str, float, float], ...]
    half_angles: tuple[float, float]


@dataclass(frozen=True)
class Content:
    """All that a report shows.

    Attributes:
        title: name of the result.
        summary: ``result.json``.
        ranges: ``ranges.csv``.
        tags_in_cam_m: (n, 3) antenna of each range's tag in the camera's frame; None without ranges.
        range_times_s: (n,) when each range was taken, seconds since the first; NaN where unknown.
        scaled, refined: the path before and after the refinement.
        reference_m: (k, 3) positions in the map's frame.
        anchors_m: (3,) by id.
        points_m, points_rgb: (m, 3) of the final map; None without a model.
        cameras: intrinsics in the scaled and in the final model.
        true_scale: the path before the refinement with the reference's scale; None if that is not known.
        reference_by_photo: (3,) by name, in the map's frame.
        images_path: folder of the photos; None where it is not known.
        candidates, consensus, bootstrap, clock_curve: how scale and clock offset came about, as far as it is there.
    """

    title: str
    summary: ResultSummary
    ranges: RangesAsUsed | None
    tags_in_cam_m: Array | None
    range_times_s: Array | None
    scaled: Trajectory | None
    refined: Trajectory | None
    reference_m: Array | None
    anchors_m: dict[str, Array]
    points_m: Array | None
    points_rgb: npt.NDArray[np.uint8] | None
    cameras: tuple[CameraIntrinsics, ...]
    true_scale: Trajectory | None
    reference_by_photo: dict[str, Array]
    images_path: Path | None
    candidates: ScaleCandidates | None
    consensus: ScaleConsensus | None
    bootstrap: ScaleBootstrap | None
    clock_curve: TimeOffsetCurve | None

    @cached_property
    def true_ranges_m(self) -> Array | None:
        """(n,) by the reference, NaN where it says nothing; None where it says nothing at all."""
        if self.ranges is None or self.tags_in_cam_m is None or self.final is None or not self.reference_by_photo:
            return None
        distances = true_ranges_m(self.ranges, self.final, self.reference_by_photo, self.anchors_m, self.tags_in_cam_m)
        return distances if np.isfinite(distances).any() else None

    @property
    def final(self) -> Trajectory | None:
        """The best path there is."""
        return self.refined if self.refined is not None else self.scaled


def gather(result: ResultFolder, *, images_path: Path | None = None) -> Content:
    """Read what the report needs.

    Args:
        images_path: folder of the photos; None: where the run had them.

    Raises:
        InputError: a file of the result is there but cannot be read.
    """
    ranges = result.read(RangesAsUsed)
    scaled, refined = result.read_model("sparse_scaled"), result.read_model("sparse_metric")
    final = refined or scaled
    path_scaled = None if scaled is None else trajectory_from_reconstruction(scaled, result.timestamps_s)
    points_m, points_rgb = (None, None) if final is None else points_of(final)
    reference = result.read_reference()
    return Content(
        title=_title(result.path.resolve()),
        summary=result.summary,
        ranges=ranges,
        tags_in_cam_m=None if ranges is None else result.lever_arms_m(ranges.tag_id),
        range_times_s=None if ranges is None else _range_times(ranges, result.timestamps_s or {}),
        scaled=path_scaled,
        refined=None if refined is None else trajectory_from_reconstruction(refined, result.timestamps_s),
        reference_m=None if reference is None else reference.positions_m,
        anchors_m=result.anchor_positions_m,
        points_m=points_m,
        points_rgb=points_rgb,
        cameras=() if final is None else _cameras(scaled, refined, final),
        true_scale=None if path_scaled is None else _with_true_scale(path_scaled, result.summary),
        reference_by_photo={} if reference is None else dict(zip(reference.image_names or (), reference.positions_m)),
        images_path=images_path or result.images_path,
        candidates=result.read(ScaleCandidates),
        consensus=result.read(ScaleConsensus),
        bootstrap=result.read(ScaleBootstrap),
        clock_curve=result.read(TimeOffsetCurve),
    )


def _title(folder: Path) -> str:
    """The folder's name; that of the survey around it where the folder has the name that all results have."""
    return folder.parent.name if folder.name == DEFAULT_FOLDER and folder.parent.name else folder.name


def _with_true_scale(path: Trajectory, summary: ResultSummary) -> Trajectory | None:
    """By the error that the comparison found: the reference itself may know no more than a few photos."""
    for row in summary.comparison:
        if row.name == "estimated scale" and row.scale_error_percent is not None:
            return path.resized(1.0 / (1.0 + row.scale_error_percent / 100.0), summary.frame)
    return None


def points_of(model: pycolmap.Reconstruction) -> tuple[Array, npt.NDArray[np.uint8]]:
    """(m, 3) positions and (m, 3) colours of a model's points."""
    points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return positions, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def _cameras(
    scaled: pycolmap.Reconstruction | None, refined: pycolmap.Reconstruction | None, final: pycolmap.Reconstruction
) -> tuple[CameraIntrinsics, ...]:
    before, after = ({} if model is None else dict(model.cameras.items()) for model in (scaled, refined))
    return tuple(
        _intrinsics(camera_id, camera, before.get(camera_id), after.get(camera_id))
        for camera_id, camera in sorted(final.cameras.items())
    )


def _intrinsics(
    camera_id: int, camera: pycolmap.Camera, before: pycolmap.Camera | None, after: pycolmap.Camera | None
) -> CameraIntrinsics:
    names = [name.strip() for name in camera.params_info.split(",")]
    unknown = [math.nan] * len(names)
    columns = [unknown if one is None else [float(value) for value in one.params] for one in (before, after)]
    focal = camera.mean_focal_length()
    return CameraIntrinsics(
        camera_id=camera_id,
        model=camera.model.name,
        size_px=(camera.width, camera.height),
        parameters=tuple(zip(names, *columns)),
        half_angles=(camera.width / (2 * focal), camera.height / (2 * focal)),
    )


def in_natural_order(ids: Iterable[str]) -> list[str]:
    """The distinct ids, "2" before "10"."""
    return sorted(set(ids), key=lambda id_: (not id_.isdecimal(), int(id_) if id_.isdecimal() else 0, id_))


def _range_times(ranges: RangesAsUsed, image_times_s: dict[str, float]) -> Array:
    """Time of each range (its own, or that of its photo) since the first: epochs have no room on an axis."""
    of_image = np.array([image_times_s.get(name, np.nan) for name in ranges.image_name], dtype=np.float64)
    times = np.where(np.isfinite(ranges.timestamp_s), ranges.timestamp_s, of_image)
    since_first: Array = times - np.min(times, initial=np.inf, where=np.isfinite(times))
    return since_first
