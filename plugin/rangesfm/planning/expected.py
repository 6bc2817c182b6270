"""Expected result of a planned survey: the uncertainty that a run will state, from its linear problem at the true map.

Ranges, known positions and the bending that the photos allow are one linear Gaussian problem. The equations, the errors
and the rule for the interval are those with which a run judges its finished map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from rangesfm.arrays import Array, Indices
from rangesfm.diagnostics.finished_map import by_similarity
from rangesfm.diagnostics.linearized import ranges_on_map, slopes_by_poses
from rangesfm.distances.tape import CHECK
from rangesfm.errors import GeometryError
from rangesfm.estimation.free_fit import GraphBending
from rangesfm.estimation.vision_information import VisionInformation
from rangesfm.geometry.similarity import IDENTITY, similarity_motions
from rangesfm.geometry.trajectory import in_first_camera
from rangesfm.options import LENGTH_M, ScaleOptions
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.errors.bending import ErrorPart, MapBending, WalkBending, averaged
from rangesfm.ranging.errors.components import BENDS
from rangesfm.ranging.errors.learned import ErrorParts, LearnedErrors, usual_stddevs
from rangesfm.ranging.errors.range_bins import MAX_NUM_BINS
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.scale.anchor_plane import mirrored_map
from rangesfm.scale.linear_map import LinearMap, regular
from rangesfm.scale.placement_prior import PlacementPrior
from rangesfm.scale.range_equation import Columns, antenna_positions, fit_at
from rangesfm.scale.scale_by_positions import expected_positions, groups_by_pose, refuse_open_turn
from rangesfm.scale.scale_estimate import ScaleUncertainty
from rangesfm.scale.scale_problem import ScaleProblem
from rangesfm.scale.scale_verdict import Verdict, judge, judge_positions
from rangesfm.scale.solution import Solution, refuse_ambiguity, solution_from, weighted
from rangesfm.scale.uncertainty import KnownMap, bias_covariance, chance_differences, errors_to_expect, linear_map

# Numbers of ranges, of bins and of keyframes in the quick computation that compares plans.
_NUM_COMPARED_RANGES, _NUM_COMPARED_BINS, _NUM_COMPARED_KEYFRAMES = 600, 120, 15
# Number of keyframes for which the uncertainty is computed; it is interpolated between them.
_NUM_KEYFRAMES = 40
# Components of the errors that a simple estimate weights by: what differs from observation to observation.
_NOISE = ("white", "points", "marks", "positions")
OPEN = 1e3
"""Standard deviation, in metres or radians, from which on a number counts as not determined."""


@dataclass(frozen=True)
class RangesAtTruth:
    """Planned ranges without errors, on the true map.

    Attributes:
        posed: the scale problem. solution: its true state, with the weight of each range.
        learned: errors to expect of the radio.
        by_pose: (c, 6 n) derivatives of the bins by the poses.
    """

    posed: ScaleProblem
    solution: Solution
    learned: LearnedErrors
    by_pose: Array


@dataclass(frozen=True)
class Expected:
    """Uncertainty that a run will state.

    Attributes:
        planned: the planned survey.
        vision: information of its photos; None: the map bends as maps of poses do.
        ranges: its ranges; None without any.
        known: uncertainty of the map as a whole.
        errors: of the c bins of ranges and of the coordinates of known positions.
        keyframe_stddevs_m: (n,) roots of the summed variances of each keyframe's position in the result's frame, after
            ranges and known positions have straightened the map; inf if not determined.
        num_positions: number of known positions that hold the map.
        notes: why known positions are not used, in words.
        refusal: why a run will find nothing at all; empty if it will.
    """

    planned: PlannedSurvey
    vision: VisionInformation | None
    ranges: RangesAtTruth | None
    known: KnownMap
    errors: ErrorParts
    keyframe_stddevs_m: Array
    num_positions: int
    notes: tuple[str, ...]
    refusal: str = ""

    @classmethod
    def nothing(cls, planned: PlannedSurvey, refusal: str) -> Expected:
        """Return that a run will refuse the survey, and know nothing of its map."""
        none, is_placed = np.zeros(0, dtype=np.int64), planned.anchor_frame == "site"
        columns, open_ = Columns(0, 1 if is_placed else -1, none, none, 7), OPEN**4 * np.eye(7)
        known = KnownMap(ScaleUncertainty(np.inf, {}), open_, columns, np.zeros(7), np.zeros(0))
        errors = ErrorParts((), np.zeros(0), np.zeros((0, 0, 0)))
        open_m = np.full(len(planned.trajectory), np.inf)
        return cls(replace(planned, photos=None), None, None, known, errors, open_m, 0, (), refusal)

    @property
    def uncertainty(self) -> ScaleUncertainty:
        """Uncertainty of the scale."""
        return self.known.uncertainty

    @property
    def frame(self) -> str:
        """Frame of the result, "site" or "first_camera"."""
        return "site" if self.known.columns.frame >= 0 else "first_camera"

    @property
    def verdict(self) -> Verdict:
        """Verdict of the run on the scale.

        Raises:
            GeometryError: the run will refuse the scale.
        """
        if self.refusal:
            raise GeometryError(self.refusal)
        if self.ranges is None:
            has_check = any(point.kind == CHECK for point in self.planned.points)
            return judge_positions(self.num_positions, self.uncertainty, ScaleOptions(), has_check=has_check)
        return judge(self.ranges.posed, self.ranges.solution, self.uncertainty, {}, (), ScaleOptions())

    @property
    def learned(self) -> LearnedErrors:
        """Errors of the ranges, with those of the map's bending."""
        assert self.ranges is not None, "a plan with ranges"
        radio, errors, num = self.ranges.learned, self.errors, len(self.ranges.learned.bins)
        of_bins = errors.covariances_m2[:, :num, :num]
        return LearnedErrors(errors.names, errors.stddevs, of_bins, radio.bins, radio.of_range)

    def mirror_image(self) -> str | None:
        """Return why the run will leave the position open, or None if it will not.

        The position is open if the map's mirror image in the anchors' plane fits ranges as they may turn out.
        """
        if self.ranges is None or self.num_positions or self.frame != "site":
            return None
        mirrored = mirrored_map(self.ranges.posed.ranges, self.ranges.solution.fit.state)
        if mirrored is None:
            return None
        try:
            # For a path in that plane the height is not determined, and the solver divides 0 by 0.
            with np.errstate(invalid="ignore", divide="ignore"):
                solution = solution_from(self.planned.posed(self.turned_out(0)), self.ranges.solution.fit.state)
                refuse_ambiguity(solution, [mirrored], None)
        except GeometryError as error:
            return str(error)
        return None

    def turned_out(self, seed: int) -> RangeObservations:
        """Return the ranges with errors drawn from those to expect."""
        assert self.ranges is not None, "a plan with ranges"
        rng, learned, observations = np.random.default_rng(seed), self.learned, self.ranges.posed.observations
        values, vectors = np.linalg.eigh(learned.without("white").covariance_m2)
        of_bins = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        white_m = self.ranges.learned.stddev_of_component["white"] / np.sqrt(self.planned.num_alike)
        range_m = observations.log.range_m.copy()
        range_m[self.ranges.posed.rows] += of_bins[learned.of_range]
        range_m[self.ranges.posed.rows] += white_m * rng.standard_normal(len(learned.of_range))
        return replace(observations, log=replace(observations.log, range_m=np.maximum(range_m, LENGTH_M.least)))

    @property
    def placement(self) -> Array | None:
        """(7, 7) covariance of the map's similarity about the first camera, as of a ScaleEstimate; None: not placed."""
        return self.known.columns.placement(self.known.covariance)

    @property
    def map_stddevs(self) -> Array | None:
        """Standard deviations (7,) of the map's similarity about its mean; inf: not determined, None: not placed."""
        placement = self.placement
        if placement is None:
            return None
        return _stddevs(np.diag(by_similarity(placement, self.planned.trajectory.centers)[0]))

    def stddevs_at(self, places_m: Array) -> Array:
        """Return the standard deviations (n,) of points (n, 3) of a map in one piece, metres; inf if not determined.

        Each is the root of the summed variances of the three coordinates in the result's frame. If the map is not
        placed in the site, only the scale contributes, with the first camera fixed.
        """
        motions, placement = similarity_motions(places_m - self.planned.trajectory.centers[0]), self.placement
        if placement is None:
            placement = np.diag([self.uncertainty.empirical**2, *np.zeros(6)])
        return _stddevs(np.einsum("nij,jk,nik->n", motions, placement, motions))

    @property
    def worst_keyframe_m(self) -> float:
        """Standard deviation of the position of the least certain keyframe, metres; NaN if the map is not placed."""
        return float("nan") if self.frame != "site" else float(self.keyframe_stddevs_m.max())


