"""Known positions as residuals of the full problem: priors of control points' marks, and positions of an antenna."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap

from rangesfm import ceres
from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.distances.tape import Marker
from rangesfm.geometry.trajectory import Trajectory, pose_of
from rangesfm.positions.antenna_track import AntennaTrack
from rangesfm.positions.surveyed_positions import SurveyedPositions
from rangesfm.refine.bundle_adjustment import BundleAdjustment
from rangesfm.scale.scale_by_positions import PositionScale


@dataclass(frozen=True)
class HeldAntenna:
    """k positions of an antenna between keyframes, with their learnt errors.

    Attributes:
        frame_ids: of the n keyframes. before, after: (k,) indices of keyframes. fraction: (k,) interpolation fraction
            of the later one.
        offset_in_world_m: (k, 3) deviation of the antenna's curved path from the straight line, in the metric world.
        interval_s: (k,) time between the two keyframes.
        position_m: (k, 3). whitening: (k, 3, 3) of their errors. share: factor of each loss, for errors that last.
        antenna_in_cam_m: (3,) lever arm as given, and its estimate, which the solver changes in place.
        time_shift_s: (1,) how much later than assumed the positions were taken, also changed in place.
        time_shift_stddev_s: of its prior; 0: the time offset was given.
    """

    frame_ids: Indices
    before: Indices
    after: Indices
    fraction: Array
    offset_in_world_m: Array
    interval_s: Array
    position_m: Array
    whitening: Array
    share: float
    antenna_in_cam_m: tuple[Array, Array]
    time_shift_s: Array
    time_shift_stddev_s: float

    @classmethod
    def of(cls, found: PositionScale, track: AntennaTrack, trajectory: Trajectory) -> HeldAntenna | None:
        """Return the antenna's positions that took part in an estimate of the scale; None if none did.

        Args:
            found: the estimate, on the unscaled model. track: of the antenna. trajectory: of the unscaled model.
        """
        known, placed, arm_m = found.known, found.site_from_model, np.array(track.antenna_in_cam_m, np.float64)
        rows = np.flatnonzero(found.is_used & ~known.is_mark)
        if not len(rows):
            return None
        before, after = known.on_path[rows].T
        fraction, turned = known.fraction[rows], trajectory.world_from_cam @ arm_m
        on_line = (1 - fraction)[:, None] * turned[before] + fraction[:, None] * turned[after]
        beyond = placed.scale * known.from_line[rows] + known.arms_m[rows] - on_line
        times = np.zeros(len(trajectory)) if trajectory.timestamps_s is None else trajectory.timestamps_s
        return cls(
            frame_ids=trajectory.frame_ids,
            before=before,
            after=after,
            fraction=fraction,
            offset_in_world_m=beyond @ placed.rotation.T,
            interval_s=times[after] - times[before],
            position_m=known.position_m[rows],
            whitening=_whitenings(known.covariance_m2[rows], found.stddev_m[rows]),
            share=1 / found.inflation**2,
            antenna_in_cam_m=(arm_m, arm_m.copy()),
            time_shift_s=np.zeros(1),
            time_shift_stddev_s=track.offset_stddev_s,
        )


def _whitenings(covariances_m2: Array, stddevs_m: Array) -> Array:
    """Return (k, 3, 3) whitenings of covariances as given, but of these mean standard deviations (k,)."""
    given = np.isfinite(covariances_m2[:, :1, :1])
    shapes = np.where(given, covariances_m2, np.eye(3))
    shapes = shapes / (np.trace(shapes, axis1=1, axis2=2) / 3)[:, None, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(shapes * stddevs_m[:, None, None] ** 2)))


@dataclass(frozen=True)
class HeldPositions:
    """Known positions that hold the map, with the standard deviations that the scale stage learnt.

    Attributes:
        markers: of the control points, by name.
        position_m: (3,) in the site, by name. stddev_m: of each coordinate.
        antenna: positions of an antenna; None without any.
    """

    markers: Mapping[str, Marker] = field(default_factory=dict)
    position_m: Mapping[str, Array] = field(default_factory=dict)
    stddev_m: Mapping[str, float] = field(default_factory=dict)
    antenna: HeldAntenna | None = None

    @classmethod
    def of(cls, found: PositionScale | None, surveyed: SurveyedPositions, trajectory: Trajectory) -> HeldPositions:
        """Return the positions that took part in an estimate of the scale.

        Args:
            found: the estimate, on the unscaled model. surveyed: all positions. trajectory: of the unscaled model.
        """
        if found is None:
            return cls()
        rows = {found.known.names[row]: row for row in np.flatnonzero(found.is_used & found.known.is_mark).tolist()}
        track = surveyed.antenna
        return cls(
            {name: surveyed.markers[name] for name in rows},
            {name: found.known.position_m[row] for name, row in rows.items()},
            {name: float(found.stddev_m[row]) for name, row in rows.items()},
            None if track is None else HeldAntenna.of(found, track, trajectory),
        )

    def refined(self, surveyed: SurveyedPositions) -> SurveyedPositions:
        """Return all positions with the antenna's lever arm and time offset as the solver has them."""
        track = surveyed.antenna
        if track is None or self.antenna is None:
            return surveyed
        offset_s = None if track.offset_s is None else track.offset_s + float(self.antenna.time_shift_s[0])
        antenna = replace(track, offset_s=offset_s, antenna_in_cam_m=self.antenna.antenna_in_cam_m[1])
        return replace(surveyed, antenna=antenna)

    @property
    def stddevs_m(self) -> list[float]:
        """Standard deviations of all positions."""
        of_antenna = [] if self.antenna is None else np.linalg.norm(np.linalg.inv(self.antenna.whitening), axis=(1, 2))
        return [*self.stddev_m.values(), *(np.asarray(of_antenna) / np.sqrt(3)).tolist()]


