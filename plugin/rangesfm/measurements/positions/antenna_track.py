"""An antenna's known positions, with its lever arm and its clock, and their places on the camera's path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.kind import by_all_poses
from rangesfm.measurements.places import AntennaPlaces, places_on_path
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.options import RangesOptions
from rangesfm.util.files.clock_times import time_text
from rangesfm.util.files.photo_names import rows_of_photos
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.trajectory import OnPath, Trajectory, places_in_time


@dataclass(frozen=True)
class AntennaTrack:
    """Positions of an antenna on the camera.

    Attributes:
        log: in the site's frame.
        antenna_in_cam_m: (3,) lever arm.
        offset: image time minus time of the positions; None: not known yet, or not needed.
        association: how positions are placed between keyframes.
        other_offset_s: offset with which the positions fit the path much better than with the given one; None: none.
    """

    log: PositionLog
    antenna_in_cam_m: Array
    offset: TimeOffset | None
    association: RangesOptions
    other_offset_s: float | None = None

    @property
    def offset_s(self) -> float:
        """Image time minus time of the positions; 0 where it is not known."""
        return 0.0 if self.offset is None else self.offset.value_s

    @property
    def offset_stddev_s(self) -> float:
        """Standard deviation of the offset; 0 where it was given."""
        return 0.0 if self.offset is None else self.offset.stddev_s

    @property
    def image_times_s(self) -> Array:
        """(n,) times of the positions on the photos' clock; NaN for positions by photo."""
        return self.log.moments.later(self.offset_s).timestamp_s


def locate_antenna(track: AntennaTrack, path: Trajectory) -> KnownPositions:
    """Return the positions that have a place on a path; the others are left out."""
    everywhere = _places(track, path)
    rows = np.flatnonzero(everywhere.before >= 0)
    k, times_s, at, velocity = len(rows), path.timestamps_s, everywhere.subset(rows), np.zeros((len(rows), 3))
    arms_m = np.tile(track.antenna_in_cam_m, (k, 1))
    # The times of positions are those of a system's own epochs, so that they are exact.
    max_gap_s = track.association.max_interpolation_gap_s
    on_path = places_on_path(path, arms_m, at, max_gap_s=max_gap_s, time_resolution_s=0.0)
    if times_s is None or len(path) < 2:
        at_s = at.before.astype(np.float64)
    else:
        velocity = at.between(np.gradient(path.centers, times_s, axis=0, edge_order=2 if len(path) > 2 else 1))
        at_s = times_s[at.before] if isinstance(track.log.moments, ByPhoto) else track.image_times_s[rows]
    moments = track.log.moments
    names = moments.image_name if isinstance(moments, ByPhoto) else [*map(time_text, moments.timestamp_s.tolist())]
    interval_s = np.zeros(k) if times_s is None else times_s[at.after] - times_s[at.before]
    places = AntennaPlaces(at.before, at.after, at.fraction, interval_s, on_path.center_offsets)
    parts = places.by_pose(Poses(path.world_from_cam, path.centers), arms_m, np.tile(np.eye(3), (k, 1, 1)))
    return KnownPositions(
        names=tuple(names[row] for row in rows.tolist()),
        is_mark=np.zeros(k, dtype=bool),
        is_check=np.zeros(k, dtype=bool),
        position_m=track.log.position_m[rows],
        covariance_m2=track.log.covariance_m2[rows],
        places=on_path.centers,
        arms_m=on_path.tag_from_center,
        own_covariance=on_path.center_stddev[:, None, None] ** 2 * np.eye(3),
        arm_stddev_m=on_path.arm_stddev_m,
        time_s=at_s,
        velocity=velocity,
        world_from_cam=path.world_from_cam[at.nearest],
        by_pose=by_all_poses(places.keyframes, parts * [0, 0, 0, 1, 1, 1], len(path)),
        arms_by_pose=by_all_poses(places.keyframes, parts * [1, 1, 1, 0, 0, 0], len(path)),
        on_path=places,
    )


def _places(track: AntennaTrack, path: Trajectory) -> OnPath:
    """Return the places of the log's positions on a path."""
    log, options = track.log, track.association
    if isinstance(log.moments, ByPhoto):
        return OnPath.at_keyframes(rows_of_photos(log.moments.image_name, path.image_names))
    if path.timestamps_s is None:
        raise InputError("the positions have times but the photos have none: give image times", log.path)
    max_gap_s, max_difference_s = options.max_interpolation_gap_s, options.max_time_difference_s
    known_s = path.timestamps_s
    return places_in_time(track.image_times_s, known_s, max_gap_s=max_gap_s, max_difference_s=max_difference_s)
