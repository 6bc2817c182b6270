"""Mistakes that begin or end at a time that nobody knows: looked for everywhere, each found once."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.scale.range_equation import tag_positions
from rangesfm.trust.catalogue import MISMEASURED_M, UNSEEN_MOVE_M
from rangesfm.trust.hypothesis import Correction, Hypothesis, of_cells
from rangesfm.trust.linearized import Linearized

# A step is best found where it was: the ranges between the true time and the one that is tried fit neither way.
_NUM_TIMES = 32
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
        for time, after in _changes(problem, k, 3 * _MIN_NUM_CELLS):

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
                effect=of_cells(problem, after[:, None] * problem.gradient.by_tag),
            )


def map_breaks(problem: Linearized) -> Iterator[Hypothesis]:
    """From some time on the map lies elsewhere, as after a wrong match."""
    on_map = problem.on_map
    tags_m = tag_positions(on_map.problem, on_map.state.metric_from_model)
    anchors_m = on_map.state.anchors_m[on_map.problem.anchor_index]
    for time, after in _changes(problem, None, 3 * _MIN_NUM_CELLS):
        of_ranges = on_map.time_s > time

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
            effect=of_cells(problem, -after[:, None] * problem.gradient.by_tag),
        )


def tags_slipped(problem: Linearized) -> Iterator[Hypothesis]:
    """From some time on the tag sits elsewhere on the camera."""
    on_map = problem.on_map
    turned = np.swapaxes(on_map.world_from_cam, 1, 2)
    tags_m = tag_positions(on_map.problem, on_map.state.metric_from_model)
    from_anchor_m = tags_m - on_map.state.anchors_m[on_map.problem.anchor_index]
    for time, after in _changes(problem, None, 3 * _MIN_NUM_CELLS):
        of_ranges = on_map.time_s > time

        def words(size: Array, when: str = _when(problem, time)) -> str:
            return (
                f"the tag slipped: {when} it sits about {np.linalg.norm(size):.2f} m elsewhere on the camera "
                f"({size[0]:+.2f}, {size[1]:+.2f}, {size[2]:+.2f} m along the camera's x, y, z)"
            )

        def back(size: Array, of_ranges: Mask = of_ranges) -> Correction:
            moved_m = from_anchor_m + size @ turned
            grown_m = np.linalg.norm(moved_m, axis=1) - np.linalg.norm(from_anchor_m, axis=1)
            return Correction(longer_m=np.where(of_ranges, grown_m, 0.0))

        yield Hypothesis(
            "tag slipped",
            "",
            unit="m",
            words=words,
            remedy="fix the tag to the camera, and run the two parts as surveys of their own",
            correction=back,
            adoption=_left_out(of_ranges),
            unawares=MISMEASURED_M,
            effect=of_cells(problem, -after[:, None] * problem.by_lever_arm),
        )


def steps(problem: Linearized) -> Iterator[Hypothesis]:
    """From some time on ranges read longer, those of one anchor or of all."""
    for k in [*(_heard(problem) if len(_heard(problem)) > 1 else []), None]:
        name = "" if k is None else problem.on_map.anchor_ids[k]
        for time, after in _changes(problem, k, _MIN_NUM_CELLS):
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
                effect=of_cells(problem, -after),
            )


def stretches(problem: Linearized) -> Iterator[Hypothesis]:
    """For a while ranges read longer."""
    windows, times = list(_windows(problem)), problem.on_map.time_s
    for k in [*(_heard(problem) if len(_heard(problem)) > 1 else []), None]:
        name = "" if k is None else problem.on_map.anchor_ids[k]
        for start, end, share in windows:
            inside = np.where(_is_of(problem.cells.anchor_index, k), share, 0.0)
            if inside.sum() < _MIN_NUM_CELLS:
                continue

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
                correction=_left_out(_of_ranges(problem, k) & (times > start) & (times <= end)),
                effect=of_cells(problem, -inside),
            )


def clock_jumps(problem: Linearized) -> Iterator[Hypothesis]:
    """The clocks' offset jumped at some time."""
    if problem.by_time is None:
        return
    for time, after in _changes(problem, None, _MIN_NUM_CELLS):
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
            effect=of_cells(problem, -after * problem.by_time),
        )


def _heard(problem: Linearized) -> list[int]:
    heard: list[int] = np.unique(problem.cells.anchor_index).tolist()
    return heard


def _of_ranges(problem: Linearized, anchor: int | None) -> Mask:
    return _is_of(problem.on_map.problem.anchor_index, anchor)


def _is_of(anchor_index: Indices, anchor: int | None) -> Mask:
    """Of one anchor, or of all."""
    return np.ones(len(anchor_index), dtype=bool) if anchor is None else np.asarray(anchor_index == anchor)


def _left_out(rows: Mask) -> Callable[[Array], Correction]:
    return lambda _: Correction(left_out=rows)


def _changes(problem: Linearized, anchor: int | None, least: int) -> Iterator[tuple[float, Array]]:
    """Times away from the ends, with (c,) shares of the cells of an anchor, or of all, that are from later; as many
    cells as that at least on either side."""
    ends = _LEAST_SHARE, 1 - _LEAST_SHARE
    times = np.unique(np.quantile(problem.on_map.time_s[_of_ranges(problem, anchor)], np.linspace(*ends, _NUM_TIMES)))
    is_of = _is_of(problem.cells.anchor_index, anchor)
    for time, share in zip(times.tolist(), _shares_after(problem, times), strict=True):
        after = np.where(is_of, share, 0.0)
        if min(after.sum(), is_of.sum() - after.sum()) >= least:
            yield time, after


def _windows(problem: Linearized) -> Iterator[tuple[float, float, Array]]:
    """Begin and end, and (c,) shares of the cells that are from in between."""
    for share in _STRETCHES:
        starts = np.arange(0.0, 1.0 - share + 1e-9, share / 2)
        for start in starts:
            times = np.quantile(problem.on_map.time_s, [start, min(start + share, 1.0)])
            after = _shares_after(problem, times)
            yield float(times[0]), float(times[1]), after[0] - after[1]


def _shares_after(problem: Linearized, times: Array) -> Array:
    """(t, c) of the ranges of each cell, as they are averaged, those that are from later than (t,) rising times."""
    cells, num = problem.cells, len(times) + 1
    of_span = cells.of_range * num + np.searchsorted(times, problem.on_map.time_s)
    worth = np.bincount(of_span, cells.weight, len(cells) * num).reshape(len(cells), num)
    later: Array = np.cumsum(worth[:, :0:-1], axis=1)[:, ::-1].T / cells.worth
    return later


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
    tags_slipped,
    steps,
    stretches,
    clock_jumps,
)
