"""The keys of a survey file: of each its type, bounds, default, meaning and flag, written here and nowhere else.

The stages take these tables, or the part of one that is theirs, as their options. The reader of survey files, the
commands' flags, their help, the reference of all keys and the settings in ``result.json`` follow from them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, model_validator

from rangesfm.errors import OptionError
from rangesfm.option_model import Options, key, looks_like

DEFAULT_FORMATS = ("tum", "ply")
_LIKE_OURS = 0.85  # a [mapper] key this similar to one of ours is a slip; others are pycolmap's

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


def _span(times: tuple[float, ...]) -> tuple[float, ...]:
    if times and not (len(times) == 2 and times[0] < times[1]):
        raise ValueError("is no span")
    return times


class KeyframeOptions(Options):
    """Which photos become keyframes. All that are given must hold."""

    table: ClassVar[str] = "images"

    every_nth: _Count = key(1, "use every n-th photo, in time order")
    min_interval_s: _Duration = key(0.0, "least time between keyframes")
    max_num_keyframes: Annotated[int, Field(ge=3, le=1_000_000)] | None = key(None, "thin evenly to at most this many")


class ImageOptions(KeyframeOptions):
    """The photos."""

    path: Path | None = key(
        None,
        "folder of the photos; as a flag also the CSV of their times",
        flag="images",
        metavar="PATH",
        role="photos",
    )
    times: Path | None = key(
        None, "CSV image_name,timestamp_s (default: EXIF, else file names)", flag="image_times", role="file"
    )


class CameraOptions(Options):
    """One camera for all photos."""

    table: ClassVar[str] = "camera"

    model: str | None = key(None, "COLMAP camera model, as OPENCV (default: COLMAP guesses)", flag="camera_model")
    params: _Numbers | None = key(None, "its parameters in COLMAP's order", flag="camera_params")
    refine_intrinsics: bool | None = key(
        None,
        "whether mapping and refinement adjust them (default: mapping does if they are not given; the refinement "
        "keeps what it finds, so that it does the same to a model just mapped and to one brought along)",
    )

    @property
    def mapping_refines_intrinsics(self) -> bool:
        return self.params is None if self.refine_intrinsics is None else self.refine_intrinsics


class LogOptions(Options):
    """The radio's log and how to take it."""

    table: ClassVar[str] = "ranges"

    path: Path | None = key(None, "the radio's log", flag="ranges", metavar="LOG", role="file")
    format: str | None = key(None, "its format (default: recognised by content)", flag="ranges_format")
    columns: dict[str, str] = key(
        {},
        "names of its columns for timestamp (or image_name), anchor_id, range, tag_id, range_stddev, los; without "
        "range, the time stamps tx1, rx1, tx2, rx2 and possibly tx3, rx3 of two-way ranging",
        metavar="QUANTITY=NAME,..",
    )
    timestamp_unit: str | None = key(None, "s, ms, us, ns or iso (default: by format)")
    range_unit: str | None = key(None, "m, cm or mm (default: by format)")
    separator: Annotated[str, Field(min_length=1, max_length=1)] | None = key(
        None, "between cells (default: told from the header row)", metavar="CHARACTER", expected="one character"
    )
    ranging_interval_s: Annotated[float, Field(ge=1e-6, le=1e6)] | None = key(
        None, "between two rounds, for a Qorvo log without the host's times (default: 0.2)"
    )
    stamp_unit: Literal["ns", "us", "ms", "s", "ticks"] = key("ns", "of time stamps, in a log without ranges")
    stamp_bits: Literal[32, 40] = key(32, "of the stamps' counter; 32 do up to 67 ms")
    propagation_speed: Literal["air", "vacuum"] | Annotated[float, Field(ge=1e8, le=3e8)] = key(
        "air", "of the signal, for stamps", expected="air, vacuum or a speed of light in m/s"
    )
    t_off_s: Annotated[float, Field(ge=-1, le=1)] = key(
        0.0, "what all delays of both devices together add to a round trip of stamps"
    )
    error_curve: Path | None = key(
        None, "the radio's error by distance, as rangesfm ranges calibrate writes it", role="file"
    )
    time_offset: Literal["auto"] | _Time = key(
        "auto",
        "image time = range time + offset; auto: searched for",
        flag="ranges_time_offset",
        metavar="auto|SECONDS",
        expected='"auto" or seconds, at most 1e+10 of them',
    )

    @property
    def time_offset_s(self) -> float | None:
        """None: to be searched for."""
        return None if self.time_offset == "auto" else self.time_offset


