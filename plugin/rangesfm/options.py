"""The keys of a survey file: of each its type, bounds, default, meaning and flag, written here (those of [mapper]
in ``mapper_options``) and nowhere else.

The stages take these tables, or the part of one that is theirs, as their options. The reader of survey files, the
commands' flags, their help, the reference of all keys and the settings in ``result.json`` follow from them.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from rangesfm.errors import OptionError
from rangesfm.mapper_options import MapperOptions as MapperOptions
from rangesfm.option_model import Options, Told

DEFAULT_FORMATS = ("tum", "ply")
_CALIBRATION_STDDEV = 0.005  # of a focal length, relative: what focus, warmth and another board make of it

# fmt: off
TagDictionary = Literal[
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_MIP_36h12", "ARUCO_ORIGINAL",
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
]
# fmt: on

# Bounds keep out what only a slip can mean, and what would be infinite once it is squared or divided by.
_Count = Annotated[int, Field(ge=1, le=1_000_000)]
_Zero = Annotated[float, Field(ge=0, le=0)]
_Positive = Annotated[float, Field(ge=1e-6, le=1e3)]
_Uncertainty = _Zero | _Positive
_Time = Annotated[float, Field(ge=-1e10, le=1e10)]
_Duration = Annotated[float, Field(ge=0, le=1e9)]
_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Numbers = Annotated[tuple[_Number, ...], Field(strict=False)]
_Times = Annotated[tuple[_Time, ...], Field(strict=False)]
_Three = Annotated[tuple[_Number, _Number, _Number], Field(strict=False)]
_Texts = Annotated[tuple[str, ...], Field(strict=False)]
# No camera carries its tag further away: beyond that its unit is wrong.
_OfLeverArm = Annotated[float, Field(ge=-20, le=20)]
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


def _is_of(name: str, pattern: str) -> bool:
    return fnmatchcase(name, pattern) or name.startswith(f"{pattern.rstrip('/')}/")


def _span(times: tuple[float, ...]) -> tuple[float, ...]:
    if times and not (len(times) == 2 and times[0] < times[1]):
        raise ValueError("is no span")
    return times


class KeyframeOptions(Options, table="images"):
    """Which photos become keyframes. All that are given must hold."""

    every_nth: _Count = 1
    """Use every n-th photo, in time order."""
    min_interval_s: _Duration = 0.0
    """Least time between keyframes."""
    max_num_keyframes: Annotated[int, Field(ge=3, le=1_000_000)] | None = None
    """Thin evenly to at most this many."""


class ImageOptions(KeyframeOptions):
    """The photos."""

    path: Annotated[Path | None, Told(flag="images", metavar="PATH", role="photos")] = None
    """Folder of the photos and of folders of them, a video, or a ROS bag with images; as a flag also the CSV of the
    photos' times."""
    model: Annotated[Path | None, Told(flag="input_path", metavar="MODEL", role="model")] = None
    """Folder of a COLMAP model, as sparse/0, to go on from: then no photos are needed."""
    times: Annotated[Path | None, Told(flag="image_times", role="file")] = None
    """CSV image_name,timestamp_s (default: EXIF, else file names)."""
    rig_config: Annotated[Path | None, Told(flag="rig_config_path", metavar="JSON", role="file")] = None
    """COLMAP's rig_config.json, lengths in metres: photos of one rig whose names go on alike after their image_prefix
    were taken at once, when the reference camera's was. A cam_from_rig is kept while mapping, and the length of its
    translation is a measured distance, which checks the ranges and is checked by them; cameras without one are placed
    by a model made without the rig first."""
    baseline_stddev_m: _Positive = 0.001
    """Of each known distance of a rig's camera from its reference camera."""
    rate_hz: Annotated[float, Field(ge=1e-3, le=1e3), Told(flag="image_rate_hz")] = 2.0
    """Photos a second of a video or a bag: of each such interval the sharpest one."""
    topic: Annotated[str | None, Told(flag="image_topic")] = None
    """Of the images, for a bag with several such topics."""


