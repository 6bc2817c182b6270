"""Mistakes that begin or end at a time that nobody knows: looked for everywhere, each found once."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.scale.range_equation import tag_positions
from rangesfm.trust.catalogue import UNSEEN_MOVE_M
from rangesfm.trust.hypothesis import Correction, Hypothesis, of_cells
from rangesfm.trust.linearized import Linearized

# A step is best found where it was: the ranges between the true time and the one that is tried fit neither way.
_MAX_NUM_TIMES = 32
# Of the survey, on either side: what begins later or ends sooner lasts as good as always.
_LEAST_SHARE = 1 / 12
# Shares of the survey that a stretch may last.
_STRETCHES = (1 / 4, 1 / 8, 1 / 16)
# Of fewer cells on either side nothing can be said.
_MIN_NUM_CELLS = 3


def anchors_moved(problem: Linearized) -> Iterator[Hypothesis]:
    """An anchor was moved at some time."""
    on_map = problem.on_map
    tags_m = tag_positions(on_map.problem, on_map.state.metric_from_model)
    for k in _heard(problem):
        name, at = on_map.anchor_ids[k], on_map.state.anchors_m[k]
        is_of = problem.cells.anchor_index == k
        for time in _times(problem.time_s[is_of]):
            is_after = is_of & (problem.time_s > time)
            is_before = is_of & ~is_after
            if min(is_after.sum(), is_before.sum()) < 3 * _MIN_NUM_CELLS:
                continue

            def words(size: Array, name: str = name, when: str = _when(problem, time)) -> str:
                return (
                    f"anchor {name} was moved by about {np.linalg.norm(size):.2f} m {when} "
                    f"({size[0]:+.2f}, {size[1]:+.2f}, {size[2]:+.2f} m in x, y, z)"
                )

            of_ranges = _of_ranges(problem, k) & (on_map.time_s > time)

            def back(size: Array, of_ranges: Mask = of_ranges, at: Array = at) -> Correction:
                grown_m = np.linalg.norm(tags_m - at - size, axis=1) - np.linalg.norm(tags_m - at, axis=1)
                return Correction(longer_m=np.where(of_ranges, grown_m, 0.0))

            yield Hypothesis(
                "anchor moved",
                name,
                unit="m",
                words=words,
                remedy="fix anchors so that nobody bumps into them, and use its ranges from before only",
                correction=back,
                adoption=_left_out(of_ranges),
                unawares=UNSEEN_MOVE_M,
                effect=of_cells(problem, np.where(is_after[:, None], problem.gradient.by_tag, 0.0)),
            )


def map_breaks(problem: Linearized) -> Iterator[Hypothesis]:
    """From some time on the map lies elsewhere, as after a wrong match."""
    on_map = problem.on_map
    tags_m = tag_positions(on_map.problem, on_map.state.metric_from_model)
    anchors_m = on_map.state.anchors_m[on_map.problem.anchor_index]
    for time in _times(problem.time_s):
        is_after, of_ranges = problem.time_s > time, on_map.time_s > time
        if min(is_after.sum(), (~is_after).sum()) < 3 * _MIN_NUM_CELLS:
            continue

        def words(size: Array, when: str = _when(problem, time)) -> str:
            return (
                f"the map breaks: {when} it lies about {np.linalg.norm(size):.2f} m from where it should "
                f"({-size[0]:+.2f}, {-size[1]:+.2f}, {-size[2]:+.2f} m in x, y, z)"
            )

        def back(size: Array, of_ranges: Mask = of_ranges) -> Correction:
            grown_m = np.linalg.norm(tags_m + size - anchors_m, axis=1) - np.linalg.norm(tags_m - anchors_m, axis=1)
            return Correction(longer_m=np.where(of_ranges, grown_m, 0.0))

        yield Hypothesis(
            "map break",
            "",
            unit="m",
            words=words,
            remedy="look at the photos there for a false match or too little overlap, and map the parts apart",
            correction=back,
            adoption=_left_out(of_ranges),
            unawares=UNSEEN_MOVE_M,
            effect=of_cells(problem, np.where(is_after[:, None], -problem.gradient.by_tag, 0.0)),
        )


def steps(problem: Linearized) -> Iterator[Hypothesis]:
    """From some time on ranges read longer, those of one anchor or of all."""
    for k in [*(_heard(problem) if len(_heard(problem)) > 1 else []), None]:
        name = "" if k is None else problem.on_map.anchor_ids[k]
        is_of = np.ones(len(problem.time_s), dtype=bool) if k is None else problem.cells.anchor_index == k
        for time in _times(problem.time_s[is_of]):
            is_after = is_of & (problem.time_s > time)
            if min(is_after.sum(), (is_of & ~is_after).sum()) < _MIN_NUM_CELLS:
                continue
            of_ranges = _of_ranges(problem, k) & (problem.on_map.time_s > time)

            def words(size: Array, name: str = name, when: str = _when(problem, time)) -> str:
                to, how = f" to anchor {name}" if name else "", "longer" if size[0] > 0 else "shorter"
                return f"{when} on the ranges{to} read about {abs(size[0]):.2f} m {how}"

            def correction(size: Array, of_ranges: Mask = of_ranges) -> Correction:
                return Correction(longer_m=np.where(of_ranges, size[0], 0.0))

            yield Hypothesis(
                "anchor step" if name else "step",
                name,
                unit="m",
                is_linear=True,
                words=words,
                remedy="see what changed then: a tag that slipped, a restarted radio, a door or a vehicle in between",
                correction=correction,
                effect=of_cells(problem, -is_after.astype(np.float64)),
            )


def stretches(problem: Linearized) -> Iterator[Hypothesis]:
    """For a while ranges read longer."""
    for k in [*(_heard(problem) if len(_heard(problem)) > 1 else []), None]:
        name = "" if k is None else problem.on_map.anchor_ids[k]
        is_of = np.ones(len(problem.time_s), dtype=bool) if k is None else problem.cells.anchor_index == k
        for start, end in _windows(problem):
            inside = is_of & (problem.time_s >= start) & (problem.time_s < end)
            if inside.sum() < _MIN_NUM_CELLS:
                continue
            times = problem.on_map.time_s

            def words(size: Array, name: str = name, when: str = _when(problem, start, end)) -> str:
                to = f" to anchor {name}" if name else ""
                return f"{when} the ranges{to} read about {abs(size[0]):.2f} m too {'long' if size[0] > 0 else 'short'}"

            yield Hypothesis(
                "anchor stretch" if name else "stretch",
                name,
                unit="m",
                is_linear=True,
                words=words,
                remedy="look for what stood in the line of sight, and leave that stretch out",
                correction=_left_out(_of_ranges(problem, k) & (times >= start) & (times < end)),
                effect=of_cells(problem, -inside.astype(np.float64)),
            )


def clock_jumps(problem: Linearized) -> Iterator[Hypothesis]:
    """The clocks' offset jumped at some time."""
    if problem.by_time is None:
        return
    for time in _times(problem.time_s):
        after = problem.time_s > time
        if min(after.sum(), (~after).sum()) < _MIN_NUM_CELLS:
            continue
        of_ranges = problem.on_map.time_s > time

        def words(size: Array, when: str = _when(problem, time)) -> str:
            return f"the clocks' offset jumped by about {size[0]:+.2f} s {when}"

        def correction(size: Array, of_ranges: Mask = of_ranges) -> Correction:
            return Correction(time_shift_s=np.where(of_ranges, size[0], 0.0))

        yield Hypothesis(
            "clock jump",
            "",
            unit="s",
            is_linear=True,
            words=words,
            remedy="see whether a logger was restarted then, and run the two parts as surveys of their own",
            correction=correction,
            effect=of_cells(problem, np.where(after, -problem.by_time, 0.0)),
        )


