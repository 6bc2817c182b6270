"""A kind of measurement in a plan: what it will say of a map that has not been made yet."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from rangesfm.measurements.joint_map import KindOnMap
from rangesfm.option_model import Options
from rangesfm.solver.bending import MapBending

if TYPE_CHECKING:
    from typing_extensions import Self


class PlannedKind(Options):
    """The table of a kind in a plan file, which has its name."""

    advice: ClassVar[str] = ""
    """What to do to have such measurements, as they usually are, where times of photos are known; empty: no advice."""

    @classmethod
    def like(cls, learnt: Mapping[str, float]) -> Self:
        """Return a plan of the same measurements as those of a result.

        Args:
            learnt: all numbers with fractions of its entry in ``result.json``, by their keys there.
        """
        del learnt
        return cls()

    @property
    def sizes(self) -> Mapping[str, float]:
        """Sizes of errors that are known better than from other surveys, by name."""
        return {}

    @abstractmethod
    def on_map(self, bending: MapBending) -> KindOnMap:
        """Return what is measured on a true map, without errors.

        Args:
            bending: of the map, whose path is in the site, z up.

        Raises:
            GeometryError: a run will not use it.
        """
