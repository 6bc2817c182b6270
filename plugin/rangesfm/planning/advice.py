"""Advice on a plan: each possible change is made in the plan, and its gain is computed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.diagnostics.preflight import SAME_PLACE_M
from rangesfm.errors import GeometryError
from rangesfm.measurements.imu.words import IMU
from rangesfm.measurements.lengths.tape import CONTROL
from rangesfm.measurements.positions.control_points import ControlPoint
from rangesfm.measurements.positions.known_positions import MIN_NUM_POSITIONS
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.errors.components import COMPONENTS
from rangesfm.measurements.ranges.scale.doubts import CALIBRATE, FEW_RANGES
from rangesfm.options import PointOptions
from rangesfm.planning.expected import Expected, expect_roughly
from rangesfm.planning.paths import NUM_WAVES, way_along
from rangesfm.planning.placement import LEAST_GAIN, spread_places
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.planning.walls import AT_WALL_M, lead_through
from rangesfm.survey.kinds_in_map import KINDS
from rangesfm.util.geometry.similarity import NEARLY_STRAIGHT, path_shape
from rangesfm.util.geometry.trajectory import Trajectory

# Changes of an anchor's height that are tried, metres.
_RAISED_M = (1.0, -1.0, 2.0, -2.0)
# A camera is carried no higher above the ground than this, metres: on a pole.
_CARRIED_M = 3.0
# Amplitude, metres, of a path that goes up and down.
_UP_AND_DOWN_M = 0.5
# Angle, degrees, by which a camera is tilted up, down and to the sides, so that gravity shows the scale of all axes.
_TILTED_DEG = 20.0
# Factor by which a path or the anchors are spread out.
_WIDER = 1.5
# Standard deviation of the radio's error curve after a calibration, metres.
_LEARNT_CURVE_M = 0.02
# A taped length and its standard deviation, metres.
_TAPED_M = (5.0, 0.005)
# Standard deviation of the coordinates of surveyed anchors, metres.
_SURVEYED_M = 0.02
# Fewest photos that show a control point, so that marks in some may fail; number of places that are tried for one.
_MIN_NUM_SHOWING, _NUM_TRIED_POINTS = 3, 24
# With few ranges, ranging so many times as often is worth trying, and so is walking the path so many times.
_MORE_OFTEN, _NUM_AGAIN = (10, 50), 5
# Number of changes that a result recommends.
_NUM_BEST = 3
# Number of places, of all allowed ones, that are tried for an anchor.
_NUM_PLACES = 8
# How many times as certain a change must make a result for a warning after a survey to tell it.
_WORTH_SAYING = 1.2


@dataclass(frozen=True)
class Advice:
    """One change of a plan, and the uncertainty that a run would then state.

    Attributes:
        kind: kind of change.
        subject: id of the anchor that is changed, or empty.
        words: what to do, for the user.
        planned: the plan with the change.
        scale_stddev: relative standard deviation of the scale.
        place_stddev_m: standard deviation of the position of the least certain keyframe; inf if the position is not
            determined, NaN if the result is not in a site frame.
        scale_gain, place_gain: relative reduction of these; 0 for the position if there is none.
    """

    kind: str
    subject: str
    words: str
    planned: PlannedSurvey = field(repr=False)
    scale_stddev: float
    place_stddev_m: float
    scale_gain: float
    place_gain: float


_Change = tuple[str, str, str, PlannedSurvey]
"""Kind, subject and words of an Advice, and the plan with the change made."""


def advise(expected: Expected) -> tuple[Advice, ...]:
    """Return all changes of a plan that gain something, in no particular order.

    What the photos see is assumed to be the same with each change.
    """
    planned = expected.planned
    before = expected if expected.on_map is None else expect_roughly(planned, expected.vision)

    def tried(changes: Iterable[_Change]) -> Iterator[Advice]:
        for change in changes:
            if not _leads_through_walls(planned, change[3]):
                with suppress(GeometryError):  # a run will find too few ranges
                    yield _advice(change, expect_roughly(change[3], expected.vision), before, expected)

    more = list(tried(_with_one_more(planned)))
    # The place where one more anchor gains most for the scale, and that for the position if it is another.
    best = [max(more, key=attrgetter(gain)) for gain in ("scale_gain", "place_gain") if more]
    places = list({id(each): each.planned.anchors_m[-1] for each in best}.values())
    found = [*more, *tried(_moved(planned, places)), *tried(_changes(planned))]
    return tuple(advice for advice in found if max(advice.scale_gain, advice.place_gain) > LEAST_GAIN)


def best_words(advice: Sequence[Advice], *, for_scale: bool, for_place: bool) -> list[str]:
    """Return lines with the changes that gain most for the scale, then for the position, with the gain of each."""
    gains: dict[str, list[str]] = {}
    for what, is_wanted in (("scale", for_scale), ("place", for_place)):
        gain = attrgetter(f"{what}_gain")
        for each in ranked(advice, gain)[:_NUM_BEST] if is_wanted else ():
            if (times := 1 / (1 - gain(each))) > _WORTH_SAYING:
                said = f"the {what} would be {times:.2g} times as certain"
                gains.setdefault(each.words, []).append(said)
    return [f"{words}: {', '.join(gained)}" for words, gained in gains.items()]


def ranked(advice: Sequence[Advice], gain: Callable[[Advice], float]) -> list[Advice]:
    """Return the best change of each kind and subject, the largest gain first, without changes that hardly gain."""
    worthwhile = sorted((each for each in advice if gain(each) > LEAST_GAIN), key=gain, reverse=True)
    best: dict[tuple[str, str], Advice] = {}
    for each in worthwhile:
        best.setdefault((each.kind, each.subject), each)
    return list(best.values())


def _advice(change: _Change, after: Expected, before: Expected, stated: Expected) -> Advice:
    """Return the advice for a change: the stated standard deviations times the ratios of the two quick computations.

    Args:
        after, before: quick computations with and without the change.
        stated: the full computation without the change.
    """
    scale_before, scale_after = before.uncertainty.empirical, after.uncertainty.empirical
    after_m, before_m, stated_m = after.worst_keyframe_m, before.worst_keyframe_m, stated.worst_keyframe_m
    # A position that is not determined, or of a map without a place, is still known to be on the site.
    size_m = float(np.linalg.norm(np.ptp(stated.planned.places_m, axis=0)))
    place_ratio = float(np.fmin(after_m, size_m) / np.fmin(before_m, size_m))
    is_known = np.isfinite([after_m, before_m]).all()
    return Advice(
        *change,
        scale_stddev=stated.uncertainty.empirical * scale_after / scale_before
        if np.isfinite(scale_before)
        else scale_after,
        place_stddev_m=place_ratio * stated_m if is_known else after_m,
        scale_gain=1 - scale_after / scale_before,
        place_gain=1 - place_ratio,
    )


def _changes(planned: PlannedSurvey) -> Iterator[_Change]:
    yield from _raised(planned)
    path = planned.trajectory
    if planned.anchor_frame == "unknown" and len(planned.anchors) > 2:
        known = tuple(replace(anchor, position_stddev_m=_SURVEYED_M) for anchor in planned.anchors)
        survey = f"survey the anchors, to {_SURVEYED_M:g} m"
        yield "anchor survey", "", survey, replace(planned, anchors=known, anchor_frame="site")
    if not planned.path_is_level:
        up = f"go up and down on the way, by {_UP_AND_DOWN_M:g} m, {NUM_WAVES} times"
        yield "up and down", "", up, replace(planned, trajectory=_up_and_down(path))
    if path_shape(path.centers).stddevs[1] < NEARLY_STRAIGHT * path_shape(path.centers).stddevs[0]:
        bent, off_m = _bent(path)
        yield "bend", "", f"walk a bend, up to {off_m:.2g} m off the line", replace(planned, trajectory=bent)
    for factor in (_WIDER, 1 + (_WIDER - 1) / 2):
        yield "wider path", "", f"walk {factor:g} times as wide", replace(planned, trajectory=_wider(path, factor))
    if planned.anchors:
        yield "rate", "", "range twice as often", replace(planned, rate_hz=2 * planned.rate_hz)
    if not len(planned.allowed_m) and planned.anchors:
        moved = zip(planned.anchors, _farther_out(path, planned.anchors_m, _WIDER), strict=True)
        spread = replace(planned, anchors=tuple(replace(anchor, position_m=at) for anchor, at in moved))
        yield "wider anchors", "", f"put the anchors {_WIDER:g} times as far out", spread
    if planned.curve_stddev_m is None and planned.anchors:
        # The calibration changes some of the error components, whose given values then do not hold.
        taken = {component.name for component in COMPONENTS if component.calibrated_median is not None}
        left = {name: stddev for name, stddev in planned.component_stddevs.items() if name not in taken}
        calibrated = replace(planned, curve_stddev_m=_LEARNT_CURVE_M, component_stddevs=left)
        yield "calibration", "", f"{CALIBRATE}, to {_LEARNT_CURVE_M:g} m", calibrated
    if planned.num_ranges < FEW_RANGES and planned.anchors:
        again = f"walk the path {_NUM_AGAIN} times, there and back"
        if len(path) > 1:
            yield "again", "", again, replace(planned, trajectory=_there_and_back(path, _NUM_AGAIN))
        for factor in _MORE_OFTEN:
            often = replace(planned, rate_hz=factor * planned.rate_hz)
            yield "rate", "", f"range {factor} times as often", often
    for kind, more in ((kind.words, kind.planned) for kind in KINDS if planned.times_are_known):
        if more is not None and more.advice and kind.kind not in planned.others:
            yield kind.words, "", more.advice, replace(planned, others={**planned.others, kind.kind: more()})
    if IMU in planned.others:
        tilt = f"tilt the camera up, down and to the sides on the way, by {_TILTED_DEG:g} degrees, {NUM_WAVES} times"
        yield "tilted camera", "", tilt, replace(planned, trajectory=_tilted(path))
    yield from _with_control_points(planned)
    length_m, stddev_m = _TAPED_M
    tape = f"tape a length of {length_m:g} m to {1000 * stddev_m:g} mm between two points of the map"
    if planned.anchors or planned.others:
        yield "tape", "", tape, replace(planned, taped=(*planned.taped, _TAPED_M))


def _leads_through_walls(before: PlannedSurvey, after: PlannedSurvey) -> bool:
    """Return whether an anchor or a keyframe moves through a wall, or a keyframe nearer to it than people walk."""
    start = before.trajectory.centers[:, :2]
    end = after.trajectory.centers[: len(start), :2]  # a path that is walked again begins with itself
    moved_m = np.linalg.norm(end - start, axis=1, keepdims=True)
    end = end + AT_WALL_M * (end - start) / np.maximum(moved_m, AT_WALL_M)
    num = min(len(before.anchors), len(after.anchors))  # a new anchor moves nowhere
    start = np.vstack([start, before.anchors_m[:num, :2]])
    end = np.vstack([end, after.anchors_m[:num, :2]])
    return bool(lead_through(start, end, before.walls_m).any())


def _farther_out(path: Trajectory, places_m: Array, factor: float) -> Array:
    """Return places (n, 3) moved horizontally away from the mean of the path, by a factor."""
    middle = path.centers.mean(axis=0)
    return np.asarray(middle + (places_m - middle) * [factor, factor, 1.0])


def _raised(planned: PlannedSurvey) -> Iterator[_Change]:
    lowest_m, highest_m = planned.heights_m or (_ground_m(planned), np.inf)
    for k, anchor in enumerate(planned.anchors):
        for by_m in _RAISED_M:
            place = planned.anchors_m[k] + [0.0, 0.0, by_m]
            if lowest_m <= place[2] <= highest_m:
                verb = "raise" if by_m > 0 else "lower"
                height = f"{planned.site.height_text(place)} m{planned.level}"
                words = f"{verb} anchor {anchor.anchor_id} by {abs(by_m):g} m, to {height}"
                yield "anchor height", anchor.anchor_id, words, planned.with_anchor_at(k, place)


def _ground_m(planned: PlannedSurvey) -> float:
    """Return the height of the ground: 0, unless something is lower, or all is higher than a camera is carried."""
    lowest_m = float(planned.places_m[:, 2].min())
    return lowest_m if lowest_m > _CARRIED_M else min(0.0, lowest_m)


def _moved(planned: PlannedSurvey, places: Sequence[Array]) -> Iterator[_Change]:
    """Yield the plan with each anchor moved to each of some allowed places."""
    for k, anchor in enumerate(planned.anchors if len(planned.allowed_m) else ()):
        for place in places:
            words = f"move anchor {anchor.anchor_id} to {planned.site.place_text(place)}{planned.axes}"
            yield "anchor place", anchor.anchor_id, words, planned.with_anchor_at(k, place)


def _with_one_more(planned: PlannedSurvey) -> Iterator[_Change]:
    if not planned.anchors:
        return
    stddev_m = float(np.median([anchor.position_stddev_m for anchor in planned.anchors]))
    taken = {anchor.anchor_id for anchor in planned.anchors}
    name = next(name for name in (f"new{number or ''}" for number in range(len(taken) + 1)) if name not in taken)
    for place in _free_places(planned):
        more = (*planned.anchors, Anchor(name, place, stddev_m))
        words = f"add an anchor at {planned.site.place_text(place)}{planned.axes}"
        yield "one more anchor", "", words, replace(planned, anchors=more)


def _with_control_points(planned: PlannedSurvey) -> Iterator[_Change]:
    """Yield the plan with three more control points, far apart, in front of photos that show them."""
    photos, path = planned.photos or PlannedPhotos(), planned.trajectory
    some = np.unique(np.linspace(0, len(path) - 1, _NUM_TRIED_POINTS).astype(np.int64))
    places = photos.aside(path, some)
    from_m = np.tile(path.centers[some], (2, 1))
    is_in_site = ~lead_through(from_m[:, :2], places[:, :2], planned.walls_m)
    if len(planned.anchors) >= MIN_NUM_POSITIONS:  # they show where the site ends
        low, high = planned.places_m.min(axis=0), planned.places_m.max(axis=0)
        is_in_site &= np.all((places >= low) & (places <= high), axis=1)
    places = places[is_in_site & (photos.num_showing(path, places) >= _MIN_NUM_SHOWING)]
    if len(places) < MIN_NUM_POSITIONS:
        return
    taken = {point.name for point in planned.points}
    names = [name for name in (f"C{k}" for k in range(1, len(taken) + MIN_NUM_POSITIONS + 1)) if name not in taken]
    outermost_first = np.argsort(-np.linalg.norm(places - places.mean(axis=0), axis=1), kind="stable")
    spread = spread_places(MIN_NUM_POSITIONS, places[outermost_first])
    stddev_m = PointOptions().stddev_m
    more = tuple(ControlPoint(name, at, stddev_m, CONTROL, 0) for name, at in zip(names, spread, strict=False))
    where = "; ".join(map(planned.site.place_text, spread)) + planned.axes
    words = f"survey three control points that the photos show, such as {where}, to {stddev_m:g} m"
    anchor_frame = "site" if planned.anchor_frame == "site" else "unknown"
    with_points = replace(planned, points=(*planned.points, *more), anchor_frame=anchor_frame)
    yield "control points", "", words, with_points


def _free_places(planned: PlannedSurvey) -> list[Array]:
    """Return places for an anchor where no other one is.

    They are the allowed places farthest apart. If none are given, they are eight points on the outline of the box
    around path and anchors, at the anchors' median height.
    """
    if len(planned.allowed_m):
        spread = spread_places(min(_NUM_PLACES, len(planned.allowed_m)), planned.allowed_m)
    else:
        low, high = planned.places_m.min(axis=0), planned.places_m.max(axis=0)
        height_m = float(np.median(planned.anchors_m[:, 2]))
        grid = [low + (high - low) * [x / 2, y / 2, 0.0] for x, y in np.ndindex(3, 3) if (x, y) != (1, 1)]
        spread = np.array(grid) * [1.0, 1.0, 0.0] + [0.0, 0.0, height_m]
    return [place for place in spread if np.linalg.norm(planned.anchors_m - place, axis=1).min() > SAME_PLACE_M]


def _up_and_down(path: Trajectory) -> Trajectory:
    way = way_along(path.centers)
    wave = _UP_AND_DOWN_M * np.sin(2 * np.pi * NUM_WAVES * way / max(float(way[-1]), 1e-9))
    return replace(path, centers=path.centers + wave[:, None] * [0.0, 0.0, 1.0])


def _tilted(path: Trajectory) -> Trajectory:
    """Return a path on which the camera looks up and down, and leans to both sides in between."""
    way = way_along(path.centers)
    phase = 2 * np.pi * NUM_WAVES * way / max(float(way[-1]), 1e-9)
    tilts = Rotation.from_euler("xz", _TILTED_DEG * np.column_stack([np.sin(phase), np.cos(phase)]), degrees=True)
    return replace(path, world_from_cam=path.world_from_cam @ tilts.as_matrix())


def _bent(path: Trajectory) -> tuple[Trajectory, float]:
    """Return a path bent to one side, horizontally, in an arc a quarter as high as it is long; also that height (m)."""
    shape = path_shape(path.centers)
    along = (path.centers - shape.centroid) @ shape.axes[:, 0]
    length_m = float(np.ptp(along))
    across = np.cross([0.0, 0.0, 1.0], shape.axes[:, 0])
    aside = across / max(float(np.linalg.norm(across)), 1e-9)
    arc = np.cos(np.pi * (along - (along.max() + along.min()) / 2) / max(length_m, 1e-9))
    return replace(path, centers=path.centers + length_m / 4 * arc[:, None] * aside), length_m / 4


def _there_and_back(path: Trajectory, num: int) -> Trajectory:
    """Return a path that is walked several times, every second time backwards, with the same directions of view."""
    times, last = path.times_s, len(path) - 1
    order = np.arange(num * last + 1) % (2 * last)
    order = np.where(order > last, 2 * last - order, order)
    steps_s = np.abs(np.diff(times[order]))
    return replace(
        path,
        frame_ids=np.arange(1, len(order) + 1),
        image_names=tuple(f"{k:06d}" for k in range(len(order))),
        timestamps_s=np.concatenate([times[:1], times[0] + np.cumsum(steps_s)]),
        centers=path.centers[order],
        world_from_cam=path.world_from_cam[order],
    )


def _wider(path: Trajectory, factor: float) -> Trajectory:
    """Return a path spread out around its mean by a factor, walked at the same speed, with as many photos."""
    times = path.times_s
    out = _farther_out(path, path.centers, factor)
    return replace(path, centers=out, timestamps_s=times[0] + factor * (times - times[0]))
