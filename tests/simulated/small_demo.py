"""The demo's survey with small photos, for tests of whole runs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from PIL import Image

from rangesfm.demo.survey import DemoSurvey, make_demo_survey
from rangesfm.util.files.atomic import new_folder

_SHRINKING = 8 / 3  # from 960 x 640 pixels to 360 x 240


def make_small_demo(folder: Path, *, num_photos: int = 14, seed: int = 0, imu: bool = False) -> DemoSurvey:
    """Make the demo's survey beside ``folder``, and in ``folder`` with its photos and its camera scaled down.

    An existing folder is left as it is.
    """
    large = make_demo_survey(folder.with_name(f"{folder.name}_large"), num_photos=num_photos, seed=seed, imu=imu)
    if not folder.exists():
        with new_folder(folder) as new:
            shutil.copytree(large.folder, new, dirs_exist_ok=True)
            for name in large.image_names:
                _shrink(new / "images" / name)
            text = large.survey_path.read_text(encoding="utf-8")
            small = text.replace("params = [748.8, 480, 320, -0.04]", "params = [280.8, 180, 120, -0.04]")
            assert small != text
            (new / large.survey_path.name).write_text(small, encoding="utf-8")
    return replace(large, folder=folder)


def _shrink(path: Path) -> None:
    with Image.open(path) as photo:
        size = round(photo.width / _SHRINKING), round(photo.height / _SHRINKING)
        photo.resize(size, Image.Resampling.BOX).save(path, quality=92, exif=photo.getexif())
