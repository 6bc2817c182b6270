"""Printed tags (ArUco, AprilTag) in photos: found by OpenCV, each corner a marker."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.distances.tape import CONTROL, FOUND_STDDEV_PX, Marker, TapedDistance
from rangesfm.errors import InputError
from rangesfm.progress import Progress
from rangesfm.vision.photos import UNREADABLE, opened_image

# To OpenCV the centre of the first pixel is (0, 0), to COLMAP (0.5, 0.5).
_CENTRE_PX = 0.5
_NUM_CORNERS = 4
# A black square looks smaller in a photo than it is: its rim is half light, and photos show half light as much more.
# Corners are sought in the light itself, by the usual curve of 8-bit photos; what another curve leaves at a side:
_GAMMA, _LEFT_AT_SIDE_PX = 2.2, 0.2
# Of a module of the tag, in which to seek its corner; and in pixels.
_WINDOW, _MIN_WINDOW_PX, _MAX_WINDOW_PX = 0.75, 2, 10


@dataclass(frozen=True)
class FoundTags:
    """The tags of some photos.

    Attributes:
        markers: ``tag7.0`` to ``tag7.3``, the corners of tag 7 from its upper left one on as it is read, clockwise.
        num_photos: in which there is any.
    """

    markers: dict[str, Marker]
    num_photos: int

    @property
    def tags(self) -> list[str]:
        """Their names, without corners."""
        return list(dict.fromkeys(name.partition(".")[0] for name in self.markers))

    @property
    def side_px(self) -> float:
        """Typical length of a side."""
        ends = [[self.markers[f"{tag}.{k}"].pixels for tag in self.tags] for k in (0, 1)]
        start, end = (np.concatenate(of) for of in ends)
        return float(np.median(np.linalg.norm(end - start, axis=1)))

    def sides(self, side_m: float, stddev_m: float) -> tuple[TapedDistance, ...]:
        """The four sides of each, as if they had been taped.

        Args:
            stddev_m: of all printed sides together; what all that are seen may be off comes on top.
        """
        if not self.markers:
            return ()
        stddev_m = float(np.hypot(stddev_m, side_m * _LEFT_AT_SIDE_PX / self.side_px))
        return tuple(
            TapedDistance(
                (f"{tag}.{k}", f"{tag}.{(k + 1) % _NUM_CORNERS}"), side_m, stddev_m, CONTROL, line=0, is_printed=True
            )
            for tag in self.tags
            for k in range(_NUM_CORNERS)
        )


def find_tags(folder: Path, image_names: Sequence[str], dictionary: str, progress: Progress) -> FoundTags:
    """Look for the tags of a dictionary, as its pixels are stored, in each photo.

    One that is in a photo twice has no place there.

    Raises:
        InputError: OpenCV is not installed, or a photo cannot be read.
    """
    cv2 = _opencv()
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    detector, num_modules = cv2.aruco.ArucoDetector(known), known.markerSize + 2
    seen: dict[str, list[tuple[str, Any]]] = defaultdict(list)
    photos_with_tags = set()
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
                photos_with_tags.add(name)
                for k, at in enumerate(_refined(cv2, pixels, np.reshape(quad, (_NUM_CORNERS, 2)), num_modules)):
                    seen[f"tag{tag}.{k}"].append((name, at + _CENTRE_PX))
    markers = {
        corner: Marker(tuple(names), np.array(places, dtype=np.float64), (0,) * len(names), FOUND_STDDEV_PX)
        for corner, (names, places) in sorted((corner, tuple(zip(*of))) for corner, of in seen.items())
    }
    return FoundTags(markers, len(photos_with_tags))


def _refined(cv2: Any, pixels: npt.NDArray[np.uint8], quad: Array, num_modules: int) -> Array:
    """(4, 2) corners in the light that fell on the pixels."""
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
        raise InputError("looking for printed tags needs OpenCV: pip install 'rangesfm[markers]'") from None
    return cv2
