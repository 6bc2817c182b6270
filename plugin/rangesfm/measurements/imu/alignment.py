"""Time offset and rotation between a camera and an inertial sensor, by the turns that both have seen.

The angle between two photos does not depend on the unknown rotation: it finds the offset roughly, over all offsets at
which log and photos overlap. Then offset, rotation and the gyroscope's bias are refined together by robust least
squares of the turns between neighbouring photos. Gravity, turned by the photos, has to stay where it is: this shows
whether the accelerometer's axes are those of the gyroscope.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask, rms
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.clock.fit import SEPARATION_S
from rangesfm.measurements.clock.offset import OffsetCurve
from rangesfm.measurements.clock.path_samples import STEP_S
from rangesfm.measurements.clock.search import MAX_NUM_CANDIDATES
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.util.files.clock_times import span_text
from rangesfm.util.geometry.robust_statistics import CAUCHY
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import Trajectory

MIN_NUM_TURNS = 8
"""Fewest turns between photos that tell offset, rotation and bias, seven numbers of three equations each."""
# Photos further apart say little: a cheap gyroscope's bias of 0.01 rad/s turns by as much as the photos themselves.
_LONGEST_S = 5.0
_NUM_ITERATIONS = 30
# Share of the turns that must be within the log, so that few chance turns do not decide.
_LEAST_SHARE = 0.3
# Two offsets are told apart if one is so much likelier: logarithm of a million.
_LIKELIER = float(np.log(1e6))
# The turns explain the photos' if they leave less than this share of their squares.
_MOST_UNEXPLAINED = 0.25
# Largest standard deviations of what counts as determined.
_MAX_OFFSET_STDDEV_S, _MAX_ROTATION_STDDEV = 0.1, float(np.radians(3.0))
# Chi-square of three degrees of freedom, and of one in squares, that chance exceeds in one of 10 000 surveys.
_FAR_OFF_SQUARED_3, _FAR_OFF_1 = 21.1, 3.9
# What a protractor and the words "mounted upside down" leave open. A given rotation nearer than this is no mistake.
_MOUNTED = float(np.radians(1.0))
# A sensor that sits otherwise later by more than this has slipped; less is what lenses and maps may make of it.
_SLIPPED = float(np.radians(3.0))
_MEDIAN_OF_CHI3 = 1.538  # median length of three standard normal numbers
_DEGREES = 180.0 / np.pi
# Mean accelerations between photos scatter by so much of gravity if that is not in them; by a tenth in people's hands.
_MOVED = 0.5
# The zeros of a phone's accelerometer (0.5 m/s^2, see ``sensor_prior``) make them scatter by up to twice their share.
_SENSORS_ERR = 0.1
# Other axes are named if they make them scatter less by this factor, and chance does not.
_CLEARLY = 1.25


@dataclass(frozen=True)
class _PhotoTurns:
    """n turns between neighbouring photos.

    Attributes:
        from_s, to_s: (n,) times of both photos.
        vectors: (n, 3) rotation vectors in the camera's frame.
        first: (n,) index of the first photo of each.
        resolution_s: of the times.
    """

    from_s: Array
    to_s: Array
    vectors: Array
    first: Indices
    resolution_s: float

    def take(self, rows: Mask) -> _PhotoTurns:
        return replace(
            self,
            from_s=self.from_s[rows],
            to_s=self.to_s[rows],
            vectors=self.vectors[rows],
            first=self.first[rows],
        )

    def __len__(self) -> int:
        return len(self.from_s)


@dataclass(frozen=True)
class ImuAlignment:
    """How a sensor's log belongs to photos.

    Attributes:
        log: with rates in rad/s, also where the file has them in degrees.
        turns: between neighbouring photos, those that were used.
        time_offset_s: image time = time of the log + offset.
        cam_from_imu: (3, 3) rotation.
        gyro_bias_rad_s: (3,) mean bias.
        residual_rad: standard deviation of a turn's errors, each of three axes, in the bulk of the turns.
        covariance: (7, 7) of the offset, of a small turn about the camera's axes (rad), and of the bias; 0 for what was
            taken as given.
        is_mirrored: whether the turns are those of the photos in a mirror.
        mistakes: what is wrong with the log or what was given with it, and what to do, one line each.
    """

    log: ImuLog
    turns: _PhotoTurns
    time_offset_s: float
    cam_from_imu: Array
    gyro_bias_rad_s: Array
    residual_rad: float
    covariance: Array
    is_mirrored: bool = False
    mistakes: tuple[str, ...] = ()

    @property
    def time_offset_stddev_s(self) -> float:
        """Standard deviation of the offset, with that of the photos' times as they are written."""
        return float(np.hypot(np.sqrt(self.covariance[0, 0]), self.turns.resolution_s / np.sqrt(12)))

    @property
    def rotation_covariance(self) -> Array:
        """(3, 3) of a small turn about the camera's axes, rad^2."""
        return self.covariance[1:4, 1:4]

    @property
    def is_determined(self) -> bool:
        stddevs = np.sqrt(np.diag(self.covariance))
        return bool(stddevs[0] <= _MAX_OFFSET_STDDEV_S and stddevs[1:4].max() <= _MAX_ROTATION_STDDEV)

    @property
    def unexplained(self) -> float:
        """Share of the turns' squares that is left."""
        return 3 * self.residual_rad**2 / max(float(np.mean(np.sum(self.turns.vectors**2, axis=1))), 1e-300)


