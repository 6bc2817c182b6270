"""Expected result of a planned survey: the uncertainty that a run will state, by the run's formulas at the true map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.diagnostics.finished_map import by_similarity
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.geometry.trajectory import in_first_camera
from rangesfm.options import ScaleOptions
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_photos import PlannedMap
from rangesfm.ranging.errors.bending import WalkBending
from rangesfm.ranging.errors.components import BENDS
from rangesfm.ranging.errors.learned import LearnedErrors, usual_stddevs
from rangesfm.ranging.errors.noise import START_STDDEV_M
from rangesfm.ranging.errors.place import shares_of_places
from rangesfm.ranging.errors.range_bins import MAX_NUM_BINS
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.scale.anchor_plane import mirrored_map
from rangesfm.scale.initialize import model_from_cam, placement_covariance
from rangesfm.scale.range_equation import RangeFit, RangeState, antenna_positions, fit_at, range_jacobian
from rangesfm.scale.scale_by_lengths import BENDING
from rangesfm.scale.scale_estimate import ScaleUncertainty
from rangesfm.scale.scale_problem import ScaleProblem
from rangesfm.scale.scale_verdict import Verdict, judge
from rangesfm.scale.solution import Solution, refuse_ambiguity, weighted
from rangesfm.scale.uncertainty import (
    errors_to_expect,
    expected_scale_uncertainty,
    parameter_covariance,
    parameter_influence,
)

# Rounds in which the noise that the run will see and the weights of its ranges are made consistent.
_NUM_NOISE_ROUNDS = 2
# Numbers of ranges and of bins in the quick computation that compares plans.
_NUM_COMPARED_RANGES, _NUM_COMPARED_BINS = 600, 120
# A parameter's information below this fraction of the largest counts as this fraction.
_ROUNDING = 1e-20
OPEN = 1e3
"""Standard deviation, in metres or radians, from which on a number counts as not determined."""


@dataclass(frozen=True)
class Expected:
    """The estimate that a run will make.

    Attributes:
        planned: the planned survey.
        observations: simulated ranges without errors.
        posed: the scale problem.
        solution: its solution, at the true values.
        learned: error model of the ranges.
        uncertainty: uncertainty of the scale.
        placement: (7, 7) covariance of the map's placement like that of a ScaleEstimate; None if the map is not placed
            in the site.
        by_ranges: (7, 7) the same without the map's bending; of the scale alone if the frame is the first camera's.
        bends_m: (n,) part of each keyframe's standard deviation from the map's bending, metres; 0 for a rigid map.
    """

    planned: PlannedSurvey
    observations: RangeObservations
    posed: ScaleProblem
    solution: Solution
    learned: LearnedErrors
    uncertainty: ScaleUncertainty
    placement: Array | None
    by_ranges: Array
    bends_m: Array

    @property
    def verdict(self) -> Verdict:
        """Verdict of the run.

        Raises:
            GeometryError: the run will refuse the scale.
        """
        return judge(self.posed, self.solution, self.uncertainty, {}, (), (), ScaleOptions())

    def mirror_image(self) -> str | None:
        """Return why the run will leave the position open, or None if it will not.

        The position is open if the map's mirror image in the anchors' plane fits as well.
        """
        problem, fit = self.solution.problem, self.solution.fit
        mirrored = mirrored_map(problem, fit.state) if problem.frame_is_free else None
        if mirrored is None:
            return None
        counted = replace(problem, share=fit.pulls)
        try:
            # For a path in that plane the height is not determined, and the solver divides 0 by 0.
            with np.errstate(invalid="ignore", divide="ignore"):
                refuse_ambiguity(replace(self.solution, problem=counted), [mirrored], None)
        except GeometryError as error:
            return str(error)
        return None

    @property
    def map_stddevs(self) -> Array | None:
        """Standard deviations (7,) of the map's similarity about its mean; inf: not determined, None: not placed."""
        if self.placement is None:
            return None
        return _stddevs(np.diag(by_similarity(self.placement, self.planned.trajectory.centers)[0]))

    @property
    def keyframe_stddevs_m(self) -> Array:
        """Standard deviation of each keyframe's position (n,), metres, like ``stddevs_at``, with the map's bending."""
        return np.hypot(self.stddevs_at(self.planned.trajectory.centers), self.bends_m)

    def stddevs_at(self, places_m: Array) -> Array:
        """Return the standard deviations (n,) of points (n, 3) of a rigid map, metres; inf if not determined.

        Each is the root of the summed variances of the three coordinates in the result's frame. If the map is not
        placed in the site, only the scale contributes, with the first camera fixed.
        """
        motions = similarity_motions(places_m - self.planned.trajectory.centers[0])
        return _stddevs(np.einsum("nij,jk,nik->n", motions, self.by_ranges, motions))

    @property
    def worst_keyframe_m(self) -> float:
        """Standard deviation of the position of the least certain keyframe, metres; NaN if the map is not placed."""
        return float("nan") if self.placement is None else float(self.keyframe_stddevs_m.max())


def _stddevs(variances: Array) -> Array:
    stddevs = np.sqrt(np.maximum(variances, 0.0))
    return np.where(stddevs < OPEN, stddevs, np.inf)


def expect_roughly(planned: PlannedSurvey) -> Expected | None:
    """Compute ``expect`` for a rigid map with fewer ranges and bins, in a tenth of the time, to compare plans.

    None if a run will find too few ranges.
    """
    try:
        return expect(replace(planned, photos=None, max_num_ranges=_NUM_COMPARED_RANGES), _NUM_COMPARED_BINS)
    except GeometryError:
        return None


