"""SurveyPlan: the expected result of a planned survey, in numbers and in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.diagnostics.place import place_in_words
from rangesfm.errors import GeometryError
from rangesfm.estimation.vision_information import VisionInformation
from rangesfm.measurements.kinds_in_words import component_words
from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.measurements.mistakes import MistakeTest
from rangesfm.planning.advice import Advice, advise, ranked
from rangesfm.planning.expected import Expected, expect
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_ranges import SIZES, mistakes, why_place_is_open
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.processes.threads import with_one_blas_thread

REFUSED, OPEN_PLACE = "refused", "open"
"""Verdicts of a plan: a run will refuse the scale; it will leave open where the map is."""
# Most lines of a list, of changes that are advised for one purpose or of mistakes; most components in a line.
_NUM_LINES, _NUM_COMPONENTS = 8, 5


@dataclass(frozen=True)
class PlannedPlace:
    """Expected uncertainty of the map's placement in the site; inf where it is not determined.

    Attributes:
        verdict: "good" or "doubtful" as in a run, or "open": a run will give the scale only. reasons: why, in words.
        stddev_m: (3,) standard deviations of x, y and z of the map's mean.
        heading_stddev_deg: standard deviation of its rotation about z.
        tilt_stddev_deg: standard deviation of its tilt.
        worst_keyframe: index of the least certain keyframe.
        worst_keyframe_stddev_m: root of the summed variances of that keyframe's position.
    """

    verdict: str
    reasons: tuple[str, ...]
    stddev_m: tuple[float, float, float]
    heading_stddev_deg: float
    tilt_stddev_deg: float
    worst_keyframe: int
    worst_keyframe_stddev_m: float


@dataclass(frozen=True)
class SurveyPlan:
    """Expected result of a planned survey, as a run will state it.

    Attributes:
        expected: what the run will state of its map.
        place: placement in the site; None if the frame is the first camera's.
        verdict, reasons: the run's verdict on the scale; "refused" if it will refuse the scale.
        by_kind: what is expected by each kind of measurement alone, by its name; empty where the plan has one kind.
        mistakes: for each possible mistake the smallest size that would be found (inf: no size that can happen), and
            the largest effect of a mistake that is not found, the largest on the scale first (inf: without limit).
        advice: changes that would gain something.
    """

    expected: Expected
    place: PlannedPlace | None
    verdict: str
    reasons: tuple[str, ...]
    by_kind: dict[str, Expected]
    mistakes: tuple[MistakeTest, ...]
    advice: tuple[Advice, ...]

    @property
    def anchors_m(self) -> dict[str, Array]:
        """Position (3,) of each anchor in the site, by id."""
        planned = self.expected.planned
        return dict(zip((anchor.anchor_id for anchor in planned.anchors), planned.anchors_m, strict=True))

    @property
    def scale_interval_95(self) -> tuple[float, float]:
        """Relative ends of the scale's 95 % interval."""
        low, high = self.expected.uncertainty.interval_95
        return float(np.expm1(low)), float(np.expm1(high))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is odd about the plan, and what a run will leave out."""
        return (*self.expected.planned.warnings, *(() if self.expected.on_map is None else self.expected.notes))

    @property
    def advice_for_scale(self) -> list[Advice]:
        """Changes by their gain for the scale, the largest first."""
        return ranked(self.advice, attrgetter("scale_gain"))[:_NUM_LINES]

    @property
    def advice_for_place(self) -> list[Advice]:
        """Changes by their gain for the position of the least certain keyframe, the largest first."""
        return ranked(self.advice, attrgetter("place_gain"))[:_NUM_LINES]

    @property
    def without_advice(self) -> str:
        """Words in place of advice; empty if there is some."""
        if self.advice:
            return ""
        if self.verdict == REFUSED:
            return (
                "no single change is enough: walk farther, range more often, and survey three anchors or control points"
            )
        return "no single change gains much"

    @property
    def largest_mistakes(self) -> list[MistakeTest]:
        """Mistakes with the largest effects, one of each kind."""
        of_kind: dict[str, MistakeTest] = {}
        for mistake in self.mistakes:
            of_kind.setdefault(mistake.name, mistake)
        return list(of_kind.values())[:_NUM_LINES]

    @property
    def lines(self) -> list[str]:
        """The plan as lines of text for the user."""
        return [*_known(self), *_alone(self), *_budget(self), *_found(self), *_advised(self)]

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON, with null for numbers that are not finite, and the advice in both orders."""
        expected, names = self.expected, ("name", "subject", "unit", *SIZES)
        planned, uncertainty = expected.planned, expected.uncertainty
        content = {
            "num_ranges": planned.num_ranges,
            "duration_s": planned.duration_s,
            "anchors_m": {name: at.tolist() for name, at in self.anchors_m.items()},
            "frame": expected.frame,
            "scale_stddev": uncertainty.empirical,
            "scale_stddev_formal": uncertainty.formal,
            "scale_interval_95": self.scale_interval_95,
            "components": uncertainty.components,
            "place": self.place,
            "keyframe_stddevs_m": expected.keyframe_stddevs_m.tolist(),
            "verdict": self.verdict,
            "reasons": self.reasons,
            "up_stddev_deg": expected.up_stddev_deg,
            "by_kind": {
                kind: {"scale_stddev": each.uncertainty.empirical, "worst_keyframe_stddev_m": each.worst_keyframe_m}
                for kind, each in self.by_kind.items()
            },
            "warnings": self.warnings,
            "mistakes": [{name: getattr(each, name) for name in names} for each in self.mistakes],
            "advice_for_scale": self.advice_for_scale,
            "advice_for_place": self.advice_for_place,
        }
        return {name: _finite(value) for name, value in content.items()}


