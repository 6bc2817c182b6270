"""Reader: the reader of one log format, the log made of its ranges, and the distinction of anchors and tags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import RangesOptions


class EndpointRoles(Enum):
    """Meaning of the two ends of a range in a log format."""

    ASKER_AND_ASKED = "who asked whom"
    TAG_AND_ANCHOR = "a side for tags and one for anchors, where a peer may stand on the other's side"
    NUMBERED_APART = "tags and anchors, each numbered by themselves"


@dataclass(frozen=True)
class Reader:
    """Reader of one log format. ``read`` and ``read_anchors`` raise InputError if the file is not valid.

    Attributes:
        name: name by which the user asks for the format.
        recognizes: returns whether the beginning of a file has this format.
        read_anchors: returns the anchors whose positions the log contains.
        roles: what the log says about the two ends of a range.
    """

    name: str
    recognizes: Callable[[str], bool]
    read: Callable[[Path, RangesOptions], RangeLog]
    read_anchors: Callable[[Path], tuple[Anchor, ...]] = lambda path: ()
    roles: EndpointRoles = EndpointRoles.TAG_AND_ANCHOR


def tell_roles(
    log: RangeLog,
    roles: EndpointRoles,
    *,
    known_anchor_ids: Collection[str] = (),
    known_tag_ids: Collection[str] = (),
) -> RangeLog:
    """Return the log with every node as an anchor or a tag, and with ranges between two anchors or two tags.

    Known anchors and tags are decisive. A node that is always on one side has the role of that side, except a node that
    only known anchors range with, which is a tag. A node on both roles is a tag if the anchors are known, and an anchor
    if the tags are known and the sides mean nothing. Otherwise it has its role in most ranges. If an id ranges with
    itself, or is known as both, tags and anchors are numbered separately, and the sides are the roles.

    Args:
        log: log as read, with all ranges between the tag and the anchor of their record.
        roles: meaning of the two sides of a record.
        known_anchor_ids, known_tag_ids: ids of known anchors and tags.
    """
    known_anchors, known_tags = set(known_anchor_ids), set(known_tag_ids)
    tags, anchors = set(log.tag_ids), set(log.anchor_ids)
    if roles is EndpointRoles.NUMBERED_APART or known_anchors & known_tags:
        return log
    if not (tags & anchors or tags & known_anchors or anchors & known_tags):
        is_hub = len(anchors) == 1 and len(tags) > 1 and not (known_anchors or known_tags)
        # One node that many others range with is the tag, because there are more anchors than tags.
        return log.with_anchors(tags) if roles is EndpointRoles.ASKER_AND_ASKED and is_hub else log
    asked = Counter(zip(log.tag_index.tolist(), log.anchor_index.tolist()))
    num_by_pair = {(log.tag_ids[tag], log.anchor_ids[anchor]): num for (tag, anchor), num in asked.items()}
    if any(tag == anchor for tag, anchor in num_by_pair):
        return log
    if roles is EndpointRoles.ASKER_AND_ASKED and known_tags and not known_anchors:
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
