"""A whole survey made on the spot: photos of a yard, a radio's log, surveyed anchors, the truth, the survey file."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.ExifTags import IFD, Base

from rangesfm.errors import InputError
from rangesfm.files.atomic import LEFTOVER, new_file, new_folder
from rangesfm.files.sole_writer import LOCK_NAME, sole_writer
from rangesfm.geometry.reference import Reference, write_reference
from rangesfm.progress import Progress, SilentProgress
from rangesfm.ranging.readers.canonical import write_ranges_csv
from rangesfm.simulate.courtyard import ANCHOR_POSITIONS_M, DEPTH_M, WIDTH_M, courtyard
from rangesfm.simulate.path import CameraPath, loop_path
from rangesfm.simulate.photos import PhotoCamera, develop, render
from rangesfm.simulate.ranges import Radio, SimulatedRanges, simulate_ranges
from rangesfm.simulate.scene import Scene

FloatArray = npt.NDArray[np.float64]

IMAGE_SIZE = (960, 640)
TAG_IN_CAM_M = (0.03, -0.12, -0.05)
TIME_OFFSET_S = 2.35
ANCHOR_STDDEV_M = 0.01

_FIRST_PHOTO = datetime(2026, 5, 14, 16, 20, 30, tzinfo=timezone(timedelta(hours=2)))
_RADIO = Radio(
    rate_hz=8.0,
    range_stddev_m=0.06,
    range_bias_m={"A1": 0.08, "A2": 0.04, "A3": 0.06, "A4": 0.08, "A5": 0.05},
    obstructed_share=0.10,
    obstructed_mean_m=0.8,
    lost_share=0.05,
    time_offset_s=TIME_OFFSET_S,
    resolution_m=0.001,
)
# The radio is on before the first photo and after the last.
_MARGIN_S = 3.0
_MAX_THREADS = 4


@dataclass(frozen=True)
class DemoSurvey:
    """Where the survey is, and the truth about it.

    Attributes:
        folder: holds ``survey.toml``, ``images``, ``uwb.csv``, ``anchors.csv`` and ``reference.csv``.
        image_names: n photos in time order.
        timestamps_s: (n,) camera clock, seconds since 1970.
        centers_m: (n, 3) projection centres in the site frame.
        world_from_cam: (n, 3, 3).
        camera: that took them.
        anchors_m: true position by id; the file's are surveyed with ``ANCHOR_STDDEV_M``.
        ranges: the log, on the radio's clock, and its truth.
        time_offset_s: image time = range time + offset.
    """

    folder: Path
    image_names: tuple[str, ...]
    timestamps_s: FloatArray
    centers_m: FloatArray
    world_from_cam: FloatArray
    camera: PhotoCamera
    anchors_m: dict[str, FloatArray]
    ranges: SimulatedRanges
    time_offset_s: float

    @property
    def survey_path(self) -> Path:
        return self.folder / "survey.toml"


def make_demo_survey(
    folder: Path,
    *,
    num_photos: int = 40,
    seed: int = 0,
    progress: Progress | None = None,
    image_size: tuple[int, int] = IMAGE_SIZE,
) -> DemoSurvey:
    """Walk through the yard with a camera and a radio and write what they brought home.

    A folder that already holds this very survey is left as it is.

    Args:
        folder: where to write; new or empty.
        num_photos: at about one a second; 40 go around the yard once.
        seed: of everything random.
        progress: told about each photo.
        image_size: width and height, pixels.

    Raises:
        InputError: the folder holds something else or cannot be written to.
    """
    progress = progress or SilentProgress()
    survey = _plan(folder, num_photos, seed, image_size)
    text = _survey_file(survey, seed)
    if _is_there(survey, text):
        return survey
    if folder.exists() and (not folder.is_dir() or any(_names_of_others(folder))):
        raise InputError("expected a new or an empty folder, or one that holds the same demo", folder)
    with sole_writer(folder):
        _take_photos(survey, seed, progress)
        write_ranges_csv(survey.ranges.log, folder / "uwb.csv")
        _write_text(folder / "anchors.csv", _anchor_file(survey, seed))
        write_reference(Reference(survey.centers_m, image_names=survey.image_names), folder / "reference.csv")
        # Last: where it is, all is.
        _write_text(survey.survey_path, text)
    return survey


def _names_of_others(folder: Path) -> Iterator[str]:
    """What is in a folder but for what a demo that is being made, or was killed, has there."""
    names = (path.name for path in folder.iterdir())
    return (name for name in names if name != LOCK_NAME and not re.fullmatch(LEFTOVER, name))


def _plan(folder: Path, num_photos: int, seed: int, image_size: tuple[int, int]) -> DemoSurvey:
    """Everything about the survey but the photos themselves."""
    rng = np.random.default_rng([seed, 2])
    path = _walk(num_photos, seed)
    times = path.start_s + _MARGIN_S + np.arange(num_photos) + np.round(rng.uniform(-0.1, 0.1, num_photos), 3)
    anchors = {name: np.array(position) for name, position in ANCHOR_POSITIONS_M.items()}
    return DemoSurvey(
        folder=folder,
        image_names=tuple(f"IMG_{number:04d}.jpg" for number in range(1, num_photos + 1)),
        timestamps_s=times,
        centers_m=path.centers(times),
        world_from_cam=path.world_from_cam(times),
        camera=PhotoCamera(image_size[0], image_size[1], 0.78 * image_size[0], -0.04),
        anchors_m=anchors,
        ranges=simulate_ranges(path, anchors, TAG_IN_CAM_M, _RADIO, seed),
        time_offset_s=TIME_OFFSET_S,
    )


def _walk(num_photos: int, seed: int) -> CameraPath:
    """Around the things in the middle of the yard, 40 photos a little more than once."""
    duration = num_photos - 1 + 2 * _MARGIN_S
    return loop_path(
        duration,
        start_s=_FIRST_PHOTO.timestamp() - _MARGIN_S,
        center_m=(WIDTH_M / 2, DEPTH_M / 2, 1.62),
        semi_axes_m=(4.4, 3.1),
        num_turns=1.25 * duration / 45,
        start_deg=200.0,
        seed=seed,
    )


def _is_there(survey: DemoSurvey, text: str) -> bool:
    try:
        return survey.survey_path.read_text(encoding="utf-8") == text and all(
            (survey.folder / "images" / name).is_file() for name in survey.image_names
        )
    except (OSError, UnicodeDecodeError):
        return False


def _take_photos(survey: DemoSurvey, seed: int, progress: Progress) -> None:
    progress.stage("photos")
    scene = courtyard(texel_m=0.006 * IMAGE_SIZE[0] / survey.camera.width_px, seed=seed)
    num_threads = min(_MAX_THREADS, os.cpu_count() or 1)
    with new_folder(survey.folder / "images") as images, ThreadPoolExecutor(num_threads) as pool:
        numbers = range(len(survey.image_names))
        taken = pool.map(lambda number: _take_photo(scene, survey, number, seed, images), numbers)
        try:
            for num_done, _ in enumerate(taken, start=1):
                progress.update(num_done, len(survey.image_names))
        except BaseException:
            pool.shutdown(cancel_futures=True)  # or a Ctrl-C would wait for all photos
            raise


def _take_photo(scene: Scene, survey: DemoSurvey, number: int, seed: int, images: Path) -> None:
    rng = np.random.default_rng([seed, 3, number])
    cam_from_world = survey.world_from_cam[number].T
    translation = -cam_from_world @ survey.centers_m[number]
    radiance = render(scene, survey.camera, np.column_stack([cam_from_world, translation]))
    exposure = float(np.exp(0.12 * np.sin(0.7 * number) + 0.05 * rng.standard_normal()))
    photo = Image.fromarray(develop(radiance, exposure, rng))
    exif = photo_exif(survey.camera, float(survey.timestamps_s[number]), _FIRST_PHOTO.tzinfo or timezone.utc)
    photo.save(images / survey.image_names[number], quality=92, exif=exif)


def photo_exif(camera: PhotoCamera, timestamp_s: float, zone: tzinfo) -> Image.Exif:
    """What a camera notes about a photo: itself, the time to the millisecond, the focal length."""
    milliseconds = round(timestamp_s * 1000)
    time = datetime.fromtimestamp(milliseconds // 1000, zone)
    # The 35 mm equivalent compares diagonals; that of the film is 43.27 mm.
    equivalent_mm = camera.focal_px * 43.27 / float(np.hypot(camera.width_px, camera.height_px))
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


def _anchor_file(survey: DemoSurvey, seed: int) -> str:
    """The anchors as somebody surveyed them."""
    rng = np.random.default_rng([seed, 1])
    lines = ["anchor_id,x_m,y_m,z_m,position_stddev_m"]
    for name, position in survey.anchors_m.items():
        x, y, z = position + ANCHOR_STDDEV_M * rng.standard_normal(3)
        lines.append(f"{name},{x:.3f},{y:.3f},{z:.3f},{ANCHOR_STDDEV_M}")
    return "\n".join(lines) + "\n"


def _survey_file(survey: DemoSurvey, seed: int) -> str:
    camera = survey.camera
    size = f"{camera.width_px} x {camera.height_px}"
    return f"""\
# A survey of a simulated yard: {len(survey.image_names)} photos of {size} pixels, seed {seed}.
# Paths are relative to this file.

[images]
path = "images"                 # when each was taken stands in its EXIF data

[camera]
model = "{camera.model}"         # f, cx, cy, k; leave the table out if the camera is not calibrated
params = [{", ".join(f"{value:g}" for value in camera.params)}]

[ranges]
path = "uwb.csv"                # timestamp_s,anchor_id,range_m
time_offset = "auto"            # the radio's clock is not the camera's: image time = range time + offset

[anchors]
path = "anchors.csv"            # surveyed in the yard: x east, y north, z up
frame = "site"

[tag]
tag_in_cam_m = [{", ".join(f"{value:g}" for value in TAG_IN_CAM_M)}]   # antenna: x right, y down, z forward

[mapper.features.sift]
max_num_features = 2000         # plenty here, and matching stays quick

[report]
reference = "reference.csv"     # the truth, only to compare with

[output]
path = "out"
"""


def _write_text(path: Path, text: str) -> None:
    with new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
