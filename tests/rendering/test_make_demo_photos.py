"""The renderer makes the photos that ship with the demo, and their camera is where its file says."""

from __future__ import annotations

from datetime import timezone
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from tests.rendering.courtyard import courtyard
from tests.rendering.make_demo_photos import CAMERA, photo_exif, take_photo, walk, write_path
from tests.rendering.photos import PhotoCamera
from tests.rendering.scene import Scene

from rangesfm.demo.survey import PATH_FILE, PHOTOS


@pytest.fixture(scope="module")
def scene() -> Scene:
    return courtyard()


@pytest.mark.parametrize("number", [0, 23])
def test_a_shipped_photo_is_what_the_renderer_makes(scene: Scene, number: int) -> None:
    path, times_s = walk()
    rendered = take_photo(scene, CAMERA, path, times_s, number)
    with Image.open(PHOTOS / f"IMG_{number + 1:04d}.jpg") as photo:
        assert photo.size == rendered.size
        error = _averaged(rendered) - _averaged(photo)
    # On a scale of 255. The loss of JPEG is 1.4; a camera two centimetres away would give 3.5.
    assert np.abs(error).mean() < 2


def _averaged(photo: Image.Image) -> npt.NDArray[np.float64]:
    """Average the photo over blocks of 4 x 4 pixels."""
    return np.asarray(photo.resize((photo.width // 4, photo.height // 4), Image.Resampling.BOX), dtype=np.float64)


def test_shipped_path_is_the_way_of_that_camera(tmp_path: Path) -> None:
    path, times_s = walk()
    write_path(path, times_s, [f"IMG_{number:04d}.jpg" for number in range(1, 41)], tmp_path / "path.csv")
    made, shipped = (
        [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
        for path in (tmp_path / "path.csv", PATH_FILE)
    )
    assert made[0] == shipped[0]
    assert [row[0] for row in made] == [row[0] for row in shipped]
    values = np.array([[row[1:] for row in rows[1:]] for rows in (made, shipped)], dtype=np.float64)
    np.testing.assert_allclose(values[0], values[1], rtol=0, atol=2e-7)


def test_time_just_before_a_full_second_keeps_its_second() -> None:
    exif = photo_exif(PhotoCamera(960, 640, 750.0), 1_000_000_000.9996, timezone.utc).get_ifd(IFD.Exif)
    assert exif[Base.DateTimeOriginal] == "2001:09:09 01:46:41"
    assert exif[Base.SubsecTimeOriginal] == "000"
