"""What gravity adds, in words, where the site's anchors do not fix the map's heading."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesfm.geometry.gravity import Gravity
from rangesfm.ranging.anchors.anchor import Anchor, AnchorEstimate


def levelled_places(gravity: Gravity, surveyed: Sequence[Anchor], found: Sequence[AnchorEstimate]) -> tuple[str, ...]:
    """In words, what gravity adds where the site's anchors do not fix the map's heading.

    Args:
        surveyed: in the site frame. found: in the first camera's frame.
    """
    height_of = {anchor.anchor_id: anchor.position_m[2] for anchor in surveyed if anchor.position_m is not None}
    texts = []
    for anchor in found:
        if anchor.anchor_id not in height_of or not np.isfinite(anchor.position_m).all():
            continue
        wheres = []
        for place in (anchor.position_m, anchor.mirror_position_m):
            if place is not None:
                rise = float(place @ gravity.up_in_first_camera)
                away = float(np.linalg.norm(place - rise * gravity.up_in_first_camera))
                wheres.append(f"at site height {height_of[anchor.anchor_id] - rise:.2f} m, {away:.2f} m horizontally")
        # On the path's plane an anchor is its own mirror image.
        where = " or ".join(dict.fromkeys(wheres))
        texts.append(
            f"the first camera was {where} from anchor {anchor.anchor_id}; in which direction is not determined"
        )
    return tuple(texts)
