"""ROS 1 and ROS 2 bags, through the optional package rosbags."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesfm.errors import InputError
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers.reader import Reader, Reading, ReadOptions, log_of_readings
from rangesfm.ranging.readers.roles import Sides

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_SQLITE = "SQLite format 3\0"
_BEGINS = ("#ROSBAG V", _SQLITE)
_MCAP = "MCAP0"
_BAG_TABLES = {"topics", "messages"}
_LED_NO_LINE_OF_SIGHT = 16


def is_bag_folder(path: Path) -> bool:
    """Whether this is the folder of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file()


def _recognizes(head: str) -> bool:
    return head.startswith(_BEGINS) or head[1:6] == _MCAP


def _read(path: Path, options: ReadOptions) -> RangeLog:
    options.check_no_table(path)
    if not path.exists():
        raise InputError("no such file", path)
    _check_database(path)
    try:
        from rosbags.highlevel import AnyReader
    except ImportError:
        raise InputError(
            "reading a ROS bag needs the package rosbags: python -m pip install 'rangesfm[ros]'", path
        ) from None
    try:
        with AnyReader([path]) as bag:
            readings = list(_readings(bag, path))
    except InputError:
        raise
    except Exception as error:  # whatever a broken bag makes its parsers do
        text = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot be read as a ROS bag ({text})", path) from error
    return log_of_readings(readings, path, READER.name)


def _check_database(path: Path) -> None:
    """Refuse SQLite databases that are no ROS 2 bag; there are many of other kinds, COLMAP's among them."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        if file.read(len(_SQLITE)) != _SQLITE.encode():
            return
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            tables = {str(name) for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except sqlite3.Error as error:
        raise InputError(f"cannot be read as a ROS bag ({error})", path) from error
    if not tables >= _BAG_TABLES:
        found = ", ".join(sorted(tables)[:3]) or "none"
        expected = " and ".join(sorted(_BAG_TABLES))
        raise InputError(f"an SQLite database that is no ROS 2 bag: it has tables {found}, expected {expected}", path)


def _readings(bag: AnyReader, path: Path) -> Iterator[Reading]:
    """The ranges in all messages that hold any, each with the 1-based number of its message as its line."""
    connections = [connection for connection in bag.connections if _type_name(connection.msgtype) in _RANGES_IN]
    if not connections:
        found = ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "no messages"
        raise InputError(f"no ranges in this bag; it has {found}, expected one of {', '.join(_RANGES_IN)}", path)
    for number, (connection, received_ns, data) in enumerate(bag.messages(connections), 1):
        message = bag.deserialize(data, connection.msgtype)
        try:
            readings = list(_RANGES_IN[_type_name(connection.msgtype)](message))
        except AttributeError as error:
            raise InputError(f"a {connection.msgtype} has another definition than expected ({error})", path) from None
        for reading in readings:
            yield reading._replace(timestamp_s=reading.timestamp_s or received_ns * 1e-9, line=number)


def _type_name(message_type: str) -> str:
    return message_type.rpartition("/")[2]


def _range_stamped(message: Any) -> Iterator[Reading]:
    yield _stamped(message, message.to_id, message.range, message.from_id, _root(message.covariance))


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


# By the last part of the type's name: any package may define it. A time of 0 is none, that of receiving counts.
_RANGES_IN: dict[str, Callable[[Any], Iterator[Reading]]] = {
    "RangeStamped": _range_stamped,
    "TwoWayRangeStamped": _two_way_range_stamped,
    "UwbRange": _uwb_range,
    "LinktrackNodeframe2": _linktrack_nodeframe,
    "LinktrackNodeframe3": _linktrack_nodeframe,
    "LinktrackTagframe0": _linktrack_tagframe,
}


def _stamped(message: Any, anchor_id: Any, range_m: Any, tag_id: Any, stddev_m: Any, los: int = -1) -> Reading:
    """At the time of the header, 0 if nobody set it."""
    stamp = message.header.stamp
    time_s = float(stamp.sec + stamp.nanosec * 1e-9)
    return Reading(time_s, str(anchor_id), float(range_m), 0, str(tag_id), float(stddev_m), los)


def _root(variance: float) -> float:
    return math.sqrt(variance) if variance > 0 else math.nan


def _character(value: int | str) -> str:
    return value if isinstance(value, str) else chr(value)


READER = Reader("ros", _recognizes, _read, sides=Sides.ASKED)
