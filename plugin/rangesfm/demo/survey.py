"""A complete survey to try the pipeline on: photos of a yard, a range log, surveyed anchors, the truth, a survey file.

The photos ship with the package. The camera's path, along which the radio is simulated, is in ``path.csv``: its poses
at each photo, and at three times before the first and after the last photo. It is in the frame of the yard, in metres:
x east, y north, z up, with the origin on the ground in the south-west corner of the yard. In the frame of the site, in
which the anchors are surveyed, that corner is not at zero, as in few real sites.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.demo.simulated_imu import PHONE, imu_table, simulate_imu
from rangesfm.demo.simulated_radio import CameraPath, Radio, simulate_ranges
from rangesfm.errors import InputError
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.util.files.atomic import new_folder, write_text
from rangesfm.util.files.output_folder import PRIVATE_NAME, sole_writer
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference, write_reference

# Rendered by tests/rendering/make_demo_photos.py.
PHOTOS = Path(__file__).with_name("photos")
PATH_FILE = PHOTOS / "path.csv"
NUM_PHOTOS = 40

CAMERA_MODEL = "SIMPLE_RADIAL"
CAMERA_PARAMS = (748.8, 480.0, 320.0, -0.04)
CORNER_IN_SITE_M = (1012.0, 5003.0, 413.0)
IN_YARD_M = {  # anchors on the walls and on a container; not in one plane
    "A1": (0.05, 6.90, 2.55),
    "A2": (4.60, 9.60, 2.15),
    "A3": (13.95, 9.60, 2.90),
    "A4": (9.60, 0.05, 0.62),
    "A5": (13.95, 2.10, 1.15),
}
ANCHORS_M = {name: (CORNER_IN_SITE_M + np.array(at)).tolist() for name, at in IN_YARD_M.items()}
ANCHOR_STDDEV_M = 0.01
TAG_IN_CAM_M = (0.03, -0.12, -0.05)
TIME_OFFSET_S = 2.35

# The radio is on before the first photo and after the last, for this number of rows of ``path.csv``, one a second.
NUM_ROWS_AROUND = 3
RADIO = Radio(
    rate_hz=8.0,
    range_stddev_m=0.06,
    range_bias_m={"A1": 0.08, "A2": 0.04, "A3": 0.06, "A4": 0.08, "A5": 0.05},
    obstructed_share=0.10,
    obstructed_mean_m=0.8,
    lost_share=0.05,
    time_offset_s=TIME_OFFSET_S,
    resolution_m=0.001,
)

# A phone that is held across, with the lens on the left: its x is up, its y left, and its z towards the user.
IMU_IN_CAM_M = (0.07, 0.03, -0.01)
IMU_TIME_OFFSET_S = -0.42
CAM_FROM_IMU = np.array([(0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
_IMU_RATE_HZ = 100.0

_EXPECTED = "expected a new or an empty folder, or one that holds the same demo"


@dataclass(frozen=True)
class DemoSurvey:
    """The demo survey, with its true poses.

    Attributes:
        folder: holds ``survey.toml``, ``images``, ``uwb.csv``, ``anchors.csv`` and ``reference.csv``, and ``imu.csv``
            if there is an inertial sensor.
        image_names: n photos in time order.
        timestamps_s: (n,) times on the camera's clock, seconds since 1970.
        centers_m: (n, 3) projection centres in the site frame, metres.
        world_from_cam: (n, 3, 3) rotations.
        ranges: the log, on the radio's clock.
        imu: the log of an inertial sensor, on its clock; None without one.
    """

    folder: Path
    image_names: tuple[str, ...]
    timestamps_s: Array
    centers_m: Array
    world_from_cam: Array
    ranges: RangeLog
    imu: ImuLog | None = None

    @property
    def survey_path(self) -> Path:
        return self.folder / "survey.toml"


def make_demo_survey(folder: Path, *, num_photos: int = NUM_PHOTOS, seed: int = 0, imu: bool = False) -> DemoSurvey:
    """Write the demo survey into a folder; a folder that already holds the same survey is left as it is.

    Args:
        folder: a new or empty folder.
        num_photos: number of photos, from the first on. They are about one second apart, and all 40 go around the yard
            once.
        seed: seed of the errors of the radio, of the surveyed anchors and of the inertial sensor.
        imu: whether the camera has an inertial sensor.

    Raises:
        InputError: the folder holds something else or cannot be written to.
    """
    survey = _plan(folder, num_photos, seed, imu)
    write_demo(
        survey,
        Reference(survey.centers_m, ByPhoto(survey.image_names)),
        _survey_file(num_photos, seed),
        {"anchors.csv": _anchor_file(seed)},
        lambda number, path: shutil.copyfile(PHOTOS / survey.image_names[number], path),
    )
    return survey


def write_demo(
    survey: DemoSurvey,
    reference: Reference,
    survey_file: str,
    files: Mapping[str, str],
    take_photo: Callable[[int, Path], object],
) -> None:
    """Write a survey into its folder; a folder that already holds the same survey is left as it is.

    Args:
        reference: the truth, for ``reference.csv``.
        survey_file: text of ``survey.toml``, without the inertial sensor. files: texts of further files, by name.
        take_photo: writes the photo with this number, from 0 on, to a path.

    Raises:
        InputError: the folder holds something else or cannot be written to.
    """
    folder = survey.folder
    if survey.imu is not None:
        survey_file += _IMU_TABLE
        files = {**files, "imu.csv": imu_table(survey.imu)}
    if _is_there(survey, survey_file):
        return
    if folder.exists() and not folder.is_dir():
        raise InputError(_EXPECTED, folder)
    with sole_writer(folder) as output:
        # A demo that was killed leaves some of its files, each of them complete and recorded as this tool's own.
        others = [path for path in output.path.iterdir() if path.name != PRIVATE_NAME]
        if survey.survey_path.exists() or not all(output.is_own(path) for path in others):
            raise InputError(_EXPECTED, folder)
        with new_folder(folder / "images") as images:
            for number, name in enumerate(survey.image_names):
                take_photo(number, images / name)
        write_ranges_csv(survey.ranges, folder / "uwb.csv")
        write_reference(reference, folder / "reference.csv")
        for name, text in files.items():
            write_text(text, folder / name)
        # The survey file is written last, so that its presence shows that the survey is complete.
        write_text(survey_file, survey.survey_path)


def _plan(folder: Path, num_photos: int, seed: int, imu: bool = False) -> DemoSurvey:
    """Return the survey with its true values; nothing is written."""
    with PATH_FILE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))[: num_photos + 2 * NUM_ROWS_AROUND]
    columns = ("timestamp_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    values = np.array([[float(row[column]) for column in columns] for row in rows])
    times, centers, world_from_cam = values[:, 0], values[:, 1:4], Rotation.from_quat(values[:, 4:]).as_matrix()
    path = CameraPath.through(times, centers, world_from_cam)
    taken = slice(NUM_ROWS_AROUND, -NUM_ROWS_AROUND)
    return DemoSurvey(
        folder=folder,
        image_names=tuple(row["image_name"] for row in rows[taken]),
        timestamps_s=times[taken],
        centers_m=centers[taken] + CORNER_IN_SITE_M,
        world_from_cam=world_from_cam[taken],
        ranges=simulate_ranges(path, IN_YARD_M, TAG_IN_CAM_M, RADIO, seed),
        imu=simulate_phone(times, centers, world_from_cam, seed) if imu else None,
    )


def simulate_phone(times_s: Array, centers_m: Array, world_from_cam: Array, seed: int) -> ImuLog:
    """Return the log of a phone's inertial sensor on a camera with n poses, from the first to the last.

    Args:
        times_s: (n,) on the camera's clock. centers_m: (n, 3) in a world whose z is up. world_from_cam: (n, 3, 3).
    """
    camera = CameraPath.through(times_s - times_s[0], centers_m, world_from_cam)

    def world_from_imu(times_s: Array) -> Rotation:
        return Rotation.from_matrix(camera.world_from_cam(times_s) @ CAM_FROM_IMU)

    def places_m(times_s: Array) -> Array:
        return np.asarray(camera.centers(times_s) + camera.world_from_cam(times_s) @ np.array(IMU_IN_CAM_M))

    # Differences are taken around each sample: the spline ends at the first and the last pose.
    samples_s = np.arange(1, int(camera.end_s * _IMU_RATE_HZ)) / _IMU_RATE_HZ
    log = simulate_imu(world_from_imu, places_m, samples_s, _IMU_RATE_HZ, PHONE, np.random.default_rng([seed, 2]))
    return replace(log, timestamp_s=times_s[0] + samples_s - IMU_TIME_OFFSET_S)


def _is_there(survey: DemoSurvey, text: str) -> bool:
    try:
        return (
            survey.survey_path.is_file()
            and survey.survey_path.read_text(encoding="utf-8") == text
            and all((survey.folder / "images" / name).is_file() for name in survey.image_names)
        )
    except (OSError, UnicodeDecodeError):
        return False


def _anchor_file(seed: int) -> str:
    """Return the text of the anchor file, with positions that have the errors of a survey."""
    rng = np.random.default_rng([seed, 1])
    lines = ["anchor_id,x_m,y_m,z_m,position_stddev_m"]
    for name, position in ANCHORS_M.items():
        x, y, z = position + ANCHOR_STDDEV_M * rng.standard_normal(3)
        lines.append(f"{name},{x:.3f},{y:.3f},{z:.3f},{ANCHOR_STDDEV_M}")
    return "\n".join(lines) + "\n"


def _survey_file(num_photos: int, seed: int) -> str:
    return f"""\
# A survey of a simulated yard: {num_photos} photos, a radio with seed {seed}.
# Paths are relative to this file.

[images]
path = "images"                 # the times of the photos are in their EXIF data

[camera]
model = "{CAMERA_MODEL}"         # f, cx, cy, k; leave the table out if the camera is not calibrated
params = [{_listed(CAMERA_PARAMS)}]

[ranges]
path = "uwb.csv"                # timestamp_s,anchor_id,range_m
time_offset = "auto"            # radio and camera have different clocks: image time = range time + offset

[anchors]
path = "anchors.csv"            # surveyed in the site: x east, y north, z up
frame = "site"

[tag]
tag_in_cam_m = [{_listed(TAG_IN_CAM_M)}]   # lever arm of the antenna: x right, y down, z forward

[mapper.features.sift]
max_num_features = 2000         # enough for these photos, and keeps matching fast

[report]
reference = "reference.csv"     # the true positions, used for comparison only

[output]
path = "out"
"""


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


_IMU_TABLE = f"""
[imu]
path = "imu.csv"                # a phone's log; its clock and its axes are found
imu_in_cam_m = [{_listed(IMU_IN_CAM_M)}]   # lever arm of the sensor: x right, y down, z forward
"""
