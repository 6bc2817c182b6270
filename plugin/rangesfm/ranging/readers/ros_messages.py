"""The ROS messages that hold ranges, by the last part of their type's name; any package may define them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

_LED_NO_LINE_OF_SIGHT = 16


class MessageRange(NamedTuple):
    """A range in a message; the sides may be swapped; ``time_s`` is None where the message has none of its own."""

    time_s: float | None
    tag_id: str
    anchor_id: str
    range_m: float
    range_stddev_m: float = math.nan
    los: int = -1


def _range_stamped(message: Any) -> Iterator[MessageRange]:
    yield MessageRange(
        _header_time_s(message), str(message.from_id), str(message.to_id), message.range, _root(message.covariance)
    )


def _two_way_range_stamped(message: Any) -> Iterator[MessageRange]:
    range_m = message.range_corr if message.range_corr > 0 else message.range_raw
    ids = str(message.UWB_ID1), str(message.UWB_ID2)
    if _character(message.type_ID1) == "A" and _character(message.type_ID2) != "A":
        ids = ids[1], ids[0]
    yield MessageRange(_header_time_s(message), *ids, range_m, _root(message.R), int(bool(message.LOS)))


def _uwb_range(message: Any) -> Iterator[MessageRange]:
    flags = (message.requester_LED_flag, message.responder_LED_flag)
    yield MessageRange(
        _header_time_s(message),
        str(message.requester_id),
        str(message.responder_id),
        message.distance,
        message.distance_err,
        0 if _LED_NO_LINE_OF_SIGHT in flags else -1,
    )


def _linktrack_nodeframe(message: Any) -> Iterator[MessageRange]:
    for node in message.nodes:
        yield MessageRange(None, str(message.id), str(node.id), node.dis)


def _linktrack_tagframe(message: Any) -> Iterator[MessageRange]:
    for slot, range_m in enumerate(message.dis_arr):
        yield MessageRange(None, str(message.id), str(slot), range_m)


RANGES_IN: dict[str, Callable[[Any], Iterator[MessageRange]]] = {
    "RangeStamped": _range_stamped,
    "TwoWayRangeStamped": _two_way_range_stamped,
    "UwbRange": _uwb_range,
    "LinktrackNodeframe2": _linktrack_nodeframe,
    "LinktrackNodeframe3": _linktrack_nodeframe,
    "LinktrackTagframe0": _linktrack_tagframe,
}


def _header_time_s(message: Any) -> float | None:
    """None for a stamp that nobody set."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec * 1e-9) or None


def _root(variance: float) -> float:
    return math.sqrt(variance) if variance > 0 else math.nan


def _character(value: int | str) -> str:
    return value if isinstance(value, str) else chr(value)
