"""Mistakes that begin or end at an unknown time: each is searched for over the whole survey."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.measurements.mistakes import Correction, Mistake, in_axes
from rangesfm.measurements.ranges.mistakes.catalogue import MISMEASURED_M, UNSEEN_MOVE_M, lever_arm_m, to_other_side_m
from rangesfm.measurements.ranges.mistakes.effects import (
    duration_s,
    longer,
    longest_m,
    too_long,
)
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.scale.range_equation import antenna_positions

# Ranges between the true time of a step and the tried time fit neither way, so the best time is refined afterwards.
_NUM_TIMES, _NUM_FINER = 32, 17
# Share of the survey that must be before and after a change; otherwise it is as good as a lasting mistake.
_LEAST_SHARE = 1 / 12
# Shares of the survey that a stretch may last.
_STRETCHES = (1 / 4, 1 / 8, 1 / 16)
# Fewest bins before and after a change.
_MIN_NUM_BINS = 3
# Kinds of moves at some time: text for whose, when and by how much; remedy; largest unnoticed size, metres.
_MOVES: dict[str, tuple[Callable[[str, str, Array], str], str, float]] = {
    "anchor moved": (
        lambda whose, when, size: (
            f"anchor {whose} was moved {when}, by about {np.linalg.norm(size):.2f} m ({in_axes(size)} in x, y, z)"
        ),
        "fix anchors so that nobody bumps into them, and use its ranges from before only",
        UNSEEN_MOVE_M,
    ),
    "map break": (
        lambda _, when, size: (
            f"the map breaks {when}: its later part lies about {np.linalg.norm(size):.2f} m from where it should "
            f"({in_axes(-size)} in x, y, z)"
        ),
        "look for a false match or too little overlap between photos, and reconstruct the parts before and after apart",
        UNSEEN_MOVE_M,
    ),
    "tag slipped": (
        lambda _, when, size: (
            f"the tag slipped {when}: since then it sits about {np.linalg.norm(size):.2f} m elsewhere on the "
            f"camera ({in_axes(size)} along the camera's x, y, z)"
        ),
        "fix the tag to the camera, and run the parts before and after as two surveys",
        MISMEASURED_M,
    ),
}


def anchors_moved(problem: Linearized) -> Iterator[Mistake]:
    """Yield for each anchor: it was moved at some time."""
    for k in problem.heard:
        # The anchor must be within reach before and after.
        most_m, name = 2 * longest_m(problem, [k]), problem.on_map.anchor_ids[k]
        yield from _elsewhere(problem, [k], name, "anchor moved", most_m, lambda: -np.eye(3), -problem.gradient.by_tag)


def map_breaks(problem: Linearized) -> Iterator[Mistake]:
    """Yield: after some time the map is elsewhere, as after a wrong match."""
    # Two parts of a map cannot be farther apart than the map is large.
    tags_m = antenna_positions(problem.on_map.problem, problem.on_map.state.metric_from_model)
    extent_m = float(np.linalg.norm(np.ptp(tags_m, axis=0)))
    return _elsewhere(problem, _all(problem), "", "map break", extent_m, lambda: np.eye(3), problem.gradient.by_tag)


def tags_slipped(problem: Linearized) -> Iterator[Mistake]:
    """Yield: after some time the tag is elsewhere on the camera."""
    on_map = problem.on_map
    # The tag is still on the camera.
    most_m = max(to_other_side_m(lever_arm_m(problem, tag)) for tag in np.unique(on_map.tag_index).tolist())
    axes, by_shift = (lambda: on_map.world_from_cam), problem.by_lever_arm
    return _elsewhere(problem, _all(problem), "", "tag slipped", most_m, axes, by_shift)


def _elsewhere(
    problem: Linearized,
    anchors: Sequence[int],
    whose: str,
    name: str,
    most_m: float,
    axes: Callable[[], Array],
    by_shift: Array,
) -> Iterator[Mistake]:
    """Yield moves at unknown times, relative to some anchors.

    Args:
        whose: the anchor's id, or nothing. name: kind of the move, a key of ``_MOVES``. most_m: largest possible move.
        axes: axes of the move, (3, 3), or (n, 3, 3) for each range.
        by_shift: (c, 3) derivatives of the predicted ranges along these axes.
    """
    words, remedy, max_unnoticed = _MOVES[name]

    def back(later: Callable[[], Mask], size: Array) -> Correction:
        from_anchor_m = problem.on_map.from_anchor_m
        grown_m = np.linalg.norm(from_anchor_m + axes() @ size, axis=1) - np.linalg.norm(from_anchor_m, axis=1)
        return Correction(longer_m=np.where(later(), grown_m, 0.0))

    def moved(when: str, later: Callable[[], Mask], after: Array) -> Mistake:
        return Mistake(
            name,
            -after[:, None] * by_shift,
            subject=whose,
            words=partial(words, whose, when),
            remedy=remedy,
            correction=partial(back, later),
            most=most_m,
            adoption=partial(_left_out, later),
            max_unnoticed=max_unnoticed,
        )

    return _changes(problem, anchors, 3 * _MIN_NUM_BINS, moved)


def steps(problem: Linearized) -> Iterator[Mistake]:
    """Yield: after some time the ranges of one anchor, or of all, read longer or shorter."""
    for name, anchors in _each_and_all(problem):
        yield from _steps(problem, name, anchors)


def _steps(problem: Linearized, name: str, anchors: Sequence[int]) -> Iterator[Mistake]:
    def words(when: str, size: Array) -> str:
        to, how = f" to anchor {name}" if name else "", "longer" if size[0] > 0 else "shorter"
        return f"the ranges{to} jumped {when}: since then they read about {abs(size[0]):.2f} m {how}"

    def step(when: str, later: Callable[[], Mask], after: Array) -> Mistake:
        return Mistake(
            "anchor step" if name else "step",
            -after[:, None],
            subject=name,
            words=partial(words, when),
            remedy="see what changed then: a tag that slipped, a restarted radio, a door or a vehicle in between",
            correction=longer(later),
            most=longest_m(problem, anchors),
            is_linear=True,
        )

    return _changes(problem, anchors, _MIN_NUM_BINS, step)


def stretches(problem: Linearized) -> Iterator[Mistake]:
    """Yield: for some time the ranges of one anchor, or of all, read longer or shorter."""
    windows = list(_windows(problem))

    def words(name: str, when: str, size: Array) -> str:
        return f"the ranges{f' to anchor {name}' if name else ''} {too_long(size)} {when}"

    for name, anchors in _each_and_all(problem):
        is_of = np.isin(problem.bins.anchor_index, anchors)
        for start, end, share in windows:
            inside = np.where(is_of, share, 0.0)
            if inside.sum() < _MIN_NUM_BINS:
                continue
            within = partial(_later, problem, anchors, start, end)
            yield Mistake(
                "anchor stretch" if name else "stretch",
                -inside[:, None],
                subject=name,
                words=partial(words, name, _when(problem, start, end)),
                remedy="look for what stood in the line of sight, and leave that stretch out",
                correction=longer(within),
                most=longest_m(problem, anchors),
                adoption=partial(_left_out, within),
                is_linear=True,
            )


def clock_jumps(problem: Linearized) -> Iterator[Mistake]:
    """Yield: the clocks' offset jumped at some time."""
    if problem.on_map.posed.velocity is None:
        return iter(())
    by_time = problem.bins.mean(problem.on_map.by_time)

    def jump(when: str, later: Callable[[], Mask], after: Array) -> Mistake:
        return Mistake(
            "clock jump",
            -(by_time * after)[:, None],
            words=lambda size: f"the clocks' offset jumped {when}, by about {size[0]:+.2f} s",
            remedy="see whether a logger was restarted then, and run the parts before and after as two surveys",
            correction=lambda size: Correction(time_shift_s=np.where(later(), size[0], 0.0)),
            most=duration_s(problem),
            unit="s",
            is_linear=True,
        )

    return _changes(problem, _all(problem), _MIN_NUM_BINS, jump)


