"""Known positions in a site, of points that people marked and of an antenna, as a source of measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.kind import Measurements
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.measurements.positions.cost import AntennaPositions
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.measurements.positions.points_cost import ControlPoints
from rangesfm.measurements.ranges.errors.noise import STRETCH_S, stretch_labels
from rangesfm.measurements.source import MapToFit, Source
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.robust_statistics import RobustLoss
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory


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

    def measurements(self, at: MapToFit) -> Iterator[Measurements]:
        """Yield control points, and positions of the antenna."""
        known = self.known
        if rows := self._marks:
            names = tuple(known.names[row] for row in rows)
            yield ControlPoints(names, at.points, known.position_m[rows], self.stddev_m[rows], {})
        if len(others := np.flatnonzero(self.takes_part & ~known.is_mark)):
            yield self._of_antenna(others, at.trajectory, at.options)

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


def _whitenings(covariances_m2: Array, stddevs_m: Array) -> Array:
    """Return (k, 3, 3) whitenings of covariances as given, but of these mean standard deviations (k,)."""
    given = np.isfinite(covariances_m2[:, :1, :1])
    shapes = np.where(given, covariances_m2, np.eye(3))
    shapes = shapes / (np.trace(shapes, axis1=1, axis2=2) / 3)[:, None, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(shapes * stddevs_m[:, None, None] ** 2)))
