"""PlannedSurvey: the anchors, the camera's path and the radio of a survey that has not been made yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from rangesfm.arrays import Array
from rangesfm.measurements.planned_kind import PlannedKind
from rangesfm.measurements.positions.antenna_track import AntennaTrack, locate_antenna
from rangesfm.measurements.positions.control_points import ControlPoint
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.option_model import Options
from rangesfm.options import RangeModelOptions, RangesOptions
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import Trajectory

Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]  # national grids go up to 1e7
Place = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]


class PlannedAntenna(Options, table="positions"):
    """Planned positions of an antenna on the camera: by satellites, a radio or a total station."""

    rate_hz: Annotated[float, Field(ge=1e-3, le=1e3)] = 1.0
    """Positions per second."""
    stddev_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.03
    """Standard deviation of each coordinate."""
    antenna_in_cam_m: Place = (0.0, 0.0, 0.0)
    """Lever arm: position of the antenna in the camera frame (right, down, forward), metres."""
    lasting_s: Annotated[float, Field(ge=1e-2, le=1e5)] | None = None
    """Time for which an error of the positions lasts (default: a mixture of 3, 30 and 300 s)."""

    def located(self, path: Trajectory) -> KnownPositions:
        """Return the positions without errors on a path."""
        times_s = np.arange(path.times_s[0], path.times_s[-1], 1 / self.rate_hz)
        covariance_m2 = np.tile(self.stddev_m**2 * np.eye(3), (len(times_s), 1, 1))
        nowhere, lines = np.zeros((len(times_s), 3)), np.zeros(len(times_s), dtype=np.int64)
        log = PositionLog(nowhere, covariance_m2, ByTime(times_s), lines)
        found = locate_antenna(AntennaTrack(log, np.array(self.antenna_in_cam_m), None, RangesOptions()), path)
        return replace(found, position_m=found.predicted_m(IDENTITY))


@dataclass(frozen=True)
class PlannedSurvey:
    """A survey that has not been made yet, in metres in the site frame.

    Attributes:
        trajectory: path of the keyframes, with times.
        anchors: anchors, all with a position, and with the standard deviation to which it will be known.
        anchor_frame: frame in which their positions will be known, as in a survey file, or "unknown".
        rate_hz: ranges to each anchor per second.
        tag_in_cam_m: (3,) lever arm of the tag.
        range_model: what a run will assume about the radio.
        curve_stddev_m: standard deviation of the radio's error curve after a calibration; None: it is not calibrated.
        component_stddevs: standard deviations of components of the range errors that are known better, by name.
        taped: taped lengths between points of the map, as pairs of length and standard deviation.
        heights_m: lowest and highest height for anchors; None: not below the ground.
        path_is_level: whether the camera cannot go up and down, as on a rover.
        photos: field of view and features of the camera; None: the map bends as maps of poses usually do.
        points: control and check points in the site. antenna: positions of an antenna on the camera; None without any.
        others: other kinds of measurement, by name.
        allowed_m: (k, 3) allowed places for anchors; empty: not given.
        walls_m: corners (k, 2) of each wall, as seen from above, through which no advice leads path or anchors.
        walls_are: what the walls are, in words.
        is_placed: whether the anchors' places are fixed; else they may be moved to any allowed place.
        times_are_known: whether the times of the path are those of photos; else they are assumed.
        max_num_ranges: largest number of simulated ranges; if there are more, each stands for several.
        warnings: what is odd about the plan, a line each.
        site: frame of all positions, from which texts get the coordinates that the user knows.
        axes, level: words after coordinates, and after a height, that say of what they are, if not of the site.
    """

    trajectory: Trajectory
    anchors: tuple[Anchor, ...]
    anchor_frame: str
    rate_hz: float
    tag_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_model: RangeModelOptions = field(default_factory=RangeModelOptions)
    curve_stddev_m: float | None = None
    component_stddevs: Mapping[str, float] = field(default_factory=dict)
    taped: tuple[tuple[float, float], ...] = ()
    photos: PlannedPhotos | None = None
    points: tuple[ControlPoint, ...] = ()
    antenna: PlannedAntenna | None = None
    others: Mapping[str, PlannedKind] = field(default_factory=dict)
    heights_m: tuple[float, float] | None = None
    path_is_level: bool = False
    allowed_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    walls_m: tuple[Array, ...] = ()
    walls_are: str = "walls"
    is_placed: bool = True
    times_are_known: bool = True
    max_num_ranges: int = 2000
    warnings: tuple[str, ...] = ()
    site: Site = field(default_factory=Site)
    axes: str = ""
    level: str = ""

    @property
    def anchors_m(self) -> Array:
        """Positions of the anchors (m, 3)."""
        return np.array([anchor.position_m for anchor in self.anchors], dtype=np.float64).reshape(-1, 3)

    @property
    def places_m(self) -> Array:
        """Positions of all anchors, points and keyframes (m + k + n, 3)."""
        points_m = np.array([point.position_m for point in self.points], dtype=np.float64).reshape(-1, 3)
        return np.vstack([self.anchors_m, points_m, self.trajectory.centers])

    @property
    def duration_s(self) -> float:
        times = self.trajectory.timestamps_s
        return 0.0 if times is None else float(times[-1] - times[0])

    @property
    def num_ranges(self) -> int:
        """Number of ranges that the radio will measure."""
        return int(self.duration_s * self.rate_hz) * len(self.anchors)

    def with_anchor_at(self, k: int, place_m: Array) -> PlannedSurvey:
        """Return the survey with its k-th anchor at another place (3,)."""
        moved = replace(self.anchors[k], position_m=place_m)
        return replace(self, anchors=(*self.anchors[:k], moved, *self.anchors[k + 1 :]))

    def ranging(self, num_ranges: int) -> PlannedSurvey:
        """Return the survey with the rate that gives this number of ranges."""
        return replace(self, rate_hz=(num_ranges / len(self.anchors) + 0.5) / self.duration_s)

    @property
    def by_kind(self) -> dict[str, PlannedSurvey]:
        """The survey with each kind of measurement alone, by its name."""
        nothing = replace(self, anchors=(), points=(), antenna=None, others={}, taped=())
        alone = {
            "ranges": replace(nothing, anchors=self.anchors),
            "positions": replace(nothing, points=self.points, antenna=self.antenna),
            "lengths": replace(nothing, taped=self.taped),
        }
        is_any = (self.anchors, self.points or self.antenna, self.taped)
        given = {kind: each for (kind, each), has in zip(alone.items(), is_any, strict=True) if has}
        return given | {kind: replace(nothing, others={kind: each}) for kind, each in self.others.items()}

    @property
    def given_sizes(self) -> Mapping[str, float]:
        """Sizes of components of the errors that are known better than from other surveys, by name."""
        of_others = {name: size for each in self.others.values() for name, size in each.sizes.items()}
        return {**of_others, **self.component_stddevs}

    @property
    def num_alike(self) -> int:
        """Number of ranges that each simulated one stands for."""
        return -(-self.num_ranges // self.max_num_ranges) or 1
