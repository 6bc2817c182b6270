"""Measured lengths, and the marks of their ends in photos."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from rangesfm.arrays import Array
from rangesfm.measurements.kind_as_read import KindAsRead

CONTROL, CHECK = "control", "check"
# Kind of a length that contradicts the map and was rejected.
LEFT_OUT = "left out"
CLICKED_STDDEV_PX = 1.0
"""Standard deviation of a coordinate of a mark set by hand."""
FOUND_STDDEV_PX = 0.3
"""Standard deviation of a coordinate of a tag's corner that was found by OpenCV."""
Mark = tuple[str, list[float], int]
"""Name of a photo, the pixel (x, y) of a marker in it, and the line in the file."""


@dataclass(frozen=True)
class TapedDistance:
    """A measured length between two ends, each a photo (its camera's centre), a marker or an anchor.

    Attributes:
        ends: names of the two ends.
        distance_m: measured length.
        stddev_m: standard deviation of the measurement.
        kind: "control" (it takes part in the scale), "check" (it is compared with the result) or "left out".
        line: line in the file; 0 if it is from no file.
        is_printed: whether it is the side of a printed tag found in photos.
        is_everywhere: whether it occurs all along the map, like the distance between cameras of a rig.
    """

    ends: tuple[str, str]
    distance_m: float
    stddev_m: float
    kind: str
    line: int
    is_printed: bool = False
    is_everywhere: bool = False


@dataclass(frozen=True)
class Marker:
    """A point of the scene, marked by hand or found in k photos.

    Attributes:
        image_names: names of the k photos.
        pixels: (k, 2) x and y in COLMAP's convention: the centre of the first pixel is (0.5, 0.5).
        lines: (k,) lines in the file; 0 if it was found.
        stddev_px: standard deviation of each coordinate.
        path: the file, for messages; None without one.
    """

    image_names: tuple[str, ...]
    pixels: Array
    lines: tuple[int, ...]
    stddev_px: float = CLICKED_STDDEV_PX
    path: Path | None = None


@dataclass(frozen=True)
class Tape(KindAsRead):
    """Measured lengths and markers.

    Attributes:
        distances: the lengths in the order of the file.
        markers: the markers by name.
        distances_path: the file of the lengths, for messages.
        notes: lines for the user about how the lengths were read.
    """

    distances: tuple[TapedDistance, ...] = ()
    markers: Mapping[str, Marker] = field(default_factory=dict)
    distances_path: Path | None = None
    notes: tuple[str, ...] = ()

    def facts(self) -> Iterator[str]:
        """Yield how many lengths there are."""
        if self.distances:
            yield f"taped distances: {len(self.distances)}"

    def control(self) -> Tape:
        """Return the tape with its control lengths only."""
        return replace(self, distances=tuple(taped for taped in self.distances if taped.kind == CONTROL))

    @property
    def end_markers(self) -> dict[str, Marker]:
        """Markers that are ends of lengths, by name."""
        ends = {name for taped in self.distances for name in taped.ends}
        return {name: marker for name, marker in self.markers.items() if name in ends}

    @property
    def found_markers(self) -> dict[str, Marker]:
        """Markers that were found in photos, not set by hand."""
        return {name: marker for name, marker in self.markers.items() if marker.stddev_px == FOUND_STDDEV_PX}

    def with_more(self, distances: tuple[TapedDistance, ...]) -> Tape:
        """Return the tape with more lengths."""
        return replace(self, distances=self.distances + distances)

    def with_more_markers(self, markers: Mapping[str, Marker]) -> Tape:
        """Return the tape with more markers; its own are kept where a new one has an equal name."""
        return replace(self, markers={**markers, **self.markers})

    def without(self, rows: Collection[int]) -> Tape:
        """Return the tape with the lengths of these indices marked as left out."""
        distances = (replace(taped, kind=LEFT_OUT) if k in rows else taped for k, taped in enumerate(self.distances))
        return replace(self, distances=tuple(distances))
