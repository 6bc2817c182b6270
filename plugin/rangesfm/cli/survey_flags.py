"""Flags that stand for keys of a survey file, shared by the commands that run stages."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesfm.errors import InputError
from rangesfm.options import ANCHOR_FRAMES, CAMERA_SIDES, MATCHING_METHODS, SCALE_METHODS, STAMP_UNITS

if TYPE_CHECKING:
    from rangesfm.survey.settings import Survey


@dataclass(frozen=True)
class Flag:
    """A flag that overrides one key of the survey file.

    Attributes:
        name: without the dashes.
        key: dotted key of the survey file.
        convert: from the text to the key's value.
        repeated: whether it may be given several times; its value is the list of all.
        is_switch: it takes no value, and makes the key true.
    """

    name: str
    key: str
    help: str
    convert: Callable[[str], Any] = str
    choices: tuple[str, ...] | None = None
    metavar: str | None = None
    repeated: bool = False
    is_switch: bool = False


def _numbers(text: str) -> list[float]:
    try:
        return [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of numbers, expected as 1.5,-2,0") from None


def _names(text: str) -> list[str]:
    return [name for name in (part.strip() for part in text.split(",")) if name]


def position(text: str) -> list[float]:
    """Three numbers X,Y,Z; to be a type of argparse."""
    numbers = _numbers(text)
    if len(numbers) != 3:
        raise argparse.ArgumentTypeError(f"'{text}' has {len(numbers)} numbers, expected X,Y,Z in metres")
    return numbers


def _lever_arm(text: str) -> tuple[str | None, list[float]]:
    """The tag's id, None without one, and its lever arm."""
    tag_id, colon, lever_arm = text.rpartition(":")
    if colon and not tag_id:
        raise argparse.ArgumentTypeError(f"'{text}' has no tag's id before the colon, expected X,Y,Z or ID:X,Y,Z")
    return tag_id or None, position(lever_arm)


def _offset(text: str) -> str | float:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither auto nor a number of seconds") from None


def _columns(text: str) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in text.split(",")]
    if not all(quantity and name for quantity, _, name in pairs):
        raise argparse.ArgumentTypeError(f"'{text}' is not a mapping, expected as timestamp=t,anchor_id=node,range=d")
    return {quantity.strip(): name.strip() for quantity, _, name in pairs}


