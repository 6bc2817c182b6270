"""How wrong the scale may be: formal, by resampling, and by what the range model leaves out.

All resamplings are single Newton steps from the estimate, which is exact to first order and costs
one small solve each.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.ranging.errors.noise import inflation_before_fit
from rangesfm.ranging.errors.shared_errors import antenna_modes, curve_modes
from rangesfm.scale.estimate import ScaleUncertainty
from rangesfm.scale.range_equation import RangeFit, RangeProblem, predicted_ranges, range_gradient
from rangesfm.scale.solution import Solution

# Where most ranges are outliers, so that the curvature says nothing.
_MIN_CURVATURE = 0.3


def scale_uncertainty(solution: Solution, curve_stddev_m: Array, *, num_bootstrap: int, seed: int) -> ScaleUncertainty:
    """Relative stddevs of the scale.

    Args:
        curve_stddev_m: (n,) what ranges of about this length may be off together.
    """
    problem, fit, blocks = solution.problem, solution.fit, solution.errors.block
    anchor_blocks = problem.anchor_index
    present = np.unique(anchor_blocks)
    correlated, correlated_dof = _correlated(solution)
    return ScaleUncertainty(
        formal=fit.log_scale_stddev,
        bootstrap=_bootstrap(fit, blocks, num_bootstrap, seed),
        jackknife=_jackknife(fit, anchor_blocks) if len(present) >= 3 else None,
        range_model=_range_model_stddev(problem, fit, curve_stddev_m),
        correlated=correlated,
        num_blocks=len(np.unique(blocks)),
        num_anchors=len(present),
        antennas=_antennas_stddev(problem, fit),
        correlated_dof=correlated_dof,
    )


def _correlated(solution: Solution) -> tuple[float, float]:
    """Formal, widened by errors that go together, and the degrees of freedom that show how much they do."""
    fit, num_groups = solution.fit, len(np.unique(solution.errors.group))
    from_ranges = fit.information - fit.prior_information
    num_fitted = float(np.trace(np.linalg.lstsq(fit.information, from_ranges, rcond=1e-12)[0]))
    stddev = fit.log_scale_stddev * inflation_before_fit(solution.errors.inflation, num_groups, num_fitted)
    return stddev, num_groups - num_fitted


def scale_influence(fit: RangeFit, problem: RangeProblem) -> Array:
    """(n,) relative change of the scale for each metre by which a range is longer."""
    to_scale = np.linalg.lstsq(fit.information, np.eye(len(fit.information))[0], rcond=1e-12)[0]
    influence: Array = fit.gradients @ to_scale / problem.stddev_m
    return influence


def _block_sums(fit: RangeFit, blocks: npt.NDArray[np.int64]) -> tuple[Array, Array]:
    """(b, p, p) information and (b, p) gradient of each block; priors left out."""
    labels, index = np.unique(blocks, return_inverse=True)
    informations, gradients = [], []
    curvature = _relative_curvature(fit)
    root_weights = np.sqrt(fit.pulls)[:, None]
    # gradients = weight * jacobian, so dividing by the root leaves what squares to the information.
    rows = fit.gradients / np.maximum(root_weights, 1e-12)
    for block in range(len(labels)):
        inside = index == block
        informations.append(curvature * rows[inside].T @ rows[inside])
        gradients.append(fit.gradients[inside].T @ fit.scaled_residuals[inside])
    return np.array(informations), np.array(gradients)


def _relative_curvature(fit: RangeFit) -> float:
    """Mean second derivative of the loss over the mean weight: 0.8 for Gaussian errors and a Cauchy loss.

    The second derivative is less than the weight, and with the weight in its place the steps would be too short. The
    mean keeps all informations positive.
    """
    return max(float(np.mean(fit.curvatures) / np.mean(fit.pulls)), _MIN_CURVATURE)


def _steps(fit: RangeFit, informations: Array, gradients: Array, counts: Array) -> Array:
    """Change of the log scale for each row of ``counts`` (k, b): how often each block is taken."""
    steps = np.empty(len(counts))
    for i, count in enumerate(counts):
        information = np.tensordot(count, informations, axes=1) + fit.prior_information
        gradient = count @ gradients + fit.prior_gradient
        steps[i] = -np.linalg.lstsq(information, gradient, rcond=1e-12)[0][0]
    return steps


def resampled_log_scales(fit: RangeFit, blocks: npt.NDArray[np.int64], *, num: int, seed: int) -> Array:
    """(num,) changes of the log scale when blocks of time are drawn anew; none from a single block."""
    informations, gradients = _block_sums(fit, blocks)
    num_blocks = len(informations)
    if num_blocks < 2:
        return np.zeros(0)
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(num_blocks, np.full(num_blocks, 1 / num_blocks), size=num).astype(np.float64)
    return _steps(fit, informations, gradients, counts)


def _bootstrap(fit: RangeFit, blocks: npt.NDArray[np.int64], num: int, seed: int) -> float:
    steps, num_blocks = resampled_log_scales(fit, blocks, num=num, seed=seed), len(np.unique(blocks))
    if len(steps) < 2:
        return fit.log_scale_stddev
    # Quartiles, so that a resample that happens to leave out a whole side does not decide alone.
    low, high = np.quantile(steps, [0.16, 0.84])
    # Blocks drawn from a few scatter less than blocks drawn anew.
    return float(max(high - low, 0.0) / 2 * np.sqrt(num_blocks / (num_blocks - 1)))


def _jackknife(fit: RangeFit, anchor_blocks: npt.NDArray[np.int64]) -> float:
    informations, gradients = _block_sums(fit, anchor_blocks)
    num = len(informations)
    steps = _steps(fit, informations, gradients, 1.0 - np.eye(num))
    return float(np.sqrt((num - 1) / num * np.sum((steps - steps.mean()) ** 2)))


def _range_model_stddev(problem: RangeProblem, fit: RangeFit, curve_stddev_m: Array) -> float:
    """What an error curve with this stddev, smooth in the logarithm of distance, does to the scale."""
    modes = curve_modes(predicted_ranges(problem, fit.state), curve_stddev_m)
    return float(np.linalg.norm(scale_influence(fit, problem) @ modes))


def _antennas_stddev(problem: RangeProblem, fit: RangeFit) -> float:
    """What antennas do to the scale, each anchor's for itself."""
    modes, influence = antenna_modes(range_gradient(problem, fit.state).by_tag), scale_influence(fit, problem)
    of_anchors = [(problem.anchor_index == k) * influence @ modes for k in range(problem.num_anchors)]
    return float(np.linalg.norm(of_anchors))
