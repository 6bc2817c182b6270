"""Marked points whose coordinates in the site are known, as measurements of the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rangesfm import solver
from rangesfm.arrays import Array, Indices
from rangesfm.measurements.kind import LEAST_SQUARES, Block, Linearization, MapState, Measurements, Weights
from rangesfm.measurements.points import NamedPoints, linearized
from rangesfm.solver.bundle_adjustment import BundleAdjustment

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class ControlPoints(Measurements):
    """k marked points with known coordinates.

    Attributes:
        names: of their markers. points: to which they belong.
        position_m: (k, 3) in the metric world. stddev_m: (k,) of each coordinate.
        beyond_m2: covariance (3, 3) of errors of marks that no residual has, by name.
    """

    kind: ClassVar[str] = "control point"
    counts_in_metres: ClassVar[bool] = True

    names: tuple[str, ...]
    points: NamedPoints
    position_m: Array
    stddev_m: Array
    beyond_m2: Mapping[str, Array]

    @property
    def _covariance_m2(self) -> Array:
        beyond_m2 = np.array([self.beyond_m2.get(name, np.zeros((3, 3))) for name in self.names])
        return np.asarray(self.stddev_m[:, None, None] ** 2 * np.eye(3) + beyond_m2)

    @property
    def weights(self) -> Weights:
        roots = np.linalg.inv(np.linalg.cholesky(self._covariance_m2))
        return Weights(roots, np.ones(len(self.names)), LEAST_SQUARES)

    def linearize(self, state: MapState) -> Linearization:
        placed = [self.points.at(name, state) for name in self.names]
        residuals = [point.position_m - at for point, at in zip(placed, self.position_m, strict=True)]
        return linearized(residuals, [[(np.eye(3), point)] for point in placed])

    def with_errors_of_marks(self, beyond_m2: Mapping[str, Array]) -> Self:
        return replace(self, beyond_m2=beyond_m2)

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> Indices:
        first = adjustment.adjuster.problem.num_residuals()
        for row, name in enumerate(self.names):
            further = self.beyond_m2.get(name, np.zeros((3, 3))) / adjustment.pixel_stddev**2
            stddev = self.stddev_m[row] / adjustment.pixel_stddev
            solver.add_normal_prior(adjustment.adjuster, blocks["mark", name], self.position_m[row], stddev, further)
        return np.arange(first, adjustment.adjuster.problem.num_residuals())
