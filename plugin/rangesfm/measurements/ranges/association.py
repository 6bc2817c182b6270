"""Association of ranges with positions on the camera's path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.measurements.places import places_on_path
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus
from rangesfm.options import RangesOptions
from rangesfm.util.files.photo_names import rows_of_photos
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.robust_statistics import robust_stddev
from rangesfm.util.geometry.trajectory import OnPath, Trajectory, is_too_long, keyframes_around, places_in_time
from rangesfm.util.processes.threads import with_one_blas_thread

# The early and the late half of a burst must agree to this many standard deviations for the camera to count as still.
_MAX_STILL_DRIFT_STDDEVS = 2.0
# A range this close in time to a keyframe, in seconds, counts as taken at it. At walking pace the difference is a tenth
# of a millimetre.
_SAME_TIME_S = 1e-4


@with_one_blas_thread
def associate(
    log: RangeLog,
    trajectory: Trajectory,
    tag_in_cam_m: npt.ArrayLike,
    *,
    time_offset_s: float | Array = 0.0,
    options: RangesOptions = RangesOptions(),
) -> RangeObservations:
    """Find the camera pose at which each range was taken.

    Between keyframes that are close in time, the camera's centre and rotation are interpolated by a motion model learnt
    from the keyframes (``MotionPrior``). The standard deviations of the result include those of this interpolation and
    of times that are recorded in coarse steps. Between keyframes further apart than
    ``options.max_interpolation_gap_s``, a range belongs to the nearest keyframe, and only if it is within
    ``max_time_difference_s`` of it, or the ranges themselves show that the camera stood still around its photos.

    Args:
        log: n ranges.
        trajectory: keyframes; with times, unless the log names photos.
        tag_in_cam_m: (3,) lever arm, the antenna in the camera (rig) frame, metres; (num_tags, 3) if the tags of
            ``log.tag_ids`` have their own.
        time_offset_s: image time = range time + offset; (n,) where the clocks drift.

    Returns:
        All n ranges, each with a position on the path, or a status that says why it has none. Ranges between two
        anchors or two tags have none.

    Raises:
        InputError: the log needs image times and there are none, or the log has more tags than lever arms.
    """
    status = np.full(len(log), RangeStatus.USED, dtype=np.int8)
    if isinstance(log.moments, ByPhoto):
        at = OnPath.at_keyframes(rows_of_photos(log.moments.image_name, trajectory.image_names))
        status[at.before < 0] = RangeStatus.UNKNOWN_IMAGE
    elif trajectory.timestamps_s is not None:
        times, known = log.moments.later(time_offset_s).timestamp_s, trajectory.timestamps_s
        at = _places_by_time(log, times, known, options)
        is_inside = (times >= known[0]) & (times <= known[-1])
        elsewhere = np.where(is_inside, RangeStatus.NO_KEYFRAME_NEAR, RangeStatus.OUTSIDE_PATH)
        status[at.before < 0] = elsewhere[at.before < 0]
    else:
        raise InputError("the log has timestamps but the photos have none: give image times", log.source)
    status[log.kind == RangeKind.ANCHOR_ANCHOR] = RangeStatus.ANCHOR_ANCHOR
    status[log.kind == RangeKind.TAG_TAG] = RangeStatus.TAG_TAG
    at = at.moved(status != RangeStatus.USED, -1)
    # The last row is for the tag index -1, which means no tag.
    tags_in_cam_m = np.vstack([log.lever_arms(tag_in_cam_m), np.full(3, np.nan)])[log.tag_index]
    max_gap_s, resolution_s = options.max_interpolation_gap_s, log.time_resolution_s
    places = places_on_path(trajectory, tags_in_cam_m, at, max_gap_s=max_gap_s, time_resolution_s=resolution_s)
    return RangeObservations(**vars(places), log=log, status=status)


def _places_by_time(log: RangeLog, times: Array, keyframe_times: Array, options: RangesOptions) -> OnPath:
    """Return the places of ranges at times (n,), also of those near a photo at which the camera stood still."""
    max_gap_s, max_difference_s = options.max_interpolation_gap_s, options.max_time_difference_s
    at = places_in_time(times, keyframe_times, max_gap_s=max_gap_s, max_difference_s=max_difference_s)
    nearest = keyframes_around(times, keyframe_times).nearest
    distance = np.abs(times - keyframe_times[nearest])
    # Standing still is tested only at keyframes with a long gap on both sides; elsewhere poses are interpolated.
    long_gap = np.concatenate([[True], is_too_long(np.diff(keyframe_times), max_gap_s), [True]])
    lonely = (log.kind == RangeKind.TAG_ANCHOR) & (long_gap[:-1] & long_gap[1:])[nearest]
    still = lonely & _camera_is_still(log, nearest, distance, times, lonely, keyframe_times)
    return at.moved(still | (distance <= min(_SAME_TIME_S, max_difference_s)), nearest)


def _camera_is_still(
    log: RangeLog, nearest: Indices, distance: Array, times: Array, candidates: Mask, keyframe_times: Array
) -> Mask:
    """Return which ranges (n,) near an isolated photo were taken while the camera stood still at that photo.

    In a stop-and-go survey, the ranges around each photo form a burst in which they do not change. The medians of the
    early and the late half of every burst are compared. Their differences must not exceed what the noise within the
    halves explains.
    """
    still = np.zeros(len(times), dtype=bool)
    # Up to half of the median gap, a range is nearer to this photo than to the next one.
    reach = 0.5 * float(np.median(np.diff(keyframe_times))) if len(keyframe_times) > 1 else np.inf
    near = np.flatnonzero(candidates & (distance <= reach))
    if len(near) < 8:
        return still
    key = nearest[near] * len(log.anchor_ids) + log.anchor_index[near]
    order = near[np.lexsort((times[near], key))]
    starts = np.flatnonzero(np.diff(np.sort(key), prepend=-1))
    drifts, noises = [], []
    for burst in np.split(log.range_m[order], starts[1:]):
        if len(burst) >= 6:
            early, late = np.array_split(burst, 2)
            drifts.append((np.median(late) - np.median(early)) * np.sqrt(len(burst) / 4))
            noises.append(robust_stddev(np.concatenate([_deviations(early), _deviations(late)])))
    if not drifts:
        return still
    # The standard deviation of a median is 1.25 times that of a mean.
    drift_stddev = robust_stddev(drifts)
    noise_stddev = 1.25 * max(float(np.median(noises)), 1e-3)
    still[near] = drift_stddev <= _MAX_STILL_DRIFT_STDDEVS * noise_stddev
    return still


def _deviations(values: Array) -> Array:
    """Return the sorted absolute deviations from the median, without the 0 of the value that is the median itself.

    Among few values that 0 would lower the estimated noise considerably.
    """
    return np.sort(np.abs(values - np.median(values)))[len(values) % 2 :]