def align_imu(
    log: ImuLog, path: Trajectory, *, time_offset_s: float | None = None, cam_from_imu: Array | None = None
) -> ImuAlignment:
    """Find how a sensor's log belongs to photos.

    Args:
        log: of the sensor.
        path: of the camera, at any scale, with times.
        time_offset_s: image time minus time of the log, if it is known; it is checked.
        cam_from_imu: (3, 3) rotation, if it is known; it is checked.

    Raises:
        InputError: the photos have no times, or log and photos do not overlap.
        GeometryError: the turns do not determine the alignment, or they are not of the same camera.
    """
    turns = _turns_of(path, log)
    factors = _possible_factors(log, turns)
    fits = [_best(replace(log, gyro_rad_s=log.gyro_rad_s / factor), turns) for factor in factors]
    (fit, rival), factor = min(zip(fits, factors, strict=True), key=lambda each: each[0][0].unexplained)
    mistakes = []
    if fit.is_mirrored:
        raise GeometryError(
            f"{log.name}: the turns of the gyroscope are those of the photos in a mirror: one of its axes has the "
            "wrong sign, or two are swapped; expected x, y, z as a right-handed system, as the accelerometer's"
        )
    if fit.unexplained > _MOST_UNEXPLAINED:
        raise GeometryError(
            f"{log.name}: at no time offset do the turns of the gyroscope fit those of the photos (the best leaves "
            f"{np.degrees(fit.residual_rad):.1f} deg): is the log of this survey, and the sensor fixed to the camera?"
        )
    if rival is not None:
        raise GeometryError(
            f"{log.name}: the turns fit the photos' at time offsets of {fit.time_offset_s:+.2f} s and of "
            f"{rival.time_offset_s:+.2f} s: turn the camera more often and less evenly, or give time_offset"
        )
    if factor != 1.0:
        unit = "degrees a second" if factor > 1 else "180 / pi times too small"
        mistakes.append(
            f"{log.name}: the gyroscope turns {factor:.3g} times as fast as the photos: its rates are taken as {unit}; "
            "name its columns gyro_x_deg_s, or write them in rad/s"
        )
    if not fit.is_determined and cam_from_imu is not None:
        fit = _refined(turns, replace(fit, cam_from_imu=cam_from_imu), is_rotation_held=True) or fit
    if not fit.is_determined:
        offset_stddev_s, turn = np.sqrt(fit.covariance[0, 0]), np.degrees(np.sqrt(np.diag(fit.covariance)[1:4].max()))
        raise GeometryError(
            f"{log.name}: the turns of the photos do not determine how the sensor sits (time offset "
            f"+-{offset_stddev_s:.2g} s, rotation +-{turn:.2g} deg): turn the camera about two axes, or give "
            "rotation_imu_to_cam_xyzw"
        )
    mistakes += _wrong_rotation(fit, cam_from_imu)
    mistakes += _wrong_offset(fit, time_offset_s)
    _require_fixed(fit, turns)
    _require_same_axes(fit, path)
    return replace(fit, mistakes=tuple(mistakes))


