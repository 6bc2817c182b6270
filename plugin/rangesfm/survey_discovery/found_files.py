"""Discovery of inputs in folders: each file is recognised by its content and listed under its key of a survey file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rangesfm.distances.tape import DISTANCE_COLUMNS, MARKER_COLUMNS
from rangesfm.errors import InputError
from rangesfm.files.bags import is_bag, is_bag_folder
from rangesfm.files.folders import LEFT_BY_RUNS, walk
from rangesfm.files.text_tables import has_columns, read_head
from rangesfm.geometry.reference import is_reference_file
from rangesfm.ranging.anchors.anchor import ANCHOR_ALIASES, ANCHOR_COLUMNS
from rangesfm.ranging.errors.error_curve import is_error_curve_file
from rangesfm.ranging.readers import find_log_reader, read_ranges
from rangesfm.sources.bag import has_images
from rangesfm.sources.source import is_video
from rangesfm.survey_discovery.calibration_files import CameraCalibration, read_calibrations
from rangesfm.vision.image_times import IMAGE_EXTENSIONS, is_image_times_file
from rangesfm.vision.photo_files import MIN_NUM_PHOTOS

PHOTOS, MODEL, LOG = "images.path", "images.model", "ranges.path"
_NOT_READ = {
    ".insv": "extract plain photos with their times from these 360 degree videos",
    **dict.fromkeys((".heic", ".heif", ".dng", ".cr2", ".nef", ".arw"), "convert them to JPEG"),
}
_TABLE_EXTENSIONS = (".csv", ".tsv", ".txt", ".log", ".dat")
# Largest number of notes on tables that may be the log, where no log was recognised.
_MAX_NUM_UNSURE = 3
# Tables that are recognised by their header row, after it is known that the file is not a log.
_TABLES: dict[str, Callable[[str], bool]] = {
    "scale.markers": partial(has_columns, required=MARKER_COLUMNS),
    "scale.distances": partial(has_columns, required=DISTANCE_COLUMNS),
    "ranges.error_curve": is_error_curve_file,
    "report.reference": is_reference_file,
    "anchors.path": partial(has_columns, required=ANCHOR_COLUMNS, aliases=ANCHOR_ALIASES),
    "images.times": is_image_times_file,
}


@dataclass(frozen=True)
class Found:
    """Possible inputs in folders.

    Attributes:
        paths: folders of photos, videos, and other files, by dotted key of a survey file.
        calibrations: cameras of each file with a calibration.
        models: folders of COLMAP models.
        notes: a line for each thing that is there and cannot be used.
    """

    paths: dict[str, list[Path]]
    calibrations: dict[Path, tuple[CameraCalibration, ...]]
    models: tuple[Path, ...]
    notes: tuple[str, ...]


def look_into(folders: Sequence[Path]) -> Found:
    """Find possible inputs in folders and all their subfolders. Hidden files and results of runs are left out.

    Raises:
        InputError: a path is not a folder.
    """
    paths: dict[str, list[Path]] = defaultdict(list)
    calibrations: dict[Path, tuple[CameraCalibration, ...]] = {}
    models: list[Path] = []
    notes: list[str] = []
    unsure: list[str] = []
    not_read: dict[str, list[Path]] = defaultdict(list)
    for path in _entries(folders):
        try:
            if path.suffix.lower() in _NOT_READ:
                not_read[path.suffix.lower()].append(path)
            elif path.is_dir() and not is_bag_folder(path):
                (models if _is_model(path) else paths[PHOTOS]).append(path)
            elif is_video(path):
                paths[PHOTOS].append(path)
            elif cameras := read_calibrations(path):
                calibrations[path] = cameras
            else:
                if is_bag(path) and has_images(path):
                    paths[PHOTOS].append(path)
                if key := _key_of(path):
                    paths[key].append(path)
        except InputError as error:
            if error.advice:
                unsure.append(f"{error}; if it is the radio's log, rangesfm ranges {path} says what is missing")
            else:
                notes.append(str(error))
    for suffix, those in not_read.items():
        notes.append(f"{suffix} files are not read ({len(those)}, such as {those[0].name}): {_NOT_READ[suffix]}")
    notes += [] if LOG in paths else unsure[:_MAX_NUM_UNSURE]
    return Found(dict(paths), calibrations, tuple(models), tuple(notes))


def _key_of(path: Path) -> str | None:
    """Return the dotted key of a survey file that takes such a file, or None if it is not recognised.

    Raises:
        InputError: it may be a log, but is not understood.
    """
    if is_bag(path):
        read_ranges(path)
        return LOG
    head = read_head(path)
    if not head.strip() or "\0" in head:
        return None
    try:
        find_log_reader(path)
        return LOG
    except InputError as error:
        unsure = error
    if key := next((key for key, is_such in _TABLES.items() if is_such(head)), None):
        return key
    if unsure.advice and path.suffix.lower() in _TABLE_EXTENSIONS:
        raise unsure
    return None


def _entries(folders: Sequence[Path]) -> Iterator[Path]:
    """Yield files, bags, models and folders of photos in folders. Links are followed once.

    Raises:
        InputError: a path is not a folder.
    """
    for top in folders:
        if not top.is_dir():
            raise InputError("is a file, expected a folder" if top.exists() else "no such folder", top)
    for folder, subfolders, names in walk(*folders):
        if not LEFT_BY_RUNS.isdisjoint(names):
            subfolders.clear()
        elif is_bag_folder(folder) or _is_model(folder):
            subfolders.clear()
            yield folder
        else:
            photos = {name for name in names if name.lower().endswith(IMAGE_EXTENSIONS)}
            if len(photos) >= MIN_NUM_PHOTOS:
                yield folder
            yield from (folder / name for name in names if name not in photos)


def _is_model(folder: Path) -> bool:
    """Return whether a folder is a COLMAP model, text or binary."""
    return any((folder / f"cameras.{end}").is_file() and (folder / f"images.{end}").is_file() for end in ("bin", "txt"))
