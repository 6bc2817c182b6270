"""Motion between keyframes as a Gaussian process with white noise on acceleration, learnt from the keyframes.

Source: Anderson and Barfoot, "Full STEAM ahead: exactly sparse Gaussian process regression for batch continuous-time
trajectory estimation on SE(3)" (IROS 2015), with the prior "white noise on acceleration". For scalar coordinates its
posterior mean is the cubic smoothing spline (Wahba, 1978), in the banded form of Reinsch (1967).

The changes of velocity z at the keyframes have the covariance ``power * R + noise**2 * Q'Q``. R comes from the white
acceleration, and Q'Q from independent errors of the keyframes' positions. Both factors are learnt by maximum likelihood
of z, which is unchanged by adding a motion at constant velocity. Errors of keyframes can be told from motion only where
keyframes are close in time. Elsewhere the keyframes count as exact. The influence of a keyframe far out of place on the
power is bounded, so that it does not make all other keyframes' motion uncertain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded, solve_banded

from rangesfm.arrays import Array, Indices, Mask

# Within this time, in seconds, a camera hardly accelerates. Two keyframes that are closer in time give an upper bound
# on the keyframes' own errors.
_CLOSE_S = 0.25
# Ratios noise**2 / power that are tried besides 0, in units of the cubed median gap between keyframes. At the smallest
# the keyframes count as exact, at the largest the whole path is one motion at constant velocity.
_RATIOS = np.geomspace(1e-6, 1e9, 61)
# Changes of velocity are limited to this many standard deviations in the estimate of the power (Huber's proposal 2).
_MOST_STDDEVS = 3.0
_NUM_SCALE_ROUNDS = 60


@dataclass(frozen=True)
class MotionPrior:
    """Motion between n keyframes, as learnt from d coordinates of them.

    Attributes:
        times_s: (n,) times of the keyframes, strictly increasing.
        is_bridged: (n - 1,) gaps across which the motion is continuous; the other gaps split the path into parts.
        power: power of the white acceleration in each coordinate, unit^2 / s^3.
        noise_stddev: standard deviation of the error of a keyframe in each coordinate, in the coordinates' unit.
        bends: (n, d) posterior mean of the acceleration at the keyframes, unit / s^2; at the ends of each part 0, or
            continued from the next keyframe where the keyframes count as exact.
        bend_covariance: (3, n) main diagonal and next two diagonals of the covariance of the bends of one coordinate,
            divided by ``power``, for piecewise linear acceleration; 0 at the ends of each part.
    """

    times_s: Array
    is_bridged: Mask
    power: float
    noise_stddev: float
    bends: Array
    bend_covariance: Array

    def beyond_chord(self, before: Indices, fraction: Array) -> tuple[Array, Array]:
        """Return the offset of the motion from the straight line between two keyframes, with its uncertainty.

        Args:
            before: (m,) index of the keyframe before each time; the gap after it must be bridged.
            fraction: (m,) fraction of the gap that has passed.

        Returns:
            (m, d) offset to add to the straight line between the keyframes, and (m,) standard deviation of each
            coordinate of the sum, including the errors of the keyframes.
        """
        gap_s = self.times_s[before + 1] - self.times_s[before]
        early = gap_s**2 / 6 * ((1 - fraction) ** 3 - (1 - fraction))
        late = gap_s**2 / 6 * (fraction**3 - fraction)
        offsets = early[:, None] * self.bends[before] + late[:, None] * self.bends[before + 1]
        of_before, of_next = self.bend_covariance[0, before], self.bend_covariance[0, before + 1]
        told = early**2 * of_before + late**2 * of_next + 2 * early * late * self.bend_covariance[1, before]
        variance = self.power * np.maximum(gap_s**3 * (fraction * (1 - fraction)) ** 2 / 3 - told, 0.0)
        variance += self.noise_stddev**2 * ((1 - fraction) ** 2 + fraction**2)
        variance += 2 * self.noise_stddev**2 * self._bent_by_ends(before, fraction, early, late)
        return offsets, np.sqrt(np.maximum(variance, 0.0))

    def _bent_by_ends(self, before: Indices, fraction: Array, early: Array, late: Array) -> Array:
        """Return the covariance (m,) of the offset and the straight line's error, over ``noise_stddev**2``.

        Both depend on the errors of the two keyframes around each time.
        """
        second = _second_differences(self.times_s, self.is_bridged)
        # Covariances of the line's error with the second differences at the four keyframes from ``before - 1`` on.
        by_line = np.zeros((4, len(before)))
        for row, k in enumerate(range(-1, 3)):
            at = np.clip(before + k, 0, len(self.times_s) - 1)
            for end, share in ((0, 1 - fraction), (1, fraction)):
                step = end - k
                if -1 <= step <= 1:
                    by_line[row] += np.where(at == before + k, second[1 + step, at], 0.0) * share
        total = np.zeros(len(before))
        for end, size in ((0, early), (1, late)):
            for row, k in enumerate(range(-1, 3)):
                apart = abs(end - k)
                if apart <= 2:
                    first = np.clip(before + min(end, k), 0, len(self.times_s) - 1)
                    total += size * self.bend_covariance[apart, first] * by_line[row]
        return total


def learn_motion(times_s: Array, values: Array, is_bridged: Mask) -> MotionPrior:
    """Learn the power of the acceleration and the noise of the keyframes, and with them the motion.

    Args:
        times_s: (n,) times of the keyframes, strictly increasing.
        values: (n, d) coordinates of the keyframes.
        is_bridged: (n - 1,) gaps across which the motion is continuous.
    """
    second = _second_differences(times_s, is_bridged)
    is_inner = second[1] != 0
    differences = second[0][:, None] * np.roll(values, 1, axis=0) + second[1][:, None] * values
    differences += second[2][:, None] * np.roll(values, -1, axis=0)
    if not np.any(differences):
        nothing = np.zeros((3, len(times_s)))
        return MotionPrior(times_s, is_bridged, 0.0, 0.0, np.zeros(values.shape), nothing)
    by_motion, by_noise = _of_motion(times_s, is_inner), _of_noise(second)
    unit = float(np.median(np.diff(times_s))) ** 3
    most_noise = _most_noise(times_s, values, is_bridged)
    best = None
    for ratio in (0.0, *(unit * _RATIOS if most_noise > 0 else ())):
        fit = _fit(by_motion + ratio * by_noise, differences, is_inner)
        if fit is not None and ratio * fit[1] <= most_noise and (best is None or fit[0] < best[0]):
            best = (*fit, ratio)
    assert best is not None, "without noise the covariance of second differences is diagonally dominant"
    _, power, bends, factor, ratio = best
    if ratio == 0:
        bends = _going_on(by_motion, np.diff(times_s), is_bridged, differences, bends)
    covariance = np.where(is_inner, _inverse_near_diagonal(factor), 0.0)
    covariance[1] *= np.append(is_inner[1:], False)
    covariance[2] *= np.append(is_inner[2:], [False, False])
    return MotionPrior(times_s, is_bridged, power, float(np.sqrt(ratio * power)), bends, covariance)


def _second_differences(times_s: Array, is_bridged: Mask) -> Array:
    """Return the coefficients (3, n) of the previous, this and the next keyframe in each change of velocity.

    They are 0 at the ends of each part of the path.
    """
    rates = 1 / np.diff(times_s)
    to_last, to_next = np.append(0.0, rates), np.append(rates, 0.0)
    is_inner = np.append(False, is_bridged) & np.append(is_bridged, False)
    return np.where(is_inner, np.array([to_last, -(to_last + to_next), to_next]), 0.0)


def _of_motion(times_s: Array, is_inner: Mask) -> Array:
    """Return the main diagonal and the next two diagonals (3, n) of R; at the ends of each part the diagonal is 1."""
    gaps_s = np.diff(times_s)
    banded = np.zeros((3, len(times_s)))
    banded[0] = np.where(is_inner, (np.append(0.0, gaps_s) + np.append(gaps_s, 0.0)) / 3, 1.0)
    banded[1, :-1] = np.where(is_inner[:-1] & is_inner[1:], gaps_s / 6, 0.0)
    return banded


def _of_noise(second: Array) -> Array:
    """Return the main diagonal and the next two diagonals (3, n) of Q'Q."""
    before, at, after = second
    banded = np.zeros_like(second)
    banded[0] = np.sum(second**2, axis=0)
    banded[1, :-1] = at[:-1] * before[1:] + after[:-1] * at[1:]
    banded[2, :-2] = after[:-2] * before[2:]
    return banded


