"""Keys of a survey file, with type, bounds, default, meaning and flag of each.

This is their only definition; those of the table [mapper] are in ``mapper_options``. The stages take these tables, or
parts of them, as their options. The reader of survey files, the flags of the commands and their help, the page of all
keys and the settings in ``result.json`` are made from them.
"""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from rangesfm.errors import OptionError
from rangesfm.option_model import Bounds, Key, Options

DEFAULT_FORMATS = ("tum", "ply")
# Relative stddev of a calibrated focal length: focus, temperature and another calibration board change it by this much.
_CALIBRATION_STDDEV = 0.005

# fmt: off
TagDictionary = Literal[
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_MIP_36h12", "ARUCO_ORIGINAL",
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
]
# fmt: on

# The bounds of numbers in survey files, tables, logs and flags. Values beyond them can only be mistakes, or would
# overflow when they are squared or divided by.
STDDEV_M = Bounds(1e-6, 1e3, "metres")
STDDEV_OR_EXACT_M = replace(STDDEV_M, or_zero=True)
LENGTH_M = Bounds(1e-6, 1e6, "metres")
"""Ranges and distances. No radio reaches further."""
BIAS_M = Bounds(-1e3, 1e3, "metres")
"""Biases of ranges. A radio without its antenna delays reads some hundred metres too long."""
COORDINATE_M = Bounds(-1e9, 1e9, "metres")
LEVER_ARM_M = Bounds(-20, 20, "metres")
"""Coordinates of a tag in the camera frame. No camera carries its tag further away."""
TIME_S = Bounds(-1e10, 1e10, "seconds")
DURATION_S = Bounds(0, 1e9, "seconds")
PIXEL = Bounds(-1e6, 1e6, "pixels")

_Count = Annotated[int, Field(ge=1, le=1_000_000)]
_Zero = Annotated[float, Field(ge=0, le=0)]
_Positive = Annotated[float, Field(ge=STDDEV_M.least, le=STDDEV_M.most)]
Uncertainty = _Zero | _Positive
_Time = Annotated[float, Field(ge=TIME_S.least, le=TIME_S.most)]
_Offset = Literal["auto"] | _Time
_Duration = Annotated[float, Field(ge=DURATION_S.least, le=DURATION_S.most)]
_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Numbers = Annotated[tuple[_Number, ...], Field(strict=False)]
_Times = Annotated[tuple[_Time, ...], Field(strict=False)]
_Three = Annotated[tuple[_Number, _Number, _Number], Field(strict=False)]
_Four = Annotated[tuple[_Number, _Number, _Number, _Number], Field(strict=False)]
_Texts = Annotated[tuple[str, ...], Field(strict=False)]
_OfLeverArm = Annotated[float, Field(ge=LEVER_ARM_M.least, le=LEVER_ARM_M.most)]
_LeverArm = Annotated[tuple[_OfLeverArm, _OfLeverArm, _OfLeverArm], Field(strict=False)]
_Place = Annotated[
    tuple[
        Annotated[float, Field(ge=-90, le=90)],
        Annotated[float, Field(ge=-360, le=360)],
        Annotated[float, Field(ge=-1e5, le=1e5)],
    ],
    Field(strict=False),
]


