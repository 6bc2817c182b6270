"""Known positions on a map as a kind of measurement: outlying control points, doubts, and tests of mistakes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special
from scipy.sparse import diags_array

from rangesfm.arrays import Array, Mask, median, rms
from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import JointMap, KindOnMap, join_kinds, most_contradicting
from rangesfm.measurements.kind import Doubt, Measurements
from rangesfm.measurements.lengths.tape import CHECK, LEFT_OUT, Marker
from rangesfm.measurements.mistakes import (
    FALSE_ALARM_RATE,
    Mistake,
    MistakeTest,
    MistakeTests,
    estimated,
    in_axes,
    noncentrality,
)
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.cost import AntennaPositions, MarkedPositions
from rangesfm.measurements.positions.known_positions import LOOK_AGAIN, MIN_NUM_POSITIONS, KnownPositions
from rangesfm.measurements.positions.position_fit import (
    at_point,
    components_of,
    design_of_positions,
    determine,
    grouped_by_time,
    groups_by_pose,
    start_of_triples,
    stddev_of,
    stddevs_as_shown,
)
from rangesfm.measurements.positions.surveyed_positions import NO_POSITIONS, SurveyedPositions
from rangesfm.measurements.positions.words import FRAME, POSITION_WORDS, POSITIONS
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.options import LEVER_ARM_M, RefineOptions
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import Observations, ScaleByKind, ScaleUncertainty
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, MAX_NUM_ROUNDS, NORMAL_95, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points
from rangesfm.util.geometry.trajectory import moved_similarity
from rangesfm.util.processes.threads import with_one_blas_thread

# Largest standard deviation of a turn of the map, radians, for which its effect is linear.
_MAX_TURN_STDDEV = 0.3
# Positions are mirrored if the mirror image of the map fits them this many times as well.
_MIRRORED = 3.0
_POINT, _CHECK_POINT, _FRAME = "control point", "check point", "frame of the points"
_OF_ALL = ""  # subject of a test of all points
_ONE_FRAME = "look whether points and anchors are in one frame, and measured to the same height of the antennas"
_ARM, _CLOCK, _DATUM = "antenna's lever arm", "antenna's clock", "datum shift"
# Words, remedy and unit of the mistakes of an antenna's positions.
_OF_ANTENNA: dict[str, tuple[Callable[[Array], str], str, str]] = {
    _ARM: (
        lambda size: f"the antenna sits elsewhere on the camera, by {in_axes(size)} (right, down, forward)",
        "measure from lens to antenna again ([positions] antenna_in_cam_m)",
        "m",
    ),
    _CLOCK: (
        lambda size: f"the times of the positions are {abs(size[0]):.2f} s {'late' if size[0] < 0 else 'early'}",
        "look for leap seconds, or let the offset be searched for ([positions] time_offset)",
        "s",
    ),
    _DATUM: (
        lambda size: f"the positions and the control points have frames that are shifted by {in_axes(size)}",
        "look which coordinate system and which height each of them has",
        "m",
    ),
}


@dataclass(frozen=True)
class PositionScale(KindOnMap):
    """k known positions on a map, and its scale and place by them alone.

    Attributes:
        known: the positions. bending: of the map that they are in.
        surveyed: what the positions were given as.
        similarity: from that model to the site, as a robust fit of the positions alone has it.
        is_kept: (k,) those that take part in it: all but check points and control points that contradict the others;
            none where a map that others place is only compared with them.
        weights, stddev_m: (k,) its robust weights, and standard deviations of a coordinate that they assume.
        is_at_rest: whether photos and positions made the map together, in the site; otherwise it is one piece, and its
            similarity is estimated.
        notes: as of ``KindOnMap``.
    """

    known: KnownPositions
    bending: MapBending
    surveyed: SurveyedPositions
    similarity: Similarity
    is_kept: Mask
    weights: Array
    stddev_m: Array
    is_at_rest: bool
    notes: tuple[str, ...] = ()

    kind = POSITIONS
    shows_bending = True
    words, remedy = POSITION_WORDS.words, "look at the units of both"

    @classmethod
    def begun(
        cls,
        known: KnownPositions,
        bending: MapBending,
        surveyed: SurveyedPositions = NO_POSITIONS,
        *,
        is_at_rest: bool = False,
    ) -> PositionScale:
        """Return positions of which none takes part yet."""
        none, nothing = np.zeros(len(known), dtype=bool), np.zeros(len(known))
        unfitted = (IDENTITY, none, nothing, nothing + 1.0)
        return cls(known, bending, surveyed, *unfitted, is_at_rest)

    @property
    def start(self) -> Similarity:
        """The similarity of the robust fit."""
        return self.similarity

    @cached_property
    def alone(self) -> JointMap:
        """The map by the positions alone, about the similarity of their fit."""
        return join_kinds((self,), self.similarity, self.bending, is_at_rest=self.is_at_rest)

    def fitted(self) -> PositionScale:
        """Return their fit by iteratively reweighted least squares, starting from this similarity."""
        path = self.bending.path
        known, similarity, used = self.known, self.similarity, self.is_kept
        for _ in range(MAX_NUM_ROUNDS):
            off_m = known.misclosures_m(similarity)
            stddev_m = stddevs_as_shown(known, off_m, used)
            away = np.sqrt(np.mean(off_m**2, axis=1)) / stddev_m
            weights = used * CAUCHY.weights(away)
            if self.is_at_rest:  # the map has its place; only outliers are told apart
                break
            root = np.repeat(np.sqrt(weights / stddev_m**2), 3)
            by = root[:, None] * design_of_positions(known, similarity, path)
            step = np.asarray(np.linalg.lstsq(by, -root * off_m.ravel(), rcond=ROUNDING)[0], dtype=np.float64)
            similarity = moved_similarity(similarity, step, path)
            if np.abs(step).max() < ROUNDING:
                break
        return replace(self, similarity=similarity, weights=weights, stddev_m=stddev_m)

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
        grouping = self.alone.observed[POSITIONS].averages
        is_antenna = np.asarray(abs(grouping) @ np.repeat(~self.known.is_mark, 3) > 0)[used]
        effects = noise.effects(np.where(is_antenna, as_independent[0], 0.0))
        of_parts = {name: size for name, size in effects.items() if name.startswith(POSITIONS)}
        alone = of_parts.get(POSITIONS, 0.0)
        return float(np.linalg.norm([*of_parts.values()])) / alone if alone > 0 else 1.0

    def without_worst(self) -> PositionScale | None:
        """Return them without the control point that contradicts the others most; None if none does."""
        known, used, found = self.known, self.is_kept, dict[int, PositionScale]()
        if not len(rows := np.flatnonzero(used & known.is_mark)):
            return None

        def against_others(row: int) -> float:
            others = used & (np.arange(len(used)) != row)
            if not determine(known, others):
                return 0.0
            found[row] = replace(self, is_kept=others).fitted()
            return found[row]._statistic(row)

        worst, statistic = most_contradicting(rows, self._statistic, against_others)
        return found[worst] if statistic > self.threshold else None

    def _statistic(self, row: int) -> float:
        """Return the squared error of a control point against all positions, in standard deviations."""
        columns = self.columns_of(self.alone, at_point(self.known, row))
        return estimated(self.alone.problem, [Mistake(_POINT, columns)])[0].statistic

    @property
    def places_map(self) -> bool:
        """True: they are in the site."""
        return True

    @property
    def is_used(self) -> bool:
        """Whether any of them takes part; otherwise a map that others place is compared with them."""
        return bool(self.is_kept.any())

    def observed(
        self, placed: Similarity, *, in_site: bool = True, max_num: int = MAX_NUM_OBSERVATIONS
    ) -> Observations:
        """Linearise the positions about a placement; an antenna has at most ``max_num`` observations."""
        del in_site
        known, similarity = self.known, placed
        grouping = grouped_by_time(known, self.weights, max_num // 3)
        used = np.asarray((abs(grouping) @ np.repeat(self.used, 3)) > 0)
        design = grouping @ design_of_positions(known, similarity, self.bending.path)
        variances = np.repeat(self.stddev_m**2 / np.maximum(self.weights, OUTLIER_BELOW), 3)
        weighed = (grouping @ diags_array(variances) @ grouping.T).toarray()
        return Observations(
            kind=POSITIONS,
            columns=Columns.of_whole(7),
            design=design,
            residual_m=grouping @ known.misclosures_m(similarity).ravel(),
            by_pose=groups_by_pose(known, similarity, grouping),
            components=components_of(known, similarity, grouping, self.stddev_m, self.surveyed, design, used),
            alone_m2=weighed,
            is_used=used,
            averages=grouping,
        )

    def stddevs_m(self, on_map: JointMap) -> Array:
        """Return (k,) standard deviations of a coordinate, without errors that last, as learnt on a map."""
        given, learnt = stddev_of(self.known.covariance_m2), on_map.problem.sizes
        base = np.where(np.isfinite(given), given, self.stddev_m)
        return base * np.where(self.known.is_mark, learnt.get("points", 1.0), learnt.get("positions", 1.0))

    def entry(self, on_map: JointMap) -> Mapping[str, object]:
        """Return how the positions of an antenna fit the map; empty without an antenna that takes part."""
        track = self.surveyed.antenna
        if track is None or not self.is_used:
            return {}
        mine, used = ~self.known.is_mark, ~self.known.is_mark & self.used
        off_m, is_timed = self.known.misclosures_m(on_map.estimate)[used], isinstance(track.log.moments, ByTime)
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
        names = (self.known.names[row] for row in np.flatnonzero(self.is_kept & self.known.is_mark).tolist())
        return {name: self.surveyed.points.markers[name] for name in names}

    def measurements(self, on_map: JointMap, points: NamedPoints, options: RefineOptions) -> Iterator[Measurements]:
        """Yield the control points that take part, and the positions of the antenna.

        Outliers of an antenna are left to the loss, because on a map that is one piece drift looks like them.
        """
        known, track, stddev_m = self.known, self.surveyed.antenna, self.stddevs_m(on_map)
        marks, others = (np.flatnonzero(self.is_kept & of_kind) for of_kind in (known.is_mark, ~known.is_mark))
        if len(marks):
            names = tuple(known.names[row] for row in marks.tolist())
            yield MarkedPositions(names, points, known.position_m[marks], stddev_m[marks], {})
        if track is not None and len(others):
            placed = on_map.path, on_map.estimate
            yield AntennaPositions.on_map(known, others, stddev_m[others], *placed, track, options)

    def columns_of(self, on_map: JointMap, of_positions: Array) -> Array:
        """Return the columns (c, m) of a mistake in a map's problem that makes the positions too large by (3 k, m)."""
        return -on_map.columns(POSITIONS, on_map.observed[POSITIONS].averages @ of_positions)

    @property
    def names_left_out(self) -> list[str]:
        """Names of the control points that contradict the others, or did so before."""
        before = [point.name for point in self.surveyed.points.points if point.kind == LEFT_OUT]
        rows = np.flatnonzero(~self.known.is_check & ~self.is_kept) if self.is_used else np.zeros(0, dtype=np.int64)
        return [*(self.known.names[row] for row in rows.tolist()), *before]

    def tests(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> MistakeTests:
        """Return the tests of each known point, of the antenna's positions, and of all against other kinds."""
        if self.kind not in on_map.observed:
            return MistakeTests()
        return tests_of_positions(self, on_map, self.against_others(on_map, by_kind))

    @property
    def used(self) -> Mask:
        """(k,) positions that take part and are no outliers."""
        return np.asarray(self.is_kept & (self.known.is_mark | (self.weights >= OUTLIER_BELOW)))

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
    here_m, mirrored_m = (
        rms(align_points(places, targets * signs).apply(places) - targets * signs) for signs in ([1, 1, 1], [1, 1, -1])
    )
    # Chance makes either of two fits of so few positions the better one; errors that last make it so in a flat site.
    by_chance = float(special.fdtri(freedom, freedom, 1 - FALSE_ALARM_RATE))
    if here_m > max(np.sqrt(by_chance), _MIRRORED) * mirrored_m:
        reason = (
            f"the known positions fit a mirror image of the map to {mirrored_m:.2g} m, and the map itself to "
            f"{here_m:.2g} m: two axes are exchanged, or heights count downwards"
        )
        yield Doubt(reason, "give the positions with x to the east, y to the north and heights upwards")


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
def scale_by_positions(begun: PositionScale) -> PositionScale:
    """Estimate the similarity to the site by known positions alone, with contradicting control points left out.

    Raises:
        GeometryError: the positions are too few, or on one line.
    """
    known = begun.known
    is_kept = ~known.is_check
    if not determine(known, is_kept):
        expected = f"expected {MIN_NUM_POSITIONS} or more that are not on one line"
        raise GeometryError(f"{np.count_nonzero(is_kept)} known positions are in the map, {expected}")
    # A start that few wrong positions do not move; that of a map at rest.
    start = begun.similarity if begun.is_at_rest else start_of_triples(known, np.flatnonzero(is_kept))
    found = replace(begun, similarity=start, is_kept=is_kept).fitted()
    while (without := found.without_worst()) is not None:
        found = without
    refuse_open_turn(found.alone.posterior.place)
    return found


def refuse_open_turn(covariance: Array) -> None:
    """Raise GeometryError if a (7, 7) covariance of a similarity by known positions leaves its turn open."""
    turn_stddev = float(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1]))
    if turn_stddev > _MAX_TURN_STDDEV:
        raise GeometryError(
            "the known positions are nearly on one line, which leaves the turn of the map about it open "
            f"({np.rad2deg(min(turn_stddev, np.pi)):.0f} degrees, 1 stddev): survey a point off that line"
        )