def _turns_of(path: Trajectory, log: ImuLog) -> _PhotoTurns:
    times_s = path.timestamps_s
    if times_s is None:
        raise InputError("the sensor's log has times but the photos have none: give image times", log.path or None)
    first = np.flatnonzero((np.diff(times_s) > 0) & (np.diff(times_s) <= _LONGEST_S))
    if len(first) < MIN_NUM_TURNS:
        raise GeometryError(
            f"{log.name}: {len(first)} turns between photos at most {_LONGEST_S:g} s apart do not tell how the sensor "
            f"sits, expected {MIN_NUM_TURNS} or more"
        )
    turned = np.swapaxes(path.world_from_cam[first], 1, 2) @ path.world_from_cam[first + 1]
    vectors = Rotation.from_matrix(turned).as_rotvec()
    return _PhotoTurns(times_s[first], times_s[first + 1], vectors, first, path.time_resolution_s)


def _possible_factors(log: ImuLog, turns: _PhotoTurns) -> tuple[float, ...]:
    """Return by what the rates may have to be divided: also by that of degrees where they differ from the photos'.

    The mean rate of the photos is at most that of the sensor, whose turns to and fro it does not see.
    """
    of_photos = np.sum(np.linalg.norm(turns.vectors, axis=1)) / np.sum(turns.to_s - turns.from_s)
    of_sensor = float(np.mean(np.linalg.norm(log.gyro_rad_s, axis=1)))
    ratio = of_sensor / max(float(of_photos), 1e-9)
    return (1.0, _DEGREES) if ratio > 7.0 else (1.0, 1 / _DEGREES) if ratio < 1 / 7.0 else (1.0,)


def _best(log: ImuLog, turns: _PhotoTurns) -> tuple[ImuAlignment, ImuAlignment | None]:
    """Return the best fit over all offsets, and another that is about as likely; None if there is none.

    Raises:
        InputError: log and photos do not overlap at any offset.
    """
    found = list[ImuAlignment]()
    for offset_s in _candidates(log, turns):
        start = _started(log, turns, offset_s)
        fit = None if start is None else _refined(turns, start)
        if fit is not None and all(abs(fit.time_offset_s - one.time_offset_s) > SEPARATION_S for one in found):
            found.append(fit)
    if not found:
        raise GeometryError(f"{log.name}: at no time offset do the turns of the gyroscope fit those of the photos")
    best, *others = sorted(found, key=_badness)
    rivals = [one for one in others if _badness(one) - _badness(best) < _LIKELIER]
    return best, rivals[0] if rivals else None


def _badness(fit: ImuAlignment) -> float:
    """Return minus the logarithm of the likelihood of a fit, whatever the noise, for the turns of a whole survey."""
    return 1.5 * len(fit.turns) * float(np.log(max(fit.unexplained, 1e-12)))


