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
from rangesfm.measurements.mistakes import (
    FALSE_ALARM_RATE,
    EstimatedMistake,
    Mistake,
    MistakeTest,
    MistakeTests,
    estimated,
)
from rangesfm.solver.bending import MapBending
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
        errors: (m,) of each length, by what all other kept measurements predict; empty before a test.
        taped: the m lengths as they were given.
    """

    lengths: LocatedDistances
    rows: Indices
    bending: MapBending
    is_kept: Mask
    errors: tuple[EstimatedMistake, ...] = ()
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
        # Where all of them are in another unit, each seems to be mistyped.
        reasons = (*left_out, *(f"{row.words}: {row.remedy}" for row in against if row.rejected), *either)
        # Printed tags are shown only if something was found: their sides are many and alike.
        told = [row for row, one in zip(rows, self.taped, strict=True) if row.rejected or not one.is_printed]
        told.sort(key=lambda row: row.threshold - row.statistic)
        return MistakeTests((*told, *against), reasons, tuple(self._hidden(rows, against)))

    def _tests_of_each(self) -> Iterator[MistakeTest]:
        """Yield the test of each length, with the effect of an error of it on the scale by the lengths."""
        for found, by_metre in zip(self.errors, self.by_metre.tolist(), strict=True):
            yield replace(found.row, effect_on_scale=abs(by_metre) * found.smallest_detectable)

    def _hidden(self, rows: Sequence[MistakeTest], against: Sequence[MistakeTest]) -> Iterator[MistakeTest]:
        """Yield mistakes that the tests may miss, of each length, and of all if they are compared with other kinds."""
        yield from (row for row in rows if row.is_checked)
        if compared := [row for row in against if np.isfinite(row.stddev)]:
            yield min(compared, key=lambda row: row.stddev)
        elif self._are_between_two_points or not all(row.is_checked for row in rows):
            yield replace(rows[0], effect_on_scale=np.inf)

    def _mistake(self, problem: JointProblem, k: int) -> Mistake:
        """Return: a length is too long."""
        columns = np.zeros((len(problem.is_used), 1))
        columns[problem.rows[LENGTHS].start + k] = -1.0
        between = f"{self.taped[k].ends[0]} to {self.taped[k].ends[1]}" if self.taped else ""
        given_m = float(self.lengths.distance_m[k])

        def words(size: Array) -> str:
            return (
                f"the length from {between} is given as {given_m:.3f} m, but all else gives {given_m - size[0]:.3f} m "
                f"({number_text(float(size[0]), '+.3f')} m)"
            )

        return Mistake("length", columns, words, _MEASURE_AGAIN, subject=between)

    def tested(self, placed: Similarity, others: Sequence[Observations], *, is_last: bool = False) -> LengthScale:
        """Return the lengths with outlying ones left out; arguments as of ``KindOnMap.tested``."""
        num = len(self.rows)

        def problem(kept: Mask) -> JointProblem:
            all_kinds = [*others, replace(self, is_kept=kept).observed(placed)]
            # A map that bends by significantly more than others do was mistaken, which must not pass for noise.
            return joined(all_kinds, self.bending).learnt(
                most_unusual=SIGNIFICANT_STDDEVS, most_bent=SIGNIFICANT_STDDEVS
            )

        def among(of: JointProblem, k: int) -> float:
            return estimated(of, [self._mistake(of, k)])[0].statistic if of.is_used.any() else 0.0

        def against(kept: Mask, k: int) -> float:
            return among(problem(kept & (np.arange(num) != k)), k)

        kept = self.is_kept.copy() if is_last else np.ones(num, dtype=bool)
        while not is_last and kept.sum() + len(others) > 2 and (~kept).sum() + 1 < (num + len(others)) / 2:
            now = problem(kept)
            worst, statistic = most_contradicting(np.flatnonzero(kept), partial(among, now), partial(against, kept))
            # Where the others contradict each other, one of them is wrong.
            of_size = (estimated(now, [Mistake("size", _size_by(now, each.kind))])[0].statistic for each in others)
            if statistic <= max(self.threshold, *of_size, 0.0):
                break
            kept[worst] = False
        now = problem(kept)
        errors = (found for k in range(num) for found in estimated(now, [self._mistake(now, k)]))
        return replace(self, is_kept=kept, errors=tuple(replace(each, threshold=self.threshold) for each in errors))


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
    lengths, every = _subset(distances, rows, bending.path), np.ones(len(rows), dtype=bool)
    given = tuple(taped[row] for row in rows.tolist()) if taped else ()
    return LengthScale(lengths, rows, bending, every, (), given)


def _subset(distances: LocatedDistances, rows: Indices, path: Trajectory) -> LocatedDistances:
    extent = float(np.linalg.norm(path_shape(path.centers).stddevs))
    if not np.all(distances.model_length[rows] > 1e-9 * extent):
        raise GeometryError("a measured length has both its ends in one place of the map")
    return distances.subset(np.isin(np.arange(len(distances)), rows))


def _size_by(problem: JointProblem, kind: str) -> Array:
    """Return the column (c, 1) of a mistake by which all observations of a kind have the map too small."""
    column = np.zeros((len(problem.is_used), 1))
    column[problem.rows[kind], 0] = -problem.design[problem.rows[kind], problem.columns.scale]
    return column
