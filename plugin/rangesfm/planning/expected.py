"""Expected result of a planned survey: the uncertainty that a run will state, from its linear problem at the true map.

The equations, the errors and the rule for the interval are those with which a run judges its finished map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.diagnostics.place import by_similarity
from rangesfm.errors import GeometryError
from rangesfm.estimation.free_fit import GraphBending
from rangesfm.estimation.scale.scale_estimate import Verdict, judge
from rangesfm.estimation.vision_information import VisionInformation
from rangesfm.measurements.lengths.lengths_on_map import lengths_on_map
from rangesfm.measurements.lengths.tape import CHECK
from rangesfm.measurements.positions.position_scale import doubts_of_positions, fit_positions, refuse_open_turn
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.ranges.errors.learned import LearnedErrors
from rangesfm.measurements.ranges.errors.noise import START_STDDEV_M
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.anchor_plane import mirrored_map
from rangesfm.measurements.ranges.scale.binned_ranges import RANGES, BinnedRanges, binned_ranges
from rangesfm.measurements.ranges.scale.doubts import doubts_of_ranges
from rangesfm.measurements.ranges.scale.placement_prior import PlacementPrior
from rangesfm.measurements.ranges.scale.range_equation import antenna_positions, fit_at
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.solution import Solution, refuse_ambiguity, solution_from, weighted
from rangesfm.options import LENGTH_M, ScaleOptions
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_sensor import PlannedScale
from rangesfm.solver.bending import BENDS, MapBending, WalkBending
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS, Component, noise_of_sizes, usual_sizes
from rangesfm.solver.posterior import JointProblem, Observations, Posterior, ScaleUncertainty, joined
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.similarity import IDENTITY, similarity_motions
from rangesfm.util.geometry.trajectory import in_first_camera

# Numbers of ranges, of bins and of keyframes in the quick computation that compares plans.
_NUM_COMPARED_RANGES, _NUM_COMPARED_BINS, _NUM_COMPARED_KEYFRAMES = 600, 120, 15
# Number of keyframes for which the uncertainty is computed; it is interpolated between them.
_NUM_KEYFRAMES = 40
# Components of the errors that a simple estimate weights by: what differs from observation to observation.
_NOISE = ("white", "points", "marks", "positions")
OPEN = 1e3
"""Standard deviation, in metres or radians, from which on a number counts as not determined."""


# Name of the coordinates of keyframes, which are predicted.
_KEYFRAMES = "keyframes"


@dataclass(frozen=True)
class RangesAtTruth:
    """Planned ranges without errors, on the true map.

    Attributes:
        posed: the scale problem. solution: its true state, with the weight of each range. bending: of the map.
        learned: errors to expect of them, with those of the map's bending.
    """

    posed: ScaleProblem
    solution: Solution
    bending: MapBending
    learned: LearnedErrors


@dataclass(frozen=True)
class Expected:
    """Uncertainty that a run will state.

    Attributes:
        planned: the planned survey.
        vision: information of its photos; None: the map bends as maps of poses do.
        ranges: its ranges; None without any.
        known: uncertainty of the map as a whole.
        keyframe_stddevs_m: (n,) roots of the summed variances of each keyframe's position in the result's frame, after
            ranges and known positions have straightened the map; inf if not determined.
        num_positions: number of known positions that hold the map.
        notes: why known positions or the inertial sensor are not used, in words.
        sensor: the inertial sensor on the true map; None without one.
        refusal: why a run will find nothing at all; empty if it will.
    """

    planned: PlannedSurvey
    vision: VisionInformation | None
    ranges: RangesAtTruth | None
    known: Posterior
    keyframe_stddevs_m: Array
    num_positions: int
    notes: tuple[str, ...]
    sensor: PlannedScale | None = None
    refusal: str = ""

    @classmethod
    def nothing(cls, planned: PlannedSurvey, refusal: str) -> Expected:
        """Return that a run will refuse the survey, and know nothing of its map."""
        none, is_placed = np.zeros(0, dtype=np.int64), planned.anchor_frame == "site"
        columns, open_ = Columns(0, 1 if is_placed else -1, none, none, 7), OPEN**4 * np.eye(7)
        known = Posterior(ScaleUncertainty(np.inf, {}), columns, open_, np.zeros(7), np.zeros(0), np.zeros(0))
        open_m = np.full(len(planned.trajectory), np.inf)
        return cls(replace(planned, photos=None), None, None, known, open_m, 0, (), refusal=refusal)

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
        if self.ranges is None and self.sensor is not None and not self.num_positions:
            doubts = self.sensor.doubts(self.uncertainty)
        elif self.ranges is None:
            has_check = any(point.kind == CHECK for point in self.planned.points)
            doubts = doubts_of_positions(self.num_positions, self.uncertainty, has_check=has_check)
        else:
            doubts = doubts_of_ranges(self.ranges.posed, self.ranges.solution, self.uncertainty, {})
        return judge(doubts, (), self.uncertainty, ScaleOptions())

    @property
    def gravity(self) -> Gravity | None:
        """The upward direction in the first camera, as the inertial sensor tells it; None without one."""
        return None if self.sensor is None else self.sensor.upward

    def mirror_image(self) -> str:
        """Return why the run will leave the position open; empty if it will not.

        The position is open if the map's mirror image in the anchors' plane fits ranges as they may turn out.
        """
        if self.ranges is None or self.num_positions or self.frame != "site":
            return ""
        mirrored = mirrored_map(self.ranges.posed.ranges, self.ranges.solution.fit.state)
        if mirrored is None:
            return ""
        try:
            # For a path in that plane the height is not determined, and the solver divides 0 by 0.
            with np.errstate(invalid="ignore", divide="ignore"):
                posed = self.planned.posed(self.turned_out(0), gravity=self.gravity)
                solution = solution_from(posed, self.ranges.solution.fit.state)
                return refuse_ambiguity(solution, [mirrored], None)
        except GeometryError as error:
            return str(error)

    def turned_out(self, seed: int) -> RangeObservations:
        """Return the ranges with errors drawn from those to expect."""
        assert self.ranges is not None, "a plan with ranges"
        posed, learned, rng = self.ranges.posed, self.ranges.learned, np.random.default_rng(seed)
        values, vectors = np.linalg.eigh(learned.without("white").covariance_m2)
        of_bins = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        white_m = learned.stddev_of_component["white"] / np.sqrt(self.planned.num_alike)
        range_m = posed.observations.log.range_m.copy()
        range_m[posed.rows] += of_bins[learned.of_range]
        range_m[posed.rows] += white_m * rng.standard_normal(len(learned.of_range))
        log = replace(posed.observations.log, range_m=np.maximum(range_m, LENGTH_M.least))
        return replace(posed.observations, log=log)

    @property
    def map_stddevs(self) -> Array | None:
        """Standard deviations (7,) of the map's similarity about its mean; inf: not determined, None: not placed."""
        placement = self.known.placement
        if placement is None:
            return None
        return _stddevs(np.diag(by_similarity(placement, self.planned.trajectory.centers)[0]))

    def stddevs_at(self, places_m: Array) -> Array:
        """Return the standard deviations (n,) of points (n, 3) of a map in one piece, metres; inf if not determined.

        Each is the root of the summed variances of the three coordinates in the result's frame. If the map is not
        placed in the site, only the scale contributes, with the first camera fixed.
        """
        motions, placement = similarity_motions(places_m - self.planned.trajectory.centers[0]), self.known.placement
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
    max_num_bins: int = MAX_NUM_OBSERVATIONS,
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
    positions, placement, notes = _positions(planned, the_map, max_num_bins)
    sensor, why_not = _sensor(planned, the_map)
    gravity = None if sensor is None or not planned.anchors else sensor.upward
    observed: list[Observations] = [] if positions is None else [positions]
    if planned.anchors:
        posed, solution, binned = _ranges(planned, the_map.bending, placement, gravity, max_num_bins)
        observed.insert(0, binned)
    if planned.taped:
        observed.append(lengths_on_map(planned.taped_lengths, 1.0, path, np.ones(len(planned.taped), dtype=bool)))
    if sensor is not None:
        most = max_num_bins // 2 if observed else max_num_bins
        observed.append(sensor.observed(sensor.start, in_site=placement is not None, max_num=most))
    problem, known, keyframe_stddevs_m = the_map.solved(observed)
    ranges = None
    if planned.anchors:
        ranges = RangesAtTruth(
            posed, solution, the_map.bending, LearnedErrors.from_noise(problem.noise_of(RANGES), binned.bins)
        )
    num_positions = 0 if positions is None else int(np.count_nonzero(positions.is_used)) // 3
    notes = (*notes, *why_not)
    return Expected(planned, vision, ranges, known, keyframe_stddevs_m, num_positions, notes, sensor)


