"""The table of kinds: what was measured becomes measurements of a map. No stage names a kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.distances.locate_lengths import distances_by_radio
from rangesfm.distances.tape import Marker, Tape
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.poses import Poses
from rangesfm.geometry.robust_statistics import RobustLoss
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.measurements.control_points import ControlPoints
from rangesfm.measurements.gravity import UpwardDirection
from rangesfm.measurements.kind import MapState, Measurements
from rangesfm.measurements.lengths import Lengths
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions import CLOCK as POSITIONS_CLOCK
from rangesfm.measurements.positions import AntennaPositions, antenna_at
from rangesfm.measurements.ranges import CLOCK, SHORT, Ranges, anchors_at, antenna_places
from rangesfm.measurements.source import Source
from rangesfm.options import RefineOptions
from rangesfm.positions.antenna_track import AntennaTrack
from rangesfm.positions.known_positions import KnownPositions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.noise import STRETCH_S, stretch_labels
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations

__all__ = [
    "CLOCK",
    "POSITIONS_CLOCK",
    "SHORT",
    "Measured",
    "Ranges",
    "TapedLengths",
    "Upwards",
    "UsedPositions",
    "anchors_at",
    "antenna_at",
    "ranges_of",
    "ranges_of_map",
]


def ranges_of_map(
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[AnchorEstimate],
    errors: RangeErrors,
    options: RefineOptions,
) -> Ranges:
    """Return the ranges of a log on a metric map; arguments as for ``refine_with_ranges``."""
    places, tags_in_cam_m = antenna_places(trajectory, observations, metric_from_sfm, tag_in_cam_m)
    rows = observations.placed_rows
    return Ranges(
        observations,
        places,
        tags_in_cam_m,
        tuple(anchors),
        errors.subset(rows),
        np.zeros((len(observations.log), 0)),
        options,
        metric_from_sfm.scale,
    )


@dataclass(frozen=True)
class TapedLengths(Source):
    """Lengths that were taped, between what the photos show or between anchors, of which the control ones take part."""

    tape: Tape

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks of the lengths' ends."""
        ends = {name for taped in self.tape.control().distances for name in taped.ends}
        return {name: marker for name, marker in self.tape.markers.items() if name in ends}

    def measurements(
        self, points: NamedPoints, trajectory: Trajectory, options: RefineOptions
    ) -> Iterator[Measurements]:
        """Yield the lengths whose ends are in the map, if there are any."""
        del trajectory, options
        taped = [each for each in self.tape.control().distances if all(name in points for name in each.ends)]
        if taped:
            yield Lengths(
                tuple(each.ends for each in taped),
                points,
                np.array([each.distance_m for each in taped]),
                np.array([each.stddev_m for each in taped]),
                {},
            )


@dataclass(frozen=True)
class Upwards(Source):
    """The upward direction in the first camera of a map in a site."""

    gravity: Gravity

    def measurements(
        self, points: NamedPoints, trajectory: Trajectory, options: RefineOptions
    ) -> Iterator[Measurements]:
        """Yield the direction."""
        del points, trajectory, options
        yield UpwardDirection(self.gravity)


