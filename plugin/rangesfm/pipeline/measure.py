"""Distances and height differences between points of a result, with their precision."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, number_text
from rangesfm.measurements.lengths.measured_lists import PAIRS
from rangesfm.measurements.lengths.tape import FOUND_STDDEV_PX, Marker
from rangesfm.measurements.lengths.tape_file import markers_of_photos, read_markers
from rangesfm.measurements.points import NamedPoints
from rangesfm.result.places import input_beside
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.result_tables import TagCorners
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import align_rows, write_table
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.processes.threads import with_one_blas_thread

_MEASURES = ("distance", "height_difference")
_COLUMNS = (*PAIRS.required, *(f"{name}{end}_m" for name in _MEASURES for end in ("", "_low", "_high")))
_SCALE_ALONE = (
    "the intervals come from the uncertainty of the scale alone, because the result has no joint covariance of its map "
    "(rangesfm run and rangesfm refine make one, with [refine] covariance); bends of the map are not in them"
)
_NO_HEIGHTS = (
    "no height differences: the map is in the first camera's frame, and its upward direction is unknown (surveyed "
    "anchors, an inertial sensor or [scale] up_in_first_camera give it)"
)


Interval = tuple[float, float]


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
                "-" if row.height_difference_m is None else number_text(row.height_difference_m, "+.3f"),
                "-" if row.height_interval_m is None else _interval(row.height_interval_m, "+"),
            )
            for row in self.rows
        ]
        return "\n".join([align_rows([header, *cells]), *self.notes])

    def write(self, path: Path) -> None:
        """Write the measurements as CSV; what is unknown is empty."""
        write_table(path, list(_COLUMNS), map(_cells, self.rows))


@with_one_blas_thread
def measure(
    result_folder: AnyPath, pairs: Iterable[tuple[str, str]], *, markers: AnyPath | None = None
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
    if result.summary.scale.interval_95 is None:
        said = f"the scale has no interval ({result.summary.scale.method})"
        raise InputError(f"{said}, so that no length in the map has one", result.output_path)
    points = _points_of(result, {} if markers is None else read_markers(markers))
    errors, up, stddev = result.read_map_errors(), result.summary.up, result.summary.scale.relative_stddev_empirical
    notes = [] if errors.are_known else [_SCALE_ALONE]
    notes += [] if up is not None else [_NO_HEIGHTS]
    for what, verdict in (("scale", result.summary.scale), ("place", result.summary.place)):
        if verdict is not None and verdict.verdict != "good":
            notes.append(f"the {what} of the map is doubtful, and so are these intervals: {'; '.join(verdict.reasons)}")
    return Measurements(measured(points, pairs, errors, stddev, up), tuple(notes))


def measured(
    points: NamedPoints,
    pairs: Iterable[tuple[str, str]],
    errors: MapErrors,
    relative_scale_stddev: float,
    up: tuple[Array, float] | None,
) -> tuple[Measurement, ...]:
    """Measure between points of a map by name.

    Args:
        errors: how its parts err together; where that is not known, intervals come from the scale alone.
        relative_scale_stddev: standard deviation of its scale, divided by the scale, as it is stated.
        up: upward unit vector (3,) in the map and the standard deviation of its direction in radians; None if unknown.

    Raises:
        InputError: a name is not in the map.
    """
    pairs = list(pairs)
    found = {name: points.find(name) for name in dict.fromkeys(name for pair in pairs for name in pair)}

    def between(ends: tuple[str, str]) -> Measurement:
        first, second = (found[name] for name in ends)
        apart = second.position_m - first.position_m
        distance_m = float(np.linalg.norm(apart))
        if errors.are_known:
            covariance = errors.relative(first, second, relative_scale_stddev)
        else:
            covariance = relative_scale_stddev**2 * np.outer(apart, apart)

        def interval(value: float, along: Array, more_stddev: float = 0.0) -> Interval:
            half = NORMAL_95 * math.sqrt(max(float(along @ covariance @ along), 0.0) + more_stddev**2)
            return value - half, value + half

        low, high = interval(distance_m, apart / distance_m if distance_m > 0 else np.zeros(3))
        height = of_height = None
        if up is not None:
            upward, tilt_stddev = up
            height = float(upward @ apart)
            if errors.are_known:
                level_m = float(np.linalg.norm(apart - height * upward))
                of_height = interval(height, upward, tilt_stddev * level_m)
        return Measurement(ends, distance_m, (max(low, 0.0), high), height, of_height)

    return tuple(map(between, pairs))


def read_point_pairs(path: Path) -> list[tuple[str, str]]:
    """Read the pairs of a CSV ``from,to``, or of another table of two ends, as a file of taped distances is.

    Raises:
        InputError: the file is not valid; the error gives the line.
    """
    table = PAIRS.read(path)
    if not len(table):
        raise InputError("holds no pair of points, expected one per line", path)
    pairs = list(zip(table.text("from"), table.text("to"), strict=True))
    for row, (first, second) in enumerate(pairs):
        if first == second:
            raise table.error(row, "to", "another point than 'from'")
    return pairs


def _points_of(result: ResultFolder, more_markers: Mapping[str, Marker]) -> NamedPoints:
    """Return the points of a result: with corners of printed tags that it found, and markers that its survey gave."""
    model = result.read_metric_model()
    if model is None:
        raise InputError(
            "there is no metric model (sparse_metric/0 or sparse_scaled/0) to measure in", result.output_path
        )
    found: dict[str, Marker] = {}
    if (result.output_path / TagCorners.NAME).is_file():
        found |= read_markers(result.output_path / TagCorners.NAME, FOUND_STDDEV_PX)
    recorded = result.summary.settings.to_json().get("scale", {}).get("markers")
    given = None if recorded is None else input_beside(result.output_path, recorded)
    found |= read_markers(given) if given is not None and given.is_file() else {}
    markers = markers_of_photos({**found, **more_markers}, [image.name for image in model.images.values()])
    refine = result.summary.refine
    pixel_stddev = None if refine is None else refine.pixel_stddev
    pixel_stddev = np.nan if pixel_stddev is None else pixel_stddev
    return NamedPoints.in_model(model, markers, result.anchor_positions_m, pixel_stddev=pixel_stddev)


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
