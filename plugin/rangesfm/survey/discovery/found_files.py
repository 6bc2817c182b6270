"""Discovery of inputs in folders: each file is recognised by its content and listed under its key of a survey file.

Files that cannot be used are listed, too, each with the reason.
"""

from __future__ import annotations

import os
import shlex
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.measurements.imu.formats import is_imu_log
from rangesfm.measurements.imu.signals import kind_of_file
from rangesfm.measurements.lengths.measured_lists import LENGTHS, MARKS
from rangesfm.measurements.lengths.metashape import is_metashape_file, read_metashape_markers
from rangesfm.measurements.positions import position_columns
from rangesfm.measurements.positions.control_point_file import is_point_file
from rangesfm.measurements.positions.position_formats import is_of_positions, is_of_radio
from rangesfm.measurements.ranges.anchors import anchor_file
from rangesfm.measurements.ranges.errors.error_curve import is_error_curve_file
from rangesfm.measurements.ranges.readers import find_log_reader, read_ranges
from rangesfm.measurements.ranges.readers.guess import guess_columns
from rangesfm.measurements.ranges.readers.layout import Layout, find_layout
from rangesfm.measurements.ranges.readers.table import TABLE
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError
from rangesfm.measurements.ranges.readers.vocabulary import ABOUT_ANCHORS, words_of
from rangesfm.sfm import photo_list
from rangesfm.sfm.photo_files import MIN_NUM_PHOTOS
from rangesfm.survey.discovery.calibration_files import CameraCalibration, read_calibrations
from rangesfm.survey.sources.bag import has_images
from rangesfm.survey.sources.source import is_video
from rangesfm.util.files.bags import is_bag, is_bag_folder
from rangesfm.util.files.folders import IMAGE_EXTENSIONS, LEFT_BY_RUNS, OTHER_PHOTOS, walk
from rangesfm.util.files.text_tables import header_names, read_head
from rangesfm.util.geometry.reference import is_reference_file, is_tum_row

PHOTOS, MODEL, LOG, TIMES, ANCHORS = "images.path", "images.model", "ranges.path", "images.times", "anchors.path"
POINTS, POSITIONS, REFERENCE, IMU = "points.path", "positions.path", "report.reference", "imu.path"
# Words in the name of a file whose positions are measured, not true ones to compare with.
_MEASURED = frozenset(
    "position positions positionen gps gnss rtk ppk geotag geotags exif pozyx marvelmind".split()  # noqa: SIM905
)
# Words in the name of a TUM trajectory that is the map itself, by a SLAM program.
_BY_SLAM = frozenset({"slam", "orb", "vo", "keyframe", "keyframes", "key", "estimate", "estimated"})
_NOT_READ = {
    ".insv": "extract plain photos with their times from these 360 degree videos",
    **dict.fromkeys(OTHER_PHOTOS, "convert them to JPEG"),
    **dict.fromkeys((".xlsx", ".xls", ".ods", ".numbers"), "save the sheet as CSV"),
    **dict.fromkeys((".xml", ".jxl", ".dxf", ".dwg", ".shp", ".kml", ".kmz", ".rw5"), "export points as CSV"),
}
_UNKNOWN = "no input that is known"
SURVEY_NAME = "survey.toml"
# Largest number of names of unused files that are listed for one reason.
_MAX_NUM_NAMED = 4
# Largest number of notes on tables that may be the log, where no log was recognised.
_MAX_NUM_UNSURE = 3
# A table without names that is like a log and like a list of points has more rows than this if it is a log.
_MOST_POINTS = 16
# Other files may be prose, in which any line may look like a row.
_TABLE_EXTENSIONS = (
    *(".csv", ".tsv", ".txt", ".log", ".dat", ".tab", ".json", ".asc", ".gsi", ".pts", ".pnt", ".pun", ".koo", ".coo"),
    *(".crd", ".xyz", ".neh", ".enz"),
)
# Tables that are recognised by their header row, after it is known that the file is not a log.
_TABLES: dict[str, Callable[[str], bool]] = {
    "scale.distances": LENGTHS.has_usual_names,
    POINTS: is_point_file,
    "ranges.error_curve": is_error_curve_file,
    REFERENCE: is_reference_file,
    ANCHORS: anchor_file.ANCHORS.is_canonical,
    TIMES: photo_list.PHOTO_TIMES.is_canonical,
}
# Lists in tables of any layout: how their columns are found, and how they are read.
_LISTS: dict[str, tuple[Callable[[Path, Layout], object], Callable[[Path], object]]] = {
    ANCHORS: (partial(anchor_file.find_points, anchor_file.ANCHORS), anchor_file.read_anchor_list),
    TIMES: (partial(photo_list.find_photo_columns, photo_list.PHOTO_TIMES), photo_list.read_photo_list),
}
_KEY_OF_LIST = {"anchors": ANCHORS, "positions": POSITIONS, "photo times": TIMES}