def _positions(
    planned: PlannedSurvey, the_map: _BendingMap, max_num: int
) -> tuple[Observations | None, PlacementPrior | None, tuple[str, ...]]:
    """Return the known positions, what they say of the map's place without ranges, and why they are not used."""
    known, notes = planned.known_positions()
    if not len(known):
        return None, None, notes
    try:
        surveyed = SurveyedPositions(lasting_s=tuple(planned.lasting_s))
        fit = fit_positions(known, planned.trajectory, the_map.bending, surveyed, is_at_rest=True)
        found = fit.observed(IDENTITY, max_num=max_num)
        alone = the_map.solved([found])[1]
        assert alone.placement is not None, "known positions place the map"
        refuse_open_turn(alone.placement)
    except GeometryError as error:
        if not planned.anchors:
            raise GeometryError(f"the scale is not determined: {error}") from None
        return None, None, (*notes, f"the known positions are not used: {error}")
    return found, PlacementPrior.with_covariance(planned.site_from_first_camera, alone.placement), notes


def _sensor(planned: PlannedSurvey, the_map: _BendingMap) -> tuple[PlannedScale | None, tuple[str, ...]]:
    """Return the inertial sensor on the map, and why it is not used."""
    if planned.sensor is None:
        return None, ()
    try:
        return planned.sensor.on_map(planned.trajectory, the_map.bending), ()
    except GeometryError as error:
        if not (planned.anchors or planned.points or planned.antenna):
            raise
        return None, (f"the inertial sensor is not used: {error}",)


