"""SurveyPlan: the expected result of a planned survey, in numbers and in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from rangesfm.diagnostics.catalogue import STANDING
from rangesfm.diagnostics.hypothesis_tests import Factorization, MistakeTest, row_of
from rangesfm.diagnostics.linearized import linearized, ranges_on_map
from rangesfm.errors import GeometryError
from rangesfm.planning.advice import Advice, advise, ranked
from rangesfm.planning.expected import OPEN, Expected, expect
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.processes.threads import with_one_blas_thread
from rangesfm.ranging.errors.components import component_words
from rangesfm.ranging.errors.noise import NORMAL_95

REFUSED = "refused"
"""Verdict of a plan whose scale a run will refuse."""
_MAX_NUM_SHOWN = 5
# Columns of a mistake's test that do not depend on the measured ranges.
_SIZES = ("smallest_detectable", "effect_on_scale", "effect_on_place_m")


@dataclass(frozen=True)
class PlannedPlace:
    """Expected uncertainty of the map's placement in the site; inf where it is not determined.

    Attributes:
        stddev_m: (3,) standard deviations of x, y and z of the map's mean.
        heading_stddev_deg: standard deviation of its rotation about z.
        tilt_stddev_deg: standard deviation of its tilt.
        worst_keyframe: index of the least certain keyframe.
        worst_keyframe_stddev_m: root of the summed variances of that keyframe's position.
    """

    stddev_m: tuple[float, float, float]
    heading_stddev_deg: float
    tilt_stddev_deg: float
    worst_keyframe: int
    worst_keyframe_stddev_m: float


@dataclass(frozen=True)
class SurveyPlan:
    """Expected result of a planned survey, as a run will state it.

    Attributes:
        num_ranges: number of ranges that the radio will measure.
        duration_s: duration of the survey.
        anchors_m: position of each anchor in the site, by id.
        frame: frame of the result, "site" or "first_camera".
        scale_stddev: relative standard deviation of the scale.
        scale_stddev_formal: the same if the errors of all ranges were independent.
        scale_interval_95: relative ends of the scale's 95 % interval.
        components: relative standard deviation of the scale from each component of the range errors, by name.
        place: placement in the site; None if the frame is the first camera's.
        keyframe_stddevs_m: (n,) standard deviation of each keyframe's position in the result's frame.
        verdict, reasons: the run's verdict on the scale; also "doubtful" if the run will leave the position open, and
            "refused" if it will refuse the scale.
        mistakes: for each possible mistake the smallest size that would be found, and its effect, the largest effect on
            the scale first; None means without limit.
        advice: changes that would gain something.
        expected: the estimate from which all this is computed.
    """

    num_ranges: int
    duration_s: float
    anchors_m: dict[str, tuple[float, ...]]
    frame: str
    scale_stddev: float
    scale_stddev_formal: float
    scale_interval_95: tuple[float, float]
    components: dict[str, float]
    place: PlannedPlace | None
    keyframe_stddevs_m: tuple[float, ...]
    verdict: str
    reasons: tuple[str, ...]
    mistakes: tuple[MistakeTest, ...]
    advice: tuple[Advice, ...]
    expected: Expected = field(repr=False)

    @property
    def advice_for_scale(self) -> list[Advice]:
        """Changes by their gain for the scale, the largest first."""
        return ranked(self.advice, attrgetter("scale_gain"))

    @property
    def advice_for_place(self) -> list[Advice]:
        """Changes by their gain for the position of the least certain keyframe, the largest first."""
        return ranked(self.advice, attrgetter("place_gain"))

    @property
    def lines(self) -> list[str]:
        """The plan as lines of text for the user."""
        return [*_known(self), *_budget(self), *_found(self), *_advised(self)]

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON, with null for numbers that are not finite, and the advice in both orders."""
        content: dict[str, Any] = _finite(self)
        del content["advice"]
        names = ("name", "subject", "unit", *_SIZES)
        return content | {
            "mistakes": [{name: each[name] for name in names} for each in content["mistakes"]],
            "advice_for_scale": _finite(self.advice_for_scale),
            "advice_for_place": _finite(self.advice_for_place),
        }


@with_one_blas_thread
def plan_survey(planned: PlannedSurvey) -> SurveyPlan:
    """Compute the expected result of a survey by the formulas of a run at the true map, and the changes that gain most.

    Raises:
        GeometryError: there is nothing to compute, because a run will find too few ranges on the path, or no two
            photos that see the same point.
    """
    expected = expect(planned)
    verdict, reasons = _verdict(expected)
    half_width = expected.uncertainty.half_width_95
    return SurveyPlan(
        num_ranges=planned.num_ranges,
        duration_s=planned.duration_s,
        anchors_m={a.anchor_id: tuple(at.tolist()) for a, at in zip(planned.anchors, planned.anchors_m, strict=True)},
        frame=expected.frame,
        scale_stddev=expected.uncertainty.empirical,
        scale_stddev_formal=expected.uncertainty.formal,
        scale_interval_95=(float(np.expm1(-half_width)), float(np.expm1(half_width))),
        components=expected.uncertainty.components,
        place=_place(expected),
        keyframe_stddevs_m=tuple(expected.keyframe_stddevs_m.tolist()),
        verdict=verdict,
        reasons=reasons,
        mistakes=_mistakes(expected),
        advice=advise(expected),
        expected=expected,
    )


