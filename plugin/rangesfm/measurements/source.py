"""Sources of measurements for the fit of a map (section 5 of ``model.md``)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import pycolmap

from rangesfm.arrays import Indices
from rangesfm.measurements.kind import Measurements
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.points import NamedPoints
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.poses import Poses, model_poses
from rangesfm.util.geometry.trajectory import Trajectory


class MapToFit(NamedTuple):
    """A metric map at the start of its fit.

    Attributes:
        poses: of its frames, those of the trajectory first. points: named ones.
        trajectory: of the unscaled model, to which the measurements refer.
        options: of the fit.
    """

    poses: Poses
    points: NamedPoints
    trajectory: Trajectory
    options: RefineOptions


class Source(ABC):
    """Measurements that become those of a metric map when its points are known."""

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks in photos to which the measurements refer, by name."""
        return {}

    @property
    def placed_points(self) -> Iterable[str]:
        """Names of points that they bring along, and which have a place, as of anchors."""
        return ()

    @property
    def places_map(self) -> bool:
        """Whether they place the map in the site."""
        return False

    @abstractmethod
    def measurements(self, at: MapToFit) -> Iterator[Measurements]:
        """Yield measurements of a metric map, with the noise to begin with."""


@dataclass(frozen=True)
class Measured:
    """All that was measured of a map."""

    sources: tuple[Source, ...]

    @property
    def markers(self) -> dict[str, Marker]:
        """Marks in photos to which the measurements refer, by name."""
        return {name: marker for source in self.sources for name, marker in source.markers.items()}

    @property
    def is_placed(self) -> bool:
        """True if measurements place the map."""
        return any(source.places_map for source in self.sources)

    def kinds(
        self, model: pycolmap.Reconstruction, frame_ids: Indices, trajectory: Trajectory, options: RefineOptions
    ) -> tuple[Measurements, ...]:
        """Return the measurements of a metric model, with the noise to begin with.

        Args:
            frame_ids: of the model's frames, those of the trajectory first. trajectory: of the unscaled model.
        """
        placed = (name for source in self.sources for name in source.placed_points)
        points = NamedPoints.in_model(model, frame_ids, self.markers, placed)
        at = MapToFit(model_poses(model, frame_ids), points, trajectory, options)
        kinds = [kind for source in self.sources for kind in source.measurements(at)]
        return (*kinds, *(prior for kind in kinds for prior in kind.priors()))
