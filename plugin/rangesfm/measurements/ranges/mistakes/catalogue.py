"""The catalogue of mistakes that last for the whole survey. Every mistake added here is tested and reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import Correction, Mistake, in_axes
from rangesfm.measurements.ranges.mistakes.effects import (
    MEASURE_AGAIN,
    duration_s,
    is_given,
    longest_m,
    of_anchor_place,
    too_long,
)
from rangesfm.measurements.ranges.mistakes.linearized import Linearized

SAME_HEIGHT_M = 1e-3
"""Nobody measures heights of anchors that agree to within this, metres."""
# Growth of an anchor's ranges per metre of distance below which they hardly change with the distance.
_STUCK = 0.3
# Largest mistakes, in metres, that nobody notices: along a camera, and of an anchor on a sketch of the site.
MISMEASURED_M, UNSEEN_MOVE_M = 0.2, 1.0
# Largest clock drift, seconds per second. A quartz stays within 100 ppm over temperature and age, and there are two.
_MOST_CLOCK_DRIFT = 2e-4
# Largest errors proportional to the distance, for all ranges and for one anchor's, as shares. The first also limits the
# scale of coordinates. Larger factors, as from feet or two-way ranges, are tried as alternatives.
_MOST_SHARE, _MOST_SHARE_OF_ANCHOR = 0.5, 2.0
LARGEST_RIG_M = 3.0
"""Largest distance between the lens and a tag on anything that is carried or driven, metres. A pole is 2 m long."""
# Largest change of a radio's delay as it warms up, far more than was ever seen.
_MOST_WARMING_M = 5.0
# Largest excess of a range past the person with the camera: the way round the body, and a weak signal found late.
_MOST_BODY_M = 2.0


def _lengthening(problem: Linearized, name: str, share: Array, **told: Any) -> Mistake:
    """Return: ranges read too long by a size times a share (n,) of each; ``told``: further attributes."""
    return Mistake(
        name,
        -problem.bins.mean(share)[:, None],
        correction=lambda size: Correction(longer_m=size[0] * share),
        is_linear=True,
        **told,
    )


def anchor_places(problem: Linearized) -> Iterator[Mistake]:
    """Yield for each given anchor: it is not where its coordinates say."""
    return (_anchor_place(problem, k) for k in problem.heard if is_given(problem, k))


def _anchor_place(problem: Linearized, k: int) -> Mistake:
    name, at = problem.on_map.anchor_ids[k], problem.on_map.problem.anchor_mean_m[k]
    site = problem.on_map.posed.given.site
    # The anchor must be within its ranges of the path, wherever its coordinates put it.
    most_m = longest_m(problem, [k]) + float(np.max(problem.gradient.distance_m[problem.bins.anchor_index == k]))

    seen = np.where((problem.bins.anchor_index == k)[:, None], problem.gradient.by_tag, 0.0)

    def unknown(_: Array) -> Correction:
        return Correction({name: None})

    def coordinate(axis: int) -> Mistake:
        letter, direction = "xyz"[axis], np.eye(3)[axis]
        return Mistake(
            "anchor coordinate",
            of_anchor_place(problem, k, direction[:, None]),
            subject=f"{name} {letter}",
            words=lambda size: (
                f"anchor {name}'s {letter} is given as {site.coordinate_text(at, axis, 3)} where about "
                f"{site.coordinate_text(at + size[0] * direction, axis, 2)} fits ({size[0]:+.2f} m)"
            ),
            remedy=f"check its {letter}, or {MEASURE_AGAIN}",
            correction=lambda size: Correction({name: at + size[0] * direction}),
            most=most_m,
            adoption=unknown,
            seen=seen[:, axis : axis + 1],
        )

    return Mistake(
        "anchor place",
        of_anchor_place(problem, k, np.eye(3)),
        subject=name,
        words=lambda size: (
            f"anchor {name} is about {np.linalg.norm(size):.2f} m from where its coordinates say "
            f"(by {in_axes(size)} in x, y, z)"
        ),
        remedy=MEASURE_AGAIN,
        correction=lambda size: Correction({name: at + size}),
        most=most_m,
        adoption=unknown,
        max_unnoticed=UNSEEN_MOVE_M,
        narrower=tuple(map(coordinate, range(3))),
        seen=seen,
    )


def anchor_biases(problem: Linearized) -> Iterator[Mistake]:
    """Yield for each anchor and for all together: ranges have a constant error, larger than usual."""
    for k in problem.heard if len(problem.heard) > 1 else []:
        yield _bias(problem, [k], "anchor bias", problem.on_map.anchor_ids[k], f"anchor {problem.on_map.anchor_ids[k]}")
    yield _bias(problem, problem.heard, "common bias", "", "every anchor")


def _bias(problem: Linearized, anchors: list[int], kind: str, subject: str, whose: str) -> Mistake:
    return _lengthening(
        problem,
        kind,
        np.isin(problem.on_map.problem.anchor_index, anchors).astype(np.float64),
        subject=subject,
        words=lambda size: f"the ranges to {whose} {too_long(size)}",
        remedy="calibrate the radio's delay (range_bias_m in the anchors' file), or look for what stands in the way",
        most=longest_m(problem, anchors),
        is_in_interval=True,
    )


def range_shares(problem: Linearized) -> Iterator[Mistake]:
    """Yield for all ranges and for each anchor's: they grow by more or less than the distance does."""
    distance_m = problem.on_map.problem.range_m
    yield Mistake(
        "range scale",
        -problem.gradient.distance_m[:, None],
        words=lambda size: f"all ranges read about {100 * abs(size[0]):.1f} % too {'long' if size[0] > 0 else 'short'}",
        remedy="check the unit, and the propagation speed that the radio assumes, against a taped distance",
        correction=lambda size: Correction(longer_m=distance_m * size[0] / (1 + size[0])),
        unit="1",
        most=_MOST_SHARE,
        is_linear=True,
        is_in_interval=True,
    )
    for k in problem.heard if len(problem.heard) > 1 else []:
        yield _share_of_anchor(problem, k)