@with_one_blas_thread
def tests_of_positions(positions: PositionScale, on_map: JointMap, against: Sequence[MistakeTest]) -> MistakeTests:
    """Return the tests of known positions.

    Args:
        on_map: all that is measured in the map. against: tests that compare the positions with other kinds.
    """
    of_points, of_antenna = _of_points(positions, on_map), [*_of_antenna(positions, on_map)]
    likely = sorted((row for row in of_antenna if row.rejected), key=lambda row: -row.statistic)[:1]
    reasons = []
    for alike in (*of_points, *([row] for row in likely)):
        first, is_left_out = alike[0], alike[0].subject in positions.names_left_out
        if first.rejected or is_left_out:
            words = f"{'either' if len(alike) > 1 else 'probably'} {'; or '.join(row.words for row in alike)}"
            ending = "; it is left out" if is_left_out else ""
            reasons.append(f"{words} ({np.sqrt(first.statistic):.0f} stddevs): {first.remedy}{ending}")
    reasons += [f"{row.words}: {row.remedy}" for row in against if row.rejected]
    rows = [*itertools.chain.from_iterable(of_points), *of_antenna, *against]
    rows.sort(key=lambda row: row.threshold - row.statistic)
    notes = positions.surveyed.warnings_on_path if positions.is_used else ()
    return MistakeTests(tuple(rows), tuple(reasons), of_place=(*reasons, *notes))


