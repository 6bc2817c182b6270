"""What a kind of measurement gives, so that each stage is one code for all kinds (section 2 of examples/model.md)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.solver.bundle_adjustment import BundleAdjustment
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.robust_statistics import RobustLoss

if TYPE_CHECKING:
    from typing_extensions import Self
Block = tuple[str, str]
"""Name of a parameter besides the poses: what it is, and whose, as ``("anchor", "A1")``."""


class Doubt(NamedTuple):
    """A fault of a map, and what to do about it."""

    reason: str
    advice: str = ""


@dataclass(frozen=True)
class MapState:
    """Values of all that is estimated.

    Attributes:
        poses: of the n keyframes, in the metric world.
        blocks: further parameters by name, each (size,).
    """

    poses: Poses
    blocks: Mapping[Block, Array]


@dataclass(frozen=True)
class ByBlock:
    """Derivatives of g groups of d residuals by blocks of one size.

    Attributes:
        blocks: the blocks. index: (g,) which of them each group depends on; -1: on none.
        values: (g, d, size) derivatives.
    """

    blocks: tuple[Block, ...]
    index: Indices
    values: Array


@dataclass(frozen=True)
class Linearization:
    """Residuals of g groups of d numbers at a state, and their derivatives.

    Attributes:
        residual: (g, d) predicted minus measured, in the unit of the measurement.
        pose: (g, q) indices of the keyframes that each group depends on; one may be there twice.
        by_pose: (g, d, q, 6) derivatives by a turn of each keyframe's rig in its own frame and a shift of its origin.
        by_block: derivatives by blocks.
    """

    residual: Array
    pose: Indices
    by_pose: Array
    by_block: tuple[ByBlock, ...]

    @classmethod
    def without_poses(cls, residual: Array, by_block: tuple[ByBlock, ...]) -> Linearization:
        """Return groups that depend on blocks alone."""
        g, d = residual.shape
        return cls(residual, np.zeros((g, 0), dtype=np.int64), np.zeros((g, d, 0, 6)), by_block)


def by_all_poses(pose: Indices, by_pose: Array, num: int) -> csr_array:
    """Return the (g d, 6 num) sparse derivatives by the first ``num`` keyframes, with all others held.

    Args:
        pose, by_pose: (g, q), (g, d, q, 6) as of ``Linearization``.
    """
    num_rows = by_pose.shape[0] * by_pose.shape[1]
    rows = np.broadcast_to(np.arange(num_rows).reshape(*by_pose.shape[:2], 1, 1), by_pose.shape)
    columns = np.broadcast_to(6 * pose[:, None, :, None] + np.arange(6), by_pose.shape)
    is_any = (by_pose != 0) & (columns < 6 * num)
    return coo_array((by_pose[is_any], (rows[is_any], columns[is_any])), shape=(num_rows, 6 * num)).tocsr()


@dataclass(frozen=True)
class Weights:
    """How much each of g groups of d residuals counts (section 4): half of ``share * loss(|root_information @ e|^2)``.

    Attributes:
        root_information: (g, r, d) inverse root of the covariance, or any root of the information.
        share: (g,) number of independent groups that each counts as.
        loss: of the length of a group in standard deviations; least squares if its width is infinite.
    """

    root_information: Array
    share: Array
    loss: RobustLoss

    def whitened(self, residual: Array) -> Array:
        """Return (g, r) numbers in standard deviations, given the (g, d) residuals."""
        return np.asarray(np.einsum("gij,gj->gi", self.root_information, residual))


LEAST_SQUARES = RobustLoss(np.inf, is_bounded=True)
"""The loss of what has no outliers."""


class Measurements(ABC):
    """Measurements of one kind. By default they have no blocks of their own and no outliers."""

    kind: ClassVar[str]
    """Name of the kind."""
    counts_in_metres: ClassVar[bool] = False
    """Whether they say with what precision, in metres, the map is to be found; priors and directions do not."""

    @property
    def places_map(self) -> bool:
        """Whether they place the map in the site."""
        return False

    @property
    def takes_part(self) -> bool:
        """Whether any of them takes part in an estimate; otherwise they are only predicted."""
        return True

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks in photos to which they refer, by name."""
        return {}

    @property
    @abstractmethod
    def weights(self) -> Weights:
        """Weights of the measurements."""

    @abstractmethod
    def linearize(self, state: MapState) -> Linearization:
        """Return residuals and derivatives at a state."""

    @abstractmethod
    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        """Add their costs to a bundle adjustment, in pixels.

        Args:
            poses: rig_from_world (7,) of each keyframe. blocks: parameter blocks by name.
        """

    @property
    def blocks(self) -> Mapping[Block, Array]:
        """Start values of the blocks that they bring along, which are estimated or held."""
        return {}

    def priors(self) -> Iterator[Measurements]:
        """Yield what was known of the blocks before."""
        yield from ()

    @property
    def fixed(self) -> frozenset[Block]:
        """Those of the blocks that are held at their start values."""
        return frozenset()

    def at_blocks(self, blocks: Mapping[Block, Array]) -> Self:
        """Return the measurements with other start values of their blocks."""
        return self

    def with_errors_of_marks(self, beyond_m2: Mapping[str, Array]) -> Self:
        """Return the measurements with the (3, 3) covariances of errors of marks that no residual has, by name."""
        return self

    def like(self, other: Self) -> Self:
        """Return the measurements with the noise of the same ones elsewhere."""
        return self

    def under(self, loss: RobustLoss) -> Self:
        """Return the measurements with another loss, if they may have outliers."""
        return self

    def with_noise_of(self, residual: Array, num_absorbed: float) -> Self:
        """Return the measurements with the noise that (g, d) residuals of a map show which may bend.

        Args:
            num_absorbed: degrees of freedom of the residuals that the map has absorbed.
        """
        return self

    def change(self, other: Self) -> float:
        """Return the largest difference of the logarithms of the roots of a measurement's information."""
        return 0.0

    def log_likelihood(self, residual: Array) -> float:
        """Return how likely (g, d) residuals are, whatever the noise, to compare two maps."""
        return 0.0
