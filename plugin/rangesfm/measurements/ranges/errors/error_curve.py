"""ErrorCurve: the mean error of a radio by distance, and its subtraction from ranges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import BIAS_M, LENGTH_M, STDDEV_OR_EXACT_M
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import FOUND, has_columns, read_table, write_table

COLUMNS = ("distance_m", "error_m", "stddev_m", "noise_stddev_m")
# Standard deviation by which the curve may change outside its knots, per e-fold of distance. The DW1000's own error
# changes by 0.05 to 0.1 m per e-fold (Decawave application note APS011).
DRIFT_STDDEV_M = 0.1
_MUCH_OUTSIDE = 0.02


@dataclass(frozen=True)
class ErrorCurve:
    """Mean error of a radio by distance, piecewise linear between k knots.

    Attributes:
        distance_m: (k,) true distances, ascending, k >= 2.
        error_m: (k,) measured minus true distance there.
        stddev_m: (k,) standard deviation of ``error_m``, which all ranges of this length share.
        noise_stddev_m: (k,) scatter of single ranges about the curve.
    """

    distance_m: Array
    error_m: Array
    stddev_m: Array
    noise_stddev_m: Array

    def true_distance(self, range_m: Array) -> tuple[Array, Array]:
        """Solve ``range = distance + error(distance)`` for the distance.

        Outside its ends the curve keeps its last value, with increasing uncertainty.

        Returns:
            (n,) distances, at least a tenth of the range, and (n,) standard deviations of the correction.
        """
        knots = self.distance_m + self.error_m
        error = np.interp(range_m, knots, self.error_m)
        distance = np.maximum(range_m - error, 0.1 * range_m)
        beyond = np.abs(np.log(distance / np.clip(distance, self.distance_m[0], self.distance_m[-1])))
        return distance, np.hypot(np.interp(range_m, knots, self.stddev_m), DRIFT_STDDEV_M * beyond)


def correct_ranges(log: RangeLog, curve: ErrorCurve) -> tuple[RangeLog, list[str]]:
    """Return the log with the error subtracted, and notes for the user."""
    distance, stddev = curve.true_distance(log.range_m)
    notes, knots = [], curve.distance_m + curve.error_m
    is_outside = (log.range_m < knots[0]) | (log.range_m > knots[-1])
    if len(log) and (outside := float(np.mean(is_outside))) > _MUCH_OUTSIDE:
        notes.append(
            f"{100 * outside:.0f} % of the ranges are shorter or longer than the {curve.distance_m[0]:.2f} to "
            f"{curve.distance_m[-1]:.2f} m at which the error curve was learnt: they weigh less"
        )
    return replace(log, range_m=distance, shared_stddev_m=stddev), notes


def write_error_curve(curve: ErrorCurve, path: AnyPath) -> None:
    """Write a table with columns ``distance_m,error_m,stddev_m,noise_stddev_m``."""
    rows = np.column_stack([curve.distance_m, curve.error_m, curve.stddev_m, curve.noise_stddev_m])
    write_table(Path(path), COLUMNS, ([f"{value:.5f}" for value in row] for row in rows.tolist()))


def is_error_curve_file(head: str) -> bool:
    """Return True if a file that begins like this is an error curve."""
    return has_columns(head, COLUMNS)


def read_error_curve(path: AnyPath) -> ErrorCurve:
    """Read a file in the format of ``write_error_curve``.

    Raises:
        InputError: with the line, for distances that do not ascend, negative stddevs, and a curve so steep
            that two distances would give the same range.
    """
    table = read_table(path, COLUMNS[:3], COLUMNS[3:], separator=FOUND)
    if len(table) < 2:
        raise InputError(f"has {len(table)} distances, expected two or more", path)
    distance, error = table.numbers("distance_m", bounds=LENGTH_M), table.numbers("error_m", bounds=BIAS_M)
    stddev = table.numbers("stddev_m", bounds=STDDEV_OR_EXACT_M)
    noise = table.numbers("noise_stddev_m", empty=0.0, bounds=STDDEV_OR_EXACT_M)
    table.refuse(np.diff(distance, prepend=0.0) <= 0, "distance_m", "more than the distance before it")
    too_steep = np.diff(distance + error, prepend=0.0) <= 0
    table.refuse(too_steep, "error_m", "one at which a longer distance gives a longer range")
    return ErrorCurve(distance, error, stddev, noise)