def _verdict(expected: Expected) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of the run on scale and position, and its reasons."""
    try:
        verdict = expected.verdict
    except GeometryError as error:
        return REFUSED, (str(error), *error.advice)
    open_place = expected.mirror_image()
    if open_place is None:
        return verdict.verdict, tuple(verdict.reasons)
    return "doubtful", (f"a run will give the scale only: {open_place}", *verdict.reasons)


def _place(expected: Expected) -> PlannedPlace | None:
    of_map, of_keyframes = expected.map_stddevs, expected.keyframe_stddevs_m
    if of_map is None:
        return None
    x_m, y_m, z_m = of_map[4:].tolist()
    return PlannedPlace(
        stddev_m=(x_m, y_m, z_m),
        heading_stddev_deg=float(np.rad2deg(of_map[3])),
        tilt_stddev_deg=float(np.rad2deg(np.linalg.norm(of_map[1:3]))),
        worst_keyframe=int(np.argmax(of_keyframes)),
        worst_keyframe_stddev_m=float(of_keyframes.max()),
    )


def _mistakes(expected: Expected) -> tuple[MistakeTest, ...]:
    """Return a row for every possible mistake that lasts for the whole survey, without test statistics.

    Nothing has been measured yet, so that there is nothing to test. The sizes and effects are known all the same.
    """
    ranges = expected.ranges
    if ranges is None:
        return ()
    on_map = ranges_on_map(ranges.posed, ranges.solution, ranges.observations, expected.planned.trajectory, None)
    problem = replace(linearized(on_map, expected.learned.bins), errors=expected.learned)
    hypotheses = [hypothesis for of_kind in STANDING for hypothesis in of_kind(problem)]
    found = []
    for test in Factorization(problem).test(hypotheses, seed=0):
        row = row_of(test)
        unlimited: dict[str, Any] = {name: None for name in _SIZES if (getattr(row, name) or 0.0) > OPEN}
        found.append(replace(row, **unlimited))
    return tuple(sorted(found, key=lambda each: -np.inf if each.effect_on_scale is None else -each.effect_on_scale))


def _known(plan: SurveyPlan) -> Iterator[str]:
    low, high = (100 * end for end in plan.scale_interval_95)
    yield f"{plan.num_ranges} ranges in {plan.duration_s:.0f} s, result in the {plan.frame.replace('_', ' ')}'s frame"
    places = (f"{name} {', '.join(f'{x:.4g}' for x in place)}" for name, place in plan.anchors_m.items())
    yield f"anchors at {'; '.join(places)}"
    yield f"scale: {low:+.2g} to {high:+.2g} % (95 %); {plan.verdict}"
    yield from (f"  {reason}" for reason in plan.reasons)
    if plan.place is not None:
        place = plan.place
        x, y, z = (_half_width_95(stddev_m) for stddev_m in place.stddev_m)
        yield (
            f"place: x {x}, y {y}, z {z}, heading {_half_width_95(place.heading_stddev_deg, 'deg')}, tilt "
            f"{_half_width_95(place.tilt_stddev_deg, 'deg')}; keyframe {place.worst_keyframe + 1} is known least, to "
            f"{_half_width_95(place.worst_keyframe_stddev_m)} (95 %)"
        )


def _budget(plan: SurveyPlan) -> Iterator[str]:
    largest = sorted(plan.components.items(), key=lambda item: -item[1])[:_MAX_NUM_SHOWN]
    words = component_words(name for name, _ in largest)
    parts = (f"{words[name]} {100 * NORMAL_95 * stddev:.2g} %" for name, stddev in largest)
    yield f"what makes the scale uncertain (95 % each): {', '.join(parts)}"


def _found(plan: SurveyPlan) -> Iterator[str]:
    yield "mistakes just too small to be found, and their largest effects:"
    of_kind: dict[str, MistakeTest] = {}
    for mistake in plan.mistakes:
        of_kind.setdefault(mistake.name, mistake)
    for mistake in list(of_kind.values())[:_MAX_NUM_SHOWN]:
        what = f"  {mistake.name} {mistake.subject}".rstrip()
        if mistake.smallest_detectable is None:
            yield f"{what}: never found, whatever its size"
            continue
        unit = "" if mistake.unit == "1" else f" {mistake.unit}"
        scale = "open" if mistake.effect_on_scale is None else f"{100 * mistake.effect_on_scale:.2g} %"
        place_m = np.inf if mistake.effect_on_place_m is None else mistake.effect_on_place_m
        yield f"{what}: {mistake.smallest_detectable:.2g}{unit}; scale {scale}, place {_rough(place_m)}"


def _advised(plan: SurveyPlan) -> Iterator[str]:
    if not plan.advice:
        yield "no single change gains much"
    for_scale = [f"{each.words}: +-{100 * NORMAL_95 * each.scale_stddev:.2g} %" for each in plan.advice_for_scale]
    for_place = [f"{each.words}: {_half_width_95(each.place_stddev_m)}" for each in plan.advice_for_place]
    for what, best in {"the scale": for_scale, "the place of the keyframe known least": for_place}.items():
        if best:
            yield f"what would gain most for {what} (95 %):"
        yield from (f"  {number}. {words}" for number, words in enumerate(best[:_MAX_NUM_SHOWN], 1))


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