def _all(problem: Linearized) -> list[int]:
    return list(range(len(problem.on_map.anchor_ids)))


def _each_and_all(problem: Linearized) -> Iterator[tuple[str, list[int]]]:
    """Yield the anchors, by name, if there are several, and all together, without a name."""
    for k in problem.heard if len(problem.heard) > 1 else ():
        yield problem.on_map.anchor_ids[k], [k]
    yield "", _all(problem)


def _later(problem: Linearized, anchors: Sequence[int], start: float, end: float = np.inf) -> Mask:
    """Return an (n,) mask of the ranges to some anchors between two times."""
    on_map = problem.on_map
    return np.isin(on_map.problem.anchor_index, anchors) & (on_map.time_s > start) & (on_map.time_s <= end)


def _left_out(rows: Callable[[], Mask], _: Array) -> Correction:
    return Correction(left_out=np.flatnonzero(rows()))


def _changes(
    problem: Linearized,
    anchors: Sequence[int],
    least: int,
    change: Callable[[str, Callable[[], Mask], Array], Mistake],
) -> Iterator[Mistake]:
    """Yield a change of some anchors at times away from the ends of the survey.

    Args:
        least: fewest bins before and after.
        change: returns the mistake, given words for its time, a function that returns the later ranges, and (c,)
            shares of the bins that are later.
    """
    of_anchors = np.isin(problem.on_map.problem.anchor_index, anchors)
    is_of = np.isin(problem.bins.anchor_index, anchors)
    shares = np.linspace(_LEAST_SHARE, 1 - _LEAST_SHARE, _NUM_TIMES)

    def at(times: Array) -> Iterator[Mistake]:
        for k, (time, share) in enumerate(zip(times.tolist(), _shares_after(problem, times), strict=True)):
            after = np.where(is_of, share, 0.0)
            if min(after.sum(), is_of.sum() - after.sum()) >= least:
                finer = np.linspace(times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)], _NUM_FINER)
                made = change(_when(problem, time), partial(_later, problem, anchors, time), after)
                yield replace(made, refine_time=partial(at, finer))

    return at(np.unique(np.quantile(problem.on_map.time_s[of_anchors], shares)))


