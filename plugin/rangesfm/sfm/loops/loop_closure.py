"""The loops of a map: what was proposed, found, contradicted by the measurements, and by how much the map moved."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.util.geometry.similarity import rmse
from rangesfm.util.geometry.trajectory import Trajectory

NamedPair = tuple[str, str]
"""Names of two photos."""


@dataclass(frozen=True)
class LoopClosure:
    """Outcome of the closing of loops.

    Attributes:
        num_proposed: pairs of photos that the map predicted to see the same.
        num_verified: pairs of these that match.
        closed: pairs of these that were used.
        contradicted: pairs of these that the measurements contradict.
        before: keyframes of the map that would be the result with its loops open, metres.
    """

    num_proposed: int
    num_verified: int
    closed: tuple[NamedPair, ...]
    contradicted: tuple[NamedPair, ...]
    before: Trajectory

    def moved_m(self, after: Trajectory) -> float:
        """Return the root mean square movement of the keyframes, whose path is now ``after``."""
        return rmse(after.centers - self.before.centers)

    @property
    def warning(self) -> str | None:
        """Return a line that names the pairs that the measurements contradict; None if there are none."""
        if not self.contradicted:
            return None
        first = " and ".join(self.contradicted[0])
        return (
            f"{len(self.contradicted)} pairs of photos match but contradict the measurements, and are not used; the"
            f" first is {first}, and loops.csv has all"
        )

    def moved(self, offset_m: Array) -> LoopClosure:
        """Return the same in a world whose coordinates are larger by ``offset_m`` (3,)."""
        return replace(self, before=self.before.transformed(1.0, np.eye(3), offset_m))