def _ranges(
    planned: PlannedSurvey,
    bending: MapBending,
    placement: PlacementPrior | None,
    gravity: Gravity | None,
    max_num_bins: int,
) -> tuple[ScaleProblem, Solution, BinnedRanges]:
    """Return the scale problem of the ranges, its true state, and the ranges, which are weighted by their noise."""
    posed = planned.posed(planned.observations(), placement, gravity)
    state = planned.state(posed)
    tags, scale = antenna_positions(posed.ranges, state.metric_from_model), state.metric_from_model.scale
    errors = posed.errors.at(tags, posed.placing_stddev_m(scale))
    problem = weighted(posed.ranges, errors)
    weights = np.full(len(posed.rows), float(planned.num_alike))
    solution = Solution(problem, fit_at(problem, state, weights), errors, START_STDDEV_M)
    found = binned_ranges(posed, solution, bending, max_num_bins)
    sizes = _given_or_usual(found.components, planned.given_sizes)
    alone = noise_of_sizes(found.components, sizes, len(found.is_used)).only(*_NOISE).covariance_m2
    return posed, solution, replace(found, alone_m2=alone)


def _given_or_usual(components: Sequence[Component], given: Mapping[str, float]) -> dict[str, float]:
    """Return the sizes of components: as given, or usual; those whose size is known have it."""
    learnt = {each.name for each in components if each.spread > 0 or each.name in BENDS}
    return usual_sizes(components) | {name: size for name, size in given.items() if name in learnt}


@dataclass(frozen=True)
class _BendingMap:
    """The map of a planned survey, which may bend.

    Attributes:
        num_keyframes: number of keyframes for which the uncertainty is computed.
    """

    planned: PlannedSurvey
    bending: MapBending
    num_keyframes: int

    def solved(self, observed: Sequence[Observations]) -> tuple[JointProblem, Posterior, Array]:
        """Return what observations say of the map: the joint problem, its posterior, and (n,) stddevs of all keyframes.

        A keyframe's error is that of the map as a whole and its bending, as far as the observations leave it open.
        """
        problem = joined([*observed, self._keyframes(observed)], self.bending)
        num_first = len(observed[0].residual_m)
        problem = replace(problem, sizes=self._sizes(problem.components, num_first))
        known = problem.posterior()
        variances = np.diag(problem.predicted_m2(_KEYFRAMES, known.covariance))
        stddevs_m = np.sqrt(np.maximum(variances.reshape(-1, 3).sum(axis=1), 0.0))
        of_all = np.interp(np.arange(len(self.planned.trajectory)), self._some, stddevs_m)
        return problem, known, np.where(of_all < OPEN, of_all, np.inf)

    def _sizes(self, components: Sequence[Component], num_first: int) -> dict[str, float]:
        """Return the sizes of all components; what is given of the bending refers to the first observations."""
        given = dict(self.planned.given_sizes)
        for each in components:
            if each.name in BENDS and each.name in given:
                given[each.name] /= float(np.sqrt(np.trace(each.alike[:num_first, :num_first]) / num_first))
        return _given_or_usual(components, given)

    @cached_property
    def _some(self) -> Indices:
        """Indices of the k keyframes for which the uncertainty is computed."""
        some: Indices = np.unique(np.linspace(0, len(self.planned.trajectory) - 1, self.num_keyframes).astype(np.int64))
        return some

    def _keyframes(self, observed: Sequence[Observations]) -> Observations:
        """Return the coordinates of these keyframes, which nobody observes."""
        path, some = self.planned.trajectory, self._some
        by_pose = np.zeros((len(some), 3, len(path), 6))
        by_pose[np.arange(len(some)), :, some, 3:] = path.world_from_cam[0]
        num, nothing = 3 * len(some), np.zeros(0, dtype=np.int64)
        is_free = max((each.columns for each in observed), key=lambda each: each.num).frame >= 0
        columns = Columns(0, 1, nothing, nothing, 7) if is_free else Columns(0, -1, nothing, nothing, 1)
        motions = similarity_motions(path.centers[some] - path.centers[0]).reshape(-1, 7)
        none = np.zeros((num, num))
        return Observations(
            _KEYFRAMES, columns, motions[:, : columns.num], np.zeros(num), by_pose.reshape(num, -1), (), none,
            np.zeros(num, dtype=bool),
        )  # fmt: skip