def add_positions(
    bundle: BundleAdjustment,
    positions: HeldPositions,
    marker_ids: Mapping[str, int],
    of_marks: Mapping[str, Array],
    *,
    lever_arm_stddev_m: float,
    loss_scale: float,
) -> list[Array]:
    """Add the positions to the bundle adjustment, as residuals in pixels, and return the parameter blocks added.

    Args:
        marker_ids: 3-D points of the model, by the names of the markers.
        of_marks: (3, 3) covariances of their errors that no residual has, by name.
        lever_arm_stddev_m: of each coordinate of the lever arm; 0 keeps it.
        loss_scale: length of an error, in standard deviations of its coordinates, from which it is down-weighted.
    """
    for name, position_m in positions.position_m.items():
        mark = bundle.metric.point3D(marker_ids[name]).xyz
        stddev, further = positions.stddev_m[name] / bundle.pixel_stddev, of_marks[name] / bundle.pixel_stddev**2
        ceres.add_normal_prior(bundle.adjuster, mark, position_m, stddev, further)
    antenna = positions.antenna
    if antenna is None:
        return []
    given_m, arm_m = antenna.antenna_in_cam_m
    arm_is_free, shift_is_free = lever_arm_stddev_m > 0, antenna.time_shift_stddev_s > 0
    for rows in rows_by_key(antenna.before, antenna.after):
        poses = _poses(bundle.metric, antenna, int(rows[0]))
        is_between = len(poses) == 2
        cost = ceres.position_cost(
            position_m=antenna.position_m[rows],
            whitening=antenna.whitening[rows],
            tag_in_cam_m=None if arm_is_free else arm_m,
            weight=antenna.fraction[rows] if is_between else None,
            offset_in_world_m=antenna.offset_in_world_m[rows] if is_between else None,
            interval_s=antenna.interval_s[rows[0]] if is_between and shift_is_free else None,
            share=bundle.pixel_stddev**2 * antenna.share,
            loss_scale=loss_scale,
        )
        shifts = [antenna.time_shift_s] if is_between and shift_is_free else []
        ceres.add_residual_block(bundle.adjuster, cost, None, [*poses, *([arm_m] if arm_is_free else []), *shifts])
    bundle.add_prior(arm_m, given_m, lever_arm_stddev_m)
    bundle.add_prior(antenna.time_shift_s, np.zeros(1), antenna.time_shift_stddev_s)
    return [block for block in (arm_m, antenna.time_shift_s) if bundle.adjuster.problem.has_parameter_block(block)]


def _poses(metric: pycolmap.Reconstruction, antenna: HeldAntenna, row: int) -> list[Array]:
    ends = dict.fromkeys([int(antenna.before[row]), int(antenna.after[row])])
    return [pose_of(metric.frame(int(antenna.frame_ids[end]))).params for end in ends]
