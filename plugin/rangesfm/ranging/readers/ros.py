"""ROS 1 and ROS 2 bags, through the optional package rosbags."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.errors import InputError
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers.printed import check_only_time_is_described
from rangesfm.ranging.readers.reader import Reader, ReadOptions
from rangesfm.ranging.readers.records import Records
from rangesfm.ranging.readers.roles import Sides
from rangesfm.ranging.readers.ros_messages import RANGES_IN, MessageRange

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_SQLITE = "SQLite format 3\0"
_BEGINS = ("#ROSBAG V", _SQLITE)
_MCAP = "MCAP0"
_BAG_TABLES = {"topics", "messages"}


def is_bag_folder(path: Path) -> bool:
    """Whether this is the folder of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file()


def _recognizes(head: str) -> bool:
    return head.startswith(_BEGINS) or head[1:6] == _MCAP


def _read(path: Path, options: ReadOptions) -> RangeLog:
    check_only_time_is_described(path, options)
    if not path.exists():
        raise InputError("no such file", path)
    _check_database(path)
    try:
        from rosbags.highlevel import AnyReader
    except ImportError:
        raise InputError(
            "reading a ROS bag needs the package rosbags: python -m pip install 'rangesfm[ros]'", path
        ) from None
    number, ranges = [], []
    try:
        with AnyReader([path]) as bag:
            for message_number, found in _ranges(bag, path):
                number.append(message_number)
                ranges.append(found)
    except InputError:
        raise
    except Exception as error:  # whatever a broken bag makes its parsers do
        text = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot be read as a ROS bag ({text})", path) from error
    return _to_log(path, number, ranges)


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


def _ranges(bag: AnyReader, path: Path) -> Iterator[tuple[int, MessageRange]]:
    """The ranges in all messages that hold any, each with the 1-based number of its message."""
    connections = [connection for connection in bag.connections if _type_name(connection.msgtype) in RANGES_IN]
    if not connections:
        found = ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "no messages"
        raise InputError(f"no ranges in this bag; it has {found}, expected one of {', '.join(RANGES_IN)}", path)
    for number, (connection, received_ns, data) in enumerate(bag.messages(connections), 1):
        message = bag.deserialize(data, connection.msgtype)
        try:
            found_ranges = list(RANGES_IN[_type_name(connection.msgtype)](message))
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


def _type_name(message_type: str) -> str:
    return message_type.rpartition("/")[2]


READER = Reader("ros", f"ROS 1 or ROS 2 bag with {', '.join(RANGES_IN)}", _recognizes, _read, sides=Sides.ASKED)
