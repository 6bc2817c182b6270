"""What pyceres' objects can do, for those who check types: it has no hints of its own."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt


class CostFunction(Protocol):
    """A ``pyceres.CostFunction``: to be added to a problem, or evaluated to see what it says."""

    def num_residuals(self) -> int: ...
    def parameter_block_sizes(self) -> list[int]: ...
    def evaluate(
        self, *blocks: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], list[npt.NDArray[np.float64]]]:
        """Residuals (n, 1), and for each block of size k the Jacobian (n, k)."""


class Manifold(Protocol):
    """A ``pyceres.Manifold``."""

    def ambient_size(self) -> int: ...
    def tangent_size(self) -> int: ...


class LossFunction(Protocol):
    """A ``pyceres.LossFunction``."""

    def evaluate(self, squared_norm: float) -> npt.NDArray[np.float64]:
        """(3,) the loss and its first two derivatives."""
