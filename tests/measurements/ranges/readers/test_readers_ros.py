"""Ranges in ROS 1 and ROS 2 bags."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import read_ranges

DEFINITIONS = {
    "uwb_ros/msg/RangeStamped": "std_msgs/Header header\nfloat32 range\nuint8 from_id\nuint8 to_id\nfloat32 covariance",
    "uwb_msgs/msg/TwoWayRangeStamped": (
        "std_msgs/Header header\nfloat64 range_raw\nfloat64 range_corr\nfloat64 R\n"
        "uint32 UWB_ID1\nuint32 UWB_ID2\nchar type_ID1\nchar type_ID2\nbool LOS"
    ),
    "uwb_driver/msg/UwbRange": (
        "std_msgs/Header header\nuint8 requester_id\nuint8 responder_id\nuint8 requester_LED_flag\n"
        "uint8 responder_LED_flag\nfloat32 distance\nfloat32 distance_err"
    ),
    "nlink_parser/msg/LinktrackNode2": "uint8 role\nuint8 id\nfloat32 dis\nfloat32 fp_rssi\nfloat32 rx_rssi",
    "nlink_parser/msg/LinktrackNodeframe2": "uint8 role\nuint8 id\nuint32 local_time\nLinktrackNode2[] nodes",
    "nlink_parser/msg/LinktrackTagframe0": "uint8 role\nuint8 id\nfloat32[8] dis_arr",
    "other/msg/RangeStamped": "std_msgs/Header header\nfloat32 distance",
}
TYPES = {version: get_typestore(store) for version, store in ((1, Stores.ROS1_NOETIC), (2, Stores.ROS2_HUMBLE))}
for typestore in TYPES.values():
    for name, text in DEFINITIONS.items():
        typestore.register(get_types_from_msg(text, name))
RECEIVED_NS = 1_700_000_000_000_000_000


def message(version: int, name: str, **fields: Any) -> Any:
    """A message of that type; if it has a header, its stamp is 100.25 s."""
    types = TYPES[version].types
    if "std_msgs/Header header" in DEFINITIONS[name]:
        sequence = {"seq": 0} if version == 1 else {}
        stamp = types["builtin_interfaces/msg/Time"](sec=100, nanosec=250_000_000)
        fields["header"] = types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **sequence)
    return types[name](**fields)


def write_bag1(folder: Path, messages: list[tuple[str, Any]]) -> Path:
    path = folder / "log.bag"
    with Writer1(path) as writer:
        for number, (name, content) in enumerate(messages):
            topic = name.lower().replace("/msg", "")
            connections = {connection.topic: connection for connection in writer.connections}
            connection = connections.get(topic) or writer.add_connection(topic, name, typestore=TYPES[1])
            data = TYPES[1].serialize_ros1(content, name)
            writer.write(connection, RECEIVED_NS + number * 500_000_000, data)
    return path


def write_bag2(folder: Path, messages: list[tuple[str, Any]], plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    path = folder / "log"
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for number, (name, content) in enumerate(messages):
            topic = "/" + name.lower().replace("/msg", "")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=TYPES[2])
            data = TYPES[2].serialize_cdr(content, name)
            writer.write(connections[topic], RECEIVED_NS + number * 500_000_000, data)
    return path


WRITERS: dict[int, Callable[[Path, list[tuple[str, Any]]], Path]] = {1: write_bag1, 2: write_bag2}


def read_one(folder: Path, version: int, name: str, **fields: Any) -> RangeLog:
    log = read_ranges(WRITERS[version](folder, [(name, message(version, name, **fields))]))
    assert log.format == "ros"
    return log


@pytest.mark.parametrize("version", [1, 2])
def test_range_stamped(tmp_path: Path, version: int) -> None:
    log = read_one(tmp_path, version, "uwb_ros/msg/RangeStamped", range=2.5, from_id=10, to_id=3, covariance=0.04)
    assert (log.tag_ids, log.anchor_ids) == (("10",), ("3",))
    np.testing.assert_array_equal(log.timestamp_s, [100.25])
    np.testing.assert_array_equal(log.range_m, [2.5])
    np.testing.assert_allclose(log.range_stddev_m, [0.2], rtol=1e-6)


@pytest.mark.parametrize("version", [1, 2])
def test_two_way_range_stamped_knows_its_sides_and_its_line_of_sight(tmp_path: Path, version: int) -> None:
    log = read_one(
        tmp_path,
        version,
        "uwb_msgs/msg/TwoWayRangeStamped",
        range_raw=2.7,
        range_corr=2.5,
        R=0.01,
        UWB_ID1=5,
        UWB_ID2=9,
        type_ID1=ord("A"),
        type_ID2=ord("T"),
        LOS=False,
    )
    assert (log.tag_ids, log.anchor_ids) == (("9",), ("5",))
    np.testing.assert_array_equal(log.range_m, [2.5])
    np.testing.assert_array_equal(log.los, [0])


@pytest.mark.parametrize("version", [1, 2])
def test_uwb_range(tmp_path: Path, version: int) -> None:
    ids = {"requester_id": 200, "responder_id": 101}
    log = read_one(
        tmp_path,
        version,
        "uwb_driver/msg/UwbRange",
        **{**ids, "requester_LED_flag": 8, "responder_LED_flag": 16, "distance": 4.5, "distance_err": 0.0},
    )
    assert (log.tag_ids, log.anchor_ids, log.los.tolist()) == (("200",), ("101",), [0])
    assert np.isnan(log.range_stddev_m[0])


@pytest.mark.parametrize("version", [1, 2])
def test_linktrack_nodes_have_the_time_of_their_arrival(tmp_path: Path, version: int) -> None:
    node = TYPES[version].types["nlink_parser/msg/LinktrackNode2"]
    nodes = [node(role=1, id=k, dis=dis, fp_rssi=-80.0, rx_rssi=-79.0) for k, dis in enumerate((1.5, 0.0, 3.25))]
    log = read_one(tmp_path, version, "nlink_parser/msg/LinktrackNodeframe2", role=2, id=7, local_time=5, nodes=nodes)
    assert (log.tag_ids, log.anchor_ids, log.num_no_measurement) == (("7",), ("0", "2"), 1)
    np.testing.assert_array_equal(log.timestamp_s, [1.7e9, 1.7e9])


def test_linktrack_tag_frame_has_a_slot_for_each_anchor(tmp_path: Path) -> None:
    distances = np.array([1, 0, 0, 4, 0, 0, 0, 0], np.float32)
    log = read_one(tmp_path, 1, "nlink_parser/msg/LinktrackTagframe0", role=2, id=7, dis_arr=distances)
    assert log.anchor_ids == ("0", "3")


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_file_of_a_bag_is_read_without_its_folder(tmp_path: Path, plugin: StoragePlugin) -> None:
    name = "uwb_ros/msg/RangeStamped"
    content = message(2, name, range=2.5, from_id=10, to_id=3, covariance=0.0)
    folder = write_bag2(tmp_path, [(name, content)], plugin)
    (file,) = (path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    assert len(read_ranges(file)) == 1


def test_known_anchors_tell_the_tag(tmp_path: Path) -> None:
    name = "uwb_ros/msg/RangeStamped"
    messages = [(name, message(1, name, range=2.5, from_id=a, to_id=b, covariance=0.0)) for a, b in ((10, 3), (4, 10))]
    log = read_ranges(write_bag1(tmp_path, messages), anchor_ids=["3", "4"])
    assert (log.tag_ids, log.anchor_ids) == (("10",), ("3", "4"))


def test_bag_without_ranges_names_what_it_has(tmp_path: Path) -> None:
    name = "nlink_parser/msg/LinktrackNode2"
    content = message(1, name, role=1, id=2, dis=1.0, fp_rssi=0.0, rx_rssi=0.0)
    with pytest.raises(InputError, match=r"no ranges in this bag; it has nlink_parser/msg/LinktrackNode2, expected"):
        read_ranges(write_bag1(tmp_path, [(name, content)]))


def test_message_of_another_definition_is_refused(tmp_path: Path) -> None:
    name = "other/msg/RangeStamped"
    with pytest.raises(InputError, match=r"other/msg/RangeStamped has another definition"):
        read_ranges(write_bag1(tmp_path, [(name, message(1, name, distance=1.0))]))


@pytest.mark.parametrize(
    ("name", "content"),
    [("x.bag", b"#ROSBAG V2.0\n\0\0"), ("x.db3", b"SQLite format 3\0xx"), ("x.mcap", b"\x89MCAP0\r\n\0"), ("x", b"")],
)
def test_broken_bags_are_refused_in_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"cannot be read as a ROS bag") as caught:
        read_ranges(tmp_path / name, format="ros")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("has_package", [True, False])
def test_a_database_of_another_kind_is_named_as_such(
    has_package: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pycolmap.Database.open(tmp_path / "database.db").close()
    if not has_package:
        monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"no ROS 2 bag: it has tables cameras, .*, expected messages and topics"):
        read_ranges(tmp_path / "database.db")


def test_folder_with_broken_metadata_is_refused(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("a: [")
    (tmp_path / "log_0.mcap").touch()
    with pytest.raises(InputError, match="cannot be read as a ROS bag"):
        read_ranges(tmp_path)


def test_missing_package_is_said_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"pip install '\.\[ros\]' in a clone"):
        read_ranges(tmp_path / "x.bag")


@settings(max_examples=40)
@given(
    suffix=st.sampled_from([".bag", ".mcap", ".db3"]),
    damage=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=20),
    kept=st.floats(0.1, 1),
)
def test_damaged_bags_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, damage: list[tuple[float, int]], kept: float
) -> None:
    folder = tmp_path_factory.mktemp("bag")
    name = "uwb_ros/msg/RangeStamped"
    fields = {"range": 2.5, "from_id": 10, "to_id": 3, "covariance": 0.0}
    if suffix == ".bag":
        path = write_bag1(folder, [(name, message(1, name, **fields))])
    else:
        plugin = StoragePlugin.MCAP if suffix == ".mcap" else StoragePlugin.SQLITE3
        path = next(write_bag2(folder, [(name, message(2, name, **fields))], plugin).glob(f"*{suffix}"))
    content = bytearray(path.read_bytes())
    for position, byte in damage:
        content[int(position * len(content))] = byte
    path.write_bytes(content[: int(kept * len(content))])
    with contextlib.suppress(InputError):
        assert len(read_ranges(path, format="ros")) > 0