@dataclass(frozen=True)
class UsedPositions(Source):
    """Known positions that took part in an estimate of the scale, with the errors that it learnt.

    Attributes:
        known: in the unscaled model.
        takes_part: (k,) all but check points and what contradicts the others. Outliers of an antenna are left to the
            loss, because on a map that is one piece drift looks like them.
        stddev_m: (k,) standard deviations of a coordinate.
        site_from_model: the estimate. of_points: marks of all points, by name. track: of the antenna, by tuple of at
            most one.
    """

    known: KnownPositions
    takes_part: Mask
    stddev_m: Array
    site_from_model: Similarity
    of_points: Mapping[str, Marker]
    track: tuple[AntennaTrack, ...]

    @property
    def places_map(self) -> bool:
        """True: they are in the site."""
        return True

    @property
    def _marks(self) -> list[int]:
        rows: list[int] = np.flatnonzero(self.takes_part & self.known.is_mark).tolist()
        return rows

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks of the control points."""
        return {name: self.of_points[name] for name in (self.known.names[row] for row in self._marks)}

    def measurements(
        self, points: NamedPoints, trajectory: Trajectory, options: RefineOptions
    ) -> Iterator[Measurements]:
        """Yield control points, and positions of the antenna."""
        known = self.known
        if rows := self._marks:
            names = tuple(known.names[row] for row in rows)
            yield ControlPoints(names, points, known.position_m[rows], self.stddev_m[rows], {})
        if len(others := np.flatnonzero(self.takes_part & ~known.is_mark)):
            yield self._of_antenna(others, trajectory, options)

    def _of_antenna(self, rows: Indices, trajectory: Trajectory, options: RefineOptions) -> AntennaPositions:
        known, [track] = self.known, self.track
        arm_m = np.array(track.antenna_in_cam_m, np.float64)
        (before, after), fraction = known.on_path[rows].T, known.fraction[rows]
        turned = trajectory.world_from_cam @ arm_m
        on_line = (1 - fraction)[:, None] * turned[before] + fraction[:, None] * turned[after]
        beyond = self.site_from_model.scale * known.from_line[rows] + known.arms_m[rows] - on_line
        times = np.zeros(len(trajectory)) if trajectory.timestamps_s is None else trajectory.timestamps_s
        stated_m = np.sqrt(np.trace(known.covariance_m2[rows], axis1=1, axis2=2) / 3)
        return AntennaPositions(
            tuple(known.names[row] for row in rows.tolist()),
            AntennaPlaces(
                before, after, fraction, times[after] - times[before], beyond @ self.site_from_model.rotation.T
            ),
            known.position_m[rows],
            _whitenings(known.covariance_m2[rows], self.stddev_m[rows]),
            stated_share=np.where(known.is_stated[rows], np.nan_to_num(stated_m) / self.stddev_m[rows], 0.0),
            group=stretch_labels(known.time_s[rows], STRETCH_S),
            arm_m=arm_m,
            arm_stddev_m=options.lever_arm_stddev_m,
            clock_stddev_s=track.offset_stddev_s,
            loss=RobustLoss(options.range_loss_scale, is_bounded=True),
        )


@dataclass(frozen=True)
class Measured:
    """All that was measured of a map: ranges of its log, and measurements of other kinds."""

    ranges: Ranges
    sources: tuple[Source, ...] = ()

    @property
    def markers(self) -> dict[str, Marker]:
        """Marks in photos to which the measurements refer, by name."""
        return {name: marker for source in self.sources for name, marker in source.markers.items()}

    @property
    def is_placed(self) -> bool:
        """True if surveyed anchors or other measurements place the map."""
        of_anchors = any(np.isfinite(each.prior_position_stddev_m) for each in self.ranges.anchors)
        return of_anchors or any(source.places_map for source in self.sources)

    def kinds(
        self, poses: Poses, model: pycolmap.Reconstruction, frame_ids: Indices, trajectory: Trajectory
    ) -> tuple[Measurements, ...]:
        """Return the measurements of a metric model, with the noise to begin with.

        Args:
            poses, frame_ids: of the model's frames, those of the trajectory first. trajectory: of the unscaled model.
        """
        placed = (each.anchor_id for each in self.ranges.anchors if np.isfinite(each.position_m).all())
        points = NamedPoints.in_model(model, frame_ids, self.markers, placed)
        kinds, ranges = list[Measurements](), self.ranges
        if len(ranges.rows):
            ranges = ranges.begun(MapState(poses, ranges.blocks))
            kinds.append(ranges)
        if len((by_radio := _lengths_by_radio(ranges, points)).ends):
            kinds.append(by_radio)
        for source in self.sources:
            kinds += source.measurements(points, trajectory, ranges.options)
        return (*kinds, *(prior for kind in kinds for prior in kind.priors()))


def _lengths_by_radio(ranges: Ranges, points: NamedPoints) -> Lengths:
    """Return the lengths between anchors that ranged to each other."""
    anchors, used_m = ranges.anchors, ranges.errors.stddev_m
    found = distances_by_radio(
        ranges.observations.log,
        float(np.median(used_m)) if len(used_m) else 0.0,
        np.array([anchor.prior_bias_m for anchor in anchors]),
        np.array([anchor.prior_bias_stddev_m for anchor in anchors]),
        common_bias_stddev_m=0.0,
    )
    ends = [tuple(anchors[k].anchor_id for k in pair) for pair in found.anchor_pair.tolist()]
    rows = [row for row, pair in enumerate(ends) if points.anchors.issuperset(pair)]
    return Lengths(
        tuple((ends[row][0], ends[row][1]) for row in rows),
        points,
        found.distance_m[rows],
        found.stddev_m[rows],
        {},
        bias_stddev_m=ranges.errors.common_bias_stddev_m,
        loss=ranges.errors.loss,
    )


def _whitenings(covariances_m2: Array, stddevs_m: Array) -> Array:
    """Return (k, 3, 3) whitenings of covariances as given, but of these mean standard deviations (k,)."""
    given = np.isfinite(covariances_m2[:, :1, :1])
    shapes = np.where(given, covariances_m2, np.eye(3))
    shapes = shapes / (np.trace(shapes, axis1=1, axis2=2) / 3)[:, None, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(shapes * stddevs_m[:, None, None] ** 2)))


def ranges_of(kinds: Sequence[Measurements], given: Ranges) -> Ranges:
    """Return the ranges among the measurements of a map; those that were given if none takes part."""
    return next((kind for kind in kinds if isinstance(kind, Ranges)), given)
