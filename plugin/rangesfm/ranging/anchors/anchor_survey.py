"""All anchors of a log, each placed on its own by ranges taken at known positions of the tag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangesfm.errors import GeometryError
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.trilateration import Trilateration, TrilaterationOptions, trilaterate
from rangesfm.ranging.errors.noise import shared_stddev
from rangesfm.ranging.log import RangeLog


@dataclass(frozen=True)
class AnchorPlacement:
    """What trilateration says of one anchor.

    Attributes:
        anchor_id: as in the log.
        num_ranges: its ranges at known positions of the tag.
        found: where it stands; None if that is not determined.
        why_not: the reason then; else None.
    """

    anchor_id: str
    num_ranges: int
    found: Trilateration | None
    why_not: str | None

    @property
    def anchor(self) -> Anchor:
        """For an anchors' file: without a position if there is none, or if there are two."""
        if self.found is None:
            return Anchor(self.anchor_id)
        bias = (self.found.range_bias_m, self.found.range_bias_stddev_m)
        if self.found.mirror_position_m is not None:
            return Anchor(self.anchor_id, None, 0.0, *bias)
        return Anchor(self.anchor_id, self.found.position_m, self.found.position_stddev_m, *bias)


def trilaterate_anchors(
    log: RangeLog,
    tag_positions_m: npt.NDArray[np.float64],
    *,
    toward: Mapping[str, Sequence[float]] | None = None,
    options: TrilaterationOptions | None = None,
) -> tuple[AnchorPlacement, ...]:
    """Place every anchor of a log.

    Args:
        log: n ranges.
        tag_positions_m: (n, 3) where the tag was at each; NaN where unknown (see ``tag_positions``).
        toward: by anchor, the direction in which it lies of two places that fit alike (see ``trilaterate``).

    Returns:
        one placement for each anchor, in the order of the log.
    """
    known = np.isfinite(tag_positions_m).all(axis=1)
    return tuple(
        _place(log, anchor_id, np.flatnonzero(known & (log.anchor_index == k)), tag_positions_m, toward, options)
        for k, anchor_id in enumerate(log.anchor_ids)
    )


def _place(
    log: RangeLog,
    anchor_id: str,
    rows: npt.NDArray[np.int64],
    tag_positions_m: npt.NDArray[np.float64],
    toward: Mapping[str, Sequence[float]] | None,
    options: TrilaterationOptions | None,
) -> AnchorPlacement:
    try:
        found = trilaterate(
            tag_positions_m[rows],
            log.range_m[rows],
            range_stddev_m=log.range_stddev_m[rows],
            shared_stddev_m=shared_stddev(log)[rows],
            timestamp_s=None if log.timestamp_s is None else log.timestamp_s[rows],
            toward=None if toward is None else toward.get(anchor_id),
            options=options,
        )
    except GeometryError as error:
        return AnchorPlacement(anchor_id, len(rows), None, str(error))
    return AnchorPlacement(anchor_id, len(rows), found, None)