class AssociationOptions(Options):
    """Ranges to places on the path."""

    table: ClassVar[str] = "ranges"

    max_interpolation_gap_s: _Duration = key(2.0, "between keyframes further apart than this no pose is interpolated")
    max_time_difference_s: _Duration = key(
        0.02, "a range this close to a keyframe counts as taken there, where no pose can be interpolated"
    )


class CheckOptions(Options):
    """Ranges held out of every estimate, to be compared with the result."""

    table: ClassVar[str] = "ranges"

    check_share: Annotated[float, Field(ge=0, le=0.5)] = key(
        0.0,
        "share of the ranges held out as checks, chosen at random; neighbours in time err alike, so that this is the "
        "mildest check",
    )
    check_anchors: _Texts = key((), "ids of anchors with surveyed positions, whose ranges are all held out")
    check_times_s: Annotated[_Times, AfterValidator(_span)] = key(
        (),
        "from when to when, on the radio's clock, ranges are held out",
        metavar="A,B",
        expected="two times in seconds, the later one last",
    )


class RangeModelOptions(Options):
    """What is assumed of the radio."""

    table: ClassVar[str] = "ranges"

    range_stddev_m: _Positive | None = key(None, "noise of a range (default: estimated from the residuals)")
    range_bias_stddev_m: _Uncertainty = key(
        0.01,
        "prior of each anchor's own constant bias, mean 0; small on purpose: a freer bias soaks up errors that depend "
        "on direction, and shifts the map instead",
    )
    common_bias_stddev_m: _Uncertainty = key(0.1, "prior of the bias that all anchors share (the tag's delay), mean 0")


class RangesOptions(RangeModelOptions, CheckOptions, AssociationOptions, LogOptions):
    """The radio's log, what is assumed of it, and which of its ranges are held out."""


class AnchorOptions(Options):
    """The anchors."""

    table: ClassVar[str] = "anchors"

    path: Path | None = key(
        None,
        "CSV anchor_id,x_m,y_m,z_m[,position_stddev_m,range_bias_m,range_bias_stddev_m] (default: the anchors in the "
        "log, all unknown)",
        flag="anchors",
        role="file",
    )
    frame: Literal["site", "first_camera", "unknown"] | None = key(
        None,
        "what their coordinates refer to (default: site if the file knows any position, else unknown)",
        flag="anchor_frame",
    )
    crs: str | None = key(
        None,
        "coordinate system of their positions, as EPSG:2056 (default: metres of a frame of their own)",
        flag="anchor_crs",
    )
    use: _Texts = key((), "only these anchors' ranges are used (default: all)", flag="use_anchors")


class TagOptions(Options):
    """The tag on the camera, or several."""

    table: ClassVar[str] = "tag"

    tag_in_cam_m: _LeverArm = key(
        (0.0, 0.0, 0.0),
        "lever arm: the tag's antenna in the camera frame, metres; of several tags, the flag once for each with its ID",
        flag="tag_in_cam",
        metavar="[ID:]X,Y,Z",
    )
    lever_arms_m: dict[str, _LeverArm] = key(
        {}, "the same by tag id, for a camera with several tags", flag="tag_in_cam", metavar="ID:X,Y,Z"
    )
    tag_id: str | None = key(None, "the tag that counts, if the log has others (default: all with a lever arm)")

    @model_validator(mode="after")
    def _one_or_several(self) -> TagOptions:
        if "tag_in_cam_m" in self.model_fields_set and self.lever_arms_m:
            raise OptionError(
                f"[tag] tag_in_cam_m is {list(self.tag_in_cam_m)}, expected nothing beside lever_arms_m: either one "
                "lever arm or one by tag id",
                "tag",
                "tag_in_cam_m",
            )
        return self