def _of_points(positions: PositionScale, on_map: JointMap) -> list[list[MistakeTest]]:
    """Return the tests of all known points, and of their frame where others place the map, the likeliest mistake first.

    All points are compared with the map and with each other. Each is tested beside the points that were left out and
    the mistakes that are likelier, as all explain each other's residuals in part. Control points of which either may be
    wrong are in one group.
    """
    known = positions.known
    if not (marks := np.flatnonzero(known.is_mark).tolist()):
        return []
    # The step to the estimate may turn a map about a straight path so far that points beside it do not move linearly.
    on_map = on_map.rejoined([each.moved(on_map.posterior) for each in on_map.kinds], on_map.estimate)
    by_name = {known.names[row]: positions.columns_of(on_map, at_point(known, row)) for row in marks}
    controls = {known.names[row] for row in marks if positions.is_kept[row]}
    left_out = [name for name in by_name if name in positions.names_left_out]
    left = [name for name in by_name if name not in left_out]
    if len(left) > 1 and any(each.places_map and each.is_used for each in on_map.kinds if each.kind != positions.kind):
        by_name[_OF_ALL] = np.sum([by_name[name] for name in left], axis=0)
        left.append(_OF_ALL)
    used, gains = on_map.problem.is_used, on_map.posterior.gains
    problem = replace(on_map.problem, is_used=np.any(np.hstack([used[:, None], *by_name.values()]), axis=1))
    mistakes = {name: _of_point(positions, name, columns) for name, columns in by_name.items()}
    threshold = float(special.chdtri(3, FALSE_ALARM_RATE / len(mistakes)))

    def tested(some: Sequence[str], beside: Sequence[str]) -> list[MistakeTest]:
        tests = []
        for found in estimated(problem, [mistakes[name] for name in some], [mistakes[name] for name in beside]):
            by_scale = gains @ found.mistake.columns[used]
            effect = np.linalg.norm(by_scale @ found.root) * np.sqrt(noncentrality(3)) if found.is_seen else np.inf
            effect_on_scale = float(effect) if by_scale.any() else 0.0
            tests.append(replace(replace(found, threshold=threshold).row, effect_on_scale=effect_on_scale))
        return sorted(tests, key=lambda test: -test.statistic)

    groups, beside = [tested([name], [other for other in left_out if other != name]) for name in left_out], [*left_out]
    while (tests := tested(left, beside)) and (first := tests[0]).rejected:
        close = [test for test in tests if test.rejected and test.statistic > first.statistic - threshold]
        alike = [test for test in close if test is first or {test.subject, first.subject} <= controls]
        groups.append(alike)
        beside.append(first.subject)
        left = [test.subject for test in tests if test not in alike]
    return [*groups, *([test] for test in tests)]