def _candidates(log: ImuLog, turns: _PhotoTurns) -> list[float]:
    """Return the offsets at which the angles of the turns agree best, all apart."""
    least_s, most_s = turns.from_s[0] - log.timestamp_s[-1], turns.to_s[-1] - log.timestamp_s[0]
    offsets_s = np.arange(least_s, most_s, STEP_S)
    angles = np.linalg.norm(turns.vectors, axis=1)
    need = max(MIN_NUM_TURNS, _LEAST_SHARE * len(turns))
    num, errors, scale = np.zeros((3, len(offsets_s)))
    for some in np.array_split(np.arange(len(offsets_s)), max(1, len(offsets_s) * len(turns) // 1_000_000)):
        from_s, to_s = (times - offsets_s[some, None] for times in (turns.from_s, turns.to_s))
        known = log.knows(from_s, to_s)
        ends = (log.nearest_quaternions(times) for times in (from_s, to_s))
        cosines = np.abs(np.einsum("otq,otq->ot", *ends))
        of_sensor = 2 * np.arccos(np.minimum(cosines, 1.0))
        num[some] = known.sum(axis=1)
        # The sum of lengths counts, not that of squares: some photos may have a wrong pose.
        errors[some] = np.where(known, np.abs(of_sensor - angles), 0.0).sum(axis=1)
        scale[some] = np.where(known, angles, 0.0).sum(axis=1)
    tried = np.flatnonzero(num >= need)
    if not len(tried):
        of_log = span_text(log.timestamp_s[0], log.timestamp_s[-1])
        of_photos = span_text(turns.from_s[0], turns.to_s[-1])
        raise InputError(
            f"the sensor's log ({of_log}) has no stretch without gaps as long as {need:.0f} turns of the photos "
            f"({of_photos})",
            log.path or None,
        )
    curve = OffsetCurve(offsets_s, num, np.maximum(scale, 1e-9) ** 2, np.maximum(errors, 1e-9) ** 2)
    return curve.take(tried).peaks(SEPARATION_S, MAX_NUM_CANDIDATES)


def _started(log: ImuLog, turns: _PhotoTurns, offset_s: float) -> ImuAlignment | None:
    """Return the best rotation at an offset, mirrored if that fits better; None if no turns are in the log."""
    turns = turns.take(log.knows(turns.from_s - offset_s, turns.to_s - offset_s))
    if len(turns) < MIN_NUM_TURNS:
        return None
    of_sensor = log.turns_between(turns.from_s - offset_s, turns.to_s - offset_s)
    left, _, right = np.linalg.svd(turns.vectors.T @ of_sensor)
    proper, mirrored = (left @ np.diag([1.0, 1.0, sign * np.linalg.det(left @ right)]) @ right for sign in (1.0, -1.0))
    misses = [np.median(np.linalg.norm(turns.vectors - of_sensor @ one.T, axis=1)) for one in (proper, mirrored)]
    # A mirror changes turns about all axes; with turns about one or two, both fit alike.
    is_mirrored = bool(misses[1] < 0.5 * misses[0])
    start = mirrored if is_mirrored else proper
    stddev = float(min(misses)) / _MEDIAN_OF_CHI3
    return ImuAlignment(log, turns, offset_s, start, np.zeros(3), max(stddev, 1e-9), np.eye(7), is_mirrored)


def _refined(turns: _PhotoTurns, start: ImuAlignment, *, is_rotation_held: bool = False) -> ImuAlignment | None:
    """Return the robust least-squares solution near a start; None if it leaves the log."""
    log, offset_s, rotation, bias = start.log, start.time_offset_s, start.cam_from_imu, start.gyro_bias_rad_s
    stddev = start.residual_rad
    is_free = np.array([True, *3 * [not is_rotation_held], True, True, True])
    used, covariance = turns, np.eye(7)
    for _ in range(_NUM_ITERATIONS):
        used = turns.take(log.knows(turns.from_s - offset_s, turns.to_s - offset_s))
        if len(used) < MIN_NUM_TURNS:
            return None
        from_s, to_s = used.from_s - offset_s, used.to_s - offset_s
        by_bias = log.turns_by_bias(from_s, to_s)
        of_sensor = log.turns_between(from_s, to_s) + by_bias @ bias
        predicted = of_sensor @ rotation.T
        residual = used.vectors - predicted
        lengths = np.linalg.norm(residual, axis=1)
        stddev = max(float(np.median(lengths)) / _MEDIAN_OF_CHI3, 1e-9)
        weights = np.repeat(CAUCHY.weights(lengths / (stddev * _MEDIAN_OF_CHI3)), 3)
        slopes = np.zeros((len(used), 3, 7))
        slopes[:, :, 0] = _by_offset(log, from_s, to_s) @ rotation.T
        slopes[:, :, 1:4] = -cross_matrices(predicted)
        slopes[:, :, 4:] = rotation @ by_bias
        columns = slopes.reshape(-1, 7)
        normal = columns.T @ (weights[:, None] * columns)
        normal[~is_free], normal[:, ~is_free] = 0.0, 0.0
        normal[~is_free, ~is_free] = 1.0
        gradient = np.where(is_free, columns.T @ (weights * residual.ravel()), 0.0)
        # What the turns do not determine stays where it is.
        inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
        step = inverse @ gradient
        covariance = _covariance(normal, stddev, is_free)
        longest = max(1.0, abs(step[0]) / (0.5 * SEPARATION_S), float(np.linalg.norm(step[1:4])))
        step /= longest
        offset_s, bias = offset_s + step[0], bias + step[4:]
        rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ rotation
        if abs(step[0]) < 1e-6 and np.linalg.norm(step[1:4]) < 1e-7:
            break
    return replace(
        start,
        turns=used,
        time_offset_s=float(offset_s),
        cam_from_imu=rotation,
        gyro_bias_rad_s=bias,
        residual_rad=stddev,
        covariance=covariance,
    )


def _covariance(normal: Array, stddev: float, is_free: Mask) -> Array:
    """Return the covariance (7, 7); what is not determined has a large one, and what is held none."""
    values, vectors = np.linalg.eigh(normal)
    covariance = stddev**2 * (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T
    covariance[~is_free], covariance[:, ~is_free] = 0.0, 0.0
    return np.asarray(covariance)


def _by_offset(log: ImuLog, from_s: Array, to_s: Array) -> Array:
    """Return the change (n, 3) of the turns by the offset, by central differences over a photo's exposure."""
    half_s = 0.005
    low, high = (log.turns_between(from_s - later, to_s - later) for later in (-half_s, half_s))
    return np.asarray((high - low) / (2 * half_s))


def _wrong_rotation(fit: ImuAlignment, given: Array | None) -> Iterator[str]:
    if given is None or not fit.rotation_covariance.any():
        return
    log = fit.log
    turn = Rotation.from_matrix(given @ fit.cam_from_imu.T).as_rotvec()
    squared = turn @ np.linalg.solve(fit.rotation_covariance, turn)
    if squared > _FAR_OFF_SQUARED_3 and np.linalg.norm(turn) > _MOUNTED:
        inverse = np.linalg.norm(Rotation.from_matrix(given.T @ fit.cam_from_imu.T).as_rotvec()) < _MOUNTED
        why = "it is the rotation from camera to sensor: give its inverse" if inverse else "leave it out"
        away = np.degrees(np.linalg.norm(turn))
        yield (
            f"{log.name}: the given rotation_imu_to_cam_xyzw is {away:.1f} deg from the one "
            f"that the turns of the photos show, which is taken; {why}"
        )


def _wrong_offset(fit: ImuAlignment, given_s: float | None) -> Iterator[str]:
    if given_s is None:
        return
    log = fit.log
    # Nobody knows an offset better than to a sample of the log.
    stddev_s, other_s = float(np.sqrt(fit.covariance[0, 0])), max(log.step_s, fit.turns.resolution_s)
    if abs(given_s - fit.time_offset_s) > _FAR_OFF_1 * stddev_s + other_s:
        sign = "; it has the other sign" if abs(given_s + fit.time_offset_s) < _FAR_OFF_1 * stddev_s + other_s else ""
        yield (
            f"{log.name}: the given time_offset of {given_s:+.3f} s is not the one that the turns of the photos show, "
            f"{fit.time_offset_s:+.3f} +- {1.96 * stddev_s:.3f} s (95 %), which is taken{sign}"
        )


def _require_fixed(fit: ImuAlignment, turns: _PhotoTurns) -> None:
    """Raise GeometryError if the sensor sits otherwise in the second half of the photos than in the first."""
    log, is_first = fit.log, np.arange(len(turns)) < len(turns) // 2
    halves = [_refined(turns.take(part), fit) for part in (is_first, ~is_first)]
    found = [half for half in halves if half is not None and half.is_determined]
    if len(found) < 2:
        return
    turn = Rotation.from_matrix(found[1].cam_from_imu @ found[0].cam_from_imu.T).as_rotvec()
    covariance = sum(half.rotation_covariance for half in found)
    angle = float(np.linalg.norm(turn))
    if angle > _SLIPPED and turn @ np.linalg.solve(covariance, turn) > _FAR_OFF_SQUARED_3:
        raise GeometryError(
            f"{log.name}: the sensor sits {np.degrees(angle):.0f} deg otherwise in the second half of the photos than "
            "in the first: expected one that is fixed to the camera; leave out the part before or after it slipped"
        )


def _require_same_axes(fit: ImuAlignment, path: Trajectory) -> None:
    """Raise GeometryError if gravity does not stay where it is, or only with other axes of the accelerometer."""
    log, means = fit.log, _turned_means(fit, path)
    others = [np.eye(3)[list(order)] * np.array(signs)[:, None] for order in permutations(range(3)) for signs in _SIGNS]
    # All signs reversed does not move gravity either: of both, the right-handed axes.
    scatters = [_scatter(means, other * np.linalg.det(other)) for other in others]
    scatter, least = _scatter(means, np.eye(3)), min(scatters)
    is_likelier = 1.5 * len(means) * np.log((scatter / least) ** 2) > _LIKELIER
    if scatter > _SENSORS_ERR and least < scatter / _CLEARLY and is_likelier:
        best = others[scatters.index(least)]
        names = ", ".join(_name_of_axis(row) for row in best.T * np.linalg.det(best))
        raise GeometryError(
            f"{log.name}: gravity moves as the camera turns, and stays where it is if x, y, z of the accelerometer are "
            f"{names} of the gyroscope (or all with the other sign): expected the same axes for both"
        )
    if scatter > _MOVED:
        raise GeometryError(
            f"{log.name}: the acceleration, turned by the photos, scatters by {scatter:.0%} of its length: expected "
            "that of an accelerometer with gravity in it, fixed to the camera"
        )


_SIGNS = [signs for signs in product((1.0, -1.0), repeat=3) if signs[0] > 0]


def _name_of_axis(row: Array) -> str:
    k = int(np.argmax(np.abs(row)))
    return f"{'-' if row[k] < 0 else ''}{'xyz'[k]}"


def _turned_means(fit: ImuAlignment, path: Trajectory) -> Array:
    """Return for each turn the matrix (n, 3, 9) that gives the mean acceleration in the photos' world by axes.

    The acceleration with other axes M (3, 3) is M f; its mean is linear in M.
    """
    log, times_s, turns = fit.log, fit.log.timestamp_s, fit.turns
    starts = np.searchsorted(times_s, turns.from_s - fit.time_offset_s)
    ends = np.searchsorted(times_s, turns.to_s - fit.time_offset_s)
    orientation = log.orientation(times_s).as_matrix()
    products = np.einsum("kij,kl->kijl", orientation, log.accel_m_s2).reshape(len(times_s), -1)
    summed = np.concatenate([np.zeros((1, 27)), np.cumsum(products, axis=0)])
    means = (summed[ends] - summed[starts]) / np.maximum(ends - starts, 1)[:, None]
    at_photo = log.orientation(turns.from_s - fit.time_offset_s).as_matrix()
    world_from_first = path.world_from_cam[turns.first] @ fit.cam_from_imu @ np.swapaxes(at_photo, 1, 2)
    return np.asarray((world_from_first @ means.reshape(-1, 3, 9))[ends > starts])


def _scatter(means: Array, axes: Array) -> float:
    """Return how far the mean accelerations are from their median, as a share of its length."""
    turned = means @ axes.ravel()
    middle = np.median(turned, axis=0)
    away = np.median(np.linalg.norm(turned - middle, axis=1))
    return float(away / max(rms(turned.ravel()) * np.sqrt(3), 1e-300))