@dataclass(frozen=True)
class Found:
    """Possible inputs in folders.

    Attributes:
        paths: folders of photos, videos, and other files, by dotted key of a survey file.
        models: folders of COLMAP models, and trajectories of SLAM programs.
        unclear: lists that are not understood for sure, by dotted key of a survey file.
        notes: lines about what is there and cannot be used; each such file is listed with the reason.
        like_anchors: files that are about the log's anchors by their names, where none is understood, with the reason.
    """

    paths: dict[str, list[Path]]
    calibrations: dict[Path, tuple[CameraCalibration, ...]]
    models: tuple[Path, ...]
    unclear: dict[str, list[UnclearFileError]]
    notes: tuple[str, ...]
    like_anchors: dict[Path, str] = field(default_factory=dict)


def look_into(folders: Sequence[Path], without: Collection[Path] = ()) -> Found:
    """Find possible inputs in folders and all their subfolders. Hidden files and results of runs are left out.

    Args:
        without: paths that are known already, and are left out.

    Raises:
        InputError: a path is not a folder.
    """
    paths: dict[str, list[Path]] = defaultdict(list)
    calibrations: dict[Path, tuple[CameraCalibration, ...]] = {}
    models: list[Path] = []
    unclear: dict[str, list[UnclearFileError]] = defaultdict(list)
    unused: dict[str, list[Path]] = defaultdict(list)
    notes: list[str] = []
    unsure: dict[Path, InputError] = {}
    for path, of_folder in _entries(folders):
        if path in without:
            continue
        if of_folder is not None:
            (models if of_folder == MODEL else paths[of_folder]).append(path)
            continue
        try:
            if reason := _reason_by_name(path):
                unused[reason].append(path)
            elif is_video(path):
                paths[PHOTOS].append(path)
            elif cameras := read_calibrations(path):
                calibrations[path] = cameras
            else:
                has_photos = is_bag(path) and has_images(path)
                paths[PHOTOS] += [path] if has_photos else []
                paths[IMU] += [path] if is_bag(path) and is_imu_log(path) else []
                if key := _key_of(path):
                    (models if key == MODEL else paths[key]).append(path)
                elif not has_photos:
                    unused[_UNKNOWN].append(path)
        except InputError as error:
            if isinstance(error, UnclearFileError) and error.what in _KEY_OF_LIST:
                unclear[_KEY_OF_LIST[error.what]].append(error)
            elif error.advice:
                unsure[path] = error
            else:
                notes.append(str(error))
    like_anchors = {}
    if LOG in paths and ANCHORS not in {*paths, *unclear}:
        tables = [path for path in (*unsure, *unused[_UNKNOWN]) if path.suffix.lower() in _TABLE_EXTENSIONS]
        if those := [
            asked for path in tables if (asked := anchor_file.like_points(anchor_file.ANCHORS, path)) is not None
        ]:
            unclear[ANCHORS] = those
        like_anchors = {path: why for why, those in unused.items() for path in those if is_about_anchors(path)}
    if LOG not in paths:
        for path in [*unsure][:_MAX_NUM_UNSURE]:
            command = shlex.join(["rangesfm", "ranges", str(path)])
            notes.append(f"{unsure.pop(path)}; if it is the radio's log, {command} says what is missing")
    unused["a table whose columns are not known for sure"] += unsure
    notes += [f"not used: {_listed(those, folders)} ({reason})" for reason, those in unused.items() if those]
    found = {key: those for key, those in paths.items() if those}
    return Found(found, calibrations, tuple(models), unclear, tuple(notes), like_anchors)


def short_path(path: Path, folders: Sequence[Path]) -> str:
    """Return a path as it is from the one of the folders that it is in."""
    inside = [os.path.relpath(path, folder) for folder in folders if path.is_relative_to(folder)]
    return inside[0] if inside else str(path)


def _listed(paths: Sequence[Path], folders: Sequence[Path]) -> str:
    names = [short_path(path, folders) for path in paths]
    if len(names) <= _MAX_NUM_NAMED + 1:
        return ", ".join(names)
    endings = ", ".join(sorted({path.suffix.lower() or path.name for path in paths[_MAX_NUM_NAMED:]}))
    return f"{', '.join(names[:_MAX_NUM_NAMED])} and {len(names) - _MAX_NUM_NAMED} more ({endings})"


def is_about_anchors(path: Path) -> bool:
    """Return whether a table or drawing is about anchors by its name, or by the names of its columns."""
    is_table = path.suffix.lower() in _TABLE_EXTENSIONS
    names = [path.stem, *(header_names(read_head(path)) if is_table else ())]
    return (is_table or path.suffix.lower() in _NOT_READ) and any(ABOUT_ANCHORS & {*words_of(name)} for name in names)


