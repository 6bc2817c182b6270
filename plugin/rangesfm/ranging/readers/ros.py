"""Ranges in ROS 1 and ROS 2 bags."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.errors import InputError
from rangesfm.files.bags import SQLITE_HEAD, open_bag, type_name
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers.printed import check_only_time_is_described
from rangesfm.ranging.readers.reader import Reader, ReadOptions
from rangesfm.ranging.readers.records import Records
from rangesfm.ranging.readers.roles import Sides
from rangesfm.ranging.readers.ros_messages import RANGES_IN, MessageRange

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_BEGINS = ("#ROSBAG V", SQLITE_HEAD)
_MCAP = "MCAP0"


def _recognizes(head: str) -> bool:
    return head.startswith(_BEGINS) or head[1:6] == _MCAP


def _read(path: Path, options: ReadOptions) -> RangeLog:
    check_only_time_is_described(path, options)
    number, ranges = [], []
    with open_bag(path) as bag:
        for message_number, found in _ranges(bag, path):
            number.append(message_number)
            ranges.append(found)
    return _to_log(path, number, ranges)


def _ranges(bag: AnyReader, path: Path) -> Iterator[tuple[int, MessageRange]]:
    """The ranges in all messages that hold any, each with the 1-based number of its message."""
    connections = [connection for connection in bag.connections if type_name(connection.msgtype) in RANGES_IN]
    if not connections:
        found = ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "no messages"
        raise InputError(f"no ranges in this bag; it has {found}, expected one of {', '.join(RANGES_IN)}", path)
    for number, (connection, received_ns, data) in enumerate(bag.messages(connections), 1):
        message = bag.deserialize(data, connection.msgtype)
        try:
            found_ranges = list(RANGES_IN[type_name(connection.msgtype)](message))
        except AttributeError as error:
            raise InputError(f"a {connection.msgtype} has another definition than expected ({error})", path) from None
        for found_range in found_ranges:
            yield number, found_range._replace(time_s=found_range.time_s or received_ns * 1e-9)


def _to_log(path: Path, number: list[int], ranges: list[MessageRange]) -> RangeLog:
    records = Records()
    for message_number, found in zip(number, ranges):
        records.add(
            found.time_s or 0.0,
            found.anchor_id,
            float(found.range_m),
            message_number,
            tag_id=found.tag_id,
            range_stddev_m=float(found.range_stddev_m or math.nan),
            los=found.los,
        )
    return records.to_log(path, READER.name)


READER = Reader("ros", f"ROS 1 or ROS 2 bag with {', '.join(RANGES_IN)}", _recognizes, _read, sides=Sides.ASKED)
