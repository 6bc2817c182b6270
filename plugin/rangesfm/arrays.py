"""Types of numpy arrays by the kind of number they hold, and the rows of arrays that belong together.

The shape of an array is said where it is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Categories:
    """n texts with few different values.

    Attributes:
        names: the different texts, in order of first appearance.
        index: (n,) index of each text in ``names``.
    """

    names: tuple[str, ...]
    index: Indices

    @classmethod
    def from_texts(cls, texts: Sequence[str]) -> Categories:
        index_of = {text: index for index, text in enumerate(dict.fromkeys(texts))}
        return cls(tuple(index_of), np.fromiter(map(index_of.__getitem__, texts), np.int64, len(texts)))

    def subset(self, rows: Mask) -> Categories:
        """Return the texts of the rows that are true in ``rows`` (n,), without the names that they do not use."""
        if rows.all():
            return self
        chosen = self.index[rows]
        used, first = np.unique(chosen, return_index=True)
        order = used[np.argsort(first)]
        rank = np.zeros(len(self.names), dtype=np.int64)
        rank[order] = np.arange(len(order))
        return Categories(tuple(self.names[k] for k in order.tolist()), rank[chosen])


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
