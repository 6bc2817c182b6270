"""Images of one topic of a ROS bag, with the time stamps of their headers.

They are raw pixels in the usual encodings, or whole JPEG or PNG files.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import convolve

from rangesfm.colmap.calibrated_cameras import colmap_camera
from rangesfm.errors import InputError
from rangesfm.options import CameraOptions
from rangesfm.survey.sources.source import MAX_SIDE_PX, Frame, PhotoSource
from rangesfm.util.files.bags import connections_of, messages_of, open_bag, stamp_s, type_name

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_RAW, _COMPRESSED, _CAMERA = "Image", "CompressedImage", "CameraInfo"
_Pixels = npt.NDArray[np.uint8]
_BEGINS = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}
# Weights of a pixel's 3 x 3 neighbours in the interpolation of a colour that the pixel itself lacks.
_WEIGHTS = ((1, 2, 1), (2, 4, 2), (1, 2, 1))


def has_images(path: Path) -> bool:
    """Return whether a bag can be read and has images."""
    with suppress(InputError), open_bag(path) as bag:
        return bool(_num_by_topic(bag))
    return False


def open_images(path: Path, topic: str) -> PhotoSource:
    """Open the images of a bag as a source of photos.

    Args:
        topic: of the images; empty: the bag has only one image topic.

    Raises:
        InputError: the bag cannot be read, has no images, or has several image topics and none is chosen.
    """
    with open_bag(path) as bag:
        num_by_topic = _num_by_topic(bag)
        topic = _chosen(num_by_topic, topic, path)
        first = next(_messages(bag, topic), None)
        if first is None:
            raise InputError(f"there is no image of {topic} in this bag", path)
        kind, message, _ = first
        image = _opened(_image_file(message, path)[0], path) if kind == _COMPRESSED else _raw_image(message, path)
        size_px = image.size
        camera, notes = _camera(bag, topic, kind, size_px, path)
        duration_s = bag.duration * 1e-9
    is_stamped = stamp_s(message) > 0
    clock = "the stamps of their headers" if is_stamped else "times of arrival, because their headers have no stamps"
    what = f"{num_by_topic[topic]} images of {topic}, {size_px[0]} x {size_px[1]} pixels"
    frames = partial(_frames, path, topic, is_stamped)
    return PhotoSource(what, size_px, duration_s, num_by_topic[topic], clock, frames, camera, notes)


def _num_by_topic(bag: AnyReader) -> dict[str, int]:
    """Return the number of images of each image topic."""
    images = {item.topic for item in connections_of(bag, (_RAW, _COMPRESSED))}
    return {topic: bag.topics[topic].msgcount for topic in sorted(images)}


def _chosen(num_by_topic: dict[str, int], topic: str, path: Path) -> str:
    several = ", ".join(f"{name} ({num})" for name, num in num_by_topic.items())
    if not topic and len(num_by_topic) == 1:
        return next(iter(num_by_topic))
    if topic in num_by_topic:
        return topic
    if not num_by_topic:
        raise InputError(f"no images in this bag, expected {_RAW} or {_COMPRESSED} of sensor_msgs", path)
    which = f"no images of {topic}; there are images of" if topic else "several topics of images"
    raise InputError(f"{which}: {several}; choose by [images] topic, or --image_topic", path)


def _messages(bag: AnyReader, topic: str) -> Iterator[tuple[str, Any, float]]:
    """Return an iterator over type, content and time of arrival (seconds) of each message of a topic."""
    connections = [item for item in bag.connections if item.topic == topic]
    return ((type_name(kind), message, received_s) for kind, message, received_s in messages_of(bag, connections))


def _frames(path: Path, topic: str, is_stamped: bool) -> Iterator[Frame]:
    with open_bag(path) as bag:
        for number, (kind, message, received_s) in enumerate(_messages(bag, topic)):
            time_s = stamp_s(message) if is_stamped else received_s
            if kind == _COMPRESSED:
                content, suffix = _image_file(message, path)
                grey = partial(_opened, content, path)
                yield Frame(number, time_s, suffix, grey, partial(_write_file, content))
            else:
                yield Frame(number, time_s, ".png", partial(_grey, message, path), partial(_write, message, path))


def _camera(
    bag: AnyReader, topic: str, kind: str, size_px: tuple[int, int], path: Path
) -> tuple[CameraOptions, tuple[str, ...]]:
    """Return the camera from the CameraInfo that belongs to an image topic, and notes on it.

    Nothing of it is given where there is no CameraInfo, or where it does not fit the images.
    """
    not_given = CameraOptions()
    infos = [item.topic for item in connections_of(bag, (_CAMERA,))]
    beside = [topic.rpartition("/")[0]]
    beside += [beside[0].rpartition("/")[0]] if kind == _COMPRESSED else []  # for /camera/image_raw/compressed
    info_topic = next((info for place in beside for info in infos if info.rpartition("/")[0] == place), None)
    found = None if info_topic is None else next(_messages(bag, info_topic), None)
    if found is None:
        return not_given, ()
    info = found[1]
    d, k, p = (getattr(info, name if hasattr(info, name) else name.upper()) for name in "dkp")  # ROS 1: D, K, P
    is_rectified = "rect" in topic.rpartition("/")[2] or "rect" in beside[0].rpartition("/")[2]
    fx, cx, fy, cy = p[[0, 2, 5, 6]] if is_rectified else k[[0, 2, 4, 5]]
    if not (fx > 0 and fy > 0):
        return not_given, ()  # the camera is not calibrated
    if (info.width, info.height) != size_px:
        return not_given, (f"{info_topic} is for {info.width} x {info.height} pixels: it is not used for the camera",)
    distortion = info.distortion_model if not is_rectified and any(d) else "none"
    try:
        return colmap_camera(distortion, (fx, fy, cx, cy), d, path), (
            f"the camera is that of {info_topic}, unless one is given",
        )
    except InputError as error:
        return not_given, (f"{info_topic} is not used for the camera: {error}",)


def _grey(message: Any, path: Path) -> Image.Image:
    return _raw_image(message, path).convert("L")


def _write(message: Any, path: Path, photo_path: Path) -> None:
    _raw_image(message, path).save(photo_path, compress_level=1)


def _write_file(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _image_file(message: Any, path: Path) -> tuple[bytes, str]:
    """Return content and suffix of the image file in a CompressedImage.

    Raises:
        InputError: it is neither JPEG nor PNG.
    """
    content = bytes(message.data)
    suffix = next((suffix for begin, suffix in _BEGINS.items() if content.startswith(begin)), None)
    if suffix is None:
        raise InputError(f"an image compressed as '{message.format}', expected jpeg or png", path)
    return content, suffix


def _opened(content: bytes, path: Path) -> Image.Image:
    """Decode an image file in grey, and at about MAX_SIDE_PX, which is much faster for JPEG.

    Raises:
        InputError: it cannot be decoded.
    """
    try:
        image: Image.Image = Image.open(io.BytesIO(content))
        image.draft("L", (MAX_SIDE_PX, MAX_SIDE_PX))
        image = image.convert("L")
        image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"a compressed image that cannot be read ({error})", path) from None
    return image


def _raw_image(message: Any, path: Path) -> Image.Image:
    """Decode a raw Image in grey or colour.

    Raises:
        InputError: the encoding is unknown, or there are too few bytes.
    """
    height, width, encoding = message.height, message.width, message.encoding
    if encoding not in _READERS:
        raise InputError(f"an image in the encoding '{encoding}', expected one of {', '.join(_READERS)}", path)
    num_bytes, read = _READERS[encoding]
    data = np.asarray(message.data, np.uint8)
    if not (width and height) or message.step < width * num_bytes or len(data) < height * message.step:
        raise InputError(f"an image of {width} x {height} pixels in {encoding} with only {len(data)} bytes", path)
    rows = data[: height * message.step].reshape(height, message.step)[:, : width * num_bytes]
    return Image.fromarray(np.ascontiguousarray(read(rows.reshape(height, width, num_bytes))))


def _luma_and_colours(luma: int, pixels: _Pixels) -> _Pixels:
    """Decode YUV 4:2:2, in which each pixel has its own luma, and two neighbours share their colour.

    Args:
        luma: which of the two bytes of a pixel is its luma.
        pixels: (h, w, 2); a last column without a partner is left out.

    Returns:
        (h, w, 3) red, green and blue.
    """
    colours = pixels[:, : pixels.shape[1] // 2 * 2, 1 - luma]
    bands = [pixels[:, : colours.shape[1], luma], *(np.repeat(colours[:, k::2], 2, axis=1) for k in (0, 1))]
    merged = Image.merge("YCbCr", [Image.fromarray(np.ascontiguousarray(band)) for band in bands])
    return np.asarray(merged.convert("RGB"))


def _colours_of_mosaic(red: tuple[int, int], pixels: _Pixels) -> _Pixels:
    """Decode a Bayer mosaic: each pixel has one colour, and the other two are interpolated from its neighbours.

    Args:
        red: row and column of the red pixel in the first 2 x 2 pixels; the blue one is diagonally opposite.
        pixels: (h, w, 1).

    Returns:
        (h, w, 3) red, green and blue.
    """
    has_red, has_blue = (np.zeros(pixels.shape[:2], bool) for _ in range(2))
    has_red[red[0] :: 2, red[1] :: 2] = has_blue[1 - red[0] :: 2, 1 - red[1] :: 2] = True
    values, mixed = pixels[..., 0].astype(np.float32), np.empty((*has_red.shape, 3), np.uint8)
    for channel, has in enumerate((has_red, ~(has_red | has_blue), has_blue)):
        weights = convolve(has.astype(np.float32), _WEIGHTS, mode="constant")
        mean = convolve(values * has, _WEIGHTS, mode="constant") / weights
        mixed[..., channel] = np.where(has, values, np.rint(mean))
    return mixed


# For each encoding: bytes of a pixel, and the function from (height, width, bytes) to grey or to red, green and blue.
_READERS: dict[str, tuple[int, Callable[[_Pixels], _Pixels]]] = {
    **dict.fromkeys(("mono8", "8UC1"), (1, lambda pixels: pixels[..., 0])),
    "mono16": (2, lambda pixels: pixels[..., 1]),  # the upper byte of two
    "rgb8": (3, lambda pixels: pixels),
    **dict.fromkeys(("bgr8", "8UC3"), (3, lambda pixels: pixels[..., ::-1])),
    "rgba8": (4, lambda pixels: pixels[..., :3]),
    "bgra8": (4, lambda pixels: pixels[..., 2::-1]),
    **dict.fromkeys(("yuv422", "uyvy"), (2, partial(_luma_and_colours, 1))),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, partial(_luma_and_colours, 0))),
    "bayer_rggb8": (1, partial(_colours_of_mosaic, (0, 0))),
    "bayer_grbg8": (1, partial(_colours_of_mosaic, (0, 1))),
    "bayer_gbrg8": (1, partial(_colours_of_mosaic, (1, 0))),
    "bayer_bggr8": (1, partial(_colours_of_mosaic, (1, 1))),
}
