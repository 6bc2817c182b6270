"""All anchors of a log, placed by ranges taken at known positions of the tag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.trilateration import (
    AnchorRanges,
    Trilateration,
    TrilaterationOptions,
    trilaterate_together,
)
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
    tag_positions_m: Array,
    *,
    toward: Mapping[str, Sequence[float]] | None = None,
    height_m: Mapping[str, float] | None = None,
    options: TrilaterationOptions | None = None,
) -> tuple[AnchorPlacement, ...]:
    """Place every anchor of a log; what the ranges get wrong is learnt from all of them together.

    Args:
        log: n ranges.
        tag_positions_m: (n, 3) where the tag was at each; NaN where unknown (see ``tag_positions``).
        toward: by anchor, the direction in which it lies of two places that fit alike (see ``trilaterate``).
        height_m: by anchor, its z where that is known.

    Returns:
        one placement for each anchor, in the order of the log.
    """
    known = np.isfinite(tag_positions_m).all(axis=1)
    rows = [np.flatnonzero(known & (log.anchor_index == k)) for k in range(len(log.anchor_ids))]
    anchors = [
        AnchorRanges(
            tag_positions_m[own],
            log.range_m[own],
            range_stddev_m=log.range_stddev_m[own],
            shared_stddev_m=None if log.shared_stddev_m is None else log.shared_stddev_m[own],
            timestamp_s=None if log.timestamp_s is None else log.timestamp_s[own],
            tag_index=log.tag_index[own],
            toward=None if toward is None or anchor_id not in toward else np.asarray(toward[anchor_id], np.float64),
            height_m=None if height_m is None else height_m.get(anchor_id),
        )
        for anchor_id, own in zip(log.anchor_ids, rows, strict=True)
    ]
    results = trilaterate_together(anchors, options or TrilaterationOptions())
    return tuple(
        AnchorPlacement(anchor_id, len(own), None, str(found))
        if isinstance(found, GeometryError)
        else AnchorPlacement(anchor_id, len(own), found, None)
        for anchor_id, own, found in zip(log.anchor_ids, rows, results, strict=True)
    )
