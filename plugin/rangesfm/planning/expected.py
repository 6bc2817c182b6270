"""What a run of a planned survey will state, before a range is measured: its own formulas, at the true map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.geometry.trajectory import in_first_camera
from rangesfm.options import ScaleOptions
from rangesfm.planning.photos import PlannedMap
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.errors.bending import WalkBending
from rangesfm.ranging.errors.cells import MAX_NUM_CELLS
from rangesfm.ranging.errors.components import BENDS
from rangesfm.ranging.errors.learned import LearnedErrors, usual_stddevs
from rangesfm.ranging.errors.noise import START_STDDEV_M
from rangesfm.ranging.errors.place import shares_of_places
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.observations import RangeObservations
from rangesfm.scale.anchor_plane import mirrored_map
from rangesfm.scale.estimate import ScaleUncertainty
from rangesfm.scale.initialize import model_from_cam, placement_covariance
from rangesfm.scale.lengths import BENDING
from rangesfm.scale.problem import ScaleProblem
from rangesfm.scale.range_equation import RangeFit, RangeState, fit_at, range_jacobian, tag_positions
from rangesfm.scale.solution import Solution, refuse_ambiguity, weighted
from rangesfm.scale.uncertainty import (
    errors_to_expect,
    expected_scale_uncertainty,
    parameter_covariance,
    parameter_influence,
)
from rangesfm.scale.verdict import Verdict, judge
from rangesfm.trust.finished_map import by_similarity

_NUM_NOISE_ROUNDS = 2
_NUM_COMPARED_RANGES, _NUM_COMPARED_CELLS = 600, 120
# Of the largest information: less is none.
_ROUNDING = 1e-20
OPEN = 1e3
"""Metres, or radians: a number this uncertain is one that nothing determines."""


@dataclass(frozen=True)
class Expected:
    """The estimate that a run will make.

    Attributes:
        observations: simulated ranges. posed: the problem. solution: the fit, at the truth.
        learned: what the ranges will get wrong.
        uncertainty: of the scale.
        placement: (7, 7) as of a ScaleEstimate; None without a place in the site.
        by_ranges: (7, 7) the same by the ranges alone, whatever the map bends; of the scale where the frame is the
            first camera's.
        bends_m: (n,) what the map's bend adds to the stddev of each keyframe; 0 of a map that is rigid.
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
        """As the run will judge.

        Raises:
            GeometryError: it will refuse the scale.
        """
        return judge(self.posed, self.solution, self.uncertainty, {}, (), (), ScaleOptions())

    def mirror_image(self) -> str | None:
        """Why the run will leave the place open: the mirror image in the anchors' plane fits as well; None if not."""
        problem, fit = self.solution.problem, self.solution.fit
        mirrored = mirrored_map(problem, fit.state) if problem.frame_is_free else None
        if mirrored is None:
            return None
        counted = replace(problem, share=fit.pulls)
        try:
            # Of a path in that plane nothing determines the height, which the solver meets as 0 / 0.
            with np.errstate(invalid="ignore", divide="ignore"):
                refuse_ambiguity(replace(self.solution, problem=counted), [mirrored], None)
        except GeometryError as error:
            return str(error)
        return None

    @property
    def map_stddevs(self) -> Array | None:
        """(7,) of the map about its middle; inf where they are open, None without a place."""
        if self.placement is None:
            return None
        return _stddevs(np.diag(by_similarity(self.placement, self.planned.trajectory.centers)[0]))

    @property
    def keyframe_stddevs_m(self) -> Array:
        """(n,) of each keyframe's place, as ``stddevs_at``, with the map's bend."""
        return np.hypot(self.stddevs_at(self.planned.trajectory.centers), self.bends_m)

    def stddevs_at(self, places_m: Array) -> Array:
        """(n,) of (n, 3) places in the map as a whole, in the result's frame: all coordinates together; inf where open.

        Without a place in the site they are as far off as the scale makes them, seen from the first camera.
        """
        motions = similarity_motions(places_m - self.planned.trajectory.centers[0])
        return _stddevs(np.einsum("nij,jk,nik->n", motions, self.by_ranges, motions))

    @property
    def worst_keyframe_m(self) -> float:
        """Stddev of the place that is known least; NaN without a place."""
        return float("nan") if self.placement is None else float(self.keyframe_stddevs_m.max())


def _stddevs(variances: Array) -> Array:
    stddevs = np.sqrt(np.maximum(variances, 0.0))
    return np.where(stddevs < OPEN, stddevs, np.inf)


def compare(planned: PlannedSurvey) -> Expected | None:
    """``expect`` in a tenth of the time, good to tell plans apart, of a rigid map; None where a run will find too few
    ranges."""
    try:
        return expect(replace(planned, photos=None, max_num_ranges=_NUM_COMPARED_RANGES), _NUM_COMPARED_CELLS)
    except GeometryError:
        return None


