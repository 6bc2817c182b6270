"""What the errors of the ranges, learnt from all anchors of a log together, do to where each of them was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.anchors.point_fit import PointFit
from rangesfm.ranging.errors.cells import cells, noisiness
from rangesfm.ranging.errors.learned import learn_errors

# Each anchor's bias is estimated with a prior of its own, and the path is known.
_NOT_HERE = ("bias", "common_bias", "bending")


@dataclass(frozen=True)
class FitErrors:
    """Of the n ranges of one anchor.

    Attributes:
        of_cell: (n,) the cell of each.
        covariance_m2: (c, c) of the errors of cells.
    """

    of_cell: Indices
    covariance_m2: Array

    def of_sums(self, influence: Array) -> Array:
        """(k, k) covariance of (k, n) sums of the ranges' errors."""
        of_cells = np.stack([np.bincount(self.of_cell, row, len(self.covariance_m2)) for row in influence])
        covariance: Array = of_cells @ self.covariance_m2 @ of_cells.T
        return covariance

    def inflation(self, fit: PointFit, change_m: Array) -> float:
        """How much larger a stddev is than if ranges erred independently, of what changes them by (n,) ``change_m``."""
        weight = fit.weights * change_m / fit.problem.stddev_m**2
        formal = float(weight @ change_m)
        return float(np.sqrt(max(self.of_sums(weight[None])[0, 0] / formal, 1.0))) if formal > 0 else 1.0

    def inflation_of_bias(self, fit: PointFit) -> float:
        """The same of the bias, all else adapted."""
        root = np.sqrt(fit.weights) / fit.problem.stddev_m
        slopes = fit.problem.slopes(fit.x)
        adapted = np.linalg.lstsq(root[:, None] * slopes[:, :3], root, rcond=None)[0]
        return self.inflation(fit, 1.0 - slopes[:, :3] @ adapted)


def errors_of_fits(
    fits: Sequence[PointFit], times_s: Sequence[Array], tags: Sequence[Indices], *, is_calibrated: bool
) -> list[FitErrors]:
    """What the residuals of all fits together say of their ranges' errors.

    Args:
        fits: one for each anchor, of n_k ranges. times_s, tags: (n_k,) of each, when and by which tag.
        is_calibrated: whether an error curve has been taken off, whose stddev the ranges share.
    """
    lengths = [len(fit.residuals_m) for fit in fits]
    anchor_index = np.repeat(np.arange(len(fits)), lengths)
    slopes = [fit.problem.slopes(fit.x) for fit in fits]
    curve_stddev_m = np.concatenate([fit.problem.shared_stddev_m for fit in fits])
    precision = np.concatenate([fit.own_stddev_m**-2 for fit in fits])
    learned = learn_errors(
        cells(
            anchor_index,
            np.concatenate(tags),
            np.concatenate(times_s),
            np.concatenate([fit.problem.positions_m - fit.x[:3] for fit in fits]),
            np.tile(np.eye(3), (len(anchor_index), 1, 1)),
            np.concatenate([fit.weights for fit in fits]) * precision / precision.mean(),
            noisiness(anchor_index, np.concatenate([fit.residuals_m for fit in fits]), len(fits)),
        ),
        off_m=np.concatenate([_off(fit) for fit in fits]),
        design=block_diag(*slopes),
        prior_design=block_diag(*(fit.problem.prior for fit in fits)),
        noise_m=float(precision.mean() ** -0.5),
        curve_stddev_m=curve_stddev_m if is_calibrated else None,
        ruled_out=_NOT_HERE,
    )
    covariance = learned.covariance_m2
    return [FitErrors(learned.of_range[anchor_index == k], covariance) for k in range(len(fits))]


def _off(fit: PointFit) -> Array:
    """(n,) measured minus predicted, with the bias that was expected."""
    return -fit.problem.residuals_m(np.append(fit.x[:3], fit.problem.prior_mean[3]))