def _most_noise(times_s: Array, values: Array, is_bridged: Mask) -> float:
    """Return the largest error variance of a keyframe's coordinate that keyframes close in time allow, else 0.

    If all of the difference between two such keyframes is noise, its mean square is twice the variance. The result is
    the median of the squares, which is 0.45 to 1 times their mean.
    """
    is_close = is_bridged & (np.diff(times_s) <= _CLOSE_S)
    squares = np.mean(np.diff(values, axis=0)[is_close] ** 2, axis=1)
    return float(np.median(squares)) if is_close.any() else 0.0


def _fit(covariance: Array, differences: Array, is_inner: Mask) -> tuple[float, float, Array, Array] | None:
    """Fit the power by maximum likelihood, given the covariance of the second differences up to the power.

    Args:
        covariance: (3, n) main diagonal and next two diagonals of that covariance.
        differences: (n, d) second differences.

    Returns:
        -2 times the log-likelihood of each coordinate up to a constant, the power, the bends (n, d), and the banded
        Cholesky factor; None if rounding makes the covariance indefinite, or the power is 0.
    """
    try:
        factor = np.asarray(cholesky_banded(covariance, lower=True, check_finite=False), dtype=np.float64)
    except LinAlgError:
        return None
    bends = np.asarray(cho_solve_banded((factor, True), differences, check_finite=False), dtype=np.float64)
    whitened = solve_banded((2, 0), factor, differences, check_finite=False)[is_inner]
    power = _mean_square(np.mean(whitened**2, axis=1))
    if not power > 0:
        return None
    unlikeliness = 2 * float(np.sum(np.log(factor[0]))) + len(whitened) * float(np.log(power))
    return unlikeliness, power, bends, factor


