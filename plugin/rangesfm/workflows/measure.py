"""Distances and height differences between points of a result, with their precision."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.distances.map_points import MapPoint, MapPoints
from rangesfm.distances.tape import FOUND_STDDEV_PX, Marker, read_markers
from rangesfm.errors import InputError
from rangesfm.files.text_tables import align_rows, read_table, write_table
from rangesfm.geometry.gravity import UP_IN_SITE, gravity_of
from rangesfm.geometry.map_errors import MapErrors
from rangesfm.result.places import input_beside
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.result_tables import TagCorners
from rangesfm.scale.scale_estimate import NORMAL_95

PAIR_COLUMNS = ("from", "to")
Interval = tuple[float, float]
_MEASURES = ("distance", "height_difference")
_COLUMNS = (*PAIR_COLUMNS, *(f"{name}{end}_m" for name in _MEASURES for end in ("", "_low", "_high")))
_SCALE_ALONE = (
    "the intervals come from the uncertainty of the scale alone, because the result has no joint covariance of its map "
    "(rangesfm run and rangesfm refine make one, with [refine] covariance); bends of the map are not in them"
)
_NO_HEIGHTS = (
    "no height differences: the map is in the first camera's frame, and nobody said which way is up (surveyed anchors, "
    "or [scale] up_in_first_camera)"
)


@dataclass(frozen=True)
class Measurement:
    """The distance of two points of a map, and how much higher the second one is.

    Attributes:
        ends: names of both points.
        distance_m: length of the straight line between them.
        distance_interval_m: 95 % interval of the distance.
        height_difference_m: height of the second minus height of the first; None if the map does not know what is up.
        height_interval_m: its 95 % interval; None without a height difference or without a joint covariance.
    """

    ends: tuple[str, str]
    distance_m: float
    distance_interval_m: Interval
    height_difference_m: float | None
    height_interval_m: Interval | None


@dataclass(frozen=True)
class Measurements:
    """Measurements in a result.

    Attributes:
        rows: in the order of the pairs.
        notes: sentences on what the intervals hold.
    """

    rows: tuple[Measurement, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        header = ("from", "to", "distance m", "95 % interval", "height difference m", "95 % interval")
        cells = [
            (
                *row.ends,
                f"{row.distance_m:.3f}",
                _interval(row.distance_interval_m),
                "-" if row.height_difference_m is None else f"{row.height_difference_m:+.3f}",
                "-" if row.height_interval_m is None else _interval(row.height_interval_m, "+"),
            )
            for row in self.rows
        ]
        return "\n".join([align_rows([header, *cells]), *self.notes])

    def write(self, path: Path) -> None:
        """Write the measurements as CSV; what is unknown is empty."""
        write_table(path, list(_COLUMNS), map(_cells, self.rows))


def measure(
    result_folder: Path | str, pairs: Iterable[tuple[str, str]], *, markers: Path | str | None = None
) -> Measurements:
    """Measure distances and height differences in the final map of a result.

    The intervals count how both points err together: by the scale, by the map's bending, by the photos in which they
    are seen. The uncertainty of the scale is the stated one.

    Args:
        result_folder: output folder of a run.
        pairs: names of both ends: photos, markers, printed tags (``tag7``) or their corners (``tag7.0``), anchors, and
            3-D points of the model (``point:1234``).
        markers: CSV marker,image_name,x_px,y_px with marks in photos; None: only those of the run.

    Raises:
        InputError: the folder is not a result with a metric model, a file cannot be read, or an end is not in the map.
    """
    result = read_result_folder(Path(result_folder))
    points, errors = _points_of(result, None if markers is None else Path(markers)), result.read_map_errors()
    up = _up_of(result)
    measured = _Measuring(points, errors, *_stated_scale(result), up)
    rows = tuple(measured.between(first, second) for first, second in pairs)
    return Measurements(rows, tuple(_notes(result, errors, knows_up=up is not None)))


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Read the pairs of a CSV ``from,to``; a file of taped distances has these columns, too.

    Raises:
        InputError: the file is not valid; the error gives the line.
    """
    table = read_table(path, PAIR_COLUMNS, text=list(PAIR_COLUMNS))
    if not len(table):
        raise InputError("holds no pair of points, expected one per line", path)
    pairs = list(zip(table.text("from"), table.text("to"), strict=True))
    for row, (first, second) in enumerate(pairs):
        if first == second:
            raise table.error(row, "to", "another point than 'from'")
    return pairs