class CameraOptions(Options, table="camera"):
    """The cameras of the photos."""

    images: Annotated[str | None, Told(flag="camera_images", metavar="PATTERN")] = None
    """Of several [[camera]] tables, which photos each is of: a folder, or a pattern of their names as left*.jpg; one
    table may do without, for all others."""
    mode: Annotated[Literal["auto", "single", "per_folder", "per_image"], Told(flag="camera_mode")] = "auto"
    """Which photos of one size share a camera: those of the same make, model, serial number and focal length by EXIF
    (auto; without EXIF all), all of them, those of one folder, or none."""
    model: Annotated[str | None, Told(flag="camera_model")] = None
    """COLMAP camera model, as OPENCV (default: COLMAP guesses)."""
    params: Annotated[_Numbers | None, Told(flag="camera_params")] = None
    """Its parameters in COLMAP's order, for photos of the most common size; rescaled for others of the same shape."""
    focal_length_stddev_px: _Uncertainty | None = None
    """Of the focal lengths in params, a calibration, which mapping and refinement refine where the photos know better;
    the other parameters' follow from it (default: 0.5 % of the focal length). 0 keeps them all to the digit."""
    refine_intrinsics: bool | None = None
    """Whether mapping and refinement adjust them at all (default: mapping does, to given ones once the map is whole;
    the refinement does to given ones, by their stddev, and else keeps what it finds, so that it does the same to a
    model just mapped and one brought)."""

    others: Annotated[tuple[CameraOptions, ...], Told(is_key=False)] = ()
    """Those of the other tables, each with its pattern; this one is for photos of which none is."""

    @property
    def tables(self) -> tuple[CameraOptions, ...]:
        return (self, *self.others)

    def of_photo(self, name: str) -> CameraOptions:
        """The table that a photo belongs to; OptionError for one that belongs to two."""
        found = [table for table in self.others if table.images is not None and _is_of(name, table.images)]
        if len(found) > 1:
            patterns = " and ".join(f"'{table.images}'" for table in found)
            raise OptionError(f"[[camera]] images {patterns} are both of the photo {name}, expected one", "camera")
        return found[0] if found else self

    @property
    def intrinsics_in_mapping(self) -> Literal["kept", "refined last", "refined"]:
        """A calibration holds while the map grows: few photos know less of a lens, and what they take it for lasts."""
        if self.refine_intrinsics is None and self.params is not None:
            return "kept" if self.focal_length_stddev_px == 0 else "refined last"
        return "kept" if self.refine_intrinsics is False else "refined"

    @property
    def refinement_refines_intrinsics(self) -> bool:
        if self.refine_intrinsics is None:
            return self.params is not None and self.focal_length_stddev_px != 0
        return self.refine_intrinsics

    def calibration_stddev_px(self, focal_length_px: float) -> float:
        """Of a given focal length."""
        return self.focal_length_stddev_px or _CALIBRATION_STDDEV * focal_length_px


class LogOptions(Options, table="ranges"):
    """The radio's log and how to take it."""

    path: Annotated[Path | None, Told(flag="ranges", metavar="LOG", role="log")] = None
    """The radio's log: a file, a folder of them, or a pattern as uwb_*.csv."""
    format: Annotated[str | None, Told(flag="ranges_format")] = None
    """Its format (default: recognised by content)."""
    columns: Annotated[dict[str, str], Told(metavar="QUANTITY=NAME,..")] = Field(default_factory=dict)
    """Names of its columns (numbers, where they have none) for timestamp (or image_name), anchor_id, range, tag_id,
    range_stddev, los; range:A1 for a column of one anchor; without range, the time stamps tx1, rx1, tx2, rx2 and
    possibly tx3, rx3 of two-way ranging."""
    timestamp_unit: Literal["s", "ms", "us", "ns", "min", "h", "d", "iso", "dmy", "mdy"] | None = None
    """Of its times; d: days, also as Excel and MATLAB count them; iso: dates and times, dmy and mdy: those whose dates
    begin with the day or the month (default: by format, name or values)."""
    range_unit: Literal["m", "cm", "mm", "ft"] | None = None
    """Of its ranges (default: by format, name or values)."""
    separator: Annotated[
        Annotated[str, Field(min_length=1, max_length=1)] | None, Told(metavar="CHARACTER", expected="one character")
    ] = None
    """Between cells (default: told from the rows)."""
    ranging_interval_s: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None
    """Between two rounds, for a Qorvo log without the host's times (default: 0.2)."""
    stamp_unit: Literal["ns", "us", "ms", "s", "ticks"] = "ns"
    """Of time stamps, in a log without ranges."""
    stamp_bits: Literal[32, 40] = 32
    """Of the stamps' counter; 32 do up to 67 ms."""
    propagation_speed: Annotated[
        Literal["air", "vacuum"] | Annotated[float, Field(ge=1e8, le=3e8)],
        Told(expected="air, vacuum or a speed of light in m/s"),
    ] = "air"
    """Of the signal, for stamps."""
    t_off_s: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """What all delays of both devices together add to a round trip of stamps."""
    error_curve: Annotated[Path | None, Told(role="file")] = None
    """The radio's error by distance, as rangesfm ranges calibrate writes it."""
    time_offset: Annotated[
        Literal["auto"] | _Time,
        Told(flag="ranges_time_offset", metavar="auto|SECONDS", expected='"auto" or seconds, at most 1e+10 of them'),
    ] = "auto"
    """Image time = range time + offset; auto: searched for."""

    @property
    def time_offset_s(self) -> float | None:
        """None: to be searched for."""
        return None if self.time_offset == "auto" else self.time_offset