def _stddevs(variances: Array) -> Array:
    stddevs = np.sqrt(np.maximum(variances, 0.0))
    return np.where(stddevs < OPEN, stddevs, np.inf)


def expect_roughly(planned: PlannedSurvey, vision: VisionInformation | None = None) -> Expected:
    """Compute ``expect`` with fewer ranges, bins and keyframes, in a tenth of the time, to compare plans."""
    few = replace(planned, max_num_ranges=_NUM_COMPARED_RANGES)
    return expect(few, _NUM_COMPARED_BINS, _NUM_COMPARED_KEYFRAMES, vision)


def expect(
    planned: PlannedSurvey,
    max_num_bins: int = MAX_NUM_BINS,
    num_keyframes: int = _NUM_KEYFRAMES,
    vision: VisionInformation | None = None,
) -> Expected:
    """Compute the uncertainty that a run will state.

    Args:
        max_num_bins: largest number of bins in which common errors of ranges are computed; fewer are coarser.
        num_keyframes: number of keyframes for which the uncertainty is computed, and not interpolated.
        vision: of the planned photos, or of those of a similar path; None: it is computed where photos are planned.

    Raises:
        GeometryError: the run will find too few ranges on the path and too few known positions, or no two photos that
            see the same point.
    """
    path = planned.trajectory
    if vision is None and planned.photos is not None:
        vision = planned.photos.information(path)
    first = in_first_camera(path)
    the_map = _BendingMap(planned, WalkBending(first) if vision is None else GraphBending(vision, first), num_keyframes)
    positions, placement, notes = _positions(planned, the_map)
    ranges = _ranges(planned, placement, max_num_bins) if planned.anchors else None
    observed = [] if ranges is None else [_of_ranges(ranges)]
    if positions is not None:
        # Beside known positions, a run gives ranges no more say on the scale than their errors allow.
        observed = [*(the_map.with_honest_weights(each) for each in observed), positions]
    known, errors, keyframe_stddevs_m = the_map.solved(observed)
    num_positions = 0 if positions is None else len(positions.linear.design) // 3
    return Expected(planned, vision, ranges, known, errors, keyframe_stddevs_m, num_positions, notes)


