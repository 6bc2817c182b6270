"""The time offset of an antenna's positions: their fit to the camera's path at every offset, and at one of them.

The rule by which offsets are found, compared and doubted is that of all kinds (``rangesfm.measurements.clock``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.clock.fit import Observed, OffsetFit, orthonormal, residual_stddev
from rangesfm.measurements.clock.offset import OffsetCurve
from rangesfm.measurements.clock.path_samples import Cells, centred_columns, moving_path
from rangesfm.measurements.clock.search import offset_of_motion, require_enough
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.util.files.photo_names import rows_of_photos, told_none
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.numerics import NUM_REWEIGHTINGS
from rangesfm.util.geometry.robust_statistics import CAUCHY
from rangesfm.util.geometry.similarity import align_points, rounding_of, similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

# A given offset is wrong if the residuals with it are at least so many times those with another one.
_MUCH_WORSE = 3.0


@dataclass(frozen=True)
class TimedPositions(Observed):
    """n positions (n, 3) in metres along a path."""

    position_m: Array

    name = "positions"
    remedy = "give the time offset (--positions_time_offset)"

    @property
    def numbers(self) -> Array:
        return self.position_m.ravel()

    @property
    def alike(self) -> Indices:
        return np.tile(np.arange(3), len(self.times_s))

    @property
    def start_weights(self) -> Array:
        return _weights_by_place(self.position_m)

    def fit(self, offset_s: float, before: OffsetFit | None = None) -> OffsetFit:
        """Fit a similarity from the path to the positions by reweighted least squares."""
        here = self.take(self.on_path(offset_s))
        antenna, scale = np.zeros(len(here.times_s), dtype=np.int64), np.inf if before is None else before.scale
        points, velocities = self.path.antennas(here.times_s + offset_s, antenna, scale)
        weights = here.start_weights
        for _ in range(NUM_REWEIGHTINGS + 1):
            found = align_points(points, here.position_m, weights=weights)
            predicted_m = found.apply(points)
            residuals_m = here.position_m - predicted_m
            away = np.sqrt(np.mean(residuals_m**2, axis=1)) / residual_stddev(residuals_m.ravel())
            weights = CAUCHY.weights(away)
        of_coordinates = np.repeat(weights, 3)
        motions = similarity_motions(predicted_m - predicted_m.mean(axis=0)).reshape(-1, 7)
        basis = orthonormal(np.sqrt(of_coordinates)[:, None] * motions)  # a straight path leaves a turn open
        rates = (velocities @ (found.scale * found.rotation).T).ravel()
        return OffsetFit(offset_s, here, of_coordinates, residuals_m.ravel(), rates, basis, 7, found.scale)

    def scanned(self, weights: Array) -> OffsetCurve:
        """Return the similarity that fits best at each offset.

        Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
        Its sums over pairs of points are correlations in time.
        """
        cells = Cells.from_times(self.times_s, self.path)
        correlate = cells.correlate
        squared, *centers, known = centred_columns(self.path, cells.stride).T
        of_path = [cells.of_path(values) for values in (known, *centers, squared)]
        position_m = self.position_m - np.median(self.position_m, axis=0)
        of_log = [cells.of_log(weights * values) for values in (np.ones(len(weights)), *position_m.T)]
        square_m2 = np.sum(position_m**2, axis=1)
        num = correlate(of_path[0], of_log[0])
        total = np.maximum(num, 1e-12 * weights.sum())
        mean_of_path = np.stack([correlate(values, of_log[0]) for values in of_path[1:4]], axis=1) / total[:, None]
        mean_m = np.stack([correlate(of_path[0], values) for values in of_log[1:]], axis=1) / total[:, None]
        products = np.array([[correlate(own, values) for own in of_path[1:4]] for values in of_log[1:]]) / total
        cross = np.moveaxis(products, 2, 0) - mean_m[:, :, None] * mean_of_path[:, None, :]
        of_places = np.maximum(correlate(of_path[4], of_log[0]) / total - np.sum(mean_of_path**2, axis=1), 0.0)
        variation = correlate(of_path[0], cells.of_log(weights * square_m2)) / total - np.sum(mean_m**2, axis=1)
        strengths = np.linalg.svd(cross, compute_uv=False)
        strengths[:, 2] *= np.sign(np.linalg.det(cross))  # a reflection is no answer
        explained = strengths.sum(axis=1) ** 2 / np.maximum(of_places, 1e-12)
        return OffsetCurve(cells.offsets_s, num, total * variation, total * (variation - explained))


def residual_stddev_at(positions: TimedPositions, offset_s: float) -> float:
    """Return the robust stddev of a coordinate's residuals at one offset, metres; infinite with too few positions."""
    if not positions.on_path(offset_s).any():
        return np.inf
    fit = positions.fit(offset_s, positions.fit(offset_s))
    return fit.residual_stddev if fit.is_testable else np.inf


def _weights_by_place(position_m: Array) -> Array:
    """Return (n,) weights that keep positions far away from most others from deciding."""
    far_m = np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1)
    return CAUCHY.weights(far_m / max(float(np.median(far_m)), rounding_of(position_m)))


def find_antenna_offset(track: AntennaTrack, path: Trajectory) -> AntennaTrack:
    """Return the track with its time offset, which is searched for if it is not given.

    Raises:
        InputError: the positions are by time and the photos have none, or they are of other photos.
        GeometryError: the motion does not determine the offset.
    """
    moments = track.log.moments
    if isinstance(moments, ByPhoto):
        listed = moments.image_name
        if np.all(rows_of_photos(listed, path.image_names) < 0):
            raise InputError(told_none("the file", listed, path.image_names), track.log.path)
        return track
    if path.timestamps_s is None:
        raise InputError("the positions have times but the photos have none: give image times", track.log.path)
    try:
        require_enough(path, len(track.log), TimedPositions)
        max_gap_s = track.association.max_interpolation_gap_s
        samples = moving_path(path, track.antenna_in_cam_m[None], max_gap_s, TimedPositions.remedy)
        positions = TimedPositions(moments.timestamp_s, samples, track.log.position_m)
        found = offset_of_motion(positions)
    except GeometryError:
        if track.offset is None:
            raise
        return track
    if track.offset is None:
        return replace(track, offset=found)
    # Of the same positions: a map that drifts fits a part of them better than all.
    offsets_s = (track.offset_s, found.value_s)
    on_both = np.logical_and(*map(positions.on_path, offsets_s))
    compared = positions.take(on_both) if on_both.any() else positions
    off_m = [residual_stddev_at(compared, each_s) for each_s in offsets_s]
    return replace(track, other_offset_s=found.value_s) if off_m[0] > _MUCH_WORSE * off_m[1] else track