def _windows(problem: Linearized) -> Iterator[tuple[float, float, Array]]:
    """Yield begin, end and the (c,) shares of the bins in between, for stretches of several lengths."""
    starts = [(start, share) for share in _STRETCHES for start in np.arange(0.0, 1.0 - share + 1e-9, share / 2)]
    ends = np.quantile(problem.on_map.time_s, [(start, min(start + share, 1.0)) for start, share in starts])
    times, rows = np.unique(ends, return_inverse=True)
    after = _shares_after(problem, times)
    for (start, end), (first, last) in zip(ends.tolist(), rows.reshape(ends.shape), strict=True):
        yield start, end, after[first] - after[last]


def _shares_after(problem: Linearized, times: Array) -> Array:
    """Return (t, c) the share of each bin's weight that is later than each of (t,) increasing times."""
    bins, num = problem.bins, len(times) + 1
    of_span = bins.of_range * num + np.searchsorted(times, problem.on_map.time_s)
    worth = np.bincount(of_span, bins.robust_weight, len(bins) * num).reshape(len(bins), num)
    later: Array = np.cumsum(worth[:, :0:-1], axis=1)[:, ::-1].T / bins.worth
    return later


def _when(problem: Linearized, start: float, end: float = np.inf) -> str:
    begin = problem.on_map.time_s.min()
    what = "m along the path" if problem.on_map.posed.velocity is None else "s after the first range"
    span = f"from {start - begin:.0f} to {end - begin:.0f}" if np.isfinite(end) else f"{start - begin:.0f}"
    return f"{span} {what}"


SCANNING: tuple[Callable[[Linearized], Iterator[Mistake]], ...] = (
    anchors_moved,
    map_breaks,
    tags_slipped,
    steps,
    stretches,
    clock_jumps,
)
