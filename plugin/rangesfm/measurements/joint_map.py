"""What all kinds of measurement say of a map that moves as a whole (sections 5 to 7 of ``model.md``).

A kind gives its observations about any placement of the map. All stages from the start to the verdict work on these,
so that none of them names a kind.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeVar

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.kind import Block, Doubt, Measurements
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.mistakes import FALSE_ALARM_RATE, MistakeTest, MistakeTests, noncentrality
from rangesfm.measurements.points import NamedPoints
from rangesfm.options import RefineOptions
from rangesfm.solver.bending import NO_STEPS, FrameSteps, MapBending
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import JointProblem, Observations, Posterior, ScaleByKind, ScaleUncertainty, joined
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory, moved_similarity
from rangesfm.util.units import TAKEN_FOR_METRES, UNITS_PER_METRE

if TYPE_CHECKING:
    from typing_extensions import Self

    from rangesfm.measurements.ranges.mistakes.bent_path import AnchorSides
    from rangesfm.measurements.ranges.scale.range_estimate import RangeEstimate


# Number of measurements for which it is tried what the others say without them, the most deviating first.
_NUM_SUSPECTS = 3


class Located(ABC):
    """Measurements of one kind in a map, where they are found beside those of all others."""

    kind: ClassVar[str]
    """Name of the kind."""

    @abstractmethod
    def beside(self, others: Sequence[KindOnMap]) -> KindOnMap:
        """Return them on the map, given the kinds that need no others to be found."""


class KindOnMap(Located):
    """Measurements of one kind, located in a map that moves as a whole."""

    shows_bending: ClassVar[bool] = False
    """Whether there are so many of them that they show by how much a map is bent."""

    may_be_in_other_unit: ClassVar[bool] = True
    """Whether a file may have them in another unit without a sign of it in their fit."""

    notes: tuple[str, ...] = ()
    """What is said of them whatever becomes of the map, in words."""

    @property
    def words(self) -> str:
        """What they are, for people."""
        return self.kind

    @property
    def method(self) -> str:
        """How they give a map its scale, if it rests on them first of all."""
        return self.kind

    @property
    def remedy(self) -> str:
        """What to do if they contradict another kind, for people."""
        return f"check the {self.words}"

    @property
    @abstractmethod
    def start(self) -> Similarity:
        """A placement near that by these measurements alone, which few wrong ones do not move."""

    @property
    @abstractmethod
    def alone(self) -> JointMap:
        """The map by these measurements alone, as ``fit_kinds`` finds it."""

    @abstractmethod
    def observed(self, placed: Similarity, *, in_site: bool, max_num: int) -> Observations:
        """Linearise about a placement of the map.

        Args:
            placed: from the world of the map's path to the metric world. in_site: whether that is the site's, in which
                turn and shift of the map are unknowns; else it is the first camera's frame.
            max_num: largest number of observations, where single ones can be averaged.
        """

    @property
    def places_map(self) -> bool:
        """Whether they give the map its place in the site; the others give it metres in the first camera's frame."""
        return False

    @property
    def upward(self) -> Gravity | None:
        """The upward direction in the first camera; None if they do not tell it."""
        return None

    @property
    def is_used(self) -> bool:
        """Whether any of them takes part."""
        return True

    @property
    def left_out(self) -> tuple[int, ...]:
        """Rows of those that contradict all else."""
        return ()

    def tested(self, placed: Similarity, others: Sequence[Observations], *, is_last: bool) -> Self:
        """Return them with those left out that contradict all else.

        Args:
            placed: where the map is. others: observations of the other kinds there.
            is_last: whether it was found before which are left out, so that they are only tested.
        """
        del placed, others, is_last
        return self

    def beside(self, others: Sequence[KindOnMap]) -> Self:
        """Return them as they are."""
        del others
        return self

    def concluded(self, on_map: JointMap) -> Self:
        """Return them with what the whole map says of them."""
        del on_map
        return self

    def moved(self, known: Posterior, bent: FrameSteps = NO_STEPS) -> Self:
        """Return them on the map that was bent by steps, and then moved as a whole to the estimate of a posterior."""
        del known, bent
        return self

    def doubts(self, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
        """Yield faults that make an interval doubtful which rests on them first of all."""
        del uncertainty
        yield from ()

    def remarks(self, on_map: JointMap) -> Iterator[Doubt]:
        """Yield what is to be said of them on a map, without any doubt of its scale."""
        del on_map
        yield from ()

    def tests(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> MistakeTests:
        """Return the tests of mistakes in them.

        Args:
            on_map: all that is measured in the map. by_kind: the scale by each kind alone, where several are used.
        """
        against = self.against_others(on_map, by_kind)
        reasons = tuple(f"{row.words}: {row.remedy}" for row in against if row.rejected)
        return MistakeTests(against, reasons, of_place=reasons if self.places_map else ())

    def against_others(self, on_map: JointMap, by_kind: Mapping[str, ScaleByKind]) -> tuple[MistakeTest, ...]:
        """Return the tests that compare the scale with that by each of the kinds before in the table."""
        before = itertools.takewhile(lambda each: each.kind != self.kind, on_map.kinds)
        used = (each for each in before if {each.kind, self.kind} <= by_kind.keys())
        return tuple(against_other(self, each, by_kind[self.kind], by_kind[each.kind]) for each in used)

    def entry(self, on_map: JointMap) -> Mapping[str, object]:
        """Return their own entry of ``result.json``, whose key is their name; empty without one."""
        del on_map
        return {}

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks in photos to which they refer in the fit of a map that may bend, by name."""
        return {}

    def measurements(self, on_map: JointMap, points: NamedPoints, options: RefineOptions) -> Iterator[Measurements]:
        """Yield them for the fit of a map that may bend, with the noise to begin with.

        Args:
            on_map: all that is measured in the unscaled map as one piece.
            points: of the metric map at the start of the fit, with the poses of its frames, those of the path first.
            options: of the fit.
        """
        del on_map, points, options
        yield from ()

    # What only kinds have that are solved with unknowns of their own, as ranges with their anchors.

    is_solved: ClassVar[bool] = False
    """Whether they were solved with unknowns of their own, so that a map with them is linear about their solution."""

    clock: ClassVar[str] = ""
    """Component of their errors that is due to their clock; a fit that estimates its offset takes it out."""

    def with_their_share(self) -> Self:
        """Return them as they count beside other kinds."""
        return self

    def posterior(self, problem: JointProblem) -> Posterior:
        """Return what they say of the map alone, given the problem of them alone about the placement."""
        return problem.posterior()

    def of_log(self, before: RangeEstimate) -> RangeEstimate:
        """Return what is said of the ranges of the log; what was known before if they are of another kind."""
        return before

    def bends_m(self, on_map: JointMap) -> Array:
        """Return (n,) how far they bend each keyframe of a map that is only scaled; (0,) if they do not."""
        del on_map
        return np.zeros(0)

    def bent(self, on_map: JointMap) -> Iterator[BentMap]:
        """Yield the map where they bend it, if it is only scaled and they show that it drifts."""
        del on_map
        yield from ()

    def sides(self, on_map: JointMap) -> Iterator[AnchorSides]:
        """Yield on which sides of the path anchors stand whose places are not known, if they see such anchors."""
        del on_map
        yield from ()

    @property
    def blocks(self) -> Mapping[Block, Array]:
        """Where they are in the metric world, as anchors, by block."""
        return {}


_Kind = TypeVar("_Kind", bound=KindOnMap)


class BentMap(NamedTuple):
    """A map that is only scaled, where measurements bend it.

    Attributes:
        kind: the measurements on it. placed: the similarity that brings the map nearest to it.
        posterior: what they say of it. doubts, remarks: as of ``KindOnMap``.
    """

    kind: KindOnMap
    placed: Similarity
    posterior: Posterior
    doubts: tuple[Doubt, ...]
    remarks: tuple[Doubt, ...]


@dataclass(frozen=True)
class JointMap:
    """A map with all that is measured in it.

    Attributes:
        kinds: of measurements, in the order of the table; the first that is used decides what is doubtful.
        placed: from the map's world to the metric world, about which all is linear.
        bending: of the map. is_at_rest: whether photos and measurements made it together; otherwise it is moved as one
            piece.
        observed: the observations of the kinds that are used or compared with the map, by kind.
        problem: of all these, with learnt errors. posterior: what they say of the map.
        metres_per_unit: of the unscaled model, in the world of the map.
    """

    kinds: tuple[KindOnMap, ...]
    placed: Similarity
    bending: MapBending
    is_at_rest: bool
    observed: Mapping[str, Observations]
    problem: JointProblem
    posterior: Posterior
    metres_per_unit: float = 1.0

    @property
    def path(self) -> Trajectory:
        """Of the keyframes."""
        return self.bending.path

    @property
    def estimate(self) -> Similarity:
        """From the world of the path to the metric world, at the estimate of the posterior."""
        known = self.posterior
        return moved_similarity(self.placed, known.columns.map_step(known.step), self.path)

    @property
    def by_pose(self) -> Array:
        """(c, 6 n) derivatives by the poses of all observations that are used."""
        return np.vstack([each.by_pose for each in self.observed.values()])[self.problem.is_used]

    @property
    def scale(self) -> ScaleByKind:
        """Metres per unit of the unscaled model, at the estimate."""
        return self.posterior.uncertainty.about(self.estimate.scale * self.metres_per_unit)

    def columns(self, kind: str, of_kind: Array) -> Array:
        """Return the columns (c, m) of the problem by those (k, m) of the observations of one kind."""
        columns = np.zeros((len(self.problem.is_used), of_kind.shape[1]))
        columns[self.problem.rows[kind]] = of_kind
        return columns

    def rejoined(self, kinds: Sequence[KindOnMap], placed: Similarity) -> JointMap:
        """Return the same map with other measurements, placed elsewhere."""
        return join_kinds(kinds, placed, self.bending, is_at_rest=self.is_at_rest)

    def of_log(self, before: RangeEstimate) -> RangeEstimate:
        """Return what is said of the ranges of the log; what was known before if none takes part."""
        for each in self.kinds:
            before = each.of_log(before)
        return before

    def without_clocks(self) -> JointMap:
        """Return the map at rest without the errors of clocks, which its fit has estimated."""
        problem = self.problem
        for each in self.kinds:
            problem = problem.without(each.kind, each.clock) if each.clock else problem
        return replace(self, problem=problem, posterior=problem.posterior(is_refined=True))

    def concluded(self) -> JointMap:
        """Return the map with what it says of each kind."""
        return replace(self, kinds=tuple(kind.concluded(self) for kind in self.kinds))


def against_other(kind: KindOnMap, other: KindOnMap, first: ScaleByKind, second: ScaleByKind) -> MistakeTest:
    """Return the test that compares the scales from two kinds of measurement, in metres per unit of the model."""
    apart = float(np.log(first.value / second.value))
    stddev = float(np.hypot(first.stddev / first.value, second.stddev / second.value))
    smallest = float(np.sqrt(noncentrality(1))) * stddev
    large, small = (kind, other) if apart > 0 else (other, kind)
    by_large, by_small = max(first.value, second.value), min(first.value, second.value)
    unit = _unit_that_explains(large, small, abs(apart), stddev)
    return MistakeTest(
        f"{kind.kind} against {other.kind}",
        "",
        (apart / stddev) ** 2 if np.isfinite(stddev) else 0.0,
        float(special.chdtri(1, FALSE_ALARM_RATE)),
        words=f"by the {large.words} the map is {100 * (by_large / by_small - 1):.1f} % larger than by the "
        f"{small.words} ({by_large:.4g} and {by_small:.4g} m per unit of the model); their errors together explain "
        f"{100 * stddev:.1f} % (1 stddev){unit}",
        remedy=f"{kind.remedy}, and {other.remedy}",
        unit="1",
        size=apart,
        stddev=stddev,
        smallest_detectable=smallest,
        effect_on_scale=smallest,
    )


def _unit_that_explains(large: KindOnMap, small: KindOnMap, apart: float, stddev: float) -> str:
    """Return in which unit the numbers of one kind are, if that explains by how much two kinds differ; else nothing.

    Args:
        large, small: those with the larger and the smaller scale. apart: logarithm of the ratio. stddev: of that.
    """
    for unit, words in TAKEN_FOR_METRES.items():
        per_metre = np.log(UNITS_PER_METRE[unit])
        if abs(apart - per_metre) < SIGNIFICANT_STDDEVS * stddev < per_metre:
            said = f"the {large.words} in {words}" * large.may_be_in_other_unit
            converted = f"the {small.words} in metres that were taken for {words}" * small.may_be_in_other_unit
            return f", and {' or '.join(filter(None, (said, converted)))} would explain it"
    return ""


def find_kind(kinds: Sequence[KindOnMap], kind: type[_Kind]) -> _Kind | None:
    """Return the measurements of a kind among all; None without any."""
    return next((each for each in kinds if isinstance(each, kind)), None)


def compared(kinds: Sequence[KindOnMap]) -> list[KindOnMap]:
    """Return the kinds that are used, and, beside others that place the map in the site, positions there anyway."""
    in_site = any(each.places_map for each in kinds if each.is_used)
    return [each for each in kinds if each.is_used or (in_site and each.places_map)]


def observations(
    kinds: Sequence[KindOnMap], placed: Similarity, max_num: int = MAX_NUM_OBSERVATIONS
) -> list[Observations]:
    """Return the observations of the kinds that are compared, about a placement, of which none crowds out another.

    Args:
        max_num: about the largest number of all together.
    """
    in_site, found, num = any(each.places_map for each in kinds if each.is_used), list[Observations](), 0
    for k, each in reversed(list(enumerate(compared(kinds)))):
        most = max(max_num - num, max_num // 2) if k == 0 else max_num // 2
        found.append(each.observed(placed, in_site=in_site, max_num=most))
        num += len(found[-1].residual_m)
    return found[::-1]


def tested_kinds(
    kinds: Sequence[KindOnMap], placed: Similarity, max_num: int, *, is_last: bool
) -> tuple[KindOnMap, ...]:
    """Return the kinds, each with that left out which contradicts all others; arguments as of ``KindOnMap.tested``.

    Args:
        max_num: as of ``observations``.
    """
    found = observations(kinds, placed, max_num)
    return tuple(
        each.tested(placed, [of for of in found if of.kind != each.kind and of.is_used.any()], is_last=is_last)
        for each in kinds
    )


def most_contradicting(
    rows: Indices, statistic: Callable[[int], float], statistic_without: Callable[[int], float]
) -> tuple[int, float]:
    """Return the measurement that contradicts the others most, and its statistic against them.

    Errors are learnt again without each suspect, as its own error would be taken for theirs.

    Args:
        rows: of the measurements, at least one. statistic: of one, with the errors as they are.
        statistic_without: the same with errors that are learnt from the others.
    """
    suspicious = np.array([statistic(row) for row in rows.tolist()])
    suspects = rows[np.argsort(-suspicious, kind="stable")[:_NUM_SUSPECTS]]
    found = {row: statistic_without(row) for row in suspects.tolist()}
    worst = max(found, key=found.__getitem__)
    return worst, found[worst]


def beside_others(located: Sequence[Located], others: Sequence[KindOnMap]) -> tuple[KindOnMap, ...]:
    """Return all kinds on the map in their order, those that need others to be found beside these."""
    found = {each.kind: each for each in others}
    return tuple(found[each.kind] if each.kind in found else each.beside(others) for each in located)


def join_kinds(
    kinds: Sequence[KindOnMap], placed: Similarity, bending: MapBending, *, is_at_rest: bool = False
) -> JointMap:
    """Join all measurements at a map, and learn their errors; arguments as of ``JointMap``."""
    found, used = observations(kinds, placed), [each for each in kinds if each.is_used]
    problem = joined(found, bending).learnt()
    if is_at_rest:
        known = problem.posterior(is_refined=True)
    else:
        known = used[0].posterior(problem) if len(used) == 1 else problem.posterior()
    observed = {each.kind: each for each in found}
    return JointMap(tuple(kinds), placed, bending, is_at_rest, observed, problem, known)


def fit_kinds(kinds: Sequence[KindOnMap], placed: Similarity, bending: MapBending) -> JointMap:
    """Join all measurements at the placement that they give, starting from another one.

    The equations are not linear in the logarithm of the scale. Kinds that were solved have theirs at their solution.
    """
    for _ in range(1 if any(each.is_solved for each in kinds) else MAX_NUM_ROUNDS):
        found = join_kinds(kinds, placed, bending)
        if abs(found.posterior.step[0]) < NEGLIGIBLE_STDDEVS**2 * found.posterior.uncertainty.empirical:
            break
        placed = found.estimate
    return found


def place_first(kinds: Sequence[KindOnMap]) -> KindOnMap:
    """Return the kind at whose placement a map starts: the first that places it, or the first of all."""
    return next((each for each in kinds if each.places_map), kinds[0])


def upward_by(kinds: Sequence[KindOnMap], given: Gravity | None) -> Gravity | None:
    """Return the upward direction in the first camera as the first kind has it that tells it, or else as given."""
    return next((upward for each in kinds if (upward := each.upward) is not None), given)