class AssociationOptions(Options, table="ranges"):
    """Ranges to places on the path."""

    max_interpolation_gap_s: _Duration = 2.0
    """Between keyframes further apart than this no pose is interpolated."""
    max_time_difference_s: _Duration = 0.02
    """A range this close to a keyframe counts as taken there, where no pose can be interpolated."""


class CheckOptions(Options, table="ranges"):
    """Ranges held out of every estimate, to be compared with the result."""

    check_share: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Share of the ranges held out as checks, chosen at random; neighbours in time err alike, so that this is the
    mildest check."""
    check_anchors: _Texts = ()
    """Ids of anchors with surveyed positions, whose ranges are all held out."""
    check_times_s: Annotated[
        _Times, AfterValidator(_span), Told(metavar="A,B", expected="two times in seconds, the later one last")
    ] = ()
    """From when to when, on the radio's clock, ranges are held out."""


class RangeModelOptions(Options, table="ranges"):
    """What is assumed of the radio."""

    range_stddev_m: _Positive | None = None
    """Noise of a range (default: estimated from the residuals)."""
    range_bias_stddev_m: _Uncertainty = 0.01
    """Prior of each anchor's own constant bias, mean 0; small on purpose: a freer bias soaks up errors that depend on
    direction, and shifts the map instead."""
    common_bias_stddev_m: _Uncertainty = 0.1
    """Prior of the bias that all anchors share (the tag's delay), mean 0."""


class RangesOptions(RangeModelOptions, CheckOptions, AssociationOptions, LogOptions):
    """The radio's log, what is assumed of it, and which of its ranges are held out."""


class AnchorOptions(Options, table="anchors"):
    """The anchors."""

    path: Annotated[Path | None, Told(flag="anchors", role="file")] = None
    """CSV anchor_id,x_m,y_m,z_m[,position_stddev_m,range_bias_m,range_bias_stddev_m] (default: the anchors in the log,
    all unknown)."""
    frame: Annotated[Literal["site", "first_camera", "unknown"] | None, Told(flag="anchor_frame")] = None
    """What their coordinates refer to (default: site if the file knows any position, else unknown)."""
    crs: Annotated[str | None, Told(flag="anchor_crs")] = None
    """Coordinate system of their positions, as EPSG:2056 (default: metres of a frame of their own)."""
    use: Annotated[_Texts, Told(flag="use_anchors")] = ()
    """Only these anchors' ranges are used (default: all)."""


class TagOptions(Options, table="tag"):
    """The tag on the camera, or several."""

    tag_in_cam_m: Annotated[_LeverArm, Told(flag="tag_in_cam", metavar="[ID:]X,Y,Z")] = (0.0, 0.0, 0.0)
    """Lever arm: the tag's antenna in the camera frame, of a rig its reference camera's, metres; of several tags, the
    flag once for each with its ID."""
    lever_arms_m: Annotated[dict[str, _LeverArm], Told(flag="tag_in_cam", metavar="ID:X,Y,Z")] = Field(
        default_factory=dict
    )
    """The same by tag id, for a camera with several tags."""
    tag_id: str | None = None
    """The tag that counts, if the log has others (default: all with a lever arm)."""

    @model_validator(mode="after")
    def _one_or_several(self) -> TagOptions:
        if "tag_in_cam_m" in self.model_fields_set and self.lever_arms_m:
            why = "expected nothing beside lever_arms_m: either one lever arm or one by tag id"
            raise self.refused("tag_in_cam_m", f"is {list(self.tag_in_cam_m)}, {why}")
        return self


class ScaleOptions(Options, table="scale"):
    """How the scale is found, and distances taped on the site."""

    method: Annotated[Literal["robust", "two-candidate"], Told(flag="scale_method")] = "robust"
    """How the scale is found; two-candidate is the paper's."""
    max_relative_stddev: Annotated[float, Field(ge=1e-9, le=1e3)] = 0.1
    """A scale less certain than this is refused."""
    up_in_first_camera: Annotated[
        Annotated[_Three, AfterValidator(_direction)] | None,
        Told(expected="a list of 3 numbers up to 1e+09: a direction, not 0,0,0"),
    ] = None
    """Upward in the first keyframe's camera frame, of any length; 0,-1,0 if it was level. Two anchors of a site are
    enough with it, and a mirror image is ruled out that would stand the map on its head."""
    camera_side: Literal["above", "below"] | None = None
    """Where the camera went, seen from surveyed anchors that are all in one plane."""
    adopt: bool = False
    """Where the tests find a mistake, run again as if its likeliest cause were so: an anchor unknown, a lever arm as it
    fits, labels swapped, a stretch of ranges left out; what changed is said."""
    distances: Annotated[Path | None, Told(role="file")] = None
    """CSV from,to,distance_m[,stddev_m,kind]: taped distances."""
    markers: Annotated[Path | None, Told(role="file")] = None
    """CSV marker,image_name,x_px,y_px: marks that they refer to."""

    @model_validator(mode="after")
    def _markers_are_of_distances(self) -> ScaleOptions:
        if self.markers is not None and self.distances is None:
            why = "expected distances beside it: marks are only the ends of taped distances"
            raise self.refused("markers", f"is '{self.markers}', {why}")
        return self


