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
from rangesfm.solver.mistakes import RISK, HiddenMistake
from rangesfm.solver.posterior import ScaleUncertainty


def scale_bound(uncertainty: ScaleUncertainty, hidden: Sequence[HiddenMistake]) -> tuple[float, str]:
    """Return the bound on the scale's error, in its logarithm, and what limits it; inf if a mistake has no limit.

    Args:
        uncertainty: of the scale.
        hidden: mistakes of which one may have been made.
    """
    bounds = {"": _bound(uncertainty, np.zeros(1), np.ones(1))}
    for mistake in hidden:
        changes, missed = mistake.sizes
        # Only a mistake that exceeds the bound so far can raise it.
        if not np.isfinite(changes).all():
            return np.inf, mistake.words
        if np.max(missed * _beyond(uncertainty, changes, max(bounds.values()))) > RISK:
            bounds[mistake.words] = _bound(uncertainty, changes, missed)
    worst = max(bounds, key=bounds.__getitem__)
    return bounds[worst], worst


def _bound(uncertainty: ScaleUncertainty, changes: Array, missed: Array) -> float:
    farthest = float(np.max(changes)) + 10 * uncertainty.empirical
    return float(brentq(lambda bound: np.max(missed * _beyond(uncertainty, changes, bound)) - RISK, 0.0, farthest))


def _beyond(uncertainty: ScaleUncertainty, changes: Array, bound: float) -> Array:
    """Return the probabilities (k,) that the scale is off by more than a bound, given changes (k,) of its logarithm."""
    stddev = max(uncertainty.empirical, 1e-300)
    return np.asarray(special.ndtr((changes - bound) / stddev) + special.ndtr((-changes - bound) / stddev))