def _of_point(positions: PositionScale, name: str, columns: Array) -> Mistake:
    """Return: a known point, or the frame of all of them, is elsewhere."""
    if name == _OF_ALL:
        return Mistake(
            _FRAME,
            columns,
            lambda size: (
                f"the map has all known points {np.linalg.norm(size):.2f} m from their coordinates ({in_axes(-size)}), "
                "alike"
            ),
            _ONE_FRAME,
            subject=name,
        )
    kinds = {point.name: point.kind for point in positions.surveyed.points.points}
    kind = _CHECK_POINT if kinds.get(name) == CHECK else _POINT
    return Mistake(
        kind,
        columns,
        lambda size: f"the {kind} {name} is {np.linalg.norm(size):.2f} m from its coordinates ({in_axes(-size)})",
        LOOK_AGAIN,
        subject=name,
    )


def _of_antenna(positions: PositionScale, on_map: JointMap) -> Iterator[MistakeTest]:
    """Yield the tests of mistakes that change all positions of an antenna."""
    known, placed = positions.known, on_map.estimate
    rotation, is_antenna = placed.rotation, ~known.is_mark & positions.used
    if not is_antenna.any():
        return
    shown = is_antenna[:, None, None]
    columns = {_ARM: np.where(shown, rotation @ known.world_from_cam, 0.0)}
    if known.velocity.any() and not positions.surveyed.clock_stddev_s:  # an offset that was searched for has no mistake
        moves = placed.scale * known.velocity @ rotation.T
        columns[_CLOCK] = np.where(shown, moves[:, :, None], 0.0)
    if (known.is_mark & positions.used).sum() >= MIN_NUM_POSITIONS:
        columns[_DATUM] = np.where(shown, np.eye(3), 0.0)
    # Clocks that differ by more than the positions last have no moment in common.
    most = {_ARM: LEVER_ARM_M.most, _CLOCK: float(np.ptp(known.time_s[is_antenna]))}
    for name, of_all in columns.items():
        in_problem = positions.columns_of(on_map, of_all.reshape(3 * len(known), -1))
        words, remedy, unit = _OF_ANTENNA[name]
        made = Mistake(name, in_problem, words, remedy, unit=unit)
        [found] = estimated(on_map.problem.learnt(in_problem), [made])
        threshold = float(special.chdtri(max(found.num, 1), FALSE_ALARM_RATE / len(columns)))
        if np.linalg.norm(found.sizes) > most.get(name, np.inf):
            found = replace(found, statistic=0.0)
        yield replace(found, threshold=threshold).row
