"""Which errors of ranges on a map are random: white and lasting, of antennas, a bent map, the radio's curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.errors.components import alike_by_direction, alike_by_distance
from rangesfm.trust.hypothesis import Effect, Hypothesis
from rangesfm.trust.linearized import Linearized
from rangesfm.trust.random_errors import Component, RandomErrors, learn

# Errors of radios stay alike for seconds (by 0.4 to 0.6 after one second on real logs).
_MEMORY_S = 3.0
# Of a radio's error curve over distance (Decawave application note APS011), and of anchors' antennas over directions
# (Pelka, Cimdins and Hellbrück, 2018).
_ANTENNA_STDDEV_M, _CURVE_STDDEV_M = 0.05, 0.07
_LASTING_STDDEV_M, _BEND_STDDEV_M = 0.04, 0.02
# Of a path's duration: a map bends over no shorter part.
_BEND_SHARE = 1 / 8
# What ranges drift by in a minute, each anchor's and all alike, as hands and bodies move and radios warm up.
_WANDERING_STDDEV_M, _WANDERING_MEMORY_S = 0.025, 60.0


def learnt_noise(problem: Linearized, explaining: Sequence[Hypothesis]) -> RandomErrors:
    """What is left random when some mistakes explain what they can."""
    all_of_it = Effect.of_all([Effect(problem.design, problem.prior_design), *(h.effect for h in explaining)])
    return learn(
        _components(problem),
        _known(problem),
        problem.residual_m,
        all_of_it.columns,
        problem.prior_residual,
        all_of_it.priors,
        problem.noise,
    )


def usual_noise(problem: Linearized) -> RandomErrors:
    """As radios and maps usually have it."""
    components = _components(problem)
    covariance = _known(problem) + sum(c.stddev_m**2 * c.unit_covariance for c in components)
    return RandomErrors(covariance, {c.name: c.stddev_m for c in components}, np.inf)


def _components(problem: Linearized) -> list[Component]:
    apart = np.abs(problem.time_s[:, None] - problem.time_s)
    same_anchor = problem.anchor_index[:, None] == problem.anchor_index
    directions = problem.gradient.by_tag
    duration = max(float(np.ptp(problem.time_s)), 1e-6)
    bend = np.exp(-0.5 * (apart / (_BEND_SHARE * duration)) ** 2)
    return [
        Component("white", np.diag(1 / problem.cells.num_ranges), problem.cells.scatter_m, 0.3),
        Component("lasting", same_anchor * np.exp(-apart / _MEMORY_S), _LASTING_STDDEV_M, 0.7),
        Component("antennas", same_anchor * alike_by_direction(directions), _ANTENNA_STDDEV_M, 0.5),
        Component("bend", (directions @ directions.T) * bend, _BEND_STDDEV_M, 1.0),
    ]


def _known(problem: Linearized) -> Array:
    """(c, c) of an error curve that nobody learnt, and of what wanders too slowly to be learnt."""
    curve = _CURVE_STDDEV_M**2 * alike_by_distance(problem.gradient.distance_m)
    apart = np.abs(problem.time_s[:, None] - problem.time_s)
    same_anchor = problem.anchor_index[:, None] == problem.anchor_index
    wandering = _WANDERING_STDDEV_M**2 * (1.0 + same_anchor) * np.exp(-apart / _WANDERING_MEMORY_S)
    return np.asarray(curve + wandering)
