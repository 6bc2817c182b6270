"""Measured lengths between points as observations of a map (sections 2 and 4 of ``model.md``)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from rangesfm.arrays import Mask
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.lengths.words import LENGTHS
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import Observations

BENDING = 0.008
"""Relative variation of the scale within a map (standard deviation), for lengths at unknown places.

Source: lengths of 0.5 to 5 m against the truth in a room mapped with a hand-held camera.
"""


def lengths_on_map(lengths: LocatedDistances, scale: float, num_poses: int, is_used: Mask) -> Observations:
    """Linearise lengths between points about the scale of a map.

    Args:
        lengths: of which all are between points, in the model of the path.
        scale: metres per unit of that model. num_poses: of the path.
        is_used: (m,) lengths that take part.
    """
    num = len(lengths)
    grown_m, printed = scale * lengths.model_length, lengths.is_printed
    # Sides of printed tags share the error of their size.
    alone = ~(printed[:, None] & printed) & ~np.eye(num, dtype=bool)
    tape_m2 = np.where(alone, 0.0, np.outer(lengths.stddev_m, lengths.stddev_m))
    marks_m2 = np.diag((scale * lengths.mark_stddev) ** 2)
    return Observations(
        kind=LENGTHS,
        columns=Columns.of_whole(1),
        design=grown_m[:, None],
        residual_m=grown_m - lengths.distance_m,
        by_pose=scale * csr_array(lengths.by_pose, shape=(num, 6 * num_poses)).toarray(),
        components=(Component("tape", tape_m2), Component("marks", marks_m2)),
        alone_m2=np.diag(lengths.stddev_m**2) + marks_m2,
        is_used=is_used,
    )
