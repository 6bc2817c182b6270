"""PlannedSurvey: the anchors, the camera's path and the radio of a survey that has not been made yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from rangesfm.arrays import Array
from rangesfm.measurements.lengths.lengths_on_map import BENDING
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.positions.antenna_track import AntennaTrack, locate_antenna
from rangesfm.measurements.positions.control_points import ControlPoint
from rangesfm.measurements.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.placement_prior import PlacementPrior
from rangesfm.measurements.ranges.scale.range_equation import RangeState
from rangesfm.measurements.ranges.scale.scale_problem import RangesOnPath, ScaleProblem, scale_problem
from rangesfm.option_model import Options
from rangesfm.options import RangeModelOptions, RangesOptions
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.planning.planned_sensor import PlannedSensor
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import Trajectory

# Offset of anchors with unknown positions, metres. In practice no anchor is exactly in line with a path or in its
# plane. In a plan it may be, and the linearized problem would then miss what is not determined.
_OFF_LINE_M = (0.07, 0.07, 0.1)


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
        assert path.timestamps_s is not None, "a planned path has times"
        times_s = np.arange(path.timestamps_s[0], path.timestamps_s[-1], 1 / self.rate_hz)
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
        sensor: inertial sensor on the camera; None without one.
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
    sensor: PlannedSensor | None = None
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
    def _standing_m(self) -> Array:
        """Positions of the anchors in the computation (m, 3)."""
        return self.anchors_m + _OFF_LINE_M if self.anchor_frame == "unknown" else self.anchors_m

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
    def given_sizes(self) -> Mapping[str, float]:
        """Sizes of components of the errors that are known better than from other surveys, by name."""
        return self.component_stddevs if self.sensor is None else {**self.sensor.sizes, **self.component_stddevs}

    @property
    def num_alike(self) -> int:
        """Number of ranges that each simulated one stands for."""
        return -(-self.num_ranges // self.max_num_ranges) or 1

    @property
    def site_from_first_camera(self) -> Similarity:
        return Similarity(1.0, self.trajectory.world_from_cam[0], self.trajectory.centers[0])

    def observations(self) -> RangeObservations:
        """Simulate ranges without errors on the path; if there are many, each stands for several."""
        num_anchors = len(self.anchors)
        turn = np.arange(self.num_ranges // self.num_alike)
        first_s = 0.0 if self.trajectory.timestamps_s is None else float(self.trajectory.timestamps_s[0])
        times = first_s + (turn + 0.5) * self.num_alike / (self.rate_hz * num_anchors)
        ids = [anchor.anchor_id for anchor in self.anchors]
        log = RangeLog.from_arrays([ids[k] for k in turn % num_anchors], np.ones(len(turn)), timestamp_s=times)
        places = associate(log, self.trajectory, self.tag_in_cam_m)
        at = self._standing_m[[ids.index(anchor_id) for anchor_id in log.anchor_ids]]
        distances = np.linalg.norm(places.centers + places.tag_from_center - at[log.anchor_index], axis=1)
        curve = None if self.curve_stddev_m is None else np.full(len(log), self.curve_stddev_m)
        # A range without a position on the path is not used; it only needs a valid number.
        measured = replace(log, range_m=np.nan_to_num(distances, nan=1.0), shared_stddev_m=curve)
        return replace(places, log=measured)

    @property
    def lasting_s(self) -> tuple[float, ...]:
        """Times for which errors of the antenna's positions last, seconds."""
        return LASTING_S if self.antenna is None or self.antenna.lasting_s is None else (self.antenna.lasting_s,)

    def known_positions(self) -> tuple[KnownPositions, tuple[str, ...]]:
        """Return the known positions without errors, as a run finds them in the map, and what it will leave out."""
        known, notes = (self.photos or PlannedPhotos()).marks_of(self.trajectory, self.points), tuple[str, ...]()
        if unseen := [point.name for point in self.points if point.name not in known.names]:
            notes = (
                f"{len(unseen)} of {len(self.points)} points are left out, as no two photos of the path show them "
                f"from different directions ([photos] field_of_view_deg, seen_m): {', '.join(unseen)}",
            )
        if self.antenna is not None:
            known = known.joined(self.antenna.located(self.trajectory))
        return known, notes

    @property
    def taped_lengths(self) -> LocatedDistances:
        """Lengths that will be taped, between places that are not known yet."""
        lengths, stddevs = np.array(self.taped, dtype=np.float64).reshape(-1, 2).T
        # Between its ends the scale of the map varies.
        stddevs = np.hypot(stddevs, BENDING * lengths)
        return LocatedDistances.between_points(lengths, stddevs, lengths)

    def posed(
        self,
        observations: RangeObservations,
        placement: PlacementPrior | None = None,
        gravity: Gravity | None = None,
    ) -> ScaleProblem:
        """Return the scale problem that a run will solve, with the input that it will have.

        Args:
            placement: what known positions say of the map's place. gravity: the upward direction; None: not known.

        Raises:
            GeometryError: the run will refuse the input.
        """
        from_site = self.site_from_first_camera.inverse() if self.anchor_frame == "first_camera" else IDENTITY
        told = [replace(a, position_m=from_site.apply(at)) for a, at in zip(self.anchors, self.anchors_m, strict=True)]
        given = (observations, self.trajectory, told, self.anchor_frame, self.range_model, self.taped_lengths)
        return scale_problem(RangesOnPath(*given, gravity=gravity), placement)

    def state(self, posed: ScaleProblem) -> RangeState:
        """Return the true state in the frame of the problem."""
        at = {anchor.anchor_id: place for anchor, place in zip(self.anchors, self._standing_m, strict=True)}
        places = np.array([at[anchor_id] for anchor_id in posed.observations.log.anchor_ids])
        first = self.site_from_first_camera
        biases = posed.ranges.bias_mean_m.copy()
        if posed.frame == "site":
            return RangeState(first, places, biases)
        return RangeState(IDENTITY, first.inverse().apply(places), biases)