def _going_on(by_motion: Array, gaps_s: Array, is_bridged: Mask, differences: Array, bends: Array) -> Array:
    """Return bends (n, d) that continue to the ends of each part of the path.

    With white noise the expected acceleration at an end is 0, although the camera may turn there as steadily as before.
    Here the acceleration at an end is a fraction of that at the neighbouring keyframe. The fraction is the regression
    coefficient of each bend on its neighbour in the same part, which is 0 or less if the acceleration is white.
    """
    is_inner = np.append(False, is_bridged) & np.append(is_bridged, False)
    both = is_inner[:-1] & is_inner[1:]
    part = np.append(0, np.cumsum(~is_bridged))[:-1]
    squares = np.bincount(part, both * np.sum(bends[:-1] ** 2 + bends[1:] ** 2, axis=1) / 2)
    products = np.bincount(part, both * np.sum(bends[:-1] * bends[1:], axis=1))
    share = np.clip(products / np.where(squares > 0, squares, 1.0), 0.0, 1.0)[part]
    is_first, is_last = both ^ is_inner[1:], both ^ is_inner[:-1]
    covariance = by_motion.copy()
    covariance[0, 1:] += np.where(is_first, share * gaps_s / 6, 0.0)
    covariance[0, :-1] += np.where(is_last, share * gaps_s / 6, 0.0)
    factor = cholesky_banded(covariance, lower=True, check_finite=False)
    bends = np.asarray(cho_solve_banded((factor, True), differences, check_finite=False), dtype=np.float64)
    ends = np.zeros_like(bends)
    ends[:-1] += np.where(is_first, share, 0.0)[:, None] * bends[1:]
    ends[1:] += np.where(is_last, share, 0.0)[:, None] * bends[:-1]
    return bends + ends


def _mean_square(squares: Array) -> float:
    """Return the mean of squares (m,), each limited to ``_MOST_STDDEVS**2`` times that mean."""
    mean = float(np.mean(squares))
    for _ in range(_NUM_SCALE_ROUNDS):
        before, mean = mean, float(np.mean(np.minimum(squares, _MOST_STDDEVS**2 * mean)))
        if mean > 0.999 * before:
            break
    return mean


def _inverse_near_diagonal(factor: Array) -> Array:
    """Return the main diagonal and the next two diagonals (3, n) of an inverse, from the banded Cholesky factor.

    Source: Takahashi et al. (1973).
    """
    diagonal = factor[0]
    one, two = (factor[1] / diagonal).tolist(), (factor[2] / diagonal).tolist()
    own = (1 / diagonal**2).tolist()
    num = len(own)
    inverse = [[0.0] * (num + 2) for _ in range(3)]
    on, next_to, beyond = inverse
    for j in range(num - 1, -1, -1):
        # The coefficients for rows below the matrix are 0.
        next_to[j] = -one[j] * on[j + 1] - two[j] * next_to[j + 1]
        beyond[j] = -one[j] * next_to[j + 1] - two[j] * on[j + 2]
        on[j] = own[j] - one[j] * next_to[j] - two[j] * beyond[j]
    return np.array(inverse)[:, :num]
