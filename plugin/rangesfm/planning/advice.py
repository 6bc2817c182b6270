"""What to change before going out: each change is made in the plan, and what it gains is computed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.planning.expected import Expected, expect
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.anchors.anchor import Anchor

# Ratios hardly change with coarser cells, and of them there are many to compute.
_NUM_CELLS = 150
_RAISED_M = (1.0, -1.0, 2.0, -2.0)
_UP_AND_DOWN_M, _NUM_WAVES = 0.5, 3
_WIDER = 1.5
_LEARNT_CURVE_M = 0.02
_TAPED_M = (5.0, 0.005)
# Of the nearest other anchor: nearer, a new one says the same.
_NEAR_M = 1.0
# Of a stddev: what changes less is not worth the way.
_LEAST_GAIN = 0.02


@dataclass(frozen=True)
class Advice:
    """One change of a plan, and what would be stated then.

    Attributes:
        kind: which sort of change. subject: what it is made to; an anchor's id, or nothing.
        words: what to do. planned: with the change made.
        scale_stddev: relative. place_stddev_m: of the keyframe known least; inf: open; NaN: no place in a site.
        scale_gain, place_gain: by which share these are less than before; 0 without a place.
    """

    kind: str
    subject: str
    words: str
    planned: PlannedSurvey = field(repr=False)
    scale_stddev: float
    place_stddev_m: float
    scale_gain: float
    place_gain: float


class _Change(NamedTuple):
    kind: str
    subject: str
    words: str
    planned: PlannedSurvey


def advise(expected: Expected) -> tuple[Advice, ...]:
    """All changes of a plan that gain something, in no order."""
    planned = expected.planned
    before = expect(planned, _NUM_CELLS)
    afters = ((change, _expect_or_none(change.planned)) for change in _changes(planned))
    found = (_advice(change, after, before, expected) for change, after in afters if after is not None)
    return tuple(advice for advice in found if max(advice.scale_gain, advice.place_gain) > _LEAST_GAIN)


def ranked(advice: Iterable[Advice], gain: Callable[[Advice], float]) -> list[Advice]:
    """What gains most first, of each kind and subject the best; nothing that gains hardly anything."""
    worthwhile = sorted((each for each in advice if gain(each) > _LEAST_GAIN), key=gain, reverse=True)
    best: dict[tuple[str, str], Advice] = {}
    for each in worthwhile:
        best.setdefault((each.kind, each.subject), each)
    return list(best.values())


def _expect_or_none(planned: PlannedSurvey) -> Expected | None:
    try:
        return expect(planned, _NUM_CELLS)
    except GeometryError:
        return None


def _advice(change: _Change, after: Expected, before: Expected, stated: Expected) -> Advice:
    """The stated numbers, changed by the ratios of the others."""
    scale_ratio = after.uncertainty.empirical / before.uncertainty.empirical
    place_after_m, place_before_m = after.worst_keyframe_m, before.worst_keyframe_m
    is_open = np.isinf(place_before_m) or np.isinf(place_after_m)
    # What is open is still on the site.
    size_m = float(np.linalg.norm(np.ptp(stated.planned.places_m, axis=0)))
    place_ratio = min(place_after_m, size_m) / min(place_before_m, size_m)
    return Advice(
        *change,
        scale_stddev=stated.uncertainty.empirical * scale_ratio,
        place_stddev_m=place_after_m if is_open else stated.worst_keyframe_m * place_ratio,
        scale_gain=1 - scale_ratio,
        place_gain=0.0 if np.isnan(place_after_m) or np.isnan(place_before_m) else 1 - place_ratio,
    )


def _changes(planned: PlannedSurvey) -> Iterator[_Change]:
    yield from _raised(planned)
    yield from _with_one_more(planned)
    path = planned.trajectory
    if not planned.path_is_level:
        up = f"go up and down on the way, by {_UP_AND_DOWN_M:g} m, {_NUM_WAVES} times"
        yield _Change("up and down", "", up, replace(planned, trajectory=_up_and_down(path)))
    wide = f"walk a loop {_WIDER:g} times as wide"
    yield _Change("wider path", "", wide, replace(planned, trajectory=_wider(path)))
    yield _Change("rate", "", "range twice as often", replace(planned, rate_hz=2 * planned.rate_hz))
    if planned.curve_stddev_m is None:
        learn = f"learn the radio's error curve (rangesfm ranges calibrate), to {_LEARNT_CURVE_M:g} m"
        yield _Change("calibration", "", learn, replace(planned, curve_stddev_m=_LEARNT_CURVE_M))
    length_m, stddev_m = _TAPED_M
    tape = f"tape a length of {length_m:g} m to {1000 * stddev_m:g} mm between two points of the map"
    yield _Change("tape", "", tape, replace(planned, taped=(*planned.taped, _TAPED_M)))


def _raised(planned: PlannedSurvey) -> Iterator[_Change]:
    lowest_m, highest_m = planned.heights_m or (min(0.0, float(planned.places_m[:, 2].min())), np.inf)
    for k, anchor in enumerate(planned.anchors):
        for by_m in _RAISED_M:
            place = planned.anchors_m[k] + [0.0, 0.0, by_m]
            if lowest_m <= place[2] <= highest_m:
                moved = (*planned.anchors[:k], replace(anchor, position_m=place), *planned.anchors[k + 1 :])
                how = f"{'raise' if by_m > 0 else 'lower'} anchor {anchor.anchor_id} by {abs(by_m):g} m"
                yield _Change(
                    "anchor height", anchor.anchor_id, f"{how}, to {place[2]:g} m", replace(planned, anchors=moved)
                )


def _with_one_more(planned: PlannedSurvey) -> Iterator[_Change]:
    """At the corners and sides of the box around all, as high as the others mostly are."""
    places = planned.places_m
    low, high = places.min(axis=0), places.max(axis=0)
    height_m = float(np.median(planned.anchors_m[:, 2]))
    stddev_m = float(np.median([anchor.position_stddev_m for anchor in planned.anchors]))
    taken = {anchor.anchor_id for anchor in planned.anchors}
    name = next(name for name in (f"new{number or ''}" for number in range(len(taken) + 1)) if name not in taken)
    for x, y in np.ndindex(3, 3):
        place = np.array([*(low + (high - low) * [x / 2, y / 2, 0.0])[:2], height_m])
        if (x, y) != (1, 1) and np.linalg.norm(planned.anchors_m - place, axis=1).min() > _NEAR_M:
            words = f"add an anchor at {place[0]:.3g}, {place[1]:.3g}, {place[2]:.3g}"
            more = (*planned.anchors, Anchor(name, place, stddev_m))
            yield _Change("one more anchor", "", words, replace(planned, anchors=more))


def _up_and_down(path: Trajectory) -> Trajectory:
    steps = np.linalg.norm(np.diff(path.centers, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    wave = _UP_AND_DOWN_M * np.sin(2 * np.pi * _NUM_WAVES * way / max(float(way[-1]), 1e-9))
    return replace(path, centers=path.centers + wave[:, None] * [0.0, 0.0, 1.0])


def _wider(path: Trajectory) -> Trajectory:
    """About its middle, at the same speed; photos as far apart in time as they were."""
    times = path.timestamps_s
    assert times is not None
    middle = path.centers.mean(axis=0)
    factor = np.array([_WIDER, _WIDER, 1.0])
    centers = middle + (path.centers - middle) * factor
    return replace(path, centers=centers, timestamps_s=times[0] + _WIDER * (times - times[0]))