def expect(planned: PlannedSurvey, max_num_bins: int = MAX_NUM_BINS) -> Expected:
    """Compute the noise that the run will see, and with the resulting weights the uncertainty that it will state.

    Args:
        max_num_bins: largest number of bins in which common errors of ranges are computed; fewer are coarser.

    Raises:
        GeometryError: the run will find too few ranges on the path.
    """
    path, observations = planned.trajectory, planned.observations()
    posed = planned.posed(observations)
    state = planned.state(posed, observations.log.anchor_ids)
    tags, scale = antenna_positions(posed.ranges, state.metric_from_model), state.metric_from_model.scale
    errors = posed.errors.at(tags, posed.placing_stddev_m(scale))
    solution = _at_the_truth(posed, errors, state, planned.num_alike)
    rotations, made = model_from_cam(observations, path, posed), None
    stddevs = usual_stddevs(is_calibrated=planned.curve_stddev_m is not None) | dict(planned.component_stddevs)
    if planned.photos is not None:
        made = PlannedMap(path, planned.photos.information(path), posed, observations, planned.tag_in_cam_m)
        stddevs |= {**dict.fromkeys(BENDS, 0.0), "bending": made.bend_m(solution)}
    bending = WalkBending(in_first_camera(path))
    learned = errors_to_expect(posed, solution, observations, rotations, stddevs, max_num_bins, bending)
    for _ in range(_NUM_NOISE_ROUNDS):
        solution = _at_the_truth(posed, _as_seen(solution, learned), state, planned.num_alike)
    open_m2 = _undetermined(solution.fit)
    uncertainty = expected_scale_uncertainty(solution, learned, BENDING)
    placement = placement_covariance(solution, parameter_covariance(solution, learned) + open_m2)
    bends_m = np.zeros(len(path))
    others = learned if made is None else learned.without(*BENDS)
    by_ranges = placement_covariance(solution, parameter_covariance(solution, others) + open_m2)
    if by_ranges is None:
        scale_stddev = expected_scale_uncertainty(solution, others, BENDING).empirical
        by_ranges = np.diag([scale_stddev**2, *np.zeros(6)])
    if made is not None:
        straightened = replace(solution, errors=_as_seen(solution, others))
        bends_m = made.bends_m(straightened, others, planned.num_alike)
    return Expected(planned, observations, posed, solution, learned, uncertainty, placement, by_ranges, bends_m)


def _at_the_truth(posed: ScaleProblem, errors: RangeErrors, state: RangeState, num_alike: int) -> Solution:
    """Return the solution at the true state; each simulated range stands for ``num_alike`` ranges."""
    problem = weighted(posed.ranges, errors)
    weights = np.full(len(posed.rows), float(num_alike))
    return Solution(problem, fit_at(problem, state, weights), errors, errors.noise_m)


def _undetermined(fit: RangeFit) -> Array:
    """Return a covariance (p, p) with huge variances in the directions of parameters that the fit does not determine.

    Least squares leave these directions unchanged, so that their uncertainty would be missing.
    """
    of_each = np.diag(fit.information)
    sizes = np.sqrt(np.maximum(of_each, _ROUNDING * of_each.max()))
    values, vectors = np.linalg.eigh(fit.information / np.outer(sizes, sizes))
    nothing = vectors[:, values < 1e-10] / sizes[:, None]
    lengths = np.linalg.norm(nothing, axis=0)
    nothing = nothing / np.where(lengths > 0, lengths, 1.0)
    return np.asarray(OPEN**4 * nothing @ nothing.T)


def _as_seen(solution: Solution, learned: LearnedErrors) -> RangeErrors:
    """Return the range errors that ``RangeErrors.seen_by_rigid_map`` and ``inflated`` will find, on average.

    The residuals of a bin have the bins' covariance without the part that the fit absorbs. The scatter of single
    ranges about the mean of their bin is added.
    """
    errors, problem, bins = solution.errors, solution.problem, learned.bins
    ones = replace(problem, stddev_m=np.ones_like(problem.stddev_m))
    design = bins.mean(range_jacobian(ones, solution.fit.columns[0], solution.fit.state, solution.fit.state))
    left = np.eye(len(bins)) - design @ parameter_influence(solution.fit, problem, learned)
    residuals_m2 = left @ learned.covariance_m2 @ left.T
    white_m2 = np.diag(learned.covariances_m2[learned.names.index("white")]) * bins.worth  # (c,) of single ranges
    together_m2 = np.maximum(np.diag(residuals_m2), 1e-12)
    alone_m2 = white_m2 * (1 - 1 / np.maximum(bins.worth, 1.0))
    ordinary = np.hypot(errors.shared_m, errors.placing_m) < START_STDDEV_M
    rows = learned.of_range[ordinary] if ordinary.any() else learned.of_range
    noise_m2 = float(np.mean((together_m2 + alone_m2)[rows]))
    alike = 1 - min(float(np.mean((white_m2 * np.ones(len(bins)))[rows])) / noise_m2, 1.0)
    num_alike = int(solution.fit.weights[0])
    share = shares_of_places(np.repeat(errors.place, num_alike), alike)[::num_alike]
    base = np.where(errors.is_estimated, np.sqrt(noise_m2), errors.given_m)
    stddev_m = np.sqrt(base**2 + errors.placing_m**2 + errors.shared_m**2)
    weights = bins.total(num_alike * share / stddev_m)
    group = np.zeros(len(bins), dtype=np.int64)
    group[learned.of_range] = errors.group
    same = group[:, None] == group
    in_groups = float(np.sum(np.outer(weights, weights) * residuals_m2 * same))
    apart = float(np.sum(bins.total(num_alike * share / stddev_m**2) * (together_m2 + alone_m2)))
    inflation = max(float(np.sqrt(in_groups / apart)), 1.0)
    return replace(errors, stddev_m=stddev_m, share=share, inflation=inflation, noise_m=float(np.sqrt(noise_m2)))
