"""Which of the two nodes of a range is the tag: either may have asked for it."""

from __future__ import annotations

from collections.abc import Collection


def tag_and_anchor(
    tag_id: list[str], anchor_id: list[str], known_anchor_ids: Collection[str]
) -> tuple[list[str], list[str]]:
    """Put every range's tag and anchor in their places.

    Known anchors decide. Without any, one node on the anchors' side that ranges with several on the
    tags' side is the tag, since anchors are many and tags few.

    Returns:
        tag_id and anchor_id, swapped where they stood the wrong way round.
    """
    if known_anchor_ids:
        swapped = [anchor not in known_anchor_ids and tag in known_anchor_ids for tag, anchor in zip(tag_id, anchor_id)]
    else:
        swapped = [len(set(anchor_id)) == 1 and len(set(tag_id)) > 1] * len(tag_id)
    if not any(swapped):
        return tag_id, anchor_id
    pairs = [(a, t) if swap else (t, a) for t, a, swap in zip(tag_id, anchor_id, swapped)]
    return [tag for tag, _ in pairs], [anchor for _, anchor in pairs]
