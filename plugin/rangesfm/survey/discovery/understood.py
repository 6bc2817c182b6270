"""Making of a survey from folders: the choice of one input of each kind, or a question where it is not clear."""

from __future__ import annotations

import glob
import os
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape_file import read_markers
from rangesfm.measurements.positions.control_point_file import read_control_points
from rangesfm.measurements.positions.known_positions import MIN_NUM_POSITIONS
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError
from rangesfm.options import PointOptions
from rangesfm.sfm.image_times import list_images
from rangesfm.sfm.photo_files import gps_data, usable_photos
from rangesfm.survey.discovery.found_files import (
    ANCHORS,
    IMU,
    LOG,
    MODEL,
    PHOTOS,
    POINTS,
    POSITIONS,
    Found,
    is_about_anchors,
    look_into,
    short_path,
)
from rangesfm.survey.settings import KEYS, METRIC_KEYS
from rangesfm.survey.sources.source import is_source, open_source

# A file or folder with such a name (without suffix, in lower case) is chosen among several candidates for a key.
_USUAL_NAMES = {
    PHOTOS: ("images", "photos", "dcim", "rgb", "frames"),
    LOG: ("uwb", "ranges"),
    "images.times": ("images", "times", "image_times", "timestamps"),
    "anchors.path": ("anchors",),
    POSITIONS: ("positions", "gnss", "gps"),
    POINTS: ("points", "control_points", "gcp_list"),
    IMU: ("imu", "imu0", "gyro_accel"),
    "report.reference": ("reference", "groundtruth", "ground_truth", "truth"),
    "camera": ("camera", "cameras"),
}
_LEVER_ARMS = ("tag.tag_in_cam_m", "tag.lever_arms_m")


def understand(
    folders: Sequence[Path], given: Mapping[str, object], command: Sequence[str] = ()
) -> tuple[dict[str, Any], list[str]]:
    """Look into folders and choose the inputs of a run.

    Args:
        given: values by dotted key from the user; inputs of these keys are not looked for.
        command: words of the command that the user has typed, for advice; empty: rangesfm init with the folders.

    Returns:
        Values of a survey file by dotted key, with absolute paths; and lines that say what was left out, and why.

    Raises:
        InputError: there are no inputs, or there are several of a kind and it is not clear which one to take, or a
            file that looks like anchors or photo times is not understood for sure. The advice of the error asks for it.
    """
    command = command or ["rangesfm", "init", *map(str, folders)]
    folders = [Path(os.path.abspath(folder)) for folder in folders]
    roles = {item.dotted: item.role for item in KEYS}
    values = {key: value if roles[key] is None else Path(os.path.abspath(str(value))) for key, value in given.items()}
    found = look_into(folders, {path for path in values.values() if isinstance(path, Path)})
    _tell_points_from_anchors(found, values)
    notes, questions = _choose_paths(values, found, folders)
    unclear = {key: those for key, those in found.unclear.items() if key not in values}
    questions += [line for key, those in unclear.items() for line in _questions(key, those, folders, command)]
    if questions:
        several = "more than one survey could be meant"
        first = next((those[0] for those in unclear.values()), None)
        raise first.advising(questions) if first else InputError(several, folders[0], advice=questions)
    if ANCHORS not in values:
        for path, why in found.like_anchors.items():
            raise InputError(
                f"is about anchors by its name and is not understood ({why}): move it out of the folder, or name the "
                "file of anchors by --anchors PATH",
                path,
            )
    notes += [
        f"not used: {short_path(error.path or Path(), folders)} ({error.message})"
        for key, those in found.unclear.items()
        for error in those
    ]
    if found.models and PHOTOS not in values:
        values.setdefault(MODEL, found.models[0])
    notes += [
        f"{path} is a COLMAP model: rangesfm refine SURVEY --input_path {shlex.quote(str(path))} starts from it"
        if path.is_dir()
        else f"{path} is a trajectory: rangesfm scale SURVEY --input_path {shlex.quote(str(path))} scales it"
        for path in found.models
        if path != values.get(MODEL)
    ]
    if not {PHOTOS, MODEL, *METRIC_KEYS} & values.keys():
        found_none = "found no photos, no COLMAP model and nothing that was measured in it"
        raise InputError(found_none, folders[0], advice=notes)
    _add_camera(values, found, notes)
    _add_exif_positions(values, notes)
    return values, notes


