"""Printed tags (ArUco, AprilTag) found in photos by OpenCV; each corner becomes a marker."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.installed_versions import missing_extra
from rangesfm.measurements.lengths.tape import CONTROL, FOUND_STDDEV_PX, Marker, TapedDistance
from rangesfm.progress import Progress
from rangesfm.sfm.photo_files import UNREADABLE, opened_image

# The centre of the first pixel is (0, 0) in OpenCV and (0.5, 0.5) in COLMAP.
_CENTRE_PX = 0.5
_NUM_CORNERS = 4
# A black square looks smaller in a photo than it is: the pixels at its rim receive half the light, and the gamma curve
# of a photo shows them brighter than half. Corners are therefore sought in linear light, by the usual gamma of 8-bit
# photos. The second number is the error of a side, in pixels, that remains where a camera has another curve.
_GAMMA, _LEFT_AT_SIDE_PX = 2.2, 0.2
# Half-width of the window in which a corner is refined: as a fraction of a module of the tag, and its limits in pixels.
_WINDOW, _MIN_WINDOW_PX, _MAX_WINDOW_PX = 0.75, 2, 10


def names_of_tags(markers: Iterable[str]) -> list[str]:
    """Return the names of the tags whose corners these markers are."""
    return list(dict.fromkeys(name.partition(".")[0] for name in markers))


def sides_of_tags(markers: Mapping[str, Marker], side_m: float, stddev_m: float) -> tuple[TapedDistance, ...]:
    """Return the four sides of each tag as measured lengths.

    Args:
        stddev_m: standard deviation of the error that all printed sides share, metres. The error that all corners found
            in photos share is added to it.
    """
    if not markers:
        return ()
    tags = names_of_tags(markers)
    start, end = (np.concatenate([markers[f"{tag}.{k}"].pixels for tag in tags]) for k in (0, 1))
    side_px = float(np.median(np.linalg.norm(end - start, axis=1)))
    stddev_m = float(np.hypot(stddev_m, side_m * _LEFT_AT_SIDE_PX / side_px))
    ends = ((f"{tag}.{k}", f"{tag}.{(k + 1) % _NUM_CORNERS}") for tag in tags for k in range(_NUM_CORNERS))
    return tuple(TapedDistance(pair, side_m, stddev_m, CONTROL, line=0, is_printed=True) for pair in ends)


def find_tags(folder: Path, image_names: Sequence[str], dictionary: str, progress: Progress) -> dict[str, Marker]:
    """Find the tags of an OpenCV dictionary in each photo, and return their corners by name, in pixels as stored.

    ``tag7.0`` to ``tag7.3`` are those of tag 7, clockwise from the upper left corner of the upright tag. A tag that
    appears twice in a photo is left out of that photo.

    Raises:
        InputError: OpenCV is not installed, or a photo cannot be read.
    """
    cv2 = _opencv()
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    detector, num_modules = cv2.aruco.ArucoDetector(known), known.markerSize + 2
    seen: dict[str, list[tuple[str, Any]]] = defaultdict(list)
    for number, name in enumerate(image_names):
        progress.update(number, len(image_names))
        try:
            with opened_image(folder / name) as photo:
                pixels = np.array(photo.convert("L"))
        except UNREADABLE as error:
            raise InputError(f"cannot be read as a photo ({error})", folder / name) from None
        corners, ids, _ = detector.detectMarkers(pixels)
        numbers = [] if ids is None else np.ravel(ids).tolist()
        times = Counter(numbers)
        for tag, quad in zip(numbers, corners, strict=True):
            if times[tag] == 1:
                for k, at in enumerate(_refined(cv2, pixels, np.reshape(quad, (_NUM_CORNERS, 2)), num_modules)):
                    seen[f"tag{tag}.{k}"].append((name, at + _CENTRE_PX))
    return {
        corner: Marker(tuple(names), np.array(places, dtype=np.float64), (0,) * len(names), FOUND_STDDEV_PX)
        for corner, (names, places) in sorted((corner, tuple(zip(*of))) for corner, of in seen.items())
    }


def _refined(cv2: Any, pixels: npt.NDArray[np.uint8], quad: Array, num_modules: int) -> Array:
    """Return the corners of a tag (4, 2), refined in linear light, in OpenCV's pixel coordinates."""
    module_px = float(np.linalg.norm(quad[0] - quad[1])) / num_modules
    window = int(np.clip(_WINDOW * module_px, _MIN_WINDOW_PX, _MAX_WINDOW_PX))
    low, high = quad.min(axis=0) - 2 * _MAX_WINDOW_PX, quad.max(axis=0) + 2 * _MAX_WINDOW_PX
    (left, top), (right, bottom) = np.maximum(low, 0).astype(int), high.astype(int)
    light = (pixels[top:bottom, left:right].astype(np.float32) / 255) ** _GAMMA
    start = (quad - [left, top]).astype(np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    found = cv2.cornerSubPix(light, start, (window, window), (-1, -1), criteria)
    corners: Array = np.asarray(found, dtype=np.float64).reshape(-1, 2) + np.array([left, top])
    return corners


def _opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise missing_extra("looking for printed tags needs OpenCV", "markers") from None
    return cv2
