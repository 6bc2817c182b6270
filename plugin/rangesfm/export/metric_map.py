"""What exporters share: the map with all that they may need, and parts of a camera that programs name one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pycolmap

from rangesfm.arrays import Array
from rangesfm.geometry.georeference import Georeference
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction


@dataclass(frozen=True)
class MetricMap:
    """A metric model with what a COLMAP model does not hold.

    Attributes:
        reconstruction: in metres.
        timestamps_s: camera-clock time of each photo by name; None if unknown.
        anchors_m: (3,) position by anchor id, in the model's world.
        metric_from_sfm: from the unscaled model's world to this one's; None if unknown.
        relative_scale_stddev: of every length in the map, by the scale alone; None if unknown.
        images_path: folder of the photos; None if unknown.
        center_covariance_m2: (3, 3) of each keyframe's projection centre, by its photo; None if unknown.
        is_site: whether the model's world is the anchors' site frame, in which z is up by custom.
        georeference: where the model's world lies on the Earth; None if unknown.
    """

    reconstruction: pycolmap.Reconstruction
    timestamps_s: Mapping[str, float] | None = None
    anchors_m: Mapping[str, Array] | None = None
    metric_from_sfm: Similarity | None = None
    relative_scale_stddev: float | None = None
    images_path: Path | None = None
    is_site: bool = False
    georeference: Georeference | None = None
    center_covariance_m2: Mapping[str, Array] | None = None

    @cached_property
    def trajectory(self) -> Trajectory:
        return trajectory_from_reconstruction(self.reconstruction, self.timestamps_s)


def distortion_params(camera: pycolmap.Camera) -> list[float]:
    """The parameters that are neither focal lengths nor principal point, in COLMAP's order."""
    others = {*camera.focal_length_idxs(), *camera.principal_point_idxs()}
    return [float(value) for index, value in enumerate(camera.params) if index not in others]