class MarkerOptions(Options, table="markers"):
    """Printed tags of known size in the photos."""

    dictionary: Annotated[TagDictionary | None, Told(flag="marker_dictionary")] = None
    """Which tags are looked for in the photos, by OpenCV's names: the corners of tag 7 are the markers tag7.0 (upper
    left, as it is read) to tag7.3, clockwise (default: none are looked for)."""
    side_m: Annotated[_Positive | None, Told(flag="marker_side_m")] = None
    """Side of the tags, from black corner to black corner: each that is found is four lengths (default: they are none,
    but ends of taped distances)."""
    side_stddev_m: Annotated[_Positive, Told(flag="marker_side_stddev_m")] = 0.0005
    """Of that; all tags are off by the same."""

    @model_validator(mode="after")
    def _side_is_of_a_dictionary(self) -> MarkerOptions:
        if self.side_m is not None and self.dictionary is None:
            raise self.refused("side_m", f"is {self.side_m:g}, expected a dictionary beside it: which tags are they?")
        return self


class RefineOptions(Options, table="refine"):
    """Bundle adjustment with the ranges."""

    enabled: Annotated[bool, Told(flag="refine")] = True
    """Whether the map is refined, or left as scaled."""
    max_num_iterations: Annotated[int, Field(ge=0, le=1_000_000)] = 200
    """Of the refinement's solver."""
    range_loss_scale: Annotated[float, Field(ge=1e-3, le=1e9)] = 3.46
    """Residual in stddevs from which a range is down-weighted (Geman-McClure)."""
    lever_arm_stddev_m: _Uncertainty = 0.0
    """Of each coordinate of the tags' places in the camera frame, which are refined unless it is 0."""
    time_offset_stddev_s: _Uncertainty = 0.0
    """Of the clocks' offset, which is refined unless it is 0; one that the motion tells but loosely is, by its own."""
    short_range_stddev_m: _Uncertainty = 0.0
    """Of an error of short ranges that all share and that dies out with a length of 1 m, which is refined unless it is
    0 (they are trusted less instead)."""
    covariance: bool = True
    """Whether to find that of poses, anchors and scale; not found of more than 1500 photos that see much of the same;
    along a path, of some thousands."""
    bundle_adjustment: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's BundleAdjustmentOptions."""


class ExportOptions(Options, table="export"):
    """The metric model in other formats, and in which frame."""

    formats: _Texts = DEFAULT_FORMATS
    """Names of exporters; an unknown one lists them all."""
    frame: Annotated[Literal["result", "level", "enu"], Told(flag="export_frame")] = "result"
    """One of result (the site's or the first camera's, as the result has it), level (z up, y as the first camera looks,
    origin as it is) and enu (x east, y north, z up; for that the map must be georeferenced)."""
    up: str = "auto"
    """What is up: cameras (the mean of what is up in the photos), path (across the plane of the path), X,Y,Z (a
    direction in the result's frame) or auto (z in a site frame, else as cameras)."""
    crs: Annotated[str | None, Told(flag="export_crs")] = None
    """Coordinate system of what is written for maps (LAZ, GeoPackage), as EPSG:2056 (default: the anchors', else
    longitude and latitude)."""
    origin_anchor: str | None = None
    """Id of an anchor whose place on the Earth is known."""
    origin_lat_lon_height: Annotated[
        _Place | None,
        Told(
            metavar="LAT,LON,H",
            expected="3 numbers: latitude up to 90 and longitude up to 360 degrees, height up to 1e+05 metres",
        ),
    ] = None
    """That place, degrees and metres above the ellipsoid (WGS 84)."""
    heading_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Azimuth in which the first camera looks, from north through east."""


class ReportOptions(Options, table="report"):
    """What is said of the result."""

    reference: Annotated[Path | None, Told(metavar="FILE", role="file")] = None
    """True positions, for comparison: CSV or TUM."""
    enabled: Annotated[bool, Told(flag="report")] = True
    """Whether report.html is written."""


class OutputOptions(Options, table="output"):
    """Where the results go."""

    path: Annotated[Path, Told(flag="output_path", role="output")] = Path("out")
    """Folder of the results."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    """Of everything random."""
