"""Render the photos that ship with the demo, and the path of their camera.

    python -m tests.rendering.make_demo_photos [FOLDER]

Writes ``IMG_0001.jpg`` to ``IMG_0040.jpg`` and ``path.csv`` to a folder, by default that of the package. Takes two
minutes on two cores.
"""

from __future__ import annotations

import argparse
import csv
import os
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image
from PIL.ExifTags import IFD, Base
from scipy.spatial.transform import Rotation
from tests.rendering.courtyard import DEPTH_M, WIDTH_M, courtyard
from tests.rendering.photos import develop, render
from tests.rendering.scene import Scene
from tests.simulated.path import loop_path

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.demo.survey import CAMERA_MODEL, CAMERA_PARAMS, NUM_ROWS_AROUND, PATH_FILE, PHOTOS

FloatArray = npt.NDArray[np.float64]

NUM_PHOTOS = 40
CAMERA = pycolmap.Camera(model=CAMERA_MODEL, width=960, height=640, params=CAMERA_PARAMS)

_FIRST_PHOTO = datetime(2026, 5, 14, 16, 20, 30, tzinfo=timezone(timedelta(hours=2)))
_JPEG_QUALITY = 80  # 40 photos are 4 MB, and as many of their features match as at 92


def walk() -> tuple[CameraPath, FloatArray]:
    """The path, a little more than once around the middle of the yard, and the (40,) times of the photos."""
    duration = NUM_PHOTOS - 1 + 2.0 * NUM_ROWS_AROUND
    path = loop_path(
        duration,
        start_s=_FIRST_PHOTO.timestamp() - NUM_ROWS_AROUND,
        center_m=(WIDTH_M / 2, DEPTH_M / 2, 1.62),
        semi_axes_m=(4.4, 3.1),
        num_turns=1.25,
        start_deg=200.0,
    )
    stray = np.random.default_rng([0, 2]).uniform(-0.1, 0.1, NUM_PHOTOS)
    return path, _FIRST_PHOTO.timestamp() + np.arange(NUM_PHOTOS) + np.round(stray, 3)


def take_photo(scene: Scene, path: CameraPath, times_s: FloatArray, number: int) -> Image.Image:
    """The photo with that number, from 0, as its camera develops it."""
    rng = np.random.default_rng([0, 3, number])
    cam_from_world = path.world_from_cam(times_s)[number].T
    translation = -cam_from_world @ path.centers(times_s)[number]
    radiance = render(scene, CAMERA, np.column_stack([cam_from_world, translation]))
    exposure = float(np.exp(0.12 * np.sin(0.7 * number) + 0.05 * rng.standard_normal()))
    return Image.fromarray(develop(radiance, exposure, rng))


def photo_exif(timestamp_s: float, zone: tzinfo) -> Image.Exif:
    """The camera's notes about a photo: its make, the time to the millisecond, the focal length."""
    milliseconds = round(timestamp_s * 1000)
    time = datetime.fromtimestamp(milliseconds // 1000, zone)
    # The 35 mm equivalent compares diagonals; the diagonal of the film is 43.27 mm.
    equivalent_mm = CAMERA.focal_length * 43.27 / float(np.hypot(CAMERA.width, CAMERA.height))
    exif = Image.Exif()
    exif[Base.Make] = "rangesfm"
    exif[Base.Model] = "simulated camera"
    exif.get_ifd(IFD.Exif).update(
        {
            Base.DateTimeOriginal: time.strftime("%Y:%m:%d %H:%M:%S"),
            Base.SubsecTimeOriginal: f"{milliseconds % 1000:03d}",
            Base.OffsetTimeOriginal: time.strftime("%z")[:3] + ":" + time.strftime("%z")[3:],
            Base.FocalLength: equivalent_mm / 5.6,
            Base.FocalLengthIn35mmFilm: round(equivalent_mm),
        }
    )
    return exif


def write_path(path: CameraPath, times_s: FloatArray, image_names: list[str], file_path: Path) -> None:
    """Poses at the photos, and at full seconds before the first and after the last."""
    before = path.start_s + np.arange(NUM_ROWS_AROUND)
    after = path.end_s - np.arange(NUM_ROWS_AROUND)[::-1]
    times = np.concatenate([before, times_s, after])
    names = [*[""] * NUM_ROWS_AROUND, *image_names, *[""] * NUM_ROWS_AROUND]
    quaternions = Rotation.from_matrix(path.world_from_cam(times)).as_quat()
    with file_path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["image_name", "timestamp_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"])
        for name, time, center, quaternion in zip(names, times, path.centers(times), quaternions, strict=True):
            writer.writerow([name, f"{time:.3f}", *(f"{value:.7f}" for value in (*center, *quaternion))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=PHOTOS, help="(default: the package's)")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    path, times_s = walk()
    names = [f"IMG_{number:04d}.jpg" for number in range(1, NUM_PHOTOS + 1)]
    scene = courtyard()

    def make(number: int) -> None:
        exif = photo_exif(float(times_s[number]), _FIRST_PHOTO.tzinfo or timezone.utc)
        photo = take_photo(scene, path, times_s, number)
        photo.save(folder / names[number], quality=_JPEG_QUALITY, optimize=True, exif=exif)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(make, range(NUM_PHOTOS)))
    write_path(path, times_s, names, folder / PATH_FILE.name)


if __name__ == "__main__":
    main()
