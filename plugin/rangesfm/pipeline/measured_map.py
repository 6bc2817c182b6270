"""Distances and height differences between points of a map, with their 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.lengths.map_points import MapPoint, MapPoints
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.numerics import NORMAL_95

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
class MeasuredMap:
    """A map to measure in.

    Attributes:
        points: of the map, by name.
        errors: how its parts err together; None if that is not known. Then intervals come from the scale alone.
        relative_scale_stddev: standard deviation of its scale, divided by the scale, as it is stated.
        up: upward unit vector (3,) in the map and the standard deviation of its direction in radians; None if unknown.
    """

    points: MapPoints
    errors: MapErrors | None
    relative_scale_stddev: float
    up: tuple[Array, float] | None

    def measure(self, pairs: Iterable[tuple[str, str]]) -> tuple[Measurement, ...]:
        """Measure between the points of these names.

        Raises:
            InputError: a name is not in the map.
        """
        pairs = list(pairs)
        points = {name: self.points.find(name) for name in dict.fromkeys(name for pair in pairs for name in pair)}
        return tuple(self._between(points[first], points[second]) for first, second in pairs)

    def _between(self, first: MapPoint, second: MapPoint) -> Measurement:
        apart = second.position_m - first.position_m
        distance_m = float(np.linalg.norm(apart))
        covariance = self._relative(first, second)
        along = apart / distance_m if distance_m > 0 else np.zeros(3)
        low, high = self._interval(distance_m, along, covariance)
        height = interval = None
        if self.up is not None:
            up, tilt_stddev = self.up
            height = float(up @ apart)
            if self.errors is not None:
                level_m = float(np.linalg.norm(apart - height * up))
                interval = self._interval(height, up, covariance, tilt_stddev * level_m)
        return Measurement((first.name, second.name), distance_m, (max(low, 0.0), high), height, interval)

    def _relative(self, first: MapPoint, second: MapPoint) -> Array:
        """Return the covariance (3, 3) of second minus first."""
        if self.errors is None:
            apart = second.position_m - first.position_m
            return self.relative_scale_stddev**2 * np.outer(apart, apart)
        return self.errors.relative(first.errors, second.errors, self.relative_scale_stddev)

    def _interval(self, value: float, along: Array, covariance: Array, more_stddev: float = 0.0) -> Interval:
        half = NORMAL_95 * math.sqrt(max(float(along @ covariance @ along), 0.0) + more_stddev**2)
        return value - half, value + half