def _positions(
    planned: PlannedSurvey, the_map: _BendingMap
) -> tuple[_Observed | None, PlacementPrior | None, tuple[str, ...]]:
    """Return the known positions, what they say of the map's place without ranges, and why they are not used."""
    known, notes = planned.known_positions()
    if known is None:
        return None, None, notes
    try:
        equations = expected_positions(known, planned.trajectory, the_map.bending, planned.lasting_s)
        linear, errors = equations.of(equations.is_used)
        by_pose = groups_by_pose(known, IDENTITY, planned.trajectory, equations.grouping)[equations.is_used]
        errors = errors.without(*BENDS)
        observed = _Observed(linear, errors, errors.only(*_NOISE).covariance_m2, by_pose)
        alone = the_map.solved([observed])[0]
        covariance = alone.columns.placement(alone.covariance)
        assert covariance is not None, "known positions place the map"
        refuse_open_turn(covariance)
    except GeometryError as error:
        if not planned.anchors:
            raise GeometryError(f"the scale is not determined: {error}") from None
        return None, None, (*notes, f"the known positions are not used: {error}")
    return observed, PlacementPrior.of(planned.site_from_first_camera, np.zeros(3), covariance), notes


def _ranges(planned: PlannedSurvey, placement: PlacementPrior | None, max_num_bins: int) -> RangesAtTruth:
    posed = planned.posed(planned.observations(), placement)
    state = planned.state(posed)
    tags, scale = antenna_positions(posed.ranges, state.metric_from_model), state.metric_from_model.scale
    errors = posed.errors.at(tags, posed.placing_stddev_m(scale))
    problem = weighted(posed.ranges, errors)
    weights = np.full(len(posed.rows), float(planned.num_alike))
    solution = Solution(problem, fit_at(problem, state, weights), errors, errors.noise_m)
    stddevs = usual_stddevs(is_calibrated=planned.curve_stddev_m is not None) | dict(planned.component_stddevs)
    learned = errors_to_expect(posed, solution, stddevs, max_num_bins)
    by_pose = averaged(learned.bins, slopes_by_poses(ranges_on_map(posed, solution, None)), len(planned.trajectory))
    return RangesAtTruth(posed, solution, learned, by_pose)