class MapperOptions(Options):
    """Photos to unscaled model. Keys that are not here are pycolmap's IncrementalPipelineOptions', as in pipeline."""

    table: ClassVar[str] = "mapper"

    matching: Literal["sequential", "exhaustive", "auto"] = key(
        "auto", "which photos are matched; auto: exhaustive up to 60 keyframes"
    )
    features: dict[str, Any] = key({}, "passed through to pycolmap's FeatureExtractionOptions")
    pairing: dict[str, Any] = key({}, "passed through to pycolmap's pairing options of the chosen matching")
    matcher: dict[str, Any] = key({}, "passed through to pycolmap's FeatureMatchingOptions")
    pipeline: dict[str, Any] = key({}, "passed through to pycolmap's IncrementalPipelineOptions")
    ranges_in_mapping: bool = key(
        False,
        "each global bundle adjustment of the mapping carries the ranges, as soon as they determine the scale; takes "
        "much longer, and the refinement at the end mostly comes to the same map",
    )
    num_threads: Literal[-1] | Annotated[int, Field(ge=1, le=4096)] = key(
        -1,
        "-1 for all cores. Matching on the processor takes one thread all the same, as pycolmap 4.2 loses matches with "
        "more; matcher.num_threads overrides that",
        expected="1 or more up to 4096, or -1 for all cores",
    )
    submap_size: Annotated[int, Field(ge=10, le=1_000_000)] | None = key(
        None,
        "more photos than that are mapped in stretches of so many in their order, each on its own, which are joined by "
        "the photos that they share (default: all in one piece)",
    )
    submap_overlap: Annotated[int, Field(ge=3, le=1_000_000)] = key(
        20, "photos that a submap shares with the one before"
    )
    num_submaps_at_once: Annotated[int, Field(ge=1, le=4096)] = key(
        1, "each is mapped by a process of its own; they share the threads"
    )

    @model_validator(mode="before")
    @classmethod
    def _others_to_pipeline(cls, values: dict[str, Any]) -> dict[str, Any]:
        """pycolmap knows best what its keys may be; only one much like ours is a slip."""
        others = {
            name: value
            for name, value in values.items()
            if name not in cls.model_fields and not looks_like(name, cls.model_fields, _LIKE_OURS)
        }
        ours = {name: value for name, value in values.items() if name not in others}
        if others and isinstance(pipeline := ours.get("pipeline", {}), dict):
            ours["pipeline"] = {**others, **pipeline}
        return ours


class ScaleOptions(Options):
    """How the scale is found."""

    table: ClassVar[str] = "scale"

    method: Literal["robust", "two-candidate"] = key(
        "robust", "how the scale is found; two-candidate is the paper's", flag="scale_method"
    )
    num_bootstrap: Annotated[int, Field(ge=0, le=100_000)] = key(200, "resamplings of the block bootstrap over time")
    bootstrap_block_s: Annotated[float, Field(ge=1e-3, le=1e9)] = key(10.0, "length of its blocks")
    max_relative_stddev: Annotated[float, Field(ge=1e-9, le=1e3)] = key(
        0.1, "a scale less certain than this is refused"
    )
    up_in_first_camera: Annotated[_Three, AfterValidator(_direction)] | None = key(
        None,
        "(3,) upward in the first keyframe's camera frame, of any length; 0,-1,0 if it was level. Two anchors of a "
        "site are enough with it, and a mirror image is ruled out that would stand the map on its head",
        expected="a list of 3 numbers up to 1e+09: a direction, not 0,0,0",
    )
    camera_side: Literal["above", "below"] | None = key(
        None, "where the camera went, seen from surveyed anchors that are all in one plane"
    )


