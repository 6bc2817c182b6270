"""What is random in the cells of a survey, learnt from what is left when every mistake may explain what it can."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from rangesfm.arrays import Array

_NUM_ROUNDS = 8
# Of the logarithm of a variance: what changes less has been found.
_SETTLED = 0.05
_MAX_STEP = 1.5
_RIDGE = 1e-10


@dataclass(frozen=True)
class Component:
    """One part of the covariance, of which only the size is to be found.

    Attributes:
        name: for people.
        unit_covariance: (c, c) of stddev 1 m.
        stddev_m: as expected beforehand. log_stddev: of its logarithm, how sure that is.
    """

    name: str
    unit_covariance: Array
    stddev_m: float
    log_stddev: float


@dataclass(frozen=True)
class RandomErrors:
    """What is random, and how well all fits with it.

    Attributes:
        covariance_m2: (c, c) of all.
        stddev_m: of each component, by name.
        deviance: -2 times the logarithm of the likelihood, up to a constant: two explanations of the same cells, each
            with the noise that it leaves, are compared by it.
    """

    covariance_m2: Array
    stddev_m: dict[str, float]
    deviance: float


def learn(
    components: list[Component],
    known_m2: Array,
    residual: Array,
    design: Array,
    prior_residual: Array,
    prior: Array,
    start: RandomErrors | None = None,
) -> RandomErrors:
    """The sizes of the components by restricted maximum likelihood and their priors (Fisher scoring).

    Args:
        known_m2: (c, c) what is assumed as it is.
        residual, design: (c,), (c, q) of the cells, with a column for whatever is not random.
        start: sizes to begin with.
        prior_residual, prior: (r,), (r, q) of what is known of the q parameters beforehand, in stddevs.
    """
    expected = np.log([component.stddev_m**2 for component in components])
    precision = np.array([(2 * component.log_stddev) ** -2.0 for component in components])
    design, prior = _scaled(design, prior)
    log_variance = expected.copy()
    if start is not None:
        log_variance = np.log([start.stddev_m[component.name] ** 2 for component in components])
    for _ in range(_NUM_ROUNDS):
        parts = [np.exp(v) * c.unit_covariance for v, c in zip(log_variance, components, strict=True)]
        inverse = _inverse(np.linalg.cholesky(known_m2 + sum(parts)))
        weighed = inverse @ design
        normal = _normal(design, weighed, prior)
        off = inverse @ residual - weighed @ cho_solve(normal, weighed.T @ residual + prior.T @ prior_residual)
        projector = inverse - weighed @ cho_solve(normal, weighed.T)
        products = [projector @ part for part in parts]
        gradient = np.array(
            [0.5 * (off @ part @ off - np.trace(product)) for part, product in zip(parts, products, strict=True)]
        )
        gradient -= precision * (log_variance - expected)
        fisher = 0.5 * np.array([[np.sum(a * b.T) for b in products] for a in products]) + np.diag(precision)
        step = np.clip(np.linalg.solve(fisher, gradient), -_MAX_STEP, _MAX_STEP)
        log_variance = log_variance + step
        if np.abs(step).max() < _SETTLED:
            break
    parts = [np.exp(v) * c.unit_covariance for v, c in zip(log_variance, components, strict=True)]
    covariance = known_m2 + sum(parts)
    unlikeliness = float(precision @ (log_variance - expected) ** 2)
    return RandomErrors(
        covariance,
        {c.name: float(np.exp(0.5 * v)) for v, c in zip(log_variance, components, strict=True)},
        unlikeliness + _deviance(covariance, residual, design, prior_residual, prior),
    )


def _deviance(covariance_m2: Array, residual: Array, design: Array, prior_residual: Array, prior: Array) -> float:
    factor = np.asarray(np.linalg.cholesky(covariance_m2), dtype=np.float64)
    inverse = _inverse(factor)
    weighed = inverse @ design
    right = weighed.T @ residual + prior.T @ prior_residual
    squares = residual @ inverse @ residual + prior_residual @ prior_residual
    squares -= right @ cho_solve(_normal(design, weighed, prior), right)
    return float(squares + 2 * np.sum(np.log(np.diag(factor))))


def _inverse(factor: Array) -> Array:
    inverse = solve_triangular(factor, np.eye(len(factor)), lower=True)
    squared: Array = inverse.T @ inverse
    return squared


def _normal(design: Array, weighed: Array, prior: Array) -> tuple[Array, bool]:
    """Of columns of length 1, a little more than it is, for those that say the same."""
    normal = design.T @ weighed + prior.T @ prior
    factor: tuple[Array, bool] = cho_factor(
        normal + _RIDGE * np.max(np.diag(normal), initial=1.0) * np.eye(len(normal))
    )
    return factor


def _scaled(design: Array, prior: Array) -> tuple[Array, Array]:
    """With columns of length 1."""
    sizes = np.maximum(np.linalg.norm(np.vstack([design, prior]), axis=0), 1e-12)
    return design / sizes, prior / sizes
