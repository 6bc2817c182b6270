"""Ranges in ROS 1 and ROS 2 bags."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers.reader import EndpointRoles
from rangesfm.measurements.ranges.readers.readings import Reading, reader_of_readings
from rangesfm.options import RangesOptions
from rangesfm.util.files.bags import SQLITE_HEAD, connections_of, messages_of, open_bag, stamp_s, type_name, types_in

_BEGINS = ("#ROSBAG V", SQLITE_HEAD)
_MCAP = "MCAP0"
_LED_NO_LINE_OF_SIGHT = 16


def _readings(path: Path, options: RangesOptions) -> Iterator[Reading]:
    """Yield the ranges in all messages, each with the 1-based number of its message as its line."""
    with open_bag(path) as bag:
        connections = connections_of(bag, _RANGES_IN)
        if not connections:
            expected = f"expected one of {', '.join(_RANGES_IN)}"
            raise InputError(f"no ranges in this bag; it has {types_in(bag)}, {expected}", path)
        for number, (kind, message, received_s) in enumerate(messages_of(bag, connections), 1):
            try:
                readings = list(_RANGES_IN[type_name(kind)](message))
            except AttributeError as error:
                raise InputError(f"a {kind} has another definition than expected ({error})", path) from None
            for reading in readings:
                yield reading._replace(timestamp_s=reading.timestamp_s or received_s, line=number)


def _two_way_range_stamped(message: Any) -> Iterator[Reading]:
    range_m = message.range_corr if message.range_corr > 0 else message.range_raw
    tag_id, anchor_id = message.UWB_ID1, message.UWB_ID2
    if _character(message.type_ID1) == "A" and _character(message.type_ID2) != "A":
        tag_id, anchor_id = anchor_id, tag_id
    yield _stamped(message, anchor_id, range_m, tag_id, _root(message.R), int(bool(message.LOS)))


def _uwb_range(message: Any) -> Iterator[Reading]:
    los = 0 if _LED_NO_LINE_OF_SIGHT in (message.requester_LED_flag, message.responder_LED_flag) else -1
    ids = message.responder_id, message.requester_id
    yield _stamped(message, ids[0], message.distance, ids[1], message.distance_err, los)


def _linktrack_nodeframe(message: Any) -> Iterator[Reading]:
    for node in message.nodes:
        yield Reading(0.0, str(node.id), float(node.dis), tag_id=str(message.id))


def _linktrack_tagframe(message: Any) -> Iterator[Reading]:
    for slot, range_m in enumerate(message.dis_arr):
        yield Reading(0.0, str(slot), float(range_m), tag_id=str(message.id))


# Functions that return the ranges of a message, by its type. A time of 0 is not set, and the time of arrival is used.
_RANGES_IN: dict[str, Callable[[Any], Iterable[Reading]]] = {
    "RangeStamped": lambda each: [_stamped(each, each.to_id, each.range, each.from_id, _root(each.covariance))],
    "TwoWayRangeStamped": _two_way_range_stamped,
    "UwbRange": _uwb_range,
    "LinktrackNodeframe2": _linktrack_nodeframe,
    "LinktrackNodeframe3": _linktrack_nodeframe,
    "LinktrackTagframe0": _linktrack_tagframe,
}


def _stamped(message: Any, anchor_id: Any, range_m: Any, tag_id: Any, stddev_m: Any, los: int = -1) -> Reading:
    return Reading(stamp_s(message), str(anchor_id), float(range_m), 0, str(tag_id), float(stddev_m), los)


def _root(variance: float) -> float:
    return math.sqrt(variance) if variance > 0 else math.nan


def _character(value: int | str) -> str:
    return value if isinstance(value, str) else chr(value)


READER = reader_of_readings(
    "ros", lambda head: head.startswith(_BEGINS) or head[1:6] == _MCAP, _readings, roles=EndpointRoles.ASKER_AND_ASKED
)