def _choose_paths(values: dict[str, Any], found: Found, folders: Sequence[Path]) -> tuple[list[str], list[str]]:
    """Add one path for each key to ``values``; return notes on those left out, and questions where it is not clear."""
    notes, questions = list(found.notes), []
    for item in KEYS:
        key, paths = item.dotted, found.paths.get(item.dotted, [])
        if not paths:
            continue
        if key in values or (key == "scale.markers" and not {"scale.distances", POINTS} & values.keys()):
            why = f"--{item.flag} names another" if key in values else "marks are ends of distances, or known points"
            notes.append(f"not used: {', '.join(short_path(path, folders) for path in paths)} ({why})")
            continue
        paths = _tops(paths, folders) if key == PHOTOS else paths
        chosen = _chosen(key, paths)
        if chosen is None:
            names = ", ".join(short_path(path, folders) for path in paths)
            questions.append(f"{names}: any of them may be [{item.table}] {item.name}; say which by --{item.flag} PATH")
            continue
        values[key] = chosen
        if chosen in paths and len(paths) > 1:
            others = ", ".join(short_path(path, folders) for path in paths if path != chosen)
            notes.append(f"{chosen.name} is used; left out: {others}")
    return notes, questions


def _tell_points_from_anchors(found: Found, values: Mapping[str, Any]) -> None:
    """Move lists of points that are no anchors, but control points or positions of the camera.

    They are control points if the photos have marks of them, or if there is no radio and they are not called anchors.
    They are positions if they are named like the photos.
    """
    has_log = LOG in {*values, *found.paths}
    photos = {
        Path(name).stem.lower()
        for folder in found.paths.get(PHOTOS, [])
        if not is_source(folder)
        for name in list_images(folder)
    }
    marks = {name for path in found.paths.get("scale.markers", []) for name in _names_of_marks(path)}
    for path in found.paths.pop(ANCHORS, []):
        ids: set[str] = set()
        with suppress(InputError):  # rangesfm check reports it
            ids = {anchor.anchor_id for anchor in read_anchors(path)}
        if ids and {Path(name).stem.lower() for name in ids} <= photos:
            key = POSITIONS
        else:
            key = POINTS if ids & marks or not (has_log or is_about_anchors(path)) else ANCHORS
        found.paths.setdefault(key, []).append(path)
    if len(points := found.paths.get(POINTS, [])) > 1 or POINTS in values:  # Metashape's markers have marks as well
        found.paths.setdefault("scale.markers", []).extend(path for path in points if path.suffix.lower() == ".xml")
        found.paths[POINTS] = [path for path in points if path.suffix.lower() != ".xml"]
    for error in found.unclear.pop(ANCHORS, []):
        if has_log or is_about_anchors(Path(error.path or "")):
            found.unclear.setdefault(ANCHORS, []).append(error)
        else:
            try:
                read_control_points(PointOptions(path=error.path))
            except UnclearFileError as as_points:
                found.unclear.setdefault(POINTS, []).append(as_points)


def _names_of_marks(path: Path) -> Iterator[str]:
    with suppress(InputError):
        yield from read_markers(path)


def _questions(
    key: str, unclear: Sequence[UnclearFileError], folders: Sequence[Path], command: Sequence[str]
) -> Iterator[str]:
    """Yield lines that ask how lists are to be read, with the command for each way."""
    flag = next(item.flag for item in KEYS if item.dotted == key)
    for error in unclear:
        path = Path(error.path or "")
        yield from (f"{short_path(path, folders)}: {line}" for line in error.about)
        for choice in error.choices:
            yield choice.typed([*command, f"--{flag}", _typed(path)], {})
    what = unclear[0].what
    yield f"if no such file holds {what}: move it out of the folder, or name the file of {what} by --{flag} PATH"


