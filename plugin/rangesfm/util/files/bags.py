"""ROS 1 and ROS 2 bags, opened through the optional package rosbags."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesfm.errors import InputError
from rangesfm.installed_versions import missing_extra

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

SQLITE_HEAD = "SQLite format 3\0"
_ROS2 = (".mcap", ".db3")
_BAG_TABLES = {"topics", "messages"}


def is_bag_folder(path: Path) -> bool:
    """Return whether this is the folder of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file() and any(any(path.glob(f"*{end}*")) for end in _ROS2)


def is_bag(path: Path) -> bool:
    """Return whether a path has a file name ending of a bag, or is the folder of a ROS 2 bag."""
    return path.suffix.lower() in (".bag", *_ROS2) or is_bag_folder(path)


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag for the duration of the block.

    Raises:
        InputError: the bag cannot be read, also inside the block, or the package rosbags is missing.
    """
    if not path.exists():
        raise InputError("no such file", path)
    _check_database(path)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_extra("reading a ROS bag needs the package rosbags", "ros", path) from None
    try:
        # ROS 2 bags from before 2023 do not contain the definitions of their messages.
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            yield bag
    except InputError:
        raise
    except Exception as error:  # a broken bag makes the parsers raise errors of all kinds
        text = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot be read as a ROS bag ({text})", path) from error


def connections_of(bag: AnyReader, types: Collection[str]) -> list[Connection]:
    """Return the connections of a bag with messages of some types, which are named without their packages.

    Any package may define such a type.
    """
    return [connection for connection in bag.connections if type_name(connection.msgtype) in types]


def types_in(bag: AnyReader) -> str:
    """Return the types of all messages in a bag, for messages to the user."""
    return ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "no messages"


def messages_of(bag: AnyReader, connections: Sequence[Connection]) -> Iterator[tuple[str, Any, float]]:
    """Yield the type, content and time of arrival (in seconds) of each message, in their order."""
    for connection, received_ns, data in bag.messages(connections):
        yield connection.msgtype, bag.deserialize(data, connection.msgtype), received_ns * 1e-9


def stamp_s(message: Any) -> float:
    """Return the time in a message's header in seconds; 0 if it was not set."""
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)


def type_name(message_type: str) -> str:
    """Return the name of a message type without its package."""
    return message_type.rpartition("/")[2]


def _check_database(path: Path) -> None:
    """Refuse SQLite databases that are not ROS 2 bags, COLMAP's for example."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        if file.read(len(SQLITE_HEAD)) != SQLITE_HEAD.encode():
            return
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            tables = {str(name) for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except sqlite3.Error as error:
        raise InputError(f"cannot be read as a ROS bag ({error})", path) from error
    if not tables >= _BAG_TABLES:
        found = ", ".join(sorted(tables)[:3]) or "none"
        expected = " and ".join(sorted(_BAG_TABLES))
        raise InputError(f"is an SQLite database but no ROS 2 bag: it has tables {found}, expected {expected}", path)
