"""Photos that share a camera, and given parameters where photos have several sizes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from PIL import Image

from rangesfm.errors import InputError, OptionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.camera import cameras_of_photos
from rangesfm.sfm.photo_files import Photos, usable_photos
from rangesfm.sfm.reconstruct import reconstruct

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

GIVEN = CameraOptions(model="PINHOLE", params=(240.0, 240.0, 128.0, 96.0))
_MODEL, _ORIENTATION = 0x0110, 0x0112


@pytest.fixture
def photos(tmp_path: Path) -> Photos:
    """Photos of two makes in two folders; one is half as large, and one is turned."""
    for name, size, make in [
        ("a/0.jpg", (256, 192), "first"),
        ("a/1.jpg", (256, 192), "second"),
        ("b/2.jpg", (256, 192), "first"),
        ("b/3.jpg", (128, 96), "first"),
        ("b/4.jpg", (192, 256), "first"),
    ]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        exif = Image.Exif()
        exif[_MODEL] = make
        Image.new("L", size).save(tmp_path / name, exif=exif)
    return usable_photos(tmp_path, [f"a/{i}.jpg" for i in (0, 1)] + [f"b/{i}.jpg" for i in (2, 3, 4)])


@pytest.mark.parametrize(
    ("mode", "of_photo"),
    [
        ("auto", (0, 1, 0, 2, 3)),
        ("single", (0, 0, 0, 1, 2)),
        ("per_folder", (0, 0, 1, 2, 3)),
        ("per_image", (0, 1, 2, 3, 4)),
    ],
)
def test_photos_share_a_camera_by_mode_and_never_one_of_another_size(
    photos: Photos, mode: str, of_photo: tuple[int, ...]
) -> None:
    found = cameras_of_photos(CameraOptions().changed(mode=mode), photos)
    assert found.of_photo == of_photo
    sizes = [(found.cameras[place].width, found.cameras[place].height) for place in of_photo]
    assert sizes == list(photos.sizes)


def test_given_parameters_are_rescaled_with_the_photos_and_guessed_for_those_of_another_shape(photos: Photos) -> None:
    found = cameras_of_photos(GIVEN.changed(mode="single"), photos)
    params = [camera.params.tolist() for camera in found.cameras]
    assert params[:2] == [[240, 240, 128, 96], [120, 120, 64, 48]]
    assert [camera.has_prior_focal_length for camera in found.cameras] == [True, True, False]
    assert found.guessed == ("b/4.jpg",)


def test_of_several_tables_each_is_of_the_photos_in_its_folder_or_of_its_pattern(photos: Photos) -> None:
    radial = CameraOptions(images="b/*4.jpg", model="SIMPLE_RADIAL")
    tables = CameraOptions(mode="single", others=(GIVEN.changed(images="a"), radial))
    found = cameras_of_photos(tables, photos)
    assert [found.cameras[place].model_name for place in found.of_photo] == [
        *("PINHOLE", "PINHOLE"),
        *("SIMPLE_RADIAL", "SIMPLE_RADIAL", "SIMPLE_RADIAL"),
    ]
    assert found.cameras[found.of_photo[0]].params.tolist() == [240, 240, 128, 96]
    assert len(set(found.of_photo[2:])) == 3
    assert found.guessed == ()


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("*1.jpg", r"\[\[camera\]\] images 'a' and '\*1.jpg' both match the photo a/1.jpg, expected one"),
        ("c/", r"\[\[camera\]\] images is 'c/', expected a pattern that fits some photo's name, such as a/0.jpg"),
    ],
)
def test_a_photo_of_two_tables_or_a_table_of_no_photo_is_one_line(photos: Photos, pattern: str, message: str) -> None:
    tables = CameraOptions(others=(CameraOptions(images="a"), CameraOptions(images=pattern)))
    with pytest.raises((InputError, OptionError), match=message):
        cameras_of_photos(tables, photos)


def test_mapping_keeps_the_camera_of_one_table_and_refines_that_of_another(room: Room, tmp_path: Path) -> None:
    known = room.camera.changed(images="photo00[0-2]*", focal_length_stddev_px=0.0)
    tables = CameraOptions(model="SIMPLE_PINHOLE", others=(known,))
    mapper = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 250}})
    (model,) = reconstruct(room.folder, room.names, tmp_path, camera=tables, mapper=mapper).models
    of_photo = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    assert tuple(of_photo[room.names[0]].params) == room.camera.params
    assert of_photo[room.names[5]].focal_length == pytest.approx(240, rel=0.03)  # the guess is 307


def test_exif_turns_no_pixels_as_it_does_not_for_colmap(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[_ORIENTATION] = 6
    for name in ("0.jpg", "1.jpg"):
        Image.new("L", (64, 32)).save(tmp_path / name, exif=exif)
    read = pycolmap.Bitmap.read(tmp_path / "0.jpg", False)
    assert read is not None
    assert [(read.width, read.height)] * 2 == list(usable_photos(tmp_path, ["0.jpg", "1.jpg"]).sizes)


def test_photos_of_other_sizes_and_turned_ones_take_their_place_on_the_path(
    room: Room, tmp_path: Path, listener: Listener
) -> None:
    for index, name in enumerate(room.names):
        with Image.open(room.folder / name) as photo:
            size = (200, 150) if index == 2 else photo.size
            resized = photo.resize(size, Image.Resampling.LANCZOS)
            (resized.transpose(Image.Transpose.ROTATE_90) if index == 4 else resized).save(tmp_path / name)
    mapper = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 400}})
    summary = reconstruct(tmp_path, room.names, tmp_path / "out", camera=room.camera, mapper=mapper, progress=listener)
    assert summary.num_registered == len(room.names)
    (model,) = summary.models
    assert len(model.cameras) == 3
    assert listener.messages == [
        f"the camera's parameters belong to photos of another shape than {room.names[4]}: COLMAP guesses its camera"
        " (1 of 3 cameras)"
    ]
    image_of = {image.name: image for image in model.images.values()}
    centers = np.array([image_of[name].projection_center() for name in room.names])
    world_from_sfm = pycolmap.estimate_sim3d(centers, room.centers)
    assert world_from_sfm is not None
    errors = np.linalg.norm([world_from_sfm * center for center in centers] - room.centers, axis=1)
    assert errors.max() < 0.05 * np.linalg.norm(np.ptp(room.centers, axis=0))
