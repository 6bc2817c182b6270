"""Prior: what was known of some blocks before, as one more kind of measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np

from rangesfm import solver
from rangesfm.arrays import Array
from rangesfm.measurements.kind import LEAST_SQUARES, Block, ByBlock, Linearization, MapState, Measurements, Weights
from rangesfm.solver.bundle_adjustment import BundleAdjustment


@dataclass(frozen=True)
class Prior(Measurements):
    """Normal distributions of g groups of m blocks of one size.

    Attributes:
        names: of the m blocks of each group. mean: (g, m, size).
        root_information: (g, r, m size) root of the information on a group's numbers, those of its first block first.
    """

    kind: ClassVar[str] = "prior"

    names: tuple[tuple[Block, ...], ...]
    mean: Array
    root_information: Array

    @classmethod
    def of_one(cls, name: Block, mean: Array, stddev: float | Array) -> Prior:
        """Return the prior of one block, whose numbers are independent and have these standard deviations."""
        return cls(((name,),), mean[None, None], np.diag(1 / np.broadcast_to(stddev, mean.shape))[None])

    @classmethod
    def of_walk(cls, names: tuple[Block, ...], stddev: Array) -> Prior:
        """Return the prior of a random walk, given the (s - 1, size) standard deviations from each of s blocks on."""
        roots = 1 / stddev[:, :, None] * np.eye(stddev.shape[1])
        return cls(
            tuple(pairwise(names)), np.zeros((len(stddev), 2, stddev.shape[1])), np.concatenate([-roots, roots], axis=2)
        )

    @property
    def weights(self) -> Weights:
        return Weights(self.root_information, np.ones(len(self.names)), LEAST_SQUARES)

    def linearize(self, state: MapState) -> Linearization:
        num, each, size = self.mean.shape
        off = np.array([[state.blocks[name] for name in of_group] for of_group in self.names]) - self.mean
        blocks = tuple(dict.fromkeys(name for of_group in self.names for name in of_group))
        row_of, slopes = {name: row for row, name in enumerate(blocks)}, np.eye(each * size).reshape(-1, each, size)
        by_block = tuple(
            ByBlock(
                blocks,
                np.array([row_of[of_group[k]] for of_group in self.names]),
                np.tile(slopes[:, k], (num, 1, 1)),
            )
            for k in range(each)
        )
        return Linearization.without_poses(off.reshape(num, -1), by_block)

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        """Add the priors of groups of which the problem has the blocks.

        Raises:
            ValueError: the problem has some of a group's blocks only.
        """
        problem = adjustment.adjuster.problem
        for names, mean, root in zip(self.names, self.mean, self.root_information, strict=True):
            own = [blocks[name] for name in names]
            are_there = [problem.has_parameter_block(block) for block in own]
            if not any(are_there):
                continue
            if not all(are_there):
                missing = [name for name, is_there in zip(names, are_there, strict=True) if not is_there]
                raise ValueError(f"a joint prior of {names}, but nothing else depends on {missing}")
            cost = solver.joint_prior_cost(mean=mean, whitening=adjustment.pixel_stddev * root)
            solver.add_residual_block(adjustment.adjuster, cost, None, own)
