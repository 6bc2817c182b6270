"""Prior: what was known of some blocks before, as one more kind of measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rangesfm import solver
from rangesfm.arrays import Array
from rangesfm.measurements.kind import LEAST_SQUARES, Block, ByBlock, Linearization, MapState, Measurements, Weights
from rangesfm.solver.bundle_adjustment import BundleAdjustment


@dataclass(frozen=True)
class Prior(Measurements):
    """Joint normal distribution of m blocks of one size.

    Attributes:
        names: of the blocks. mean: (m, size).
        root_information: (r, m size) root of the information on their numbers, those of the first block first.
    """

    kind: ClassVar[str] = "prior"

    names: tuple[Block, ...]
    mean: Array
    root_information: Array

    @classmethod
    def of_one(cls, name: Block, mean: Array, stddev: float | Array) -> Prior:
        """Return the prior of one block, whose numbers are independent and have these standard deviations."""
        return cls((name,), mean[None], np.diag(1 / np.broadcast_to(stddev, mean.shape)))

    @property
    def weights(self) -> Weights:
        return Weights(self.root_information[None], np.ones(1), LEAST_SQUARES)

    def linearize(self, state: MapState) -> Linearization:
        num, size = self.mean.shape
        off = np.array([state.blocks[name] for name in self.names]) - self.mean
        slopes = np.eye(num * size).reshape(num * size, num, size)
        by_block = tuple(
            ByBlock((name,), np.zeros(1, dtype=np.int64), slopes[None, :, k]) for k, name in enumerate(self.names)
        )
        return Linearization.without_poses(off.reshape(1, -1), by_block)

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        """Add the prior, if the problem has its blocks.

        Raises:
            ValueError: the problem has some of the blocks only.
        """
        problem, own = adjustment.adjuster.problem, [blocks[name] for name in self.names]
        are_there = [problem.has_parameter_block(block) for block in own]
        if not any(are_there):
            return
        if not all(are_there):
            missing = [name for name, is_there in zip(self.names, are_there, strict=True) if not is_there]
            raise ValueError(f"a joint prior of {self.names}, but nothing else depends on {missing}")
        cost = solver.joint_prior_cost(mean=self.mean, whitening=adjustment.pixel_stddev * self.root_information)
        solver.add_residual_block(adjustment.adjuster, cost, None, own)
