"""ROS 1 and ROS 2 bags, opened through the optional package rosbags."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesfm.errors import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

SQLITE_HEAD = "SQLite format 3\0"
_ROS2 = (".mcap", ".db3")
_BAG_TABLES = {"topics", "messages"}


def is_bag_folder(path: Path) -> bool:
    """Whether this is the folder of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file() and any(any(path.glob(f"*{end}*")) for end in _ROS2)


def is_bag(path: Path) -> bool:
    """Whether it is called as a file of a bag, or is the folder of one."""
    return path.suffix.lower() in (".bag", *_ROS2) or is_bag_folder(path)


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """Yield the bag; whatever goes wrong with it, also inside the block, or without rosbags, becomes an InputError."""
    if not path.exists():
        raise InputError("no such file", path)
    _check_database(path)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            "reading a ROS bag needs the package rosbags: python -m pip install 'rangesfm[ros]'", path
        ) from None
    try:
        # ROS 2 bags of before 2023 do not say what their messages are made of.
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            yield bag
    except InputError:
        raise
    except Exception as error:  # whatever a broken bag makes its parsers do
        text = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot be read as a ROS bag ({text})", path) from error


def messages_of(bag: AnyReader, connections: Sequence[Connection]) -> Iterator[tuple[str, Any, float]]:
    """Type, content and time of arrival in seconds of each message, in their order."""
    for connection, received_ns, data in bag.messages(connections):
        yield connection.msgtype, bag.deserialize(data, connection.msgtype), received_ns * 1e-9


def stamp_s(message: Any) -> float:
    """The time in the header of a message; 0 if nobody set it."""
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)


def type_name(message_type: str) -> str:
    """The last part, without the package that defines it."""
    return message_type.rpartition("/")[2]


def _check_database(path: Path) -> None:
    """Refuse SQLite databases that are no ROS 2 bag; there are many of other kinds, COLMAP's among them."""
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
        raise InputError(f"an SQLite database that is no ROS 2 bag: it has tables {found}, expected {expected}", path)