def _typed(path: Path) -> str:
    """Return a path as a user in the working folder types it."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)


def _chosen(key: str, paths: Sequence[Path]) -> Path | None:
    """Choose one path for a key.

    It is the only one, the only one with a usual name, or (for a log) a pattern for files of one anchor each. None
    where it is not clear.
    """
    usual = [path for path in paths if path.stem.lower() in _USUAL_NAMES.get(key, ())]
    for candidates in (paths, usual):
        if len(candidates) == 1:
            return candidates[0]
    return _pattern(paths) if key == LOG else None


def _tops(paths: Sequence[Path], folders: Sequence[Path]) -> list[Path]:
    """Replace folders of photos by the highest folder above them with a usual name, such as photos for photos/left.

    Only folders inside ``folders`` are considered. Videos and bags are kept.
    """
    tops = []
    for path in paths:
        if is_source(path):
            tops.append(path)
            continue
        inside = [above for above in (path, *path.parents) if any(above.is_relative_to(folder) for folder in folders)]
        tops.append(next((above for above in reversed(inside) if above.name.lower() in _USUAL_NAMES[PHOTOS]), path))
    return list(dict.fromkeys(tops))


def _pattern(paths: Sequence[Path]) -> Path | None:
    """Return a pattern that matches exactly these files, if each is a log of another anchor; otherwise None."""
    names, folder = [path.name for path in paths], paths[0].parent
    common = os.path.commonprefix
    prefix = common(names)
    suffix = common([name[len(prefix) :][::-1] for name in names])[::-1]
    pattern = Path(folder, f"{prefix}*{suffix}")
    if glob.has_magic(f"{folder}{prefix}{suffix}") or {*map(Path, glob.glob(str(pattern)))} != {*paths}:
        return None
    try:
        anchors = [read_ranges(path).anchor_ids for path in paths]
    except InputError:
        return None
    return pattern if all(len(ids) == 1 for ids in anchors) and len({*anchors}) == len(paths) else None


def _add_camera(values: dict[str, Any], found: Found, notes: list[str]) -> None:
    """Add camera and lever arm to ``values`` where exactly one calibration fits the size of the photos."""
    files = [*found.calibrations]
    path = _chosen("camera", files)
    if path is None:
        if files:
            several = ", ".join(file.name for file in files)
            notes.append(f"{several}: it is not clear which of these is the camera, so none is used; keep only one")
        return
    cameras = found.calibrations[path]
    arms = [camera.tag_in_cam_m for camera in cameras if camera.tag_in_cam_m is not None]
    if len(arms) == 1 and not values.keys() & {*_LEVER_ARMS}:
        values["tag.tag_in_cam_m"] = arms[0]
        notes.append(f"the lever arm is that of {path.name}")
    sits = next((camera.cam_from_imu for camera in cameras if camera.cam_from_imu is not None), None)
    if IMU in values and sits is not None:
        matrix = np.array(sits)
        values.setdefault(
            "imu.rotation_imu_to_cam_xyzw", Rotation.from_matrix(matrix[:3, :3]).as_quat().round(9).tolist()
        )
        values.setdefault("imu.imu_in_cam_m", matrix[:3, 3].tolist())
        notes.append(f"the place of the inertial sensor is that of {path.name}")
    if known := {"camera.model", "camera.params", MODEL} & values.keys():
        why = "a COLMAP model has its own cameras" if MODEL in known else "the camera is given"
        notes.append(f"{path.name}: its camera is not used ({why})")
        return
    size_px = _size_px(values)
    fitting = [camera for camera in cameras if None in (camera.size_px, size_px) or camera.size_px == size_px]
    if len(fitting) == 1:
        camera = fitting[0].camera
        values |= {"camera.model": camera.model, "camera.params": camera.params}
        notes.append(f"the camera is that of {path.name}")
    else:
        sizes = ", ".join(" x ".join(map(str, camera.size_px)) for camera in cameras if camera.size_px)
        notes.append(f"{path.name}: {len(fitting)} of its cameras ({sizes} pixels) fit the photos, so none is used")


def _add_exif_positions(values: dict[str, Any], notes: list[str]) -> None:
    """Take the positions in the photos' EXIF data where nothing else is in metres."""
    if PHOTOS not in values or POSITIONS in values or is_source(folder := values[PHOTOS]):
        return
    num = sum(gps_data(folder / name) is not None for name in list_images(folder))
    if num < MIN_NUM_POSITIONS:
        return
    if {*METRIC_KEYS} & values.keys():
        notes.append(f"{num} photos have positions in their EXIF data: --positions {folder} uses them, too")
    else:
        values[POSITIONS] = folder
        notes.append(f"the positions are those in the EXIF data of {num} photos")


def _size_px(values: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the most common width and height of the photos; None without photos."""
    if PHOTOS not in values:
        return None
    if is_source(values[PHOTOS]):
        with suppress(InputError):  # rangesfm check reports this error
            return open_source(values[PHOTOS], values.get("images.topic", "")).size_px
        return None
    photos = usable_photos(values[PHOTOS], list_images(values[PHOTOS]))
    return Counter(photos.sizes).most_common(1)[0][0]
