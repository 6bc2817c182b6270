"""The images of ROS 1 and ROS 2 bags, in all encodings, with their time stamps and their camera."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from PIL import Image
from rosbags.rosbag2 import StoragePlugin
from tests.survey.sources.damage import DAMAGES, Damage
from tests.survey.sources.recorded import Message, camera_info, compressed, raw, write_bag

from rangesfm.errors import InputError
from rangesfm.options import CameraOptions
from rangesfm.survey.sources.source import PhotoSource, open_source

Pixels = npt.NDArray[np.uint8]
IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
INFO_OF_8_X_6 = camera_info((8, 6), (9, 10, 4, 3), (0.1, 0, 0, 0, 0))


def gradient() -> Pixels:
    """(6, 8, 3) pixels: red grows to the right, green downwards, and blue is the same everywhere."""
    rows, columns = np.mgrid[:6, :8]
    return np.stack([20 * columns, 30 * rows, np.full((6, 8), 77)], axis=-1).astype(np.uint8)


def mosaic(red: tuple[int, int]) -> Pixels:
    """The same image as a sensor with a colour filter mosaic records it."""
    rgb, (i, j) = gradient(), red
    seen = rgb[..., 1:2].copy()
    seen[i::2, j::2, 0] = rgb[i::2, j::2, 0]
    seen[1 - i :: 2, 1 - j :: 2, 0] = rgb[1 - i :: 2, 1 - j :: 2, 2]
    return seen


def yuv422() -> Pixels:
    luma, blue, red = np.moveaxis(np.asarray(Image.fromarray(gradient()).convert("YCbCr")), -1, 0)
    colours = np.where(np.arange(8) % 2, np.roll(red, 1, axis=1), blue)
    return np.stack([colours, luma], axis=-1)


def open_bag(folder: Path, messages: list[Message], *, topic: str = "", **how: Any) -> PhotoSource:
    path = folder / ("a.bag" if how.get("version") == 1 else "a")
    return open_source(write_bag(path, messages, **how), topic)


def written(source: PhotoSource, folder: Path) -> Pixels:
    next(source.frames()).write(folder / "photo.png")
    with Image.open(folder / "photo.png") as photo:
        return np.asarray(photo.convert("RGB"))


ALPHA = np.full((6, 8, 1), 5, np.uint8)
GREY = gradient()[..., :1]
IN_COLOUR = {
    "rgb8": gradient(),
    "bgr8": gradient()[..., ::-1],
    "rgba8": np.dstack([gradient(), ALPHA]),
    "bgra8": np.dstack([gradient()[..., ::-1], ALPHA]),
}


@pytest.mark.parametrize(("encoding", "pixels"), IN_COLOUR.items())
@pytest.mark.parametrize("version", [1, 2])
def test_raw_colours_are_kept_to_the_digit(version: int, encoding: str, pixels: Pixels, tmp_path: Path) -> None:
    source = open_bag(tmp_path, [("/cam/image", IMAGE, 5.5, raw(pixels, encoding, padding=3))], version=version)
    assert source.size_px == (8, 6)
    np.testing.assert_array_equal(written(source, tmp_path), gradient())


@pytest.mark.parametrize(("encoding", "pixels"), {"mono8": GREY, "mono16": np.dstack([ALPHA, GREY])}.items())
def test_raw_grey_is_kept_of_16_bits_the_upper_eight(encoding: str, pixels: Pixels, tmp_path: Path) -> None:
    source = open_bag(tmp_path, [("/cam/image", IMAGE, 5.5, raw(pixels, encoding))])
    np.testing.assert_array_equal(written(source, tmp_path), np.repeat(GREY, 3, axis=-1))


@pytest.mark.parametrize(
    ("encoding", "red"),
    {"bayer_rggb8": (0, 0), "bayer_grbg8": (0, 1), "bayer_gbrg8": (1, 0), "bayer_bggr8": (1, 1)}.items(),
)
def test_colours_between_filters_are_those_of_the_neighbours(
    encoding: str, red: tuple[int, int], tmp_path: Path
) -> None:
    source = open_bag(tmp_path, [("/cam/image", IMAGE, 5.5, raw(mosaic(red), encoding))])
    inside = slice(1, -1), slice(1, -1)  # a colour that changes linearly is the mean of its neighbours
    np.testing.assert_array_equal(written(source, tmp_path)[inside], gradient()[inside])


@pytest.mark.parametrize(("encoding", "pixels"), {"yuv422": yuv422(), "yuv422_yuy2": yuv422()[..., ::-1]}.items())
def test_pixels_that_share_a_colour_with_a_neighbour_have_it(encoding: str, pixels: Pixels, tmp_path: Path) -> None:
    source = open_bag(tmp_path, [("/cam/image", IMAGE, 5.5, raw(pixels, encoding))])
    shared = gradient().astype(int)
    found = written(source, tmp_path).astype(int)
    np.testing.assert_allclose(found[:, ::2], shared[:, ::2], atol=4)
    # red is taken from a neighbour that has 20 less
    np.testing.assert_allclose(found[:, 1::2], shared[:, 1::2], atol=26)


def test_a_compressed_image_is_the_photo_byte_for_byte(tmp_path: Path) -> None:
    content = io.BytesIO()
    Image.fromarray(gradient()).save(content, "JPEG")
    messages: list[Message] = [
        ("/cam/image/compressed", COMPRESSED, 5.5, compressed(content.getvalue())),
        ("/cam/camera_info", INFO, 5.5, INFO_OF_8_X_6),
    ]
    source = open_bag(tmp_path, messages, plugin=StoragePlugin.SQLITE3)
    (frame,) = source.frames()
    assert (frame.suffix, frame.grey().mode, source.size_px) == (".jpg", "L", (8, 6))
    frame.write(tmp_path / "photo.jpg")
    assert (tmp_path / "photo.jpg").read_bytes() == content.getvalue()
    assert source.camera.model


def test_times_are_the_stamps_and_without_any_the_arrivals(tmp_path: Path) -> None:
    image = raw(gradient(), "rgb8")
    source = open_bag(tmp_path, [("/cam/image", IMAGE, time_s, image) for time_s in (5.5, 5.625)])
    assert [frame.time_s for frame in source.frames()] == [5.5, 5.625]
    assert source.clock == "the stamps of their headers"
    (tmp_path / "unset").mkdir()
    source = open_bag(tmp_path / "unset", [("/cam/image", IMAGE, 0.0, image)])
    assert [frame.time_s for frame in source.frames()] == [0.02]
    assert source.clock == "times of arrival, because their headers have no stamps"


def test_of_several_topics_one_must_be_chosen(tmp_path: Path) -> None:
    image = raw(gradient(), "rgb8")
    messages: list[Message] = [
        ("/right", IMAGE, 1.0, image),
        ("/left", IMAGE, 1.0, image),
        ("/left", IMAGE, 2.0, image),
    ]
    which = r": /left \(2\), /right \(1\); choose by \[images\] topic, or --image_topic"
    with pytest.raises(InputError, match=f"a: several topics of images{which}"):
        open_bag(tmp_path, messages)
    with pytest.raises(InputError, match=f"a: no images of /up; there are images of{which}"):
        open_source(tmp_path / "a", "/up")
    assert len(list(open_source(tmp_path / "a", "/left").frames())) == 2


@pytest.mark.parametrize("version", [1, 2])
def test_the_camera_is_that_of_the_info_beside_the_images(version: int, tmp_path: Path) -> None:
    messages: list[Message] = [
        ("/camera_info", INFO, 1.0, camera_info((8, 6), (1, 1, 1, 1), ())),
        ("/cam/image_raw", IMAGE, 1.0, raw(gradient(), "rgb8")),
        ("/cam/image_rect", IMAGE, 1.0, raw(gradient(), "rgb8")),
        ("/cam/camera_info", INFO, 1.0, INFO_OF_8_X_6),
    ]
    plain = open_bag(tmp_path, messages, topic="/cam/image_raw", version=version)
    assert plain.camera == CameraOptions(model="OPENCV", params=(9.0, 10.0, 4.5, 3.5, 0.1, 0.0, 0.0, 0.0))
    assert plain.notes == ("the camera is that of /cam/camera_info, unless one is given",)
    rectified = open_source(next(tmp_path.iterdir()), "/cam/image_rect")
    assert rectified.camera == CameraOptions(model="PINHOLE", params=(4.5, 5.0, 4.5, 3.5))


@pytest.mark.parametrize(
    ("info", "notes"),
    [
        (camera_info((8, 6), (0, 0, 0, 0), ()), ()),
        (
            camera_info((16, 12), (9, 9, 8, 6), ()),
            (r"/camera_info is for 16 x 12 pixels: it is not used for the camera",),
        ),
        (camera_info((8, 6), (9, 9, 4, 3), (1,), "odd"), (r"/camera_info is not used.* distortion_model is 'odd'",)),
    ],
    ids=["not calibrated", "other size", "other model"],
)
def test_an_info_that_does_not_fit_is_not_taken(info: dict[str, Any], notes: tuple[str, ...], tmp_path: Path) -> None:
    source = open_bag(tmp_path, [("/image", IMAGE, 1.0, raw(gradient(), "rgb8")), ("/camera_info", INFO, 1.0, info)])
    assert source.camera == CameraOptions()
    assert len(source.notes) == len(notes)
    for found, expected in zip(source.notes, notes):
        assert re.match(expected, found)


@pytest.mark.parametrize(
    ("kind", "fields", "said"),
    [
        (IMAGE, raw(GREY, "32FC1"), "in the encoding '32FC1', expected one of mono8"),
        (IMAGE, {**raw(GREY, "mono8"), "height": 7}, "8 x 7 pixels in mono8 with only 48 bytes"),
        (COMPRESSED, compressed(b"\0\0\0\1", "h264"), "compressed as 'h264', expected jpeg or png"),
        (COMPRESSED, compressed(b"\xff\xd8\xff\xe0"), "a compressed image that cannot be read"),
        (INFO, INFO_OF_8_X_6, "no images in this bag"),
    ],
)
def test_what_is_no_photo_is_refused_in_one_line(kind: str, fields: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"^{tmp_path}/a: .*{said}"):
        open_bag(tmp_path, [("/image", kind, 1.0, fields)])


@settings(max_examples=30)
@given(damage=DAMAGES)
def test_a_damaged_bag_is_read_or_refused(damage: Damage, tmp_path_factory: pytest.TempPathFactory) -> None:
    messages: list[Message] = [
        ("/camera_info", INFO, 1.0, INFO_OF_8_X_6),
        ("/image", IMAGE, 1.0, raw(gradient(), "rgb8")),
    ]
    path = write_bag(tmp_path_factory.mktemp("bag") / "a.bag", messages, version=1)
    damage.read_or_refused(path)
