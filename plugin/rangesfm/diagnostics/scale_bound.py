"""Bound on the scale's error that holds with a small risk, even if one mistake was made and not found.

Aviation computes protection levels of satellite positions in this way. A mistake that moves its test by s standard
deviations is missed with the probability that a noncentral chi-square variable with noncentrality s^2 stays below the
threshold, and moves the scale in proportion to s. Noise of the scale and the tests are independent, because the tests
see only what the estimate leaves. So the risk of a bound is the largest product, over all sizes s, of the probabilities
to miss the mistake and to exceed the bound with it (R. G. Brown, "A baseline GPS RAIM scheme and a note on the
equivalence of three RAIM methods", Navigation 39, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special
from scipy.optimize import brentq

from rangesfm.arrays import Array
from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.measurements.mistakes import MistakeTest, noncentrality
from rangesfm.solver.posterior import ScaleUncertainty

RISK = 1e-4
"""Probability with which the scale may be off by more than the bound."""


def scale_bound(uncertainty: ScaleUncertainty, hidden: Sequence[MistakeTest]) -> tuple[float, str]:
    """Return the bound on the scale's error, in its logarithm, and what limits it; inf if a mistake has no limit.

    Args:
        uncertainty: of the scale.
        hidden: tests of mistakes of which one may have been made.
    """
    bounds = {"": _bound(uncertainty, np.zeros(1), np.ones(1))}
    for mistake in hidden:
        (changes, missed), words = _unnoticed(mistake), mistake_in_words(mistake.name, mistake.subject)
        # Only a mistake that exceeds the bound so far can raise it.
        if not np.isfinite(changes).all():
            return np.inf, words
        if np.max(missed * _beyond(uncertainty, changes, max(bounds.values()))) > RISK:
            bounds[words] = _bound(uncertainty, changes, missed)
    worst = max(bounds, key=bounds.__getitem__)
    return bounds[worst], worst


def _unnoticed(test: MistakeTest) -> tuple[Array, Array]:
    """Return possible changes of the scale's logarithm (k,), and the probabilities (k,) that the test misses them."""
    if not np.isfinite(test.effect_on_scale):  # no test sees it
        return np.array([test.most_unnoticed]), np.ones(1)
    # Change by a mistake that moves the test by one standard deviation.
    slope = test.effect_on_scale / float(np.sqrt(noncentrality(test.num)))
    # A mistake that moves the test farther beyond its threshold is missed with a smaller probability than the risk.
    farthest = np.sqrt(test.threshold) - special.ndtri(RISK)
    if slope > 0:
        farthest = min(farthest, test.most_unnoticed / slope)
    moves = np.linspace(0.0, farthest, 80)
    return slope * moves, np.asarray(special.chndtr(test.threshold, test.num, moves**2))


def _bound(uncertainty: ScaleUncertainty, changes: Array, missed: Array) -> float:
    farthest = float(np.max(changes)) + 10 * uncertainty.empirical
    return float(brentq(lambda bound: np.max(missed * _beyond(uncertainty, changes, bound)) - RISK, 0.0, farthest))


def _beyond(uncertainty: ScaleUncertainty, changes: Array, bound: float) -> Array:
    """Return the probabilities (k,) that the scale is off by more than a bound, given changes (k,) of its logarithm."""
    stddev = max(uncertainty.empirical, 1e-300)
    return np.asarray(special.ndtr((changes - bound) / stddev) + special.ndtr((-changes - bound) / stddev))
