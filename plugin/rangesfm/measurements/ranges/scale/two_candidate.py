"""The scale estimate of the paper: two candidates per range, of which the branch with less scatter is chosen.

Lee, Zhu, Giorgi and Günther, "Fusion of Monocular Vision and Radio-based Ranging for Global Scale Estimation and Drift
Mitigation", 2018. It is kept exactly as published, for comparison. With real radios it is far off: the candidates grow
without bound near the origin, and the correct root changes branches along a path that first approaches the anchor and
then leaves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.util.geometry.numerics import ROUNDING
from rangesfm.util.geometry.similarity import off_origin


@dataclass(frozen=True)
class Branch:
    """Mean and standard deviation of one of the two roots over all ranges, metres per SfM unit."""

    mean: float
    std: float


@dataclass(frozen=True)
class TwoCandidate:
    """The paper's table of both branches.

    Attributes:
        alpha0, alpha1: branches of the smaller and of the larger roots.
        chosen: "alpha0" or "alpha1", the branch with the smaller standard deviation.
        scale: mean of the chosen branch, metres per SfM unit.
        duplets: (k, 2) both candidates of each range that has them.
        rows: (k,) rows of these ranges.
        num_without_root: ranges dropped for a negative discriminant or a camera at the origin.
    """

    alpha0: Branch
    alpha1: Branch
    chosen: str
    scale: float
    duplets: Array
    rows: Indices
    num_without_root: int


def two_candidate(centers: Array, tag_from_center: Array, anchor_m: Array, range_m: Array) -> TwoCandidate | None:
    """Compute both roots of the squared range equation for every range, and the paper's choice.

    With A = |c|^2, B = c.(R^T l - a), C = |R^T l - a|^2 - rho^2, the candidates are
    -B/A -+ sqrt((B/A)^2 - C/A).

    Args:
        centers: (n, 3) in the frame of the first camera, SfM units.
        tag_from_center: (n, 3) lever arm turned into that frame, metres.
        anchor_m: (3,) or (n, 3) anchor in that frame, metres.
        range_m: (n,).

    Returns:
        None if fewer than two ranges have candidates: then there is no scatter to compare.
    """
    offset = tag_from_center - anchor_m
    a = np.sum(centers**2, axis=1)
    b = np.sum(centers * offset, axis=1)
    c = np.sum(offset**2, axis=1) - range_m**2
    with np.errstate(divide="ignore", invalid="ignore"):
        center, discriminant = -b / a, (b / a) ** 2 - c / a
        # Where its ray is nearest to the anchor, a camera has one candidate; rounding must not make it none.
        has_one = np.abs(discriminant) < ROUNDING * np.sum(offset**2, axis=1) / a
    discriminant[has_one] = 0.0
    rows = np.flatnonzero(off_origin(centers) & (discriminant >= 0))
    if len(rows) < 2:
        return None
    root = np.sqrt(discriminant[rows])
    duplets = np.column_stack([center[rows] - root, center[rows] + root])
    branches = [Branch(float(np.mean(branch)), float(np.std(branch, ddof=1))) for branch in duplets.T]
    chosen = 0 if branches[0].std <= branches[1].std else 1
    return TwoCandidate(
        branches[0], branches[1], f"alpha{chosen}", branches[chosen].mean, duplets, rows, len(range_m) - len(rows)
    )
