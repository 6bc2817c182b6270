"""When measurements were taken: at times of a clock, or at photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices


@dataclass(frozen=True)
class ByTime:
    """n moments by a clock.

    Attributes:
        timestamp_s: (n,) seconds.
    """

    timestamp_s: Array

    def __len__(self) -> int:
        return len(self.timestamp_s)

    @property
    def image_name(self) -> tuple[str, ...]:
        """n empty texts, as a table has them in its column of photos."""
        return ("",) * len(self)

    @property
    def sort_keys(self) -> Array:
        """Numbers (n,) that sort the moments: the times."""
        return self.timestamp_s

    def subset(self, rows: Indices) -> ByTime:
        """Return some of the moments."""
        return ByTime(self.timestamp_s[rows])

    def later(self, offset_s: float | Array) -> ByTime:
        """Return the moments on a clock that shows a later time, by one offset or (n,)."""
        return ByTime(self.timestamp_s + offset_s)


@dataclass(frozen=True)
class ByPhoto:
    """n moments by the photos that were taken then.

    Attributes:
        image_name: names of the n photos.
    """

    image_name: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.image_name)

    @property
    def timestamp_s(self) -> Array:
        """(n,) NaN, as a table has them in its column of times."""
        return np.full(len(self), np.nan)

    @property
    def sort_keys(self) -> Array:
        """Numbers (n,) that sort the moments: those of the photos in the order of their names."""
        return np.unique(np.array(self.image_name, dtype=str), return_inverse=True)[1].astype(np.float64)

    def subset(self, rows: Indices) -> ByPhoto:
        """Return some of the moments."""
        return ByPhoto(tuple(self.image_name[row] for row in rows.tolist()))

    def later(self, offset_s: float | Array) -> ByPhoto:
        """Return the same moments: photos have no clock."""
        return self


Moments = ByTime | ByPhoto
"""When n measurements were taken; a log is by time or by photo as a whole."""
