"""Outliers among measured lengths, by all that is known of a map, and the scale by the lengths alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError, number_text
from rangesfm.measurements.joint_map import (
    JointMap,
    KindOnMap,
    fit_kinds,
    most_contradicting,
)
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.lengths.lengths_on_map import lengths_on_map
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.lengths.tape import TapedDistance
from rangesfm.measurements.lengths.words import LENGTH_WORDS, LENGTHS
from rangesfm.solver.bending import MapBending
from rangesfm.solver.linear_map import FALSE_ALARM_RATE, noncentrality
from rangesfm.solver.mistakes import HiddenMistake, MistakeTest, MistakeTests
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import JointProblem, Observations, ScaleByKind, ScaleUncertainty, joined
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import Similarity, path_shape
from rangesfm.util.geometry.trajectory import Trajectory, first_camera_from

_MEASURE_AGAIN = "look whether it was mistyped, or measure it again"


@dataclass(frozen=True)
class LengthScale(KindOnMap):
    """m measured lengths between points of a map, and what all else says of them.

    Attributes:
        lengths: in the map. rows: (m,) of them among all distances. bending: of the map.
        is_kept: (m,) True for lengths that agree with all else; the others are not used. Where none is kept, the scale
            alone is that of all of them.
        too_long_m, stddev_m: (m,) excess of each length over what all other kept measurements predict, and its standard
            deviation; inf where nothing predicts it, and before a test.
        redundancy: (m,) how much of an error of each length the others check, 0 to 1 (Baarda's redundancy number).
        taped: the m lengths as they were given.
    """

    lengths: LocatedDistances
    rows: Indices
    bending: MapBending
    is_kept: Mask
    too_long_m: Array
    stddev_m: Array
    redundancy: Array
    taped: tuple[TapedDistance, ...] = ()

    kind = LENGTHS
    words, remedy = LENGTH_WORDS.words, "measure a length again"

    def observed(
        self, placed: Similarity, *, in_site: bool = False, max_num: int = MAX_NUM_OBSERVATIONS
    ) -> Observations:
        """Linearise the lengths about the scale of a placement."""
        del in_site, max_num
        return lengths_on_map(self.lengths, placed.scale, len(self.bending.path), self.is_kept)

    @property
    def start(self) -> Similarity:
        """The placement with the median of the scales by the kept lengths."""
        scales = self.lengths.distance_m / self.lengths.model_length
        return first_camera_from(self.bending.path, float(np.median(scales[self.is_kept])))

    @cached_property
    def alone(self) -> JointMap:
        """The map by the kept lengths alone."""
        used = self if self.is_used else replace(self, is_kept=~self.is_kept)
        return fit_kinds((used,), used.start, self.bending)

    @property
    def is_used(self) -> bool:
        """Whether any of the lengths takes part."""
        return bool(self.is_kept.any())

    @property
    def left_out(self) -> tuple[int, ...]:
        """Rows of the lengths that contradict all else, among all distances."""
        return tuple(self.rows[~self.is_kept].tolist())

    @property
    def threshold(self) -> float:
        """Squared error of a length, in standard deviations, above which it is an outlier."""
        return float(special.chdtri(1, FALSE_ALARM_RATE / len(self.rows)))

    @property
    def statistic(self) -> Array:
        """(m,) squared excess of each length, in standard deviations."""
        return (self.too_long_m / self.stddev_m) ** 2

    @property
    def by_metre(self) -> Array:
        """(m,) relative change of the scale by the lengths if the length was a metre longer."""
        return self.alone.problem.of_kind(LENGTHS, self.alone.posterior.gains)

    def on_refined_map(self, distances: LocatedDistances, bending: MapBending) -> LengthScale:
        """Return the same lengths on the map that this one became, with the same ones left out.

        Args:
            distances: all measured ones in the refined map. bending: of that.

        Raises:
            GeometryError: both ends of a length are in one place of the map.
        """
        return replace(self, lengths=_subset(distances, self.rows, bending.path), bending=bending)

    def doubts(self, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
        """Yield that nothing checks a single length, and that the lengths are too short."""
        if self._are_between_two_points:
            reason = "the scale depends on one length that nothing checks: a mistake in it changes the whole map"
            yield Doubt(reason, "measure another length, far from the first and in another direction")
        if uncertainty.half_width_95 > DOUBTFUL_ABOVE:
            yield Doubt(
                "the measured lengths are too short for their standard deviations", "measure more and longer lengths"
            )

    @property
    def _are_between_two_points(self) -> bool:
        """Whether there is one length, however often it was taped: nothing checks between which points it is."""
        return len(self.rows) == 1 or len({frozenset(one.ends) for one in self.taped}) == 1

    def tests(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> MistakeTests:
        """Return the tests of each length against all else, and of all of them against other kinds."""
        rows = list(self._tests_of_each())
        left_out = [
            f"probably {row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}; it is left out"
            for row, is_kept in zip(rows, self.is_kept, strict=True)
            if not is_kept
        ]
        open_words = [row.words for row, is_kept in zip(rows, self.is_kept, strict=True) if is_kept and row.rejected]
        either = [f"either {'; or '.join(open_words)}: {_MEASURE_AGAIN}"] if open_words else []
        against = self.against_others(on_map, by_kind)
        reasons = (*left_out, *either, *(f"{row.words}: {row.remedy}" for row in against if row.rejected))
        # Printed tags are shown only if something was found: their sides are many and alike.
        told = [row for row, one in zip(rows, self.taped, strict=True) if row.rejected or not one.is_printed]
        told.sort(key=lambda row: row.threshold - row.statistic)
        return MistakeTests((*told, *against), reasons, tuple(self._hidden(against)))

    def _tests_of_each(self) -> Iterator[MistakeTest]:
        for k, one in enumerate(self.taped):
            size_m, stddev_m = float(self.too_long_m[k]), float(self.stddev_m[k])
            smallest_m = float(np.sqrt(noncentrality(1))) * stddev_m
            is_known = np.isfinite(stddev_m)
            between = f"{one.ends[0]} to {one.ends[1]}"
            yield MistakeTest(
                "length",
                between,
                float(self.statistic[k]),
                self.threshold,
                words=f"the length from {between} is given as {one.distance_m:.3f} m, but all else gives "
                f"{one.distance_m - size_m:.3f} m ({number_text(size_m, '+.3f')} m)",
                remedy=_MEASURE_AGAIN,
                unit="m",
                size=size_m if is_known else np.nan,
                stddev=stddev_m,
                smallest_detectable=smallest_m,
                effect_on_scale=abs(float(self.by_metre[k])) * smallest_m,
                redundancy=float(self.redundancy[k]),
                is_checked=bool(is_known),
            )

    def _hidden(self, against: Sequence[MistakeTest]) -> Iterator[HiddenMistake]:
        """Yield mistakes that the tests may miss, of each length, and of all if they are compared with other kinds."""
        is_checked = np.isfinite(self.stddev_m)
        for slope in (np.abs(self.by_metre) * self.stddev_m)[is_checked].tolist():
            yield HiddenMistake("length", slope, self.threshold, 1, np.inf)
        compared = [row.stddev for row in against if np.isfinite(row.stddev)]
        if compared:
            threshold = float(special.chdtri(1, FALSE_ALARM_RATE))
            yield HiddenMistake("lengths", min(compared), threshold, 1, np.inf)
        elif self._are_between_two_points or not is_checked.all():
            yield HiddenMistake("length", np.inf, np.inf, 1, np.inf)

    def tested(self, placed: Similarity, others: Sequence[Observations], *, is_last: bool = False) -> LengthScale:
        """Return the lengths with outlying ones left out; arguments as of ``KindOnMap.tested``."""
        num = len(self.rows)

        def problem(kept: Mask) -> JointProblem:
            all_kinds = [*others, replace(self, is_kept=kept).observed(placed)]
            # A map that bends by significantly more than others do was mistaken, which must not pass for noise.
            return joined(all_kinds, self.bending).learnt(
                most_unusual=SIGNIFICANT_STDDEVS, most_bent=SIGNIFICANT_STDDEVS
            )

        def effect(of: JointProblem, k: int) -> Array:
            columns = np.zeros((len(of.is_used), 1))
            columns[of.rows[LENGTHS].start + k] = 1.0
            return columns

        def among(of: JointProblem, k: int) -> float:
            return of.mistake(effect(of, k)).statistic if of.is_used.any() else 0.0

        def against(kept: Mask, k: int) -> float:
            return among(problem(kept & (np.arange(num) != k)), k)

        kept = self.is_kept.copy() if is_last else np.ones(num, dtype=bool)
        while not is_last and kept.sum() + len(others) > 2 and (~kept).sum() + 1 < (num + len(others)) / 2:
            now = problem(kept)
            worst, statistic = most_contradicting(np.flatnonzero(kept), partial(among, now), partial(against, kept))
            # Where the others contradict each other, one of them is wrong.
            wrong_size = (now.mistake(now.size_of(each.kind)).statistic for each in others)
            if statistic <= max(self.threshold, *wrong_size, 0.0):
                break
            kept[worst] = False
        now = problem(kept)
        too_long_m, stddev_m, redundancy = np.array([_test(now, effect(now, k)) for k in range(num)]).T
        return replace(self, is_kept=kept, too_long_m=too_long_m, stddev_m=stddev_m, redundancy=redundancy)


def lengths_between_points(
    distances: LocatedDistances, bending: MapBending, taped: Sequence[TapedDistance] = ()
) -> LengthScale | None:
    """Return the lengths among measured distances, before any test; None where there is none between points.

    Args:
        taped: the distances as they were given, for the tests.

    Raises:
        GeometryError: both ends of a length are in one place of the map.
    """
    rows = np.flatnonzero(distances.is_between_points & ~distances.is_check)
    if not len(rows):
        return None
    lengths, nothing = _subset(distances, rows, bending.path), np.zeros(len(rows))
    given = tuple(taped[row] for row in rows.tolist()) if taped else ()
    return LengthScale(lengths, rows, bending, nothing == 0, nothing, nothing + np.inf, nothing, given)


def _subset(distances: LocatedDistances, rows: Indices, path: Trajectory) -> LocatedDistances:
    extent = float(np.linalg.norm(path_shape(path.centers).stddevs))
    if not np.all(distances.model_length[rows] > 1e-9 * extent):
        raise GeometryError("a measured length has both its ends in one place of the map")
    return distances.subset(np.isin(np.arange(len(distances)), rows))


def _test(problem: JointProblem, columns: Array) -> tuple[float, float, float]:
    """Return by how much a length is too long, the standard deviation of that, and the redundancy of the length."""
    found = problem.mistake(columns)
    if not found.is_seen or not np.isfinite(found.stddevs[0]):
        return 0.0, np.inf, 0.0
    rows = problem.is_used | np.any(columns != 0, axis=1)
    seen = replace(problem, is_used=rows).solution.whitened(columns[rows])
    return float(found.sizes[0]), float(found.stddevs[0]), found.redundancy_against(seen)