@dataclass(frozen=True)
class _Measuring:
    """Points of a map and their joint errors.

    Attributes:
        points: of the map.
        errors: of the map; None if they are not known.
        scale_stddev, scale_lean: standard deviation, and shift of the middle, of the interval of the scale's logarithm.
        up: upward unit vector (3,) in the map and the standard deviation of its direction in radians; None if unknown.
    """

    points: MapPoints
    errors: MapErrors | None
    scale_stddev: float
    scale_lean: float
    up: tuple[Array, float] | None

    def between(self, first_name: str, second_name: str) -> Measurement:
        first, second = (self.points.find(name) for name in (first_name, second_name))
        apart = second.position_m - first.position_m
        distance_m = float(np.linalg.norm(apart))
        covariance, by_scale = self._relative(first, second)
        along = apart / distance_m if distance_m > 0 else np.zeros(3)
        low, high = self._interval(distance_m, along, covariance, by_scale)
        height = interval = None
        if self.up is not None:
            up, tilt_stddev = self.up
            height = float(up @ apart)
            if self.errors is not None:
                level_m = float(np.linalg.norm(apart - height * up))
                interval = self._interval(height, up, covariance, by_scale, tilt_stddev * level_m)
        return Measurement((first_name, second_name), distance_m, (max(low, 0.0), high), height, interval)

    def _relative(self, first: MapPoint, second: MapPoint) -> tuple[Array, Array]:
        """Return the covariance (3, 3) of second minus first, and its change (3,) by the logarithm of the scale."""
        apart = second.position_m - first.position_m
        if self.errors is None:
            return self.scale_stddev**2 * np.outer(apart, apart), apart
        return self.errors.relative(first.errors, second.errors, self.scale_stddev)

    def _interval(
        self, value: float, along: Array, covariance: Array, by_scale: Array, more_stddev: float = 0.0
    ) -> Interval:
        middle = value + self.scale_lean * float(along @ by_scale)
        variance = max(float(along @ covariance @ along), 0.0) + more_stddev**2
        half = NORMAL_95 * math.sqrt(variance)
        return middle - half, middle + half


def _points_of(result: ResultFolder, markers_path: Path | None) -> MapPoints:
    model = result.read_metric_model()
    if model is None:
        raise InputError("there is no metric model (sparse_metric/0 or sparse_scaled/0) to measure in", result.path)
    refine = result.summary.refine
    pixel_stddev = None if refine is None else refine.pixel_stddev
    markers = _markers_of(result) | ({} if markers_path is None else read_markers(markers_path))
    anchors_m = result.anchor_positions_m
    return MapPoints(model, anchors_m, markers, np.inf if pixel_stddev is None else pixel_stddev, markers_path)


def _markers_of(result: ResultFolder) -> dict[str, Marker]:
    """Return the corners of printed tags that the run found, and the markers that its survey gave."""
    found: dict[str, Marker] = {}
    if (result.path / TagCorners.NAME).is_file():
        found |= read_markers(result.path / TagCorners.NAME, FOUND_STDDEV_PX)
    recorded = result.summary.settings.to_json().get("scale", {}).get("markers")
    given = None if recorded is None else input_beside(result.path, recorded)
    return found | (read_markers(given) if given is not None and given.is_file() else {})


def _stated_scale(result: ResultFolder) -> tuple[float, float]:
    stated = result.summary.scale.relative_stddev
    return stated.empirical, stated.lean


def _up_of(result: ResultFolder) -> tuple[Array, float] | None:
    if result.summary.frame == "site":
        return UP_IN_SITE, 0.0
    gravity = gravity_of(result.summary.settings.to_json().get("scale", {}).get("up_in_first_camera"))
    return None if gravity is None else (gravity.up_in_first_camera, gravity.stddev_rad)


def _notes(result: ResultFolder, errors: MapErrors | None, *, knows_up: bool) -> Iterator[str]:
    if errors is None:
        yield _SCALE_ALONE
    if not knows_up:
        yield _NO_HEIGHTS
    for what, verdict in (("scale", result.summary.scale), ("place", result.summary.place)):
        if verdict is not None and verdict.verdict != "good":
            yield f"the {what} of the map is doubtful, and so are these intervals: {'; '.join(verdict.reasons)}"


def _interval(ends: Interval, sign: str = "") -> str:
    return "{:{s}.3f} to {:{s}.3f}".format(*ends, s=sign)


def _cells(row: Measurement) -> Sequence[str]:
    values = (
        row.distance_m,
        *row.distance_interval_m,
        row.height_difference_m,
        *(row.height_interval_m or (None,) * 2),
    )
    return [*row.ends, *("" if value is None else f"{value:.6g}" for value in values)]
