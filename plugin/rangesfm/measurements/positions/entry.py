"""Entries of known positions in ``result.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from rangesfm.errors import number_text
from rangesfm.measurements.kind_entry import KindEntry
from rangesfm.util.files.records import Count, Number, NumberOrNull, Record, Text, Vector, VectorOrNull


class PositionsEntry(KindEntry):
    """Positions of an antenna on the camera, and their residuals in the final map.

    Attributes:
        num: in the file. num_used: that fit. num_rejected: on the path, that do not fit; the others are not on it.
        rms_m: length of the residuals of those used. rms_by_axis_m: of each coordinate.
        stddev_m: learnt standard deviation of a coordinate.
        inflation: of the standard deviation of a mean, by errors that last.
        time_offset_s: image time = time of the position + this; null where the file names photos.
        antenna_in_cam_m: lever arm, as given or estimated.
    """

    num: Count
    num_used: Count
    num_rejected: Count
    rms_m: NumberOrNull
    rms_by_axis_m: VectorOrNull
    stddev_m: NumberOrNull
    inflation: NumberOrNull
    time_offset_s: NumberOrNull
    time_offset_stddev_s: NumberOrNull
    antenna_in_cam_m: Vector

    caption: ClassVar[str] = "Positions of the antenna"
    meanings: ClassVar[Mapping[str, str]] = {
        "num": "in the file",
        "num_used": "used",
        "num_rejected": "on the path, and rejected as they do not fit",
        "rms_m": "RMS residual, m",
        "rms_by_axis_m": "by coordinate, m",
        "stddev_m": "standard deviation of a coordinate, as learnt, m",
        "inflation": "factor on the standard deviation of a mean, as their errors last",
        "time_offset_s": "time offset, s",
        "time_offset_stddev_s": "standard deviation of that offset by the search, s",
        "antenna_in_cam_m": "lever arm, m",
    }
    section: ClassVar[str] = "points"

    def lines(self) -> Iterator[str]:
        """Yield how well the positions fit."""
        shift_s = self.time_offset_s
        offset = "" if shift_s is None else f", time offset {number_text(shift_s, '+.3f')} s"
        rms = "unknown" if self.rms_m is None else number_text(self.rms_m, ".3f")
        yield f"positions: {self.num_used} of {self.num} used, rms {rms} m{offset}"


class PointRow(Record):
    """One control or check point, in the frame of the metric models.

    Attributes:
        kind: "control", "check" or "left out".
        estimated_m: by the marks in the final map; null where fewer than two of its photos have them.
        residual_m: in the map minus known. distance_m: its length.
    """

    marker: Text
    kind: Text
    known_m: Vector
    stddev_m: Number
    estimated_m: VectorOrNull
    residual_m: VectorOrNull
    distance_m: NumberOrNull


class PointErrors3d(Record):
    """Root mean square of the residuals of some points.

    Attributes:
        num: of points that are in the map. rmse_m: of each coordinate. rmse_3d_m: of the distances.
    """

    num: int
    rmse_m: VectorOrNull
    rmse_3d_m: NumberOrNull


class PointsEntry(KindEntry):
    """Control and check points, compared with the final map."""

    control: PointErrors3d
    check: PointErrors3d
    points: tuple[PointRow, ...]

    def lines(self) -> Iterator[str]:
        """Yield how far the points are off."""
        for kind, errors in (("control", self.control), ("check", self.check)):
            if errors.rmse_m is not None:
                axes = ", ".join(f"{value:.3f}" for value in errors.rmse_m)
                yield f"{kind} points: {errors.num}, RMSE {errors.rmse_3d_m:.3f} m (x, y, z: {axes} m)"
