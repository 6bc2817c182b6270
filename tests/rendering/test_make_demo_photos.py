"""The camera of the photos that ship with the demo is where its file says.

``tests/studies/demo_photos.py`` compares the photos themselves with what the renderer makes.
"""

from __future__ import annotations

from datetime import timezone
from pathlib import Path

import numpy as np
from PIL.ExifTags import IFD, Base
from tests.rendering.make_demo_photos import photo_exif, walk, write_path

from rangesfm.demo.survey import PATH_FILE


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
    exif = photo_exif(1_000_000_000.9996, timezone.utc).get_ifd(IFD.Exif)
    assert exif[Base.DateTimeOriginal] == "2001:09:09 01:46:41"
    assert exif[Base.SubsecTimeOriginal] == "000"
