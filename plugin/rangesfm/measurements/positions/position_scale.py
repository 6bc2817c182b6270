"""The similarity from a map to the site by known positions: of marks (control points) and of an antenna on the camera.

It is fitted robustly, and control points that contradict the others are left out.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices, Mask, median, rms
from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import JointMap, KindOnMap, join_kinds, most_contradicting
from rangesfm.measurements.kind import Doubt, Measurements
from rangesfm.measurements.lengths.tape import LEFT_OUT, Marker
from rangesfm.measurements.points import MapToFit
from rangesfm.measurements.positions.cost import AntennaPositions, MarkedPositions
from rangesfm.measurements.positions.grouped_positions import (
    POSITIONS,
    GroupedPositions,
    PositionFit,
    at_point,
    design_of_positions,
    stddev_of,
)
from rangesfm.measurements.positions.known_positions import (
    MIN_NUM_POSITIONS,
    KnownPositions,
)
from rangesfm.measurements.positions.position_tests import tests_of_positions
from rangesfm.measurements.positions.surveyed_positions import NO_POSITIONS, SurveyedPositions
from rangesfm.measurements.ranges.errors.components import FRAME
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import FALSE_ALARM_RATE
from rangesfm.solver.mistakes import MistakeTests
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, MAX_NUM_ROUNDS, NORMAL_95, ROUNDING, UNDETERMINED
from rangesfm.util.geometry.robust_statistics import CAUCHY, MIN_STDDEV_M
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points, path_shape
from rangesfm.util.geometry.trajectory import Trajectory, moved_similarity
from rangesfm.util.processes.threads import with_one_blas_thread

# Most triples for a start.
_MAX_NUM_TRIPLES = 300
# Largest standard deviation of a turn of the map, radians, for which its effect is linear.
_MAX_TURN_STDDEV = 0.3
# Positions are mirrored if the mirror image of the map fits them this many times as well.
_MIRRORED = 3.0


@dataclass(frozen=True)
class PositionScale(KindOnMap):
    """k known positions on a map, and its scale and place by them alone.

    Attributes:
        fit: robust one of the positions alone, without control points that contradict the others.
        bending: of the map.
        surveyed: what the positions were given as.
    """

    fit: PositionFit
    bending: MapBending
    surveyed: SurveyedPositions

    kind = POSITIONS
    shows_bending = True
    words, remedy = "known positions", "look at the units of both"

    @property
    def start(self) -> Similarity:
        """The similarity of the robust fit."""
        return self.fit.similarity

    @cached_property
    def alone(self) -> JointMap:
        """The map by the positions alone, about the similarity of their fit."""
        fit = self.fit
        return join_kinds((self,), fit.path, fit.similarity, self.bending, is_at_rest=fit.is_at_rest)

    @property
    def is_left_out(self) -> Mask:
        """(k,) control points that contradict the others."""
        return np.asarray(~self.known.is_check & ~self.fit.used)

    @property
    def threshold(self) -> float:
        """Squared error of a control point, in standard deviations, above which it is left out."""
        num_control = int(np.count_nonzero(self.known.is_mark & ~self.known.is_check))
        return float(special.chdtri(3, FALSE_ALARM_RATE / max(num_control, 1)))

    @cached_property
    def inflation(self) -> float:
        """Standard deviation of the scale by the antenna's positions, divided by that for independent errors."""
        problem, used = self.alone.problem, self.alone.problem.is_used
        linear, noise = problem.among(used)
        as_independent, _ = linear.solved(problem.alone_m2[np.ix_(used, used)]).gains
        grouping = self.grouped(self.alone).grouping
        is_antenna = np.asarray(abs(grouping) @ np.repeat(~self.known.is_mark, 3) > 0)[used]
        effects = noise.effects(np.where(is_antenna, as_independent[0], 0.0))
        of_parts = {name: size for name, size in effects.items() if name.startswith(POSITIONS)}
        alone = of_parts.get(POSITIONS, 0.0)
        return float(np.linalg.norm([*of_parts.values()])) / alone if alone > 0 else 1.0

    def without_worst(self) -> PositionScale | None:
        """Return them without the control point that contradicts the others most; None if none does."""
        known, used, found = self.known, self.fit.used, dict[int, PositionScale]()
        if not len(rows := np.flatnonzero(used & known.is_mark)):
            return None

        def against_others(row: int) -> float:
            others = used & (np.arange(len(used)) != row)
            if int(others.sum()) < MIN_NUM_POSITIONS or not _determine(known, others):
                return 0.0
            found[row] = replace(self, fit=_fitted(replace(self.fit, used=others)))
            return found[row]._statistic(row)

        worst, statistic = most_contradicting(rows, self._statistic, against_others)
        return found[worst] if statistic > self.threshold else None

    def _statistic(self, row: int) -> float:
        """Return the squared error of a control point against all positions, in standard deviations."""
        return self.alone.problem.mistake(self.columns_of(self.alone, at_point(self.known, row))).statistic

    @property
    def places_map(self) -> bool:
        """True: they are in the site."""
        return True

    def observed(
        self, placed: Similarity, *, in_site: bool = True, max_num: int = MAX_NUM_OBSERVATIONS
    ) -> GroupedPositions:
        """Linearise the positions about a placement."""
        del in_site
        return self.fit.at(placed, max_num)

    @property
    def known(self) -> KnownPositions:
        """The positions."""
        return self.fit.known

    def stddevs_m(self, on_map: JointMap) -> Array:
        """Return (k,) standard deviations of a coordinate, without errors that last, as learnt on a map."""
        given, learnt = stddev_of(self.known.covariance_m2), on_map.problem.sizes
        base = np.where(np.isfinite(given), given, self.fit.stddev_m)
        return base * np.where(self.known.is_mark, learnt.get("points", 1.0), learnt.get("positions", 1.0))

    def entry(self, on_map: JointMap) -> Mapping[str, object]:
        """Return how the positions of an antenna fit the map; empty without an antenna."""
        track = self.surveyed.antenna
        if track is None:
            return {}
        mine, used = ~self.known.is_mark, ~self.known.is_mark & self.used
        off_m, is_timed = self.known.misclosures_m(on_map.estimate)[used], track.log.timestamp_s is not None
        return {
            "num": len(track.log),
            "num_used": int(used.sum()),
            "num_rejected": int((mine & ~used).sum()),
            "rms_m": rms(np.linalg.norm(off_m, axis=1)),
            "rms_by_axis_m": tuple(map(rms, off_m.T)) if len(off_m) else None,
            "stddev_m": median(self.stddevs_m(on_map)[used]),
            "inflation": self.inflation,
            "time_offset_s": track.offset_s if is_timed else None,
            "time_offset_stddev_s": track.offset_stddev_s if is_timed else None,
            "antenna_in_cam_m": np.array(track.antenna_in_cam_m).tolist(),
        }

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks of the control points that take part."""
        names = (self.known.names[row] for row in np.flatnonzero(self.takes_part & self.known.is_mark).tolist())
        return {name: self.surveyed.points.markers[name] for name in names}

    def measurements(self, on_map: JointMap, at: MapToFit) -> Iterator[Measurements]:
        """Yield the control points that take part, and the positions of the antenna.

        Outliers of an antenna are left to the loss, because on a map that is one piece drift looks like them.
        """
        known, track, stddev_m = self.known, self.surveyed.antenna, self.stddevs_m(on_map)
        marks, others = (np.flatnonzero(self.takes_part & of_kind) for of_kind in (known.is_mark, ~known.is_mark))
        if len(marks):
            names = tuple(known.names[row] for row in marks.tolist())
            yield MarkedPositions(names, at.points, known.position_m[marks], stddev_m[marks], {})
        if track is not None and len(others):
            yield AntennaPositions.on_map(known, others, stddev_m[others], on_map.estimate, track, at)

    def grouped(self, on_map: JointMap) -> GroupedPositions:
        """Return the groups of the positions on a map."""
        observed = on_map.observed[POSITIONS]
        assert isinstance(observed, GroupedPositions), "positions come in groups"
        return observed

    def columns_of(self, on_map: JointMap, of_positions: Array) -> Array:
        """Return the columns (c, m) of a map's problem by those (3 k, m) of the positions."""
        return on_map.columns(POSITIONS, self.grouped(on_map).grouping @ of_positions)

    @property
    def names_left_out(self) -> list[str]:
        """Names of the control points that contradict the others, or did so before."""
        before = [point.name for point in self.surveyed.points.points if point.kind == LEFT_OUT]
        return [*(self.known.names[row] for row in np.flatnonzero(self.is_left_out).tolist()), *before]

    def tests(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> MistakeTests:
        """Return the tests of each control point, of the antenna's positions, and of all against other kinds."""
        return tests_of_positions(self, on_map, self.against_others(on_map, by_kind))

    @property
    def takes_part(self) -> Mask:
        """(k,) control positions that do not contradict the others, outliers of an antenna among them."""
        return np.asarray(~self.known.is_check & ~self.is_left_out)

    @property
    def used(self) -> Mask:
        """(k,) positions that take part and are no outliers."""
        return np.asarray(self.takes_part & (self.known.is_mark | (self.fit.weights >= OUTLIER_BELOW)))

    def doubts(self, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
        """Yield that the positions are mirrored, that three of them check nothing, and why the interval is wide."""
        yield from _doubts_of_axes(self.known)
        yield from doubts_of_positions(int(self.used.sum()), uncertainty, has_check=bool(self.known.is_check.any()))


def _doubts_of_axes(known: KnownPositions) -> Iterator[Doubt]:
    """Yield that the positions are those of a mirror image, as with two axes exchanged."""
    places, targets = known.places[~known.is_check], known.position_m[~known.is_check]
    freedom = 3 * len(places) - 7
    if freedom <= 0:
        return
    here_m, mirrored_m = (_rms_m(places, targets * signs) for signs in ([1, 1, 1], [1, 1, -1]))
    # Chance makes either of two fits of so few positions the better one; errors that last make it so in a flat site.
    by_chance = float(special.fdtri(freedom, freedom, 1 - FALSE_ALARM_RATE))
    if here_m > max(np.sqrt(by_chance), _MIRRORED) * mirrored_m:
        reason = (
            f"the known positions fit a mirror image of the map to {mirrored_m:.2g} m, and the map itself to "
            f"{here_m:.2g} m: two axes are exchanged, or heights count downwards"
        )
        yield Doubt(reason, "give the positions with x to the east, y to the north and heights upwards")


def _rms_m(places: Array, targets: Array) -> float:
    return rms(align_points(places, targets).apply(places) - targets)


def doubts_of_positions(num_used: int, uncertainty: ScaleUncertainty, *, has_check: bool) -> Iterator[Doubt]:
    """Yield the faults of a map by known positions.

    Args:
        num_used: number of positions. has_check: whether others check them.
    """
    if num_used == MIN_NUM_POSITIONS and not has_check:
        reason = f"the map rests on {num_used} known positions, so that nothing tells which of them is wrong if one is"
        yield Doubt(reason, "survey a fourth control point, far from the others")
    by_frame = uncertainty.components.get(FRAME, 0.0)
    if NORMAL_95 * by_frame > DOUBTFUL_ABOVE:
        reason = (
            "a system whose positions err as these do may also measure the whole site too large or too small, by up to "
            f"{100 * NORMAL_95 * by_frame:.1f} % (95 %): its positions alone cannot show that"
        )
        yield Doubt(reason, "tape a long distance in the map (--distances), or survey control points (--points)")
    elif uncertainty.half_width_95 > DOUBTFUL_ABOVE:
        reason = "the known positions are too close together for their standard deviations"
        yield Doubt(reason, "survey control points at the ends of the site, or walk farther")


@with_one_blas_thread
def scale_by_positions(
    known: KnownPositions,
    path: Trajectory,
    bending: MapBending,
    surveyed: SurveyedPositions = NO_POSITIONS,
    *,
    is_at_rest: bool = False,
    metres_per_unit: float = 1.0,
) -> PositionScale:
    """Estimate the similarity to the site by known positions alone, with contradicting control points left out.

    Args:
        known: positions in the model of ``path``. path: of the camera. bending: of the map.
        surveyed: what the positions were given as. is_at_rest, metres_per_unit: as of ``PositionFit``.

    Raises:
        GeometryError: the positions are too few, or on one line.
    """
    used = _enough(known)
    # A start that few wrong positions do not move; that of a map at rest.
    start = IDENTITY if is_at_rest else _of_triples(known, np.flatnonzero(used))
    nothing = np.zeros(len(known))
    begun = PositionFit(
        start, known, path, used, nothing, nothing, surveyed.lasting_s, metres_per_unit, is_at_rest=is_at_rest
    )
    found = PositionScale(_fitted(begun), bending, surveyed)
    while (without := found.without_worst()) is not None:
        found = without
    refuse_open_turn(found.alone.posterior.place)
    return found


def _enough(known: KnownPositions) -> Mask:
    """Return the control positions (k,); raises GeometryError if they do not determine a similarity."""
    if not _determine(known, ~known.is_check):
        expected = f"expected {MIN_NUM_POSITIONS} or more that are not on one line"
        raise GeometryError(f"{np.count_nonzero(~known.is_check)} known positions are in the map, {expected}")
    return ~known.is_check


def _fitted(begun: PositionFit) -> PositionFit:
    """Fit the similarity by iteratively reweighted least squares, starting from that of the fit."""
    known, similarity, used = begun.known, begun.similarity, begun.used
    for _ in range(MAX_NUM_ROUNDS):
        off_m = known.misclosures_m(similarity)
        stddev_m = _stddevs_m(known, off_m, used)
        away = np.sqrt(np.mean(off_m**2, axis=1)) / stddev_m
        weights = used * CAUCHY.weights(away)
        if begun.is_at_rest:  # the map has its place; only outliers are told apart
            break
        root = np.repeat(np.sqrt(weights / stddev_m**2), 3)
        by = root[:, None] * design_of_positions(known, similarity, begun.path)
        step = np.asarray(np.linalg.lstsq(by, -root * off_m.ravel(), rcond=ROUNDING)[0], dtype=np.float64)
        similarity = moved_similarity(similarity, step, begun.path)
        if np.abs(step).max() < ROUNDING:
            break
    return replace(begun, similarity=similarity, weights=weights, stddev_m=stddev_m)


def _stddevs_m(known: KnownPositions, off_m: Array, used: Mask) -> Array:
    """Return (k,) standard deviations of a coordinate: as given, or larger if the residuals of its kind are."""
    stddevs, given = np.ones(len(known)), stddev_of(known.covariance_m2)
    freedom = np.sqrt(3 * used.sum() / max(3 * used.sum() - 7, 1))
    # Half of all vectors of three normally distributed numbers are shorter than this.
    median_length = np.sqrt(special.chdtri(3, 0.5))
    for of_kind in (known.is_mark, ~known.is_mark):
        if (rows := used & of_kind).any():
            is_given = bool(np.isfinite(given[of_kind]).all())
            ratio = given if is_given else np.ones(len(known))
            shown = freedom * float(np.median(np.linalg.norm(off_m[rows], axis=1) / ratio[rows])) / median_length
            stddevs[of_kind] = ratio[of_kind] * max(shown, 1.0 if is_given else MIN_STDDEV_M)
    return stddevs


def planned_positions(
    known: KnownPositions, path: Trajectory, lasting_s: Sequence[float], max_num: int
) -> GroupedPositions:
    """Return the observations of positions that are planned, on a map that is true.

    Args:
        known: without errors, in the model of ``path``, whose world is the site.
        max_num: largest number of observations of an antenna.

    Raises:
        GeometryError: the positions are too few, or on one line.
    """
    nothing = np.zeros(len(known))
    begun = PositionFit(IDENTITY, known, path, _enough(known), nothing, nothing, tuple(lasting_s), is_at_rest=True)
    return _fitted(begun).at(IDENTITY, max_num)


def _determine(known: KnownPositions, used: Mask) -> bool:
    """Return whether positions determine a similarity: three or more that are not on one line."""
    if used.sum() < MIN_NUM_POSITIONS:
        return False
    stddevs = path_shape(known.places[used]).stddevs
    return bool(stddevs[1] > UNDETERMINED * stddevs[0])


def refuse_open_turn(covariance: Array) -> None:
    """Raise GeometryError if a (7, 7) covariance of a similarity by known positions leaves its turn open."""
    turn_stddev = float(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1]))
    if turn_stddev > _MAX_TURN_STDDEV:
        raise GeometryError(
            "the known positions are nearly on one line, which leaves the turn of the map about it open "
            f"({np.rad2deg(turn_stddev):.0f} degrees, 1 stddev): survey a point off that line"
        )


