"""The table of kinds: what was measured becomes measurements of a map. No stage names a kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

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
class UsedPositions:
    """Known positions that took part in an estimate of the scale, with the errors that it learnt.

    Attributes:
        known: in the unscaled model.
        takes_part: (k,) all but check points and what contradicts the others. Outliers of an antenna are left to the
            loss, because on a map that is one piece drift looks like them.
        stddev_m: (k,) standard deviations of a coordinate.
        site_from_model: the estimate. markers: of all points, by name. track: of the antenna, by tuple of at most one.
    """

    known: KnownPositions
    takes_part: Mask
    stddev_m: Array
    site_from_model: Similarity
    markers: Mapping[str, Marker]
    track: tuple[AntennaTrack, ...]


@dataclass(frozen=True)
class Measured:
    """All that was measured of a map.

    Attributes:
        ranges: of its log. tape: the control lengths. gravity, positions: at most one.
    """

    ranges: Ranges
    tape: Tape = field(default_factory=Tape)
    gravity: tuple[Gravity, ...] = ()
    positions: tuple[UsedPositions, ...] = ()

    @property
    def markers(self) -> dict[str, Marker]:
        """Marks in photos to which the measurements refer, by name."""
        ends = {name for taped in self.tape.distances for name in taped.ends}
        found = {name: marker for name, marker in self.tape.markers.items() if name in ends}
        for used in self.positions:
            found |= {name: used.markers[name] for name in _names_of_marks(used)}
        return found

    @property
    def is_placed(self) -> bool:
        """True if surveyed anchors or known positions place the map."""
        return bool(self.positions) or any(np.isfinite(each.prior_position_stddev_m) for each in self.ranges.anchors)

    def kinds(
        self, poses: Poses, model: pycolmap.Reconstruction, frame_ids: Indices, trajectory: Trajectory
    ) -> tuple[Measurements, ...]:
        """Return the measurements of a metric model, with the noise to begin with.

        Args:
            poses, frame_ids: of the model's frames, those of the trajectory first. trajectory: of the unscaled model.
        """
        points = NamedPoints.in_model(model, frame_ids, self.markers, (a.anchor_id for a in self._placed_anchors))
        ranges = self.ranges
        if len(ranges.rows):
            ranges = ranges.begun(MapState(poses, ranges.blocks))
        kinds = tuple(replace(self, ranges=ranges)._kinds(points, trajectory))
        return (*kinds, *(prior for kind in kinds for prior in kind.priors()))

    @property
    def _placed_anchors(self) -> Iterator[AnchorEstimate]:
        return (each for each in self.ranges.anchors if np.isfinite(each.position_m).all())

    def _kinds(self, points: NamedPoints, trajectory: Trajectory) -> Iterator[Measurements]:
        if len(self.ranges.rows):
            yield self.ranges
        for lengths in (self._taped(points), self._by_radio(points)):
            if len(lengths.ends):
                yield lengths
        for used in self.positions:
            yield from _of_positions(used, points, trajectory, self.ranges.options)
        for gravity in self.gravity:
            yield UpwardDirection(gravity)

    def _taped(self, points: NamedPoints) -> Lengths:
        taped = [each for each in self.tape.distances if all(name in points for name in each.ends)]
        return Lengths(
            tuple(each.ends for each in taped),
            points,
            np.array([each.distance_m for each in taped]),
            np.array([each.stddev_m for each in taped]),
            {},
        )

    def _by_radio(self, points: NamedPoints) -> Lengths:
        """Return the lengths between anchors that ranged to each other."""
        ranges, anchors = self.ranges, self.ranges.anchors
        used_m = ranges.errors.stddev_m
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


def _names_of_marks(used: UsedPositions) -> list[str]:
    return [used.known.names[row] for row in np.flatnonzero(used.takes_part & used.known.is_mark).tolist()]


def _of_positions(
    used: UsedPositions, points: NamedPoints, trajectory: Trajectory, options: RefineOptions
) -> Iterator[Measurements]:
    known = used.known
    if len(rows := np.flatnonzero(used.takes_part & known.is_mark)):
        yield ControlPoints(
            tuple(known.names[row] for row in rows.tolist()), points, known.position_m[rows], used.stddev_m[rows], {}
        )
    rows = np.flatnonzero(used.takes_part & ~known.is_mark)
    if not len(rows):
        return
    [track] = used.track
    arm_m = np.array(track.antenna_in_cam_m, np.float64)
    (before, after), fraction = known.on_path[rows].T, known.fraction[rows]
    turned = trajectory.world_from_cam @ arm_m
    on_line = (1 - fraction)[:, None] * turned[before] + fraction[:, None] * turned[after]
    beyond = used.site_from_model.scale * known.from_line[rows] + known.arms_m[rows] - on_line
    times = np.zeros(len(trajectory)) if trajectory.timestamps_s is None else trajectory.timestamps_s
    stated_m = np.sqrt(np.trace(known.covariance_m2[rows], axis1=1, axis2=2) / 3)
    positions = AntennaPositions(
        tuple(known.names[row] for row in rows.tolist()),
        AntennaPlaces(before, after, fraction, times[after] - times[before], beyond @ used.site_from_model.rotation.T),
        known.position_m[rows],
        _whitenings(known.covariance_m2[rows], used.stddev_m[rows]),
        stated_share=np.where(known.is_stated[rows], np.nan_to_num(stated_m) / used.stddev_m[rows], 0.0),
        group=stretch_labels(known.time_s[rows], STRETCH_S),
        arm_m=arm_m,
        arm_stddev_m=options.lever_arm_stddev_m,
        clock_stddev_s=track.offset_stddev_s,
        loss=RobustLoss(options.range_loss_scale, is_bounded=True),
    )
    yield positions


def _whitenings(covariances_m2: Array, stddevs_m: Array) -> Array:
    """Return (k, 3, 3) whitenings of covariances as given, but of these mean standard deviations (k,)."""
    given = np.isfinite(covariances_m2[:, :1, :1])
    shapes = np.where(given, covariances_m2, np.eye(3))
    shapes = shapes / (np.trace(shapes, axis1=1, axis2=2) / 3)[:, None, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(shapes * stddevs_m[:, None, None] ** 2)))


def ranges_of(kinds: Sequence[Measurements], given: Ranges) -> Ranges:
    """Return the ranges among the measurements of a map; those that were given if none takes part."""
    return next((kind for kind in kinds if isinstance(kind, Ranges)), given)
