"""MetricMap: all that an exporter may need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.geometry import Similarity
from rangesfm.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MetricMap:
    """A metric model with what a COLMAP model does not hold.

    Attributes:
        reconstruction: in metres.
        timestamps_s: camera-clock time of each photo by name; None if unknown.
        anchors_m: (3,) position by anchor id, in the model's world.
        metric_from_sfm: from the unscaled model's world to this one's; None if unknown.
    """

    reconstruction: pycolmap.Reconstruction
    timestamps_s: Mapping[str, float] | None
    anchors_m: Mapping[str, Array]
    metric_from_sfm: Similarity | None

    @cached_property
    def trajectory(self) -> Trajectory:
        return trajectory_from_reconstruction(self.reconstruction, self.timestamps_s)