def _heard(problem: Linearized) -> list[int]:
    heard: list[int] = np.unique(problem.cells.anchor_index).tolist()
    return heard


def _of_ranges(problem: Linearized, anchor: int | None) -> Mask:
    index = problem.on_map.problem.anchor_index
    return np.ones(len(index), dtype=bool) if anchor is None else np.asarray(index == anchor)


def _left_out(rows: Mask) -> Callable[[Array], Correction]:
    return lambda _: Correction(left_out=rows)


def _times(time_s: Array) -> Array:
    """Between cells at (c,) times, away from the ends: between any two, or between as many as are looked at."""
    ordered = np.sort(time_s)
    between, aside = (ordered[1:] + ordered[:-1]) / 2, round(_LEAST_SHARE * len(ordered))
    between = between[aside : len(between) - aside]
    return np.asarray(between[:: max(-(-len(between) // _MAX_NUM_TIMES), 1)])


def _windows(problem: Linearized) -> Iterator[tuple[float, float]]:
    for share in _STRETCHES:
        starts = np.arange(0.0, 1.0 - share + 1e-9, share / 2)
        for start in starts:
            first, last = np.quantile(problem.time_s, [start, min(start + share, 1.0)])
            yield float(first), float(last)


def _when(problem: Linearized, start: float, end: float | None = None) -> str:
    begin = problem.on_map.time_s.min()
    if problem.by_time is None:
        unit, after = "m", "along the path"
    else:
        unit, after = "s", "after the first range"
    if end is None:
        return f"from {start - begin:.0f} {unit} {after}"
    return f"from {start - begin:.0f} to {end - begin:.0f} {unit} {after}"


SCANNING: tuple[Callable[[Linearized], Iterator[Hypothesis]], ...] = (
    anchors_moved,
    map_breaks,
    steps,
    stretches,
    clock_jumps,
)
