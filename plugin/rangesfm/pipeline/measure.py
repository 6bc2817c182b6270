"""Distances and height differences between points of a result, with their precision."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError, number_text
from rangesfm.measurements.lengths.map_points import MapPoints
from rangesfm.measurements.lengths.measured_lists import PAIRS
from rangesfm.measurements.lengths.tape import FOUND_STDDEV_PX, Marker
from rangesfm.measurements.lengths.tape_file import markers_of_photos, read_markers
from rangesfm.pipeline.measured_map import Interval, MeasuredMap, Measurement
from rangesfm.result.places import input_beside
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.result_tables import TagCorners
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import align_rows, write_table
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
        raise InputError(f"{said}, so that no length in the map has one", result.path)
    map_ = MeasuredMap(
        _points_of(result, None if markers is None else Path(markers)),
        result.read_map_errors(),
        result.summary.scale.relative_stddev_empirical,
        result.summary.up,
    )
    return Measurements(map_.measure(pairs), tuple(_notes(result, map_)))


def read_point_pairs(path: Path) -> list[tuple[str, str]]:
    """Read the pairs of a CSV ``from,to``, or of another table of two ends, as a file of taped distances is.

    Raises:
        InputError: the file is not valid; the error gives the line.
    """
    listed = PAIRS.read(path)
    table = listed.table
    if not len(table):
        raise InputError("holds no pair of points, expected one per line", path)
    pairs = list(zip(listed.text("from"), listed.text("to"), strict=True))
    for row, (first, second) in enumerate(pairs):
        if first == second:
            raise table.error(row, listed.columns["to"], "another point than 'from'")
    return pairs


def _points_of(result: ResultFolder, markers_path: Path | None) -> MapPoints:
    model = result.read_metric_model()
    if model is None:
        raise InputError("there is no metric model (sparse_metric/0 or sparse_scaled/0) to measure in", result.path)
    refine = result.summary.refine
    pixel_stddev = None if refine is None else refine.pixel_stddev
    markers = _markers_of(result) | ({} if markers_path is None else read_markers(markers_path))
    markers = markers_of_photos(markers, [image.name for image in model.images.values()])
    anchors_m = result.anchor_positions_m
    return MapPoints(model, anchors_m, markers, np.nan if pixel_stddev is None else pixel_stddev)


def _markers_of(result: ResultFolder) -> dict[str, Marker]:
    """Return the corners of printed tags that the run found, and the markers that its survey gave."""
    found: dict[str, Marker] = {}
    if (result.path / TagCorners.NAME).is_file():
        found |= read_markers(result.path / TagCorners.NAME, FOUND_STDDEV_PX)
    recorded = result.summary.settings.to_json().get("scale", {}).get("markers")
    given = None if recorded is None else input_beside(result.path, recorded)
    return found | (read_markers(given) if given is not None and given.is_file() else {})


def _notes(result: ResultFolder, map_: MeasuredMap) -> Iterator[str]:
    if map_.errors is None:
        yield _SCALE_ALONE
    if map_.up is None:
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