def _reason_by_name(path: Path) -> str | None:
    """Return why a file is not used, if its name already says so."""
    is_read = path.suffix.lower() == ".xml" and is_metashape_file(read_head(path))
    if path.suffix.lower() in _NOT_READ and not path.is_dir() and not is_read:
        return _NOT_READ[path.suffix.lower()]
    if path.suffix.lower() in IMAGE_EXTENSIONS and not path.is_dir():
        return f"a folder of photos has {MIN_NUM_PHOTOS} or more"
    return None


def _key_of(path: Path) -> str | None:
    """Return the dotted key of a survey file that takes such a file, or None if it is not recognised.

    Raises:
        UnclearFileError: it may be a list of anchors or of photo times, but is not understood.
        InputError: it may be a log, but is not understood.
    """
    if is_bag(path):
        read_ranges(path)
        return LOG
    head = read_head(path)
    if not head.strip() or "\0" in head:
        return IMU if is_imu_log(path) else None
    if is_metashape_file(head):
        return POINTS if read_metashape_markers(path).places else "scale.markers"
    if LENGTHS.is_such(path):  # between photos it could be read as a log that names photos
        return "scale.distances"
    if MARKS.is_such(path):
        return "scale.markers"
    if is_of_positions(head):
        return POSITIONS
    unsure = None
    try:
        reader = find_log_reader(path)
        if reader.name != TABLE.name:
            return LOG
    except InputError as error:
        unsure = error
    is_table = path.suffix.lower() in _TABLE_EXTENSIONS
    if unsure is None:  # columns that look like those of a log may be those of a list
        layout = find_layout(path)
        if layout is None:
            return LOG
        # A short table without names is asked about.
        is_short = not layout.has_names and len(layout.columns[0].cells) <= _MOST_POINTS
        with nullcontext() if is_short else suppress(UnclearFileError):
            return (_list_of(path) if is_short or layout.has_names else None) or LOG
        return LOG
    if is_imu_log(path):
        return IMU
    if is_of_radio(head):
        return POSITIONS
    if key := next((key for key, is_such in _TABLES.items() if is_such(head)), None):
        return _measured_or_true(path) if key == REFERENCE else key
    with nullcontext() if is_table else suppress(UnclearFileError):
        if key := _list_of(path) or _positions_of(path):
            return key
    if unsure.advice and is_table:
        raise unsure
    return None


def _measured_or_true(path: Path) -> str:
    """Return the key of a file of positions by its name: a map's, measured ones, or true ones to compare with."""
    if is_tum_row(header_names(read_head(path))) and not _BY_SLAM.isdisjoint(words_of(path.stem)):
        return MODEL
    return REFERENCE if _MEASURED.isdisjoint(words_of(path.stem)) else POSITIONS


def _positions_of(path: Path) -> str | None:
    """Return the key for a table of the camera's positions by photo or time; None if it is none.

    Raises:
        UnclearFileError: it holds places on the Earth, or of photos, and the columns are not known for sure.
    """
    layout = find_layout(path)
    if layout is None or not layout.has_names:
        return None
    on_earth = all(
        any(position_columns.is_degrees(column.name, axis) for column in layout.columns) for axis in ("x", "y")
    )
    try:
        columns = position_columns.find_position_columns(position_columns.POSITIONS, path, layout)
    except UnclearFileError:
        if on_earth:
            raise
        return None
    guess = guess_columns(layout)
    ranges = {name for quantity, name in guess.columns.items() if quantity.startswith("range")}
    if not ranges <= {*columns.values()}:
        return None  # perhaps a log that has ranges beside the positions
    return POSITIONS if on_earth else _measured_or_true(path)


def _list_of(path: Path) -> str | None:
    """Return the dotted key for a list in a table of any layout, or None if the file is none.

    Raises:
        UnclearFileError: the columns or a unit are not known for sure.
    """
    layout = find_layout(path)
    if layout is None:
        return None
    for key, (find, read) in _LISTS.items():
        if find(path, layout) is not None:
            try:
                read(path)
            except UnclearFileError:
                raise
            except InputError:  # an error in a cell; rangesfm check reports it
                pass
            return key
    return None


def _entries(folders: Sequence[Path]) -> Iterator[tuple[Path, str | None]]:
    """Yield files and bags in folders, without survey files, and folders that are an input as a whole.

    These come with their dotted key: models, folders of photos, and recordings of a phone with a file for each sensor.
    Links are followed once.

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
            yield folder, MODEL if _is_model(folder) else None
        else:
            photos = {name for name in names if name.lower().endswith(IMAGE_EXTENSIONS)}
            if len(photos) >= MIN_NUM_PHOTOS:
                yield folder, PHOTOS
                names = [name for name in names if name not in photos]
            if is_imu_log(folder):
                yield folder, IMU
                names = [name for name in names if kind_of_file(Path(name).stem) is None]
            yield from ((folder / name, None) for name in names if name != SURVEY_NAME)


def _is_model(folder: Path) -> bool:
    """Return whether a folder is a COLMAP model, text or binary."""
    return any((folder / f"cameras.{end}").is_file() and (folder / f"images.{end}").is_file() for end in ("bin", "txt"))