def _direction(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(map(abs, vector)) < 1e-6:
        raise ValueError("is 0,0,0")
    return vector


def _unit_quaternion(xyzw: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if abs(sum(x * x for x in xyzw) - 1.0) > 0.02:  # rounded to two digits
        raise ValueError("no unit quaternion")
    return xyzw


def _is_of(name: str, pattern: str) -> bool:
    return fnmatchcase(name, pattern) or name.startswith(f"{pattern.rstrip('/')}/")


def _span(times: tuple[float, ...]) -> tuple[float, ...]:
    if times and not (len(times) == 2 and times[0] < times[1]):
        raise ValueError("is no span")
    return times


_TimeUnit = Literal["s", "ms", "us", "ns", "ticks", "min", "h", "d", "iso", "dmy", "mdy"]
_LengthUnit = Literal["m", "cm", "mm", "dm", "km", "ft", "in", "yd"]


class ImageOptions(Options, table="images"):
    """The photos. Of the keys that choose keyframes, all that are given apply together."""

    every_nth: Annotated[_Count, Key(is_common=True)] = 1
    """Use every n-th photo, in order of time."""
    min_interval_s: _Duration = 0.0
    """Shortest time between two keyframes."""
    max_num_keyframes: Annotated[int, Field(ge=3, le=1_000_000)] | None = None
    """Largest number of keyframes; the photos are thinned evenly to it (default: no limit)."""
    path: Annotated[Path | None, Key(flag="images", metavar="PATH", role="photos", is_common=True)] = None
    """Folder of the photos (subfolders included), a video, or a ROS bag with images. The flag also takes the CSV with
    the photos' times."""
    model: Annotated[Path | None, Key(flag="input_path", metavar="MODEL", role="model", is_common=True)] = None
    """Folder of a COLMAP model, such as sparse/0, to start from; no photos are needed then. Or a trajectory of the
    camera in any unit, to be scaled: a TUM file, or a CSV timestamp_s,x_m,y_m,z_m,qx,qy,qz,qw."""
    times: Annotated[Path | None, Key(flag="image_times", role="file", is_common=True)] = None
    """CSV image_name,timestamp_s with the times of the photos, or another table of photos and times (default: by
    rate_hz if given, else EXIF, else file names)."""
    times_columns: Annotated[dict[str, str], Key(flag="image_times_columns")] = Field(default_factory=dict)
    """Names of the columns of times (numbers, where they have no names) for image_name, timestamp and possibly date
    and nanoseconds (default: recognised)."""
    times_unit: Annotated[_TimeUnit | None, Key(flag="image_times_unit")] = None
    """Unit of the times, as timestamp_unit in [ranges] (default: by column name or values)."""
    rig_config: Annotated[Path | None, Key(flag="rig_config_path", metavar="JSON", role="file")] = None
    """COLMAP's rig_config.json, lengths in metres. Photos of a rig whose names are the same after their image_prefix
    were taken at the same time, that of the reference camera's photo. A given cam_from_rig is kept while mapping, and
    the length of its translation is a measured distance, tested against the ranges; cameras without one are placed by
    a first model made without the rig."""
    baseline_stddev_m: _Positive = 0.001
    """Standard deviation of the known distance of each camera of a rig from the reference camera."""
    rate_hz: Annotated[Annotated[float, Field(ge=1e-3, le=1e3)] | None, Key(flag="image_rate_hz")] = None
    """Photos per second. From a video or a bag so many are taken, the sharpest image of each interval (default: 2). For
    a folder of photos it is the fixed rate at which they were taken, in the order of the numbers in their names
    (default: the photos have times)."""
    topic: Annotated[str, Key(flag="image_topic")] = ""
    """Topic of the images, for a bag with several image topics."""

    @property
    def extraction_rate_hz(self) -> float:
        """Return the number of photos per second that are taken from a video or a bag."""
        return 2.0 if self.rate_hz is None else self.rate_hz


class CameraOptions(Options, table="camera"):
    """The cameras of the photos."""

    images: Annotated[str, Key(flag="camera_images", metavar="PATTERN")] = ""
    """Photos that this table is about, where there are several [[camera]] tables: a folder, or a pattern of names such
    as left*.jpg. One table may leave it out, for all other photos."""
    mode: Annotated[Literal["auto", "single", "per_folder", "per_image"], Key(flag="camera_mode")] = "auto"
    """Photos of one size that have one camera. auto: those with the same make, model, serial number and focal length in
    EXIF, or all without EXIF; single: all; per_folder: those of one folder; per_image: none."""
    model: Annotated[str, Key(flag="camera_model")] = ""
    """COLMAP camera model, such as OPENCV (default: COLMAP chooses one)."""
    params: Annotated[_Numbers, Key(flag="camera_params")] = ()
    """Parameters of the camera model in COLMAP's order, for photos of the most common size; they are rescaled for
    photos of another size and the same shape."""
    focal_length_stddev_px: Uncertainty | None = None
    """Standard deviation of the focal lengths in params, in pixels; those of the other parameters are derived from it.
    Mapping and refinement adjust the given parameters within it. 0 keeps them all exactly as given (default: 0.5 % of
    the focal length)."""
    refine_intrinsics: bool | None = None
    """Adjust the camera parameters in mapping and refinement (default: mapping does, given ones only once the map is
    complete; the refinement adjusts given ones within their stddev and keeps all others)."""

    others: Annotated[tuple[CameraOptions, ...], Key(is_key=False)] = ()
    """Further [[camera]] tables, each with its pattern. This table is for photos that match none of them."""

    @property
    def tables(self) -> tuple[CameraOptions, ...]:
        return (self, *self.others)

    def of_photo(self, name: str) -> CameraOptions:
        """Return the table that a photo belongs to.

        Raises:
            OptionError: the photo matches the patterns of two tables.
        """
        found = [table for table in self.others if table.images and _is_of(name, table.images)]
        if len(found) > 1:
            patterns = " and ".join(f"'{table.images}'" for table in found)
            raise OptionError(f"[[camera]] images {patterns} both match the photo {name}, expected one", "camera")
        return found[0] if found else self

    @property
    def intrinsics_in_mapping(self) -> Literal["kept", "refined last", "refined"]:
        """Say when mapping adjusts the camera parameters.

        A given calibration is kept until the map is complete: few photos determine a lens badly, and a map begun with
        wrong parameters stays bent.
        """
        if self.refine_intrinsics is None and self.params:
            return "kept" if self.focal_length_stddev_px == 0 else "refined last"
        return "kept" if self.refine_intrinsics is False else "refined"

    @property
    def refinement_refines_intrinsics(self) -> bool:
        if self.refine_intrinsics is None:
            return bool(self.params) and self.focal_length_stddev_px != 0
        return self.refine_intrinsics

    def calibration_stddev_px(self, focal_length_px: float) -> float:
        """Return the standard deviation of a given focal length, both in pixels."""
        return self.focal_length_stddev_px or _CALIBRATION_STDDEV * focal_length_px


class RangeModelOptions(Options, table="ranges"):
    """Assumptions about the radio's errors."""

    range_stddev_m: _Positive | None = None
    """Standard deviation of the noise of a range (default: estimated from the residuals)."""
    range_bias_stddev_m: Uncertainty = 0.01
    """Standard deviation of the prior of each anchor's own constant bias, mean 0. It is small on purpose: a freer bias
    absorbs errors that depend on direction, and shifts the map."""
    common_bias_stddev_m: Uncertainty = 0.1
    """Standard deviation of the prior of the bias that is common to all anchors (the tag's delay), mean 0."""


def _offset_key(table: str) -> Key:
    return Key(flag=f"{table}_time_offset", metavar="auto|SECONDS", expected='"auto" or seconds, at most 1e+10 of them')


class _OptionsOfLog(Options):
    """What all logs have that are kept by a clock of their own."""

    time_offset: _Offset = "auto"

    @property
    def time_offset_s(self) -> float | None:
        """Return the given time offset, or None where it is to be searched for."""
        return None if self.time_offset == "auto" else self.time_offset


class RangesOptions(RangeModelOptions, _OptionsOfLog):
    """The radio's log, how its ranges are placed on the path, assumptions about its errors, and checks."""

    path: Annotated[
        Path | None, Key(flag="ranges", metavar="LOG", role="log", is_common=True, metres="a radio's log")
    ] = None
    """The radio's log: a file, a folder of files, or a pattern such as uwb_*.csv."""
    format: Annotated[str, Key(flag="ranges_format")] = ""
    """Format of the log (default: recognised by content)."""
    columns: dict[str, str] = Field(default_factory=dict)
    """Names of the log's columns (numbers, where they have no names) for timestamp (or image_name), anchor_id, range,
    tag_id, range_stddev, los; range:A1 for a column that holds the ranges of anchor A1. A log without ranges needs the
    time stamps of two-way ranging: tx1, rx1, tx2, rx2 and possibly tx3, rx3."""
    timestamp_unit: _TimeUnit | None = None
    """Unit of the log's times. ticks: those of a DW1000, of 15.65 ps; d: days, also as Excel and MATLAB count them;
    iso: dates and times; dmy, mdy: the same with dates that begin with the day or the month (default: by format, column
    name or values)."""
    range_unit: _LengthUnit | None = None
    """Unit of the log's ranges (default: by format, column name or values)."""
    separator: Annotated[Annotated[str, Field(max_length=1)], Key(metavar="CHARACTER", expected="one character")] = ""
    """Character between the cells of a row (default: recognised)."""
    ranging_interval_s: Annotated[float, Field(ge=1e-6, le=1e6)] = 0.2
    """Time between two ranging rounds, for a Qorvo log without times of the host."""
    stamp_unit: Literal["ns", "us", "ms", "s", "ticks"] = "ns"
    """Unit of the time stamps, in a log without ranges."""
    stamp_bits: Literal[32, 40] = 32
    """Number of bits of the counter behind the time stamps; 32 bits count up to 67 ms."""
    propagation_speed: Annotated[
        Literal["air", "vacuum"] | Annotated[float, Field(ge=1e8, le=3e8)],
        Key(expected="air, vacuum or a speed of light in m/s"),
    ] = "air"
    """Speed of the radio signal, for ranges computed from time stamps."""
    t_off_s: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Time that the delays of both devices together add to a round trip, for ranges computed from time stamps."""
    error_curve: Annotated[Path | None, Key(role="file")] = None
    """File with the radio's error by distance, written by rangesfm ranges calibrate."""
    time_offset: Annotated[_Offset, _offset_key("ranges")] = "auto"
    """Time offset between the clocks: image time = range time + offset. auto: it is searched for."""

    max_interpolation_gap_s: _Duration = 2.0
    """Longest time between two keyframes between which poses are interpolated."""
    max_time_difference_s: _Duration = 0.02
    """Largest time between a range and a keyframe at which the range counts as taken at the keyframe, where no pose can
    be interpolated."""
    check_share: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Fraction of the ranges that are checks, chosen at random, and take no part in the estimate. This is the mildest
    check, because ranges that are close in time have the same errors."""
    check_anchors: _Texts = ()
    """Ids of anchors with surveyed positions; all their ranges are checks."""
    check_times_s: Annotated[
        _Times, AfterValidator(_span), Key(metavar="A,B", expected="two times in seconds, the later one last")
    ] = ()
    """First and last time, on the radio's clock; the ranges between them are checks."""


class AnchorOptions(Options, table="anchors"):
    """The anchors."""

    path: Annotated[Path | None, Key(flag="anchors", role="file", is_common=True)] = None
    """CSV anchor_id,x_m,y_m,z_m, possibly with position_stddev_m, range_bias_m and range_bias_stddev_m, or another
    table of points or a GSI file; empty coordinates mean an unknown position (default: the anchors in the log, all
    unknown)."""
    columns: Annotated[dict[str, str], Key(flag="anchor_columns")] = Field(default_factory=dict)
    """Names of the columns of the file (numbers, where they have no names) for anchor_id, x, y, z, position_stddev,
    range_bias and range_bias_stddev; x is east and y north, if they are such (default: recognised)."""
    unit: Annotated[_LengthUnit | None, Key(flag="anchor_unit")] = None
    """Unit of the coordinates (default: that in the names of the columns, else m)."""
    frame: Annotated[Literal["site", "first_camera", "unknown"] | None, Key(flag="anchor_frame")] = None
    """Frame of the anchors' coordinates (default: site if the file has any position, else unknown)."""
    crs: Annotated[str, Key(flag="anchor_crs")] = ""
    """Coordinate reference system of the anchors' positions, such as EPSG:2056 (default: a local frame in metres)."""
    use: Annotated[_Texts, Key(flag="use_anchors")] = ()
    """Ids of the anchors whose ranges are used (default: all)."""


class PointOptions(Options, table="points"):
    """Marks in the photos whose coordinates are known: control points and check points."""

    path: Annotated[Path | None, Key(flag="points", role="file", is_common=True, metres="control points")] = None
    """CSV marker,x_m,y_m,z_m[,stddev_m,kind] with coordinates of marks in the site, or another table of points, ODM's
    gcp_list.txt, or Metashape's markers (XML). A control point determines the map, a check point is only compared with
    it. The photos that show them are in that file, in that of [scale] markers, or found (printed tags)."""
    columns: Annotated[dict[str, str], Key(flag="point_columns")] = Field(default_factory=dict)
    """Names of the columns of the file (numbers, where they have no names) for marker, x, y, z, stddev and kind; x is
    east and y north, if they are such (default: recognised)."""
    unit: Annotated[_LengthUnit | None, Key(flag="point_unit")] = None
    """Unit of the coordinates (default: that in the names of the columns, else m)."""
    crs: Annotated[str, Key(flag="point_crs")] = ""
    """Coordinate reference system of the points, such as EPSG:2056 (default: that of gcp_list.txt, else the frame of
    the anchors)."""
    stddev_m: Annotated[_Positive, Key(flag="point_stddev_m")] = 0.01
    """Standard deviation of each coordinate of a point for which the file has none. Its order of magnitude is enough,
    as it is estimated with the map."""


class PositionOptions(_OptionsOfLog, table="positions"):
    """Positions of an antenna on the camera: by satellites, by a radio that hands out positions, or a total station."""

    path: Annotated[Path | None, Key(flag="positions", role="file_or_photos", metres="positions")] = None
    """CSV timestamp_s,x_m,y_m,z_m[,stddev_m] (or image_name in place of timestamp_s; stddev_x_m, stddev_y_m and
    stddev_z_m, or a covariance cov_xx_m2, cov_xy_m2, ..), another table, a TUM trajectory, NMEA sentences, a solution
    of RTKLIB, a log of Marvelmind's dashboard, or a database of COLMAP with pose priors; or the folder of photos, for
    those in their EXIF data."""
    format: Annotated[str, Key(flag="positions_format")] = ""
    """Format of the file: table, tum, nmea, rtklib, gpx, odm, dwm1001, marvelmind or colmap (default: by content)."""
    columns: Annotated[dict[str, str], Key(flag="position_columns")] = Field(default_factory=dict)
    """Names of the columns of a table (numbers, where they have no names) for timestamp or image_name, x, y, z, and
    possibly stddev (or stddev_x, stddev_y, stddev_z) and tag_id (default: recognised)."""
    timestamp_unit: Annotated[_TimeUnit | None, Key(flag="position_time_unit")] = None
    """Unit of the times, as timestamp_unit in [ranges] (default: by column name or values)."""
    unit: Annotated[_LengthUnit | None, Key(flag="position_unit")] = None
    """Unit of the coordinates (default: that in the names of the columns, else m)."""
    crs: Annotated[str, Key(flag="position_crs")] = ""
    """Coordinate reference system of the positions, such as EPSG:2056 (default: that of the format, else the frame of
    anchors and points)."""
    tag_id: Annotated[str, Key(flag="position_tag_id")] = ""
    """Id of the tag on the camera, for a file with positions of several."""
    antenna_in_cam_m: Annotated[_LeverArm, Key(flag="antenna_in_cam", metavar="X,Y,Z")] = (0.0, 0.0, 0.0)
    """Lever arm: position of the antenna, or of the prism, in the camera frame (right, down, forward), metres."""
    time_offset: Annotated[_Offset, _offset_key("positions")] = "auto"
    """Time offset between the clocks: image time = time of the position + offset. auto: it is searched for."""
    stddev_m: Annotated[_Positive | None, Key(flag="position_stddev_m")] = None
    """Standard deviation of each coordinate of the positions, in place of what the file says of it (default: as the
    file says; in both cases it is estimated with the map)."""
    lasting_s: Annotated[Annotated[float, Field(ge=1e-2, le=1e5)] | None, Key(flag="position_lasting_s")] = None
    """Time for which an error of the positions lasts (default: a mixture of 3, 30 and 300 s, learnt with the map)."""


class ImuOptions(_OptionsOfLog, table="imu"):
    """The log of an inertial sensor (IMU) that is fixed to the camera: of a phone, an action camera or a rig."""

    path: Annotated[
        Path | None, Key(flag="imu", metavar="PATH", role="log", metres="the log of an inertial sensor")
    ] = None
    """CSV timestamp_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2, another table with
    the rates and accelerations of three axes, the folder or zip archive of a phone's recording, or a ROS bag."""
    rotation_imu_to_cam_xyzw: Annotated[
        Annotated[_Four, AfterValidator(_unit_quaternion)] | None,
        Key(metavar="X,Y,Z,W", expected="a list of 4 numbers: a quaternion x, y, z, w of length 1"),
    ] = None
    """Rotation that takes the sensor's axes to the camera's (right, down, forward). It is compared with the turns of
    the photos (default: found from these)."""
    imu_in_cam_m: Annotated[_LeverArm | None, Key(flag="imu_in_cam", metavar="X,Y,Z")] = None
    """Lever arm: position of the sensor in the camera frame (right, down, forward), metres (default: at the camera)."""
    time_offset: Annotated[_Offset, _offset_key("imu")] = "auto"
    """Time offset between the clocks: image time = time of the log + offset. auto: found from the turns of the photos,
    with which a given one is compared."""
    noise: Annotated[Path | None, Key(flag="imu_noise", metavar="YAML", role="file")] = None
    """Kalibr's imu.yaml, with the densities of the sensor's noise (default: learnt)."""


class TagOptions(Options, table="tag"):
    """The radio tag on the camera, or several tags."""

    tag_in_cam_m: Annotated[_LeverArm, Key(flag="tag_in_cam", metavar="[ID:]X,Y,Z", is_common=True)] = (
        0.0,
        0.0,
        0.0,
    )
    """Lever arm: position of the tag's antenna in the camera frame (right, down, forward), metres; with a rig, in the
    frame of its reference camera. With several tags, give the flag once for each, with the tag's ID."""
    lever_arms_m: Annotated[dict[str, _LeverArm], Key(flag="tag_in_cam", metavar="ID:X,Y,Z")] = Field(
        default_factory=dict
    )
    """Lever arms by tag id, for a camera with several tags."""
    tag_id: str = ""
    """Id of the tag whose ranges are used, if the log has others (default: all tags with a lever arm)."""

    @model_validator(mode="after")
    def _one_or_several(self) -> TagOptions:
        if "tag_in_cam_m" in self.model_fields_set and self.lever_arms_m:
            why = "expected nothing beside lever_arms_m: either one lever arm or one by tag id"
            raise self.refused("tag_in_cam_m", f"is {list(self.tag_in_cam_m)}, {why}")
        return self


class ScaleOptions(Options, table="scale"):
    """The estimate of the scale, and distances taped on the site."""

    method: Annotated[Literal["robust", "two-candidate", "two-candidate-unchecked"], Key(flag="scale_method")] = (
        "robust"
    )
    """Method of the scale estimate. robust: a robust fit of all ranges; two-candidate: that of the 2018 paper, for
    comparison: it has no interval, and is refused where the robust estimate excludes it; two-candidate-unchecked: not
    even then."""
    max_relative_stddev: Annotated[float, Field(ge=1e-9, le=1e3)] = 0.1
    """Largest accepted relative standard deviation of the scale; a scale that is less certain is refused."""
    up_in_first_camera: Annotated[
        Annotated[_Three, AfterValidator(_direction)] | None,
        Key(expected="a list of 3 numbers up to 1e+09: a direction, not 0,0,0"),
    ] = None
    """Upward direction in the camera frame of the first keyframe, of any length; 0,-1,0 if the camera was level. With
    it, two anchors with site coordinates are enough, and a mirror image that puts the map upside down is ruled out."""
    camera_side: Literal["above", "below"] | None = None
    """Side of the anchors' plane on which the camera moved, for surveyed anchors that are all in one plane."""
    adopt: bool = False
    """Run again with the likeliest mistake corrected, where the tests find one: an anchor taken as unknown, the lever
    arm that fits, labels swapped, some of the ranges left out. The result says what was changed."""
    distances: Annotated[Path | None, Key(role="file", is_common=True, metres="taped distances")] = None
    """CSV from,to,distance_m[,stddev_m,kind] with taped distances."""
    markers: Annotated[Path | None, Key(role="file")] = None
    """CSV marker,image_name,x_px,y_px with the places in photos of the marks between which distances were taped, or
    whose coordinates are in [points]."""


class MarkerOptions(Options, table="markers"):
    """Printed tags of known size in the photos."""

    dictionary: Annotated[TagDictionary | None, Key(flag="marker_dictionary", metavar="NAME")] = None
    """Dictionary of the printed tags, by OpenCV's name. The corners of tag 7 are the markers tag7.0 (upper left of the
    upright tag) to tag7.3, clockwise (default: no tags are looked for)."""
    side_m: Annotated[_Positive | None, Key(flag="marker_side_m", metres="the size of printed tags")] = None
    """Side of the tags, from black corner to black corner. Each tag found gives four known lengths (default: none; the
    corners only serve as ends of taped distances)."""
    side_stddev_m: Annotated[_Positive, Key(flag="marker_side_stddev_m")] = 0.0005
    """Standard deviation of the side; the error is the same for all tags."""

    @model_validator(mode="after")
    def _side_is_of_a_dictionary(self) -> MarkerOptions:
        if self.side_m is not None and self.dictionary is None:
            raise self.refused("side_m", f"is {self.side_m:g}, expected a dictionary beside it: which tags are they?")
        return self


class RefineOptions(Options, table="refine"):
    """Bundle adjustment with the ranges."""

    enabled: Annotated[bool, Key(flag="refine")] = True
    """Refine the map after it is scaled."""
    max_num_iterations: Annotated[int, Field(ge=0, le=1_000_000)] = 200
    """Largest number of iterations of the solver."""
    range_loss_scale: Annotated[float, Field(ge=1e-3, le=1e9)] = 3.46
    """Residual, in standard deviations, from which a range is down-weighted (Geman-McClure loss)."""
    lever_arm_stddev_m: Uncertainty = 0.0
    """Standard deviation of each coordinate of the lever arms. They are refined unless it is 0."""
    time_offset_stddev_s: Uncertainty = 0.0
    """Standard deviation of the time offset, which is refined unless it is 0. An offset that the search finds only
    roughly is refined in any case, with the standard deviation of the search."""
    short_range_stddev_m: Uncertainty = 0.0
    """Standard deviation of an error of short ranges that is common to all anchors and decays with a length of 1 m. It
    is refined unless this is 0; with 0, short ranges get less weight instead."""
    covariance: bool = True
    """Compute the covariance of poses, anchors and scale. It is not computed for more than 1500 photos that nearly all
    see the same, or for more than some 18 000 over a field with loops everywhere; along a path it can be computed for
    more."""
    bundle_adjustment: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's BundleAdjustmentOptions."""


class ExportOptions(Options, table="export"):
    """The metric model in other formats, and the frame of the exported files."""

    formats: Annotated[_Texts, Key(is_common=True)] = DEFAULT_FORMATS
    """Names of export formats; the message about an unknown name lists them all."""
    frame: Annotated[Literal["result", "level", "enu"], Key(flag="export_frame")] = "result"
    """Frame of the exported files. result: that of the result (site or first camera); level: z up, y along the first
    camera's view unless it is in the site, the origin near the cameras if it is far from them; enu: x east, y north,
    z up, which needs a georeferenced map."""
    up: str = "auto"
    """Upward direction, for the frames level and enu. cameras: mean upward direction of the photos; path: perpendicular
    to the plane of the path; X,Y,Z: a direction in the result's frame; auto: z in a site frame, else as cameras."""
    crs: Annotated[str, Key(flag="export_crs")] = ""
    """Coordinate reference system of LAZ and GeoPackage files, such as EPSG:2056 (default: that of the anchors, else
    longitude and latitude)."""
    origin_anchor: str = ""
    """Id of an anchor whose geographic position is known."""
    origin_lat_lon_height: Annotated[
        _Place | None,
        Key(
            metavar="LAT,LON,H",
            expected="3 numbers: latitude up to 90 and longitude up to 360 degrees, height up to 1e+05 metres",
        ),
    ] = None
    """Geographic position of that anchor: degrees, and metres above the ellipsoid (WGS 84)."""
    heading_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Azimuth of the first camera's viewing direction, clockwise from north."""


class ReportOptions(Options, table="report"):
    """The report, and true positions to compare the result with."""

    reference: Annotated[Path | None, Key(metavar="FILE", role="file", is_common=True)] = None
    """File with true positions of the camera, for comparison: CSV or TUM."""
    title: Annotated[str, Key(flag="report_title", metavar="TEXT")] = ""
    """Title of the report. Without one it is the name of the folder."""
    by: Annotated[str, Key(flag="report_by", metavar="TEXT")] = ""
    """Who made the survey, for the report."""
    enabled: Annotated[bool, Key(flag="report")] = True
    """Write report.html."""


class OutputOptions(Options, table="output"):
    """The folder of the results, and the seed."""

    path: Annotated[Path, Key(flag="output_path", role="output", is_common=True)] = Path("out")
    """Folder of the results."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    """Seed of everything random: the same model and ranges give the same result with it, and so do photos with
    reproducible."""
