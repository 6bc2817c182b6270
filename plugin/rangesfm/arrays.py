"""Types of numpy arrays by the kind of number they hold, and the rows of arrays that belong together.

The shape of an array is said where it is used.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


def rows_by_key(*keys: Indices) -> list[Indices]:
    """Return the rows that agree in all keys, group by group, in the order of the keys; the first one counts most.

    Args:
        keys: each (n,).
    """
    order = np.lexsort(keys[::-1])
    starts = np.flatnonzero(np.any(np.diff(np.stack(keys)[:, order]) != 0, axis=0)) + 1
    return np.split(order, starts) if len(order) else []


def rms(values: Array) -> float:
    """Return the root mean square of values, or NaN where there are none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def median(values: Array) -> float:
    """Return the median of values, or NaN where there are none."""
    return float(np.median(values)) if len(values) else np.nan