def _of_triples(known: KnownPositions, rows: Indices) -> Similarity:
    """Return the similarity of three positions with the least sum of distances of all: a robust start.

    Lever arms are taken off with the rotation of a first fit.
    """
    places, targets = known.places[rows], known.position_m[rows]
    for _ in range(2):
        candidates = [align_points(places, targets)]
        for chosen in map(list, _triples(len(rows))):
            if not any(path_shape(each).is_line for each in (places[chosen], targets[chosen])):
                candidates.append(align_points(places[chosen], targets[chosen]))
        best = candidates[int(np.argmin([_distance_sum(each, places, targets) for each in candidates]))]
        targets = known.position_m[rows] - known.arms_m[rows] @ best.rotation.T
    return best


def _distance_sum(similarity: Similarity, places: Array, targets: Array) -> float:
    return float(np.linalg.norm(similarity.apply(places) - targets, axis=1).sum())


def _triples(num: int) -> Iterator[tuple[int, ...]]:
    """Yield triples of numbers below ``num``: all if they are few, else some that are spread over them."""
    if num * (num - 1) * (num - 2) // 6 <= _MAX_NUM_TRIPLES:
        yield from itertools.combinations(range(num), MIN_NUM_POSITIONS)
        return
    rng = np.random.default_rng(0)
    for _ in range(_MAX_NUM_TRIPLES):
        yield tuple(rng.choice(num, MIN_NUM_POSITIONS, replace=False).tolist())