@dataclass(frozen=True)
class _Observed:
    """Observations of one kind, three for each known position or one for each bin of ranges.

    Attributes:
        linear: their equations. errors: all but the map's bending. simple_m2: covariance that simple weights assume.
        by_pose: derivatives by the poses.
    """

    linear: LinearMap
    errors: ErrorParts
    simple_m2: Array
    by_pose: Array


def _of_ranges(ranges: RangesAtTruth) -> _Observed:
    # Known positions are observations of their own, and not a prior of the ranges' equations.
    posed = replace(ranges.posed, ranges=replace(ranges.posed.ranges, placement=None))
    learned = ranges.learned
    simple_m2 = learned.only(*_NOISE).covariance_m2 + bias_covariance(learned.bins, posed.ranges)
    return _Observed(linear_map(posed, ranges.solution, learned.bins), learned, simple_m2, ranges.by_pose)


@dataclass(frozen=True)
class _BendingMap:
    """The map of a planned survey, which may bend.

    Attributes:
        num_keyframes: number of keyframes for which the uncertainty is computed.
    """

    planned: PlannedSurvey
    bending: MapBending
    num_keyframes: int

    def solved(self, observed: Sequence[_Observed]) -> tuple[KnownMap, ErrorParts, Array]:
        """Return what observations say of the map: as a whole, their errors, and (n,) stddevs of all keyframes.

        A keyframe's error is that of the map as a whole and its bending, as far as the observations leave it open
        (universal kriging: Rasmussen and Williams, "Gaussian processes for machine learning", 2006, eq. 2.42).
        """
        columns = observed[0].linear.columns
        design = np.vstack([_in_columns(each.linear.design, columns) for each in observed])
        prior_design = np.vstack([_in_columns(each.linear.prior_design, columns) for each in observed])
        linear = LinearMap(np.zeros(len(design)), design, np.zeros(len(prior_design)), prior_design, columns)
        bent = self._bent(observed, is_free=columns.frame >= 0)
        num = len(design)
        errors = _joined([each.errors for each in observed], {name: by[:num, :num] for name, by in bent.items()})
        formal = float(np.sqrt(linear.solved(errors.only(*_NOISE).covariance_m2).covariance[0, 0]))
        bent_m2 = np.sum([np.zeros((num + 3 * len(self._some),) * 2), *bent.values()], axis=0)
        simple_m2 = block_diag(*(each.simple_m2 for each in observed)) + bent_m2[:num, :num]
        by_others, _ = linear.with_weights(simple_m2, errors.covariance_m2)
        # The estimates with different weights will differ by about one standard deviation.
        best = linear.solved(errors.covariance_m2)
        half_way = chance_differences(by_others, best.covariance) / 2
        known = KnownMap.of(best, errors, formal, columns, half_way)
        whitened = cho_solve(cho_factor(regular(errors.covariance_m2)), np.hstack([bent_m2[:num, num:], design]))
        of_places, of_design = whitened[:, : bent_m2.shape[0] - num], whitened[:, bent_m2.shape[0] - num :]
        left = self._motions(columns) - bent_m2[num:, :num] @ of_design
        variances = np.diag(bent_m2)[num:] - np.sum(bent_m2[num:, :num] * of_places.T, axis=1)
        variances = variances + np.einsum("ip,pq,iq->i", left, known.covariance, left)
        stddevs_m = np.sqrt(np.maximum(variances.reshape(-1, 3).sum(axis=1), 0.0))
        of_all = np.interp(np.arange(len(self.planned.trajectory)), self._some, stddevs_m)
        return known, errors, np.where(of_all < OPEN, of_all, np.inf)

    def with_honest_weights(self, observed: _Observed) -> _Observed:
        """Return observations whose simple weights claim no more about the scale than their errors allow."""
        linear, known = observed.linear, self.solved([observed])[0]
        claimed = float(linear.solved(observed.simple_m2).covariance[0, 0])
        excess = max(known.uncertainty.empirical**2 / claimed, 1.0)
        return replace(observed, simple_m2=excess * observed.simple_m2)

    def _bent(self, observed: Sequence[_Observed], *, is_free: bool) -> dict[str, Array]:
        """Return by name the covariance of the observations and of the keyframes' coordinates due to the bending."""
        by_pose = np.vstack([*(each.by_pose for each in observed), self._by_pose])
        num_first = len(observed[0].by_pose)
        parts = self.bending.of_functions(by_pose, frame_is_free=is_free).parts
        return {part.name: self._variance(part, num_first) * part.alike for part in parts}

    def _variance(self, part: ErrorPart, num_first: int) -> float:
        """Return the variance of a part's size; what is given of it refers to the first observations."""
        given_m = self.planned.component_stddevs.get(part.name)
        if given_m is None:
            return float(part.median_m * np.exp(part.spread**2)) ** 2
        return given_m**2 * num_first / float(np.trace(part.alike[:num_first, :num_first]))

    @cached_property
    def _some(self) -> Indices:
        """Indices of the k keyframes for which the uncertainty is computed."""
        some: Indices = np.unique(np.linspace(0, len(self.planned.trajectory) - 1, self.num_keyframes).astype(np.int64))
        return some

    @cached_property
    def _by_pose(self) -> Array:
        """Derivatives (3 k, 6 n) of these keyframes' coordinates by the poses, with shifts as in the first camera."""
        path, some = self.planned.trajectory, self._some
        by_pose = np.zeros((len(some), 3, len(path), 6))
        by_pose[np.arange(len(some)), :, some, 3:] = path.world_from_cam[0]
        return by_pose.reshape(3 * len(some), -1)

    def _motions(self, columns: Columns) -> Array:
        """Return the derivatives (3 k, p) of these keyframes' coordinates by the unknowns."""
        centers = self.planned.trajectory.centers
        of_map = columns.of_map
        motions = np.zeros((3 * len(self._some), columns.num))
        motions[:, of_map] = similarity_motions(centers[self._some] - centers[0]).reshape(-1, 7)[:, : len(of_map)]
        return motions


def _in_columns(design: Array, columns: Columns) -> Array:
    """Return the derivatives by all unknowns; known positions have those by the map as a whole."""
    if design.shape[1] == columns.num:
        return design
    widened = np.zeros((len(design), columns.num))
    widened[:, columns.of_map] = design
    return widened


def _joined(observed: Sequence[ErrorParts], bent: Mapping[str, Array]) -> ErrorParts:
    """Return the errors of all observations; those of different kinds are independent, but for the bending."""
    nums = [each.covariances_m2.shape[1] for each in observed]
    by_name = {
        name: block_diag(
            *(
                each.covariances_m2[each.names.index(name)] if name in each.names else np.zeros((num, num))
                for each, num in zip(observed, nums, strict=True)
            )
        )
        for name in dict.fromkeys(name for each in observed for name in each.names)
    } | dict(bent)
    covariances = np.array(list(by_name.values()))
    stddevs = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / covariances.shape[1])
    return ErrorParts(tuple(by_name), stddevs, covariances)