def _share_of_anchor(problem: Linearized, k: int) -> Mistake:
    name, distance_m = problem.on_map.anchor_ids[k], problem.on_map.gradient.distance_m
    of_ranges, mean = (
        problem.on_map.problem.anchor_index == k,
        problem.gradient.distance_m[problem.bins.anchor_index == k].mean(),
    )

    def words(size: Array) -> str:
        if 1 + size[0] < _STUCK:
            return f"the ranges to anchor {name} hardly change with the distance: they are always nearly the same"
        return f"the ranges to anchor {name} grow by {1 + size[0]:.2f} m for each metre of distance"

    return _lengthening(
        problem,
        "anchor range scale",
        np.where(of_ranges, distance_m - mean, 0.0),
        subject=name,
        words=words,
        remedy="look at its ranges in the log, and leave it out (use_anchors)",
        most=_MOST_SHARE_OF_ANCHOR,
        unit="1",
        adoption=lambda _: Correction(left_out=np.flatnonzero(of_ranges)),
        is_in_interval=True,
    )


def anchors_in_another_scale(problem: Linearized) -> Iterator[Mistake]:
    """Yield: the anchors' coordinates are in a unit that is not quite the metre."""
    given_m, ids = problem.on_map.problem.anchor_mean_m, problem.on_map.anchor_ids
    known = np.flatnonzero(np.isfinite(given_m).all(axis=1)).tolist()
    if len(known) < 2 or not any(is_given(problem, k) for k in known):
        return
    middle = given_m[known].mean(axis=0)
    yield Mistake(
        "anchors' scale",
        np.sum(
            [of_anchor_place(problem, k, (given_m[k] - middle)[:, None]) for k in known if is_given(problem, k)], axis=0
        ),
        words=lambda size: (
            f"the anchors' coordinates are about {100 * abs(size[0]):.1f} % too {'small' if size[0] > 0 else 'large'}"
        ),
        remedy="check the unit of the anchors' coordinates against a taped distance between two of them",
        correction=lambda size: Correction(
            {ids[k]: middle + (1 + size[0]) * (given_m[k] - middle) for k in known},
        ),
        most=_MOST_SHARE,
        unit="1",
        is_in_interval=True,
    )


def heights_never_measured(problem: Linearized) -> Iterator[Mistake]:
    """Yield: the anchors were all given the same height, which is not true."""
    given_m, ids = problem.on_map.problem.anchor_mean_m, problem.on_map.anchor_ids
    known = [k for k in problem.heard if np.isfinite(given_m[k]).all()]
    if len(known) < 3 or np.ptp(given_m[known, 2]) > SAME_HEIGHT_M or not all(is_given(problem, k) for k in known):
        return
    up, site = np.array([0.0, 0.0, 1.0]), problem.on_map.posed.given.site
    yield Mistake(
        "anchor heights",
        np.hstack([of_anchor_place(problem, k, up[:, None]) for k in known]),
        words=lambda size: (
            f"all anchors are given the same height, {site.height_text(given_m[known[0]])} m, but the ranges "
            f"fit heights that differ by {np.ptp(size):.1f} m"
        ),
        remedy="measure the heights of the antennas",
        correction=lambda size: Correction(
            {ids[k]: given_m[k] + height_m * up for k, height_m in zip(known, size, strict=True)}
        ),
        most=longest_m(problem, problem.heard) * np.sqrt(len(known)),
    )


def to_other_side_m(lever_arm_m: float) -> float:
    """Return the distance from a tag to the other side of its camera, plus an error of measurement, in metres."""
    return MISMEASURED_M + 2 * lever_arm_m


