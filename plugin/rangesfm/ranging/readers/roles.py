"""Which nodes of a log are anchors and which are tags: either may have asked for a range, also of its own kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from enum import Enum

from rangesfm.ranging.log import RangeLog


class Sides(Enum):
    """What a log format says of the two ends of a range."""

    ASKED = "who asked whom"
    TOLD = "a side for tags and one for anchors, where a peer may stand on the other's side"
    APART = "tags and anchors, each numbered by themselves"


def tell_roles(
    log: RangeLog,
    sides: Sides,
    *,
    known_anchor_ids: Collection[str] = (),
    known_tag_ids: Collection[str] = (),
) -> RangeLog:
    """Put every range's tag and anchor in their places, and tell those between two of a kind.

    What is known decides. A node that stands on one side only has the role of that side, but for one that only
    known anchors range with: it is a tag. One on both sides is a tag where the anchors are known, an anchor where
    the tags are known and sides mean nothing; else it is what it is in most ranges. Where an id ranges with itself,
    or is known as both, tags and anchors are numbered by themselves, and their sides count.

    Args:
        log: as read: all ranges between the tag and the anchor of their record.
        sides: what these mean.
        known_anchor_ids, known_tag_ids: as far as anybody said.
    """
    known_anchors, known_tags = set(known_anchor_ids), set(known_tag_ids)
    tags, anchors = set(log.tag_ids), set(log.anchor_ids)
    if sides is Sides.APART or known_anchors & known_tags:
        return log
    if not (tags & anchors or tags & known_anchors or anchors & known_tags):
        is_hub = len(anchors) == 1 and len(tags) > 1 and not (known_anchors or known_tags)
        # Anchors are many and tags few.
        return log.with_anchors(tags) if sides is Sides.ASKED and is_hub else log
    asked = Counter(zip(log.tag_index.tolist(), log.anchor_index.tolist()))
    num_by_pair = {(log.tag_ids[tag], log.anchor_ids[anchor]): num for (tag, anchor), num in asked.items()}
    if any(tag == anchor for tag, anchor in num_by_pair):
        return log
    if sides is Sides.ASKED and known_tags and not known_anchors:
        return log.with_anchors((tags | anchors) - known_tags)
    return log.with_anchors(
        {node for node in tags | anchors if _is_anchor(node, num_by_pair, known_anchors, known_tags)}
    )


def _is_anchor(
    node: str, num_by_pair: dict[tuple[str, str], int], known_anchors: set[str], known_tags: set[str]
) -> bool:
    if node in known_anchors or node in known_tags:
        return node in known_anchors
    num_as_tag = sum(num for (tag, _), num in num_by_pair.items() if tag == node)
    num_as_anchor = {tag: num for (tag, anchor), num in num_by_pair.items() if anchor == node}
    if known_anchors:
        return num_as_tag == 0 and not num_as_anchor.keys() <= known_anchors
    return sum(num_as_anchor.values()) >= num_as_tag