def expect(planned: PlannedSurvey, max_num_cells: int = MAX_NUM_CELLS) -> Expected:
    """Find the noise that the run will see, and with its weights what it will state.

    Args:
        max_num_cells: in which how ranges err together is computed, as a run has it or coarser.

    Raises:
        GeometryError: the run will find too few ranges on the path.
    """
    path, observations = planned.trajectory, planned.observations()
    posed = planned.posed(observations)
    state = planned.state(posed, observations.log.anchor_ids)
    tags, scale = tag_positions(posed.ranges, state.metric_from_model), state.metric_from_model.scale
    errors = posed.errors.at(tags, posed.placing_stddev_m(scale))
    solution = _at_the_truth(posed, errors, state, planned.num_alike)
    rotations, made = model_from_cam(observations, path, posed), None
    stddevs = usual_stddevs(is_calibrated=planned.curve_stddev_m is not None) | dict(planned.component_stddevs)
    if planned.photos is not None:
        made = PlannedMap(path, planned.photos.information(path), posed, observations, planned.tag_in_cam_m)
        stddevs |= {**dict.fromkeys(BENDS, 0.0), "bending": made.bend_m(solution)}
    bending = WalkBending(in_first_camera(path))
    learned = errors_to_expect(posed, solution, observations, rotations, stddevs, max_num_cells, bending)
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
    """Of ranges that stand for several each."""
    problem = weighted(posed.ranges, errors)
    weights = np.full(len(posed.rows), float(num_alike))
    return Solution(problem, fit_at(problem, state, weights), errors, errors.noise_m)


def _undetermined(fit: RangeFit) -> Array:
    """(p, p) variances without limit in the directions that nothing determines, which least squares leave alone."""
    of_each = np.diag(fit.information)
    sizes = np.sqrt(np.maximum(of_each, _ROUNDING * of_each.max()))
    values, vectors = np.linalg.eigh(fit.information / np.outer(sizes, sizes))
    nothing = vectors[:, values < 1e-10] / sizes[:, None]
    lengths = np.linalg.norm(nothing, axis=0)
    nothing = nothing / np.where(lengths > 0, lengths, 1.0)
    return np.asarray(OPEN**4 * nothing @ nothing.T)


def _as_seen(solution: Solution, learned: LearnedErrors) -> RangeErrors:
    """As ``RangeErrors.seen_by_rigid_map`` and ``inflated`` will find it, in the mean over all surveys like this one.

    Of the cells' covariance the fit takes its part; what single ranges scatter by about their cell comes on top.
    """
    errors, problem, cells = solution.errors, solution.problem, learned.cells
    ones = replace(problem, stddev_m=np.ones_like(problem.stddev_m))
    design = cells.mean(range_jacobian(ones, solution.fit.columns[0], solution.fit.state, solution.fit.state))
    left = np.eye(len(cells)) - design @ parameter_influence(solution.fit, problem, learned)
    residuals_m2 = left @ learned.covariance_m2 @ left.T
    white_m2 = np.diag(learned.covariances_m2[learned.names.index("white")]) * cells.worth  # (c,) of single ranges
    together_m2 = np.maximum(np.diag(residuals_m2), 1e-12)
    alone_m2 = white_m2 * (1 - 1 / np.maximum(cells.worth, 1.0))
    ordinary = np.hypot(errors.shared_m, errors.placing_m) < START_STDDEV_M
    rows = learned.of_range[ordinary] if ordinary.any() else learned.of_range
    noise_m2 = float(np.mean((together_m2 + alone_m2)[rows]))
    alike = 1 - min(float(np.mean((white_m2 * np.ones(len(cells)))[rows])) / noise_m2, 1.0)
    num_alike = int(solution.fit.weights[0])
    share = shares_of_places(np.repeat(errors.place, num_alike), alike)[::num_alike]
    base = np.where(errors.is_estimated, np.sqrt(noise_m2), errors.given_m)
    stddev_m = np.sqrt(base**2 + errors.placing_m**2 + errors.shared_m**2)
    weights = cells.total(num_alike * share / stddev_m)
    group = np.zeros(len(cells), dtype=np.int64)
    group[learned.of_range] = errors.group
    same = group[:, None] == group
    in_groups = float(np.sum(np.outer(weights, weights) * residuals_m2 * same))
    apart = float(np.sum(cells.total(num_alike * share / stddev_m**2) * (together_m2 + alone_m2)))
    inflation = max(float(np.sqrt(in_groups / apart)), 1.0)
    return replace(errors, stddev_m=stddev_m, share=share, inflation=inflation, noise_m=float(np.sqrt(noise_m2)))
