"""Sources of measurements for the fit of a map (section 5 of ``model.md``)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping

from rangesfm.distances.tape import Marker
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.measurements.kind import Measurements
from rangesfm.measurements.points import NamedPoints
from rangesfm.options import RefineOptions


class Source(ABC):
    """Measurements that become those of a metric map when its points are known."""

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks in photos to which the measurements refer, by name."""
        return {}

    @property
    def places_map(self) -> bool:
        """Whether they place the map in the site."""
        return False

    @abstractmethod
    def measurements(
        self, points: NamedPoints, trajectory: Trajectory, options: RefineOptions
    ) -> Iterator[Measurements]:
        """Yield measurements of a metric model, with the noise to begin with.

        Args:
            points: named ones of the model. trajectory: of the unscaled model.
        """