@with_one_blas_thread
def plan_survey(planned: PlannedSurvey) -> SurveyPlan:
    """Compute the expected result of a survey by the formulas of a run at the true map, and the changes that gain most.

    A survey that a run would refuse has a plan as well, whose advice says what would make it possible.
    """
    expected, alone = _expect(planned), planned.by_kind
    verdict, reasons = _verdict(expected)
    return SurveyPlan(
        expected,
        _place(expected),
        verdict,
        reasons,
        by_kind={kind: _expect(each, expected.vision) for kind, each in alone.items()} if len(alone) > 1 else {},
        mistakes=() if expected.on_map is None else mistakes(expected.on_map),
        advice=advise(expected),
    )


def _expect(planned: PlannedSurvey, vision: VisionInformation | None = None) -> Expected:
    try:
        return expect(planned, vision=vision)
    except GeometryError as error:
        return Expected(replace(planned, photos=None), None, None, (str(error),))


def _verdict(expected: Expected) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of the run on the scale, and its reasons."""
    try:
        verdict = expected.verdict
    except GeometryError as error:
        return REFUSED, (str(error), *error.advice)
    return verdict.verdict, tuple(verdict.reasons)


def _place(expected: Expected) -> PlannedPlace | None:
    of_map, of_keyframes = expected.map_stddevs, expected.keyframe_stddevs_m
    if of_map is None:
        return None
    size_m = float(np.linalg.norm(np.ptp(expected.planned.places_m, axis=0)))
    words, is_wide = place_in_words(of_map, float(of_keyframes.max()), size_m)
    verdict, reasons = "doubtful" if is_wide else "good", [words]
    if expected.on_map is None:
        verdict, reasons = OPEN_PLACE, ["a run will not place the map: it will refuse its scale"]
    elif open_place := why_place_is_open(expected.on_map):
        verdict, reasons = OPEN_PLACE, [f"a run will give metres, but no place in the site: {open_place}", words]
    x_m, y_m, z_m = of_map[4:].tolist()
    return PlannedPlace(
        verdict=verdict,
        reasons=tuple(reasons),
        stddev_m=(x_m, y_m, z_m),
        heading_stddev_deg=float(np.rad2deg(of_map[3])),
        tilt_stddev_deg=float(np.rad2deg(np.linalg.norm(of_map[1:3]))),
        worst_keyframe=int(np.argmax(of_keyframes)),
        worst_keyframe_stddev_m=float(of_keyframes.max()),
    )


def size_in_words(size: float, unit: str) -> str:
    """Return the size of a mistake, with a fraction as a percentage; "never found" where no size would be found."""
    if not np.isfinite(size):
        return "never found"
    return f"{100 * size:.2g} %" if unit == "1" else f"{size:.2g} {unit}"


def _known(plan: SurveyPlan) -> Iterator[str]:
    low, high = (100 * end for end in plan.scale_interval_95)
    expected, planned = plan.expected, plan.expected.planned
    of_anchors = f"{planned.num_ranges} ranges in {planned.duration_s:.0f} s, " if planned.anchors else ""
    yield f"{of_anchors}result in the {expected.frame.replace('_', ' ')}'s frame"
    if planned.anchors:
        places = (f"{name} {planned.site.place_text(place)}" for name, place in plan.anchors_m.items())
        yield f"anchors at {'; '.join(places)}{planned.axes}"
    interval = f"{low:+.2g} to {high:+.2g} % (95 %)" if np.isfinite(high) else "open"
    yield f"scale: {plan.verdict}; {interval}"
    yield from (f"  {reason}" for reason in plan.reasons)
    if expected.up_stddev_deg is not None:
        yield f"vertical: {_half_width_95(expected.up_stddev_deg, 'deg')} (95 %), by the inertial sensor"
    if plan.place is None:
        yield "place: none, as neither surveyed anchors nor known positions say where the map is in the site"
        return
    place = plan.place
    x, y, z = (_half_width_95(stddev_m) for stddev_m in place.stddev_m)
    yield f"place: {place.verdict}" + (
        f"; x {x}, y {y}, z {z}, heading {_half_width_95(place.heading_stddev_deg, 'deg')}, tilt "
        f"{_half_width_95(place.tilt_stddev_deg, 'deg')}; the least certain keyframe is number "
        f"{place.worst_keyframe + 1}, with {_half_width_95(place.worst_keyframe_stddev_m)} (95 %)"
        if np.isfinite(place.stddev_m).any()
        else ""
    )
    yield from (f"  {reason}" for reason in place.reasons)


def _alone(plan: SurveyPlan) -> Iterator[str]:
    for kind, alone in plan.by_kind.items():
        scale = f"scale +-{_rough(100 * NORMAL_95 * alone.uncertainty.empirical, '%')}"
        is_placed = not np.isnan(alone.worst_keyframe_m)
        place = f", least certain keyframe {_half_width_95(alone.worst_keyframe_m)}" if is_placed else ", no place"
        yield f"{kind} alone (95 %): {scale}{place}"


def _budget(plan: SurveyPlan) -> Iterator[str]:
    largest = sorted(plan.expected.uncertainty.components.items(), key=lambda item: -item[1])[:_NUM_COMPONENTS]
    words = component_words(name for name, _ in largest)
    parts = [f"{words[name]} {100 * NORMAL_95 * stddev:.2g} %" for name, stddev in largest]
    if parts:
        yield f"what makes the scale uncertain (95 % each): {', '.join(parts)}"


def _found(plan: SurveyPlan) -> Iterator[str]:
    if plan.mistakes:
        yield "mistakes just too small to be found, and their largest effects:"
    for mistake in plan.largest_mistakes:
        size = size_in_words(mistake.smallest_detectable, mistake.unit)
        scale, place = _rough(100 * mistake.effect_on_scale, "%"), _rough(mistake.effect_on_place_m)
        yield f"  {mistake_in_words(mistake.name, mistake.subject)}: {size}; scale {scale}, place {place}"


def _advised(plan: SurveyPlan) -> Iterator[str]:
    if plan.without_advice:
        yield plan.without_advice
    for_scale = [f"{each.words}: +-{100 * NORMAL_95 * each.scale_stddev:.2g} %" for each in plan.advice_for_scale]
    for_place = [f"{each.words}: {_half_width_95(each.place_stddev_m)}" for each in plan.advice_for_place]
    now_m = np.inf if plan.place is None else plan.place.worst_keyframe_stddev_m
    scale, place = f"+-{_rough(100 * NORMAL_95 * plan.expected.uncertainty.empirical, '%')}", _half_width_95(now_m)
    purposes = {
        f"the scale, now {scale}": for_scale,
        f"the place of the least certain keyframe, now {place}": for_place,
    }
    for what, best in purposes.items():
        if best:
            yield f"what would gain most for {what} (95 %):"
        yield from (f"  {number}. {words}" for number, words in enumerate(best, 1))


def _half_width_95(stddev: float, unit: str = "m") -> str:
    return _rough(NORMAL_95 * stddev, unit)


def _rough(size: float, unit: str = "m") -> str:
    return f"{size:.2g} {unit}" if np.isfinite(size) else "open"


def _finite(value: Any) -> Any:
    if is_dataclass(value):
        value = {part.name: getattr(value, part.name) for part in fields(value) if part.repr}
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
