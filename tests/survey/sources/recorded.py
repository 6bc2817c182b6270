"""Photos as the video or bag that a camera, a robot or a phone would have recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from tests.measurements.ranges.readers.test_readers_ros import TYPES

PORTRAIT = (0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
"""QuickTime's matrix of a phone held upright: the stored right goes down, and the stored bottom goes left."""
_TIME_BASE = Fraction(1, 90_000)

# Topic, type, time of the stamp, and the other fields.
Message = tuple[str, str, float, Mapping[str, Any]]


def write_video(
    path: Path,
    images: Iterable[Image.Image],
    times_s: Sequence[float],
    *,
    created: str | None = None,
    matrix: Sequence[int] | None = None,
) -> Path:
    """Write an H.264 video with a frame at each time, counted from the first one."""
    with av.open(path, "w") as video:
        if created is not None:
            video.metadata["creation_time"] = created
        stream = None
        for image, time_s in zip(images, times_s, strict=True):
            if stream is None:
                stream = video.add_stream("libx264", rate=30, options={"crf": "16"})
                stream.width, stream.height, stream.pix_fmt = *image.size, "yuv420p"
                stream.time_base = stream.codec_context.time_base = _TIME_BASE
                stream.set_display_matrix(matrix)
            frame = av.VideoFrame.from_ndarray(np.asarray(image.convert("RGB")))
            frame.pts, frame.time_base = round((time_s - times_s[0]) / _TIME_BASE), _TIME_BASE
            video.mux(stream.encode(frame))
        assert stream is not None
        video.mux(stream.encode())
    return path


def raw(pixels: npt.NDArray[np.uint8], encoding: str, *, padding: int = 0) -> dict[str, Any]:
    """Fields of an Image with (height, width, bytes) pixels, whose rows are padded with some bytes."""
    rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, padding)), constant_values=255)
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    return {**size, "encoding": encoding, "is_bigendian": 0, "data": rows.ravel()}


def compressed(content: bytes, format: str = "jpeg") -> dict[str, Any]:
    """Fields of a CompressedImage."""
    return {"format": format, "data": np.frombuffer(content, np.uint8)}


def write_bag(
    path: Path, messages: Iterable[Message], *, version: int = 2, plugin: StoragePlugin = StoragePlugin.MCAP
) -> Path:
    """Write a ROS 1 file or a ROS 2 folder, in which messages arrive 0.02 s after their stamps."""
    types = TYPES[version]
    with Writer1(path) if version == 1 else Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, name, time_s, fields in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=types)
            content = types.types[name](header=_header(version, time_s), **_spelled(version, name, fields))
            data = types.serialize_ros1(content, name) if version == 1 else types.serialize_cdr(content, name)
            writer.write(connections[topic], round((time_s + 0.02) * 1e9), data)
    return path


def _header(version: int, time_s: float) -> Any:
    types, time_ns = TYPES[version].types, round(time_s * 1e9)
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **({"seq": 0} if version == 1 else {}))


def camera_info(
    size: tuple[int, int], k: Sequence[float], d: Sequence[float], model: str = "plumb_bob"
) -> dict[str, Any]:
    """Fields of a CameraInfo with fx, fy, cx, cy; its rectified images have half these focal lengths."""
    fx, fy, cx, cy = k
    return {
        "width": size[0],
        "height": size[1],
        "distortion_model": model,
        "d": np.array(d, float),
        "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], float),
        "p": np.array([fx / 2, 0, cx, 0, 0, fy / 2, cy, 0, 0, 0, 1, 0], float),
    }


def _spelled(version: int, name: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields under their names in that version of ROS, with the other fields that a CameraInfo needs."""
    if not name.endswith("CameraInfo"):
        return dict(fields)
    region = TYPES[version].types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    more = {"r": np.eye(3).ravel(), "binning_x": 0, "binning_y": 0, "roi": region}
    return {key.upper() if version == 1 and len(key) == 1 else key: value for key, value in {**fields, **more}.items()}