class ScaleAndTapeOptions(ScaleOptions):
    """How the scale is found, and distances taped on the site."""

    distances: Path | None = key(None, "CSV from,to,distance_m[,stddev_m,kind]: taped distances", role="file")
    markers: Path | None = key(None, "CSV marker,image_name,x_px,y_px: marks that they refer to", role="file")

    @model_validator(mode="after")
    def _markers_are_of_distances(self) -> ScaleAndTapeOptions:
        if self.markers is not None and self.distances is None:
            raise OptionError(
                f"[scale] markers is '{self.markers}', expected distances beside it: marks are only the ends of taped "
                "distances",
                "scale",
                "markers",
            )
        return self


class RefineOptions(Options):
    """Bundle adjustment with the ranges."""

    table: ClassVar[str] = "refine"

    enabled: bool = key(True, "whether the map is refined, or left as scaled", flag="refine")
    max_num_iterations: Annotated[int, Field(ge=0, le=1_000_000)] = key(200, "of the refinement's solver")
    range_loss_scale: Annotated[float, Field(ge=1e-3, le=1e9)] = key(
        3.46, "residual in stddevs from which a range is down-weighted (Geman-McClure)"
    )
    lever_arm_stddev_m: _Uncertainty = key(
        0.0, "of each coordinate of the tags' places in the camera frame, which are refined unless it is 0"
    )
    time_offset_stddev_s: _Uncertainty = key(0.0, "of the clocks' offset, which is refined unless it is 0")
    short_range_stddev_m: _Uncertainty = key(
        0.0,
        "of an error of short ranges that all share and that dies out with a length of 1 m, which is refined unless it "
        "is 0 (they are trusted less instead)",
    )
    covariance: bool = key(
        True,
        "whether to find that of poses, anchors and scale; not found of more than 1500 photos that see much of the "
        "same; along a path, of some thousands",
    )
    bundle_adjustment: dict[str, Any] = key({}, "passed through to pycolmap's BundleAdjustmentOptions")


class ExportOptions(Options):
    """The metric model in other formats, and in which frame."""

    table: ClassVar[str] = "export"

    formats: _Texts = key(DEFAULT_FORMATS, "names of exporters; an unknown one lists them all")
    frame: Literal["result", "level", "enu"] = key(
        "result",
        "result (the site's or the first camera's, as the result has it), level (z up, y as the first camera looks, "
        "origin as it is) or enu (x east, y north, z up; for that the map must be georeferenced)",
        flag="export_frame",
    )
    up: str = key(
        "auto",
        "what is up: cameras (the mean of what is up in the photos), path (across the plane of the path), X,Y,Z (a "
        "direction in the result's frame) or auto (z in a site frame, else as cameras)",
    )
    crs: str | None = key(
        None,
        "coordinate system of what is written for maps (LAZ, GeoPackage), as EPSG:2056 (default: the anchors', else "
        "longitude and latitude)",
        flag="export_crs",
    )
    origin_anchor: str | None = key(None, "id of an anchor whose place on the Earth is known")
    origin_lat_lon_height: _Place | None = key(
        None,
        "that place, degrees and metres above the ellipsoid (WGS 84)",
        metavar="LAT,LON,H",
        expected="a list of 3 numbers: latitude and longitude in degrees, height in metres",
    )
    heading_deg: Annotated[float, Field(ge=-360, le=360)] | None = key(
        None, "azimuth in which the first camera looks, from north through east"
    )


class ReportOptions(Options):
    """What is said of the result."""

    table: ClassVar[str] = "report"

    reference: Path | None = key(None, "true positions, for comparison: CSV or TUM", metavar="FILE", role="file")
    enabled: bool = key(True, "whether report.html is written", flag="report")


class OutputOptions(Options):
    """Where the results go."""

    table: ClassVar[str] = "output"

    path: Path = key(Path("out"), "folder of the results", flag="output_path", role="output")
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = key(0, "of everything random")