def _speed(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


_LEVER_ARMS = "tag.by_id"

IMAGE_FLAGS = (
    Flag("image_times", "images.times", "CSV image_name,timestamp_s (default: EXIF, else file names)", metavar="CSV"),
)
RECONSTRUCTION_FLAGS = (
    Flag("every_nth", "images.every_nth", "use every n-th photo", int, metavar="N"),
    Flag("min_interval_s", "images.min_interval_s", "least time between keyframes", float, metavar="SECONDS"),
    Flag("max_num_keyframes", "images.max_num_keyframes", "thin evenly to this many", int, metavar="N"),
    Flag("camera_model", "camera.model", "COLMAP camera model, as OPENCV", metavar="MODEL"),
    Flag("camera_params", "camera.params", "its parameters in COLMAP's order", _numbers, metavar="A,B,.."),
    Flag("matching", "mapper.matching", "which photos are matched", choices=MATCHING_METHODS),
    Flag(
        "submap_size",
        "mapper.submap_size",
        "map stretches of so many photos each on its own, and join them (default: all in one piece)",
        int,
        metavar="N",
    ),
    Flag("submap_overlap", "mapper.submap_overlap", "photos that two of them share (default: 20)", int, metavar="N"),
    Flag(
        "num_submaps_at_once",
        "mapper.num_submaps_at_once",
        "each in a process of its own; they share the threads (default: 1)",
        int,
        metavar="N",
    ),
)
LOG_FLAGS = (
    Flag(
        "columns",
        "ranges.columns",
        "names of its columns for timestamp (or image_name), anchor_id, range, tag_id, range_stddev, los; without "
        "range, the time stamps tx1, rx1, tx2, rx2 and possibly tx3, rx3 of two-way ranging",
        _columns,
        metavar="QUANTITY=NAME,..",
    ),
    Flag("timestamp_unit", "ranges.timestamp_unit", "s, ms, us, ns or iso (default: by format)", metavar="UNIT"),
    Flag("range_unit", "ranges.range_unit", "m, cm or mm (default: by format)", metavar="UNIT"),
    Flag("separator", "ranges.separator", "between cells (default: told from the header row)", metavar="CHARACTER"),
    Flag(
        "ranging_interval_s",
        "ranges.ranging_interval_s",
        "between two rounds, for a Qorvo log without the host's times (default: 0.2)",
        float,
        metavar="S",
    ),
    Flag(
        "stamp_unit", "ranges.stamp_unit", "of time stamps, in a log without ranges (default: ns)", choices=STAMP_UNITS
    ),
    Flag(
        "stamp_bits", "ranges.stamp_bits", "32 or 40: their counter's (default: 32, up to 67 ms)", int, metavar="BITS"
    ),
    Flag(
        "propagation_speed",
        "ranges.propagation_speed",
        "air (default), vacuum or m/s, for stamps",
        _speed,
        metavar="SPEED",
    ),
    Flag("t_off_s", "ranges.t_off_s", "what all delays together add to a round trip of stamps", float, metavar="S"),
)
RANGE_FLAGS = (
    Flag("ranges", "ranges.path", "the radio's log", metavar="LOG"),
    Flag("ranges_format", "ranges.format", "its format (default: recognised by content)", metavar="FORMAT"),
    *LOG_FLAGS,
    Flag("ranges_time_offset", "ranges.time_offset", "image time minus range time", _offset, metavar="auto|SECONDS"),
    Flag("range_stddev_m", "ranges.range_stddev_m", "noise of a range (default: estimated)", float, metavar="METRES"),
    Flag("error_curve", "ranges.error_curve", "the radio's, by rangesfm ranges calibrate", metavar="CSV"),
    Flag("anchors", "anchors.path", "CSV anchor_id,x_m,y_m,z_m (default: all unknown)", metavar="CSV"),
    Flag("anchor_frame", "anchors.frame", "what their coordinates refer to", choices=ANCHOR_FRAMES),
    Flag("anchor_crs", "anchors.crs", "coordinate system of their positions, as EPSG:2056", metavar="CRS"),
    Flag("use_anchors", "anchors.use", "only these anchors' ranges are used", _names, metavar="ID,ID"),
    Flag(
        "tag_in_cam",
        _LEVER_ARMS,
        "the tag's antenna in the camera frame, metres; of several tags, once for each with its ID",
        _lever_arm,
        metavar="[ID:]X,Y,Z",
        repeated=True,
    ),
    Flag("tag_id", "tag.tag_id", "the tag that counts, if the log has others", metavar="ID"),
    Flag("check_share", "ranges.check_share", "share of the ranges held out as checks", float, metavar="SHARE"),
    Flag("check_anchors", "ranges.check_anchors", "anchors whose ranges are all held out", _names, metavar="ID,ID"),
    Flag("check_times_s", "ranges.check_times_s", "times between which ranges are held out", _numbers, metavar="A,B"),
    Flag(
        "up_in_first_camera",
        "scale.up_in_first_camera",
        "upward in the first photo's camera frame; 0,-1,0 if it was level",
        position,
        metavar="X,Y,Z",
    ),
    Flag(
        "camera_side",
        "scale.camera_side",
        "where the camera went, seen from anchors all in one plane",
        choices=CAMERA_SIDES,
    ),
    Flag("scale_method", "scale.method", "how the scale is found", choices=SCALE_METHODS),
    Flag("distances", "scale.distances", "CSV from,to,distance_m[,stddev_m,kind]: taped distances", metavar="CSV"),
    Flag("markers", "scale.markers", "CSV marker,image_name,x_px,y_px: marks that they refer to", metavar="CSV"),
    Flag("reference", "report.reference", "true positions, for comparison", metavar="FILE"),
)
_OF_A_RUN = ("check_share", "check_anchors", "check_times_s", "scale_method", "reference")
COMPARE_FLAGS = tuple(flag for flag in RANGE_FLAGS if flag.name not in _OF_A_RUN)
# Of surveys that are finished: the rest is theirs.
_JOINED_ANCHORS = "CSV anchor_id,x_m,y_m,z_m (default: as the surveys had them)"
_OF_A_JOIN = ("range_stddev_m", "anchor_frame", "anchor_crs", "use_anchors", "camera_side", "scale_method", "reference")
JOIN_FLAGS = (
    Flag("anchors", "anchors.path", _JOINED_ANCHORS, metavar="CSV"),
    *(flag for flag in RANGE_FLAGS if flag.name in _OF_A_JOIN),
)
REFINE_FLAGS = (
    Flag("max_num_iterations", "refine.max_num_iterations", "of the refinement's solver", int, metavar="N"),
    Flag(
        "lever_arm_stddev_m",
        "refine.lever_arm_stddev_m",
        "of the tag's place in the camera frame, which is then refined (default: 0, it is exact)",
        float,
        metavar="METRES",
    ),
    Flag(
        "time_offset_stddev_s",
        "refine.time_offset_stddev_s",
        "of the clocks' offset, which is then refined (default: 0)",
        float,
        metavar="SECONDS",
    ),
    Flag(
        "short_range_stddev_m",
        "refine.short_range_stddev_m",
        "of what the shortest ranges err all alike, which is then refined (default: 0, they are trusted less instead)",
        float,
        metavar="METRES",
    ),
)
MAPPING_FLAGS = (
    Flag(
        "ranges_in_mapping",
        "mapper.ranges_in_mapping",
        "ranges take part while the map grows, not only at the end; takes much longer",
        is_switch=True,
    ),
)
OUTPUT_FLAGS = (
    Flag("output_path", "output.path", "folder of the results (default: out)", metavar="FOLDER"),
    Flag("num_threads", "mapper.num_threads", "-1 for all cores", int, metavar="N"),
    Flag("seed", "output.seed", "of everything random", int, metavar="N"),
)


def add_survey_arguments(parser: argparse.ArgumentParser, *groups: tuple[Flag, ...]) -> None:
    """The survey file, the photos and the flags of some groups."""
    parser.add_argument("survey", nargs="?", metavar="SURVEY.toml", help="survey file; flags override its keys")
    parser.add_argument(
        "--base_path", metavar="FOLDER", help="what the file's paths are relative to (default: its folder)"
    )
    parser.add_argument("--images", metavar="PATH", help="folder of the photos, or CSV of their times")
    for group in (IMAGE_FLAGS, *groups, OUTPUT_FLAGS):
        add_flags(parser, group)


def add_flags(parser: argparse.ArgumentParser, flags: tuple[Flag, ...]) -> None:
    """Flags whose values ``overrides_from_arguments`` finds again."""
    for flag in flags:
        if flag.is_switch:
            parser.add_argument(f"--{flag.name}", dest=flag.key, action="store_const", const=True, help=flag.help)
            continue
        parser.add_argument(
            f"--{flag.name}",
            dest=flag.key,
            action="append" if flag.repeated else "store",
            type=flag.convert,
            choices=flag.choices,
            help=flag.help,
            metavar=flag.metavar,
        )


def overrides_from_arguments(args: argparse.Namespace) -> dict[str, Any]:
    """The values of all flags that were given, by their keys in a survey file."""
    overrides = {key: value for key, value in vars(args).items() if "." in key and value is not None}
    lever_arms = dict(overrides.pop(_LEVER_ARMS, []))
    if None in lever_arms and len(lever_arms) > 1:
        raise InputError("--tag_in_cam is given with an ID and without, expected X,Y,Z once, or ID:X,Y,Z for each tag")
    if None in lever_arms:
        overrides["tag.tag_in_cam_m"] = lever_arms[None]
    elif lever_arms:
        overrides["tag.lever_arms_m"] = lever_arms
    return overrides


def add_model_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--input_path", metavar="MODEL", help="existing COLMAP model, as sparse/0")


def add_restart_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--restart", action="store_true", help="do anew what an earlier run has done")


def survey_from_arguments(args: argparse.Namespace) -> Survey:
    """The survey file, if any, with the flags in place of its keys."""
    from rangesfm.survey.settings import read_survey, survey_from_tables

    overrides = overrides_from_arguments(args)
    if args.images is not None:
        overrides["images.times" if _is_table(args.images) else "images.path"] = args.images
    if getattr(args, "survey", None) is None:
        survey = survey_from_tables({}, Path.cwd(), overrides)
    else:
        survey = read_survey(args.survey, overrides, args.base_path)
    model = getattr(args, "input_path", None)
    return survey if model is None else replace(survey, model_path=Path.cwd() / model)


def require_images(survey: Survey) -> None:
    """Raise InputError unless there is a folder of photos."""
    if survey.images_path is None:
        raise InputError("no photos: give [images] path in a survey file, or --images FOLDER")
    if not os.path.isdir(survey.images_path):
        raise InputError("no such folder of photos", survey.images_path)


def require_model(survey: Survey) -> None:
    """Raise InputError unless there is a folder of a COLMAP model."""
    if survey.model_path is None:
        raise InputError("no model: give --input_path MODEL, the folder of a COLMAP model such as sparse/0")
    if not os.path.isdir(survey.model_path):
        raise InputError("no such folder of a COLMAP model", survey.model_path)


def require_ranges(survey: Survey) -> None:
    """Raise InputError unless there is a radio log."""
    if survey.ranges.path is None:
        raise InputError("no ranges: give [ranges] path in a survey file, or --ranges LOG")


def _is_table(path: str) -> bool:
    return os.path.isfile(path) or path.endswith(".csv")
