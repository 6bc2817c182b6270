"""Pictures in messages of ROS: raw pixels in the usual encodings, and whole files of JPEG or PNG.

All functions take the path of the bag, for messages alone.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import convolve

from rangesfm.errors import InputError

_Pixels = npt.NDArray[np.uint8]
_BEGINS = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}
# Of the neighbours that have a colour, for a pixel that has not.
_WEIGHTS = ((1, 2, 1), (2, 4, 2), (1, 2, 1))


def image_file(message: Any, path: Path) -> tuple[bytes, str]:
    """Content and suffix of the file that a CompressedImage holds."""
    content = bytes(message.data)
    suffix = next((suffix for begin, suffix in _BEGINS.items() if content.startswith(begin)), None)
    if suffix is None:
        raise InputError(f"an image compressed as '{message.format}', expected jpeg or png", path)
    return content, suffix


def opened(content: bytes, path: Path, *, reduced_to_px: int | None = None) -> Image.Image:
    """The picture of such a file, in grey and of about that size if one is given, as JPEG decodes it quickest."""
    try:
        image: Image.Image = Image.open(io.BytesIO(content))
        if reduced_to_px is not None:
            image.draft("L", (reduced_to_px, reduced_to_px))
            image = image.convert("L")
        image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"a compressed image that cannot be read ({error})", path) from None
    return image


def raw_image(message: Any, path: Path) -> Image.Image:
    """The picture of an Image, in grey or in colour.

    Raises:
        InputError: its encoding is not known, or it has too few bytes.
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
    """Of an even number of pixels a row, that have a luma each, and a colour together with their neighbour."""
    colours = pixels[:, : pixels.shape[1] // 2 * 2, 1 - luma]
    bands = [pixels[:, : colours.shape[1], luma], *(np.repeat(colours[:, k::2], 2, axis=1) for k in (0, 1))]
    merged = Image.merge("YCbCr", [Image.fromarray(np.ascontiguousarray(band)) for band in bands])
    return np.asarray(merged.convert("RGB"))


def _colours_of_mosaic(red: tuple[int, int], pixels: _Pixels) -> _Pixels:
    """Of pixels behind red, green and blue filters; those two colours that one lacks are of its neighbours.

    Args:
        red: row and column of a red one in the first 2 x 2 pixels; blue is across from it.
    """
    has_red, has_blue = (np.zeros(pixels.shape[:2], bool) for _ in range(2))
    has_red[red[0] :: 2, red[1] :: 2] = has_blue[1 - red[0] :: 2, 1 - red[1] :: 2] = True
    values, mixed = pixels[..., 0].astype(np.float32), np.empty((*has_red.shape, 3), np.uint8)
    for channel, has in enumerate((has_red, ~(has_red | has_blue), has_blue)):
        weights = convolve(has.astype(np.float32), _WEIGHTS, mode="constant")
        mean = convolve(values * has, _WEIGHTS, mode="constant") / weights
        mixed[..., channel] = np.where(has, values, np.rint(mean))
    return mixed


# By encoding: bytes of a pixel, and how (height, width, bytes) become grey or red, green and blue.
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