def wrong_lever_arms(problem: Linearized) -> Iterator[Mistake]:
    """Yield for each tag: it is elsewhere on the camera."""
    return (_lever_arm(problem, k) for k in np.unique(problem.bins.tag_index).tolist())


def lever_arm_m(problem: Linearized, tag: int) -> float:
    """Return the given length, metres, of a tag's lever arm."""
    arms_m = np.linalg.norm(problem.on_map.problem.tag_from_center, axis=1)
    return float(np.median(arms_m[problem.on_map.tag_index == tag]))


def _lever_arm(problem: Linearized, k: int) -> Mistake:
    on_map = problem.on_map
    name = on_map.tag_ids[k] if len(on_map.tag_ids) > 1 else ""
    length_m = lever_arm_m(problem, k)

    def words(size: Array) -> str:
        of_tag, far = f" of tag {name}" if name else "", f"about {np.linalg.norm(size):.2f} m"
        what = f"no lever arm{of_tag} is given, and the tag sits {far} from the lens"
        if length_m > 0:
            what = f"the lever arm{of_tag} is off by {far}"
        return f"{what} ({in_axes(size)} along the camera's x, y, z)"

    return Mistake(
        "lever arm",
        np.where((problem.bins.tag_index == k)[:, None], -problem.by_lever_arm, 0.0),
        subject=name,
        words=words,
        remedy="measure where the tag's antenna sits, x to the right, y down, z forward (--tag_in_cam)",
        correction=lambda size: Correction(tag_moves_m={on_map.tag_ids[k]: size}),
        most=LARGEST_RIG_M + length_m,
        max_unnoticed=to_other_side_m(length_m),
    )


def radios_warming(problem: Linearized) -> Iterator[Mistake]:
    """Yield: the radio's delay changes steadily, by more than radios drift."""
    since = problem.on_map.time_s - problem.time_s.mean()
    lasts, unit = float(np.ptp(since)), "m of the path" if problem.on_map.posed.velocity is None else "s"

    def words(size: Array) -> str:
        how = "longer" if size[0] > 0 else "shorter"
        return f"the ranges get {how} and {how}, by about {abs(size[0]):.2f} m within {lasts:.0f} {unit}"

    yield _lengthening(
        problem,
        "radio drift",
        since / lasts,
        words=words,
        remedy="let the radio warm up before the survey, or calibrate it at the end too",
        most=_MOST_WARMING_M,
    )


def people_in_between(problem: Linearized) -> Iterator[Mistake]:
    """Yield: a person who carries the camera blocks the signals of anchors behind."""
    on_map = problem.on_map
    is_behind = np.sum(on_map.from_anchor_m * on_map.world_from_cam[:, :, 2], axis=1) > 0
    yield _lengthening(
        problem,
        "behind the camera",
        is_behind.astype(np.float64),
        words=lambda size: f"the ranges to anchors behind the camera {too_long(size)}",
        remedy="carry the tag above the head, or see what stands behind it",
        most=_MOST_BODY_M,
        max_unnoticed=MISMEASURED_M,
    )


def clocks(problem: Linearized) -> Iterator[Mistake]:
    """Yield: the offset or the rate between the clocks of camera and radio differs from what is assumed."""
    if problem.on_map.posed.velocity is None:
        return
    of_ranges, since = problem.on_map.time_s - problem.time_s.mean(), problem.time_s - problem.time_s.mean()
    by_time = problem.bins.mean(problem.on_map.by_time)
    remedy = (
        "film sharp turns at the beginning and the end, or let the offset be searched for, if you gave it "
        "(ranges_time_offset auto)"
    )
    yield Mistake(
        "clock offset",
        -by_time[:, None],
        words=lambda size: f"the time offset between the clocks is wrong: it needs about {size[0]:+.2f} s more",
        remedy=remedy,
        correction=lambda size: Correction(time_shift_s=float(size[0])),
        most=duration_s(problem),
        unit="s",
    )
    yield Mistake(
        "clock drift",
        -(by_time * since)[:, None],
        words=lambda size: (
            f"the radio's clock runs {1e6 * abs(size[0]):.0f} ppm too {'slow' if size[0] > 0 else 'fast'}"
        ),
        remedy=remedy,
        correction=lambda size: Correction(time_shift_s=size[0] * of_ranges),
        unit="s/s",
        most=_MOST_CLOCK_DRIFT,
    )


STANDING: tuple[Callable[[Linearized], Iterator[Mistake]], ...] = (
    anchor_places,
    anchor_biases,
    range_shares,
    anchors_in_another_scale,
    heights_never_measured,
    wrong_lever_arms,
    radios_warming,
    people_in_between,
    clocks,
)
"""Mistakes that last for the whole survey."""
