"""The catalogue of mistakes: each hypothesis in one place. One that is added here is tested, named and told."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.trust.hypothesis import Correction, Effect, Hypothesis, of_anchor_place, of_cells
from rangesfm.trust.linearized import Linearized

_AXES = "xyz"
_SAME_HEIGHT_M = 1e-3
# Of an anchor's ranges: where they follow the distance by less, they hardly change at all.
_STUCK = 0.3
# Along a camera; of an anchor, beside what is drawn on any sketch of the site.
MISMEASURED_M, UNSEEN_MOVE_M = 0.2, 1.0
# Seconds a second: no quartz drifts by more.
_BAD_CLOCK = 1e-3
_MEASURE_AGAIN = "measure it again, or run with it unknown (leave its coordinates in the anchors' file empty)"


def anchor_places(problem: Linearized) -> Iterator[Hypothesis]:
    """An anchor is not where its coordinates say."""
    given_m = problem.on_map.problem.anchor_mean_m
    for k, name in enumerate(problem.on_map.anchor_ids):
        found = of_anchor_place(problem, k, np.eye(3)) if np.any(problem.cells.anchor_index == k) else None
        if found is None:
            continue

        def unknown(_: Array, name: str = name) -> Correction:
            return Correction(anchors_m={name: None})

        def moved(size: Array, name: str = name, at: Array = given_m[k]) -> Correction:
            return Correction(anchors_m={name: at + size})

        coordinates = []
        for axis, of_axis in enumerate(_AXES):

            def typed(size: Array, name: str = name, axis: str = of_axis, at: float = given_m[k, axis]) -> str:
                return (
                    f"anchor {name}'s {axis} is given as {at:.3f} where about {at + size[0]:.2f} fits "
                    f"({size[0]:+.2f} m)"
                )

            def along(size: Array, name: str = name, axis: int = axis, at: Array = given_m[k]) -> Correction:
                return Correction(anchors_m={name: at + size[0] * np.eye(3)[axis]})

            columns = of_anchor_place(problem, k, np.eye(3)[:, [axis]])
            if columns is not None:
                coordinates.append(
                    Hypothesis(
                        "anchor coordinate",
                        f"{name} {of_axis}",
                        unit="m",
                        words=typed,
                        remedy=f"check its {of_axis}, or {_MEASURE_AGAIN}",
                        correction=along,
                        adoption=unknown,
                        effect=columns,
                    )
                )

        def place(size: Array, name: str = name) -> str:
            return (
                f"anchor {name} is about {np.linalg.norm(size):.2f} m from where its coordinates say "
                f"(by {size[0]:+.2f}, {size[1]:+.2f}, {size[2]:+.2f} m in x, y, z)"
            )

        yield Hypothesis(
            "anchor place",
            name,
            unit="m",
            words=place,
            remedy=_MEASURE_AGAIN,
            correction=moved,
            adoption=unknown,
            unawares=UNSEEN_MOVE_M,
            narrower=tuple(coordinates),
            effect=found,
        )


def anchor_biases(problem: Linearized) -> Iterator[Hypothesis]:
    """The ranges of one anchor, or of all, are off by a constant, by more than is usual."""
    heard = np.unique(problem.cells.anchor_index).tolist()
    if len(heard) > 1:
        for k in heard:
            yield _bias(problem, [k], problem.on_map.anchor_ids[k], f"anchor {problem.on_map.anchor_ids[k]}")
    yield _bias(problem, heard, "", "every anchor")


def _bias(problem: Linearized, anchors: list[int], subject: str, whose: str) -> Hypothesis:
    is_of = np.isin(problem.on_map.problem.anchor_index, anchors)

    def words(size: Array) -> str:
        return f"the ranges to {whose} read about {abs(size[0]):.2f} m too {_long(size[0])}"

    def correction(size: Array) -> Correction:
        return Correction(longer_m=np.where(is_of, size[0], 0.0))

    return Hypothesis(
        "anchor bias" if subject else "common bias",
        subject,
        unit="m",
        words=words,
        remedy="calibrate the radio's delay (range_bias_m in the anchors' file), or look for what stands in the way",
        correction=correction,
        is_linear=True,
        is_in_interval=True,
        effect=of_cells(problem, -np.isin(problem.cells.anchor_index, anchors).astype(np.float64)),
    )


def range_shares(problem: Linearized) -> Iterator[Hypothesis]:
    """Ranges grow by more or less than the distance does."""
    by_distance, distance_m = -problem.gradient.distance_m, problem.on_map.problem.range_m

    def words(size: Array) -> str:
        return f"all ranges read about {100 * abs(size[0]):.1f} % too {_long(size[0])}"

    yield Hypothesis(
        "range share",
        "",
        unit="1",
        words=words,
        remedy="check the unit, and the propagation speed that the radio assumes, against a taped distance",
        correction=lambda size: Correction(longer_m=distance_m * size[0] / (1 + size[0])),
        most=0.5,
        is_linear=True,
        is_in_interval=True,
        effect=of_cells(problem, by_distance),
    )
    heard = np.unique(problem.cells.anchor_index)
    for k in heard if len(heard) > 1 else []:
        is_of, of_ranges = problem.cells.anchor_index == k, problem.on_map.problem.anchor_index == k
        mean = problem.gradient.distance_m[is_of].mean()

        def of_one(size: Array, name: str = problem.on_map.anchor_ids[k]) -> str:
            if 1 + size[0] < _STUCK:
                return f"the ranges to anchor {name} hardly change with the distance: it reads nearly the same always"
            return f"the ranges to anchor {name} grow by {1 + size[0]:.2f} m for each metre of distance"

        def left_out(_: Array, of_ranges: Mask = of_ranges) -> Correction:
            return Correction(left_out=of_ranges)

        def level(size: Array, of_ranges: Mask = of_ranges, mean: float = mean) -> Correction:
            grown_m = np.linalg.norm(problem.on_map.from_anchor_m, axis=1) - mean
            return Correction(longer_m=np.where(of_ranges, size[0] * grown_m, 0.0))

        yield Hypothesis(
            "anchor share",
            problem.on_map.anchor_ids[k],
            unit="1",
            words=of_one,
            remedy="look at its ranges in the log, and leave it out (use_anchors)",
            correction=level,
            adoption=left_out,
            is_linear=True,
            is_in_interval=True,
            effect=of_cells(problem, np.where(is_of, by_distance + mean, 0.0)),
        )


def anchors_in_another_scale(problem: Linearized) -> Iterator[Hypothesis]:
    """The anchors' coordinates are in a unit that is not quite the metre."""
    given_m = problem.on_map.problem.anchor_mean_m
    known = np.flatnonzero(np.isfinite(given_m).all(axis=1))
    if len(known) < 2:
        return
    middle = given_m[known].mean(axis=0)
    parts = [of_anchor_place(problem, int(k), (given_m[k] - middle)[:, None]) for k in known]
    found = [part for part in parts if part is not None]
    if not found:
        return

    def words(size: Array) -> str:
        return (
            f"the anchors' coordinates are about {100 * abs(size[0]):.1f} % too {'small' if size[0] > 0 else 'large'}"
        )

    def correction(size: Array) -> Correction:
        ids = problem.on_map.anchor_ids
        return Correction(anchors_m={ids[k]: middle + (1 + size[0]) * (given_m[k] - middle) for k in known})

    yield Hypothesis(
        "anchors' scale",
        "",
        unit="1",
        is_in_interval=True,
        words=words,
        remedy="check the unit of the anchors' coordinates against a taped distance between two of them",
        correction=correction,
        effect=Effect.of_sum(found),
    )


def heights_never_measured(problem: Linearized) -> Iterator[Hypothesis]:
    """All anchors are given one height, and do not have it."""
    given_m, ids = problem.on_map.problem.anchor_mean_m, problem.on_map.anchor_ids
    heard = np.unique(problem.cells.anchor_index)
    known = heard[np.isfinite(given_m[heard]).all(axis=1)]
    if len(known) < 3 or np.ptp(given_m[known, 2]) > _SAME_HEIGHT_M:
        return
    parts = [of_anchor_place(problem, int(k), np.eye(3)[:, 2:]) for k in known]
    found = [part for part in parts if part is not None]
    if len(found) < len(known):
        return

    def words(size: Array) -> str:
        return (
            f"the anchors are all given a height of {given_m[known[0], 2]:g} m where heights fit that differ by "
            f"{np.ptp(size):.1f} m"
        )

    yield Hypothesis(
        "anchor heights",
        "",
        unit="m",
        words=words,
        remedy="measure the heights of the antennas",
        correction=lambda size: Correction(
            anchors_m={ids[k]: given_m[k] + np.array([0.0, 0.0, h]) for k, h in zip(known.tolist(), size, strict=True)}
        ),
        effect=Effect.of_all(found),
    )


def lever_arms(problem: Linearized) -> Iterator[Hypothesis]:
    """The tag is elsewhere on the camera."""
    for k in np.unique(problem.cells.tag_index).tolist():
        name = problem.on_map.tag_ids[k] if len(problem.on_map.tag_ids) > 1 else ""
        of_tag = problem.on_map.tag_index == k
        length_m = float(np.median(np.linalg.norm(problem.on_map.problem.tag_from_center[of_tag], axis=1)))
        columns = np.where((problem.cells.tag_index == k)[:, None], -problem.by_lever_arm, 0.0)

        def words(size: Array, name: str = name, is_given: bool = length_m > 0) -> str:
            of_tag, far = f" of tag {name}" if name else "", f"about {np.linalg.norm(size):.2f} m"
            what = (
                f"the lever arm{of_tag} is off by {far}" if is_given
                else f"no lever arm{of_tag} is given, and the tag sits {far} from the lens"
            )  # fmt: skip
            return f"{what} ({size[0]:+.2f}, {size[1]:+.2f}, {size[2]:+.2f} m along the camera's x, y, z)"

        def correction(size: Array, tag: str = problem.on_map.tag_ids[k]) -> Correction:
            return Correction(tag_moves_m={tag: size})

        yield Hypothesis(
            "lever arm",
            name,
            unit="m",
            words=words,
            remedy="measure where the tag's antenna sits, x to the right, y down, z forward (--tag_in_cam)",
            correction=correction,
            unawares=MISMEASURED_M + 2 * length_m,  # the other way round
            effect=of_cells(problem, columns),
        )


def radios_warming(problem: Linearized) -> Iterator[Hypothesis]:
    """The radio's delay grows or shrinks all the time, by more than radios drift."""
    of_ranges, since = problem.on_map.time_s - problem.time_s.mean(), problem.time_s - problem.time_s.mean()
    lasts, unit = float(np.ptp(of_ranges)), "s" if problem.by_time is not None else "m of the path"

    def words(size: Array) -> str:
        how = "longer" if size[0] > 0 else "shorter"
        return f"the ranges get {how} and {how}, by about {abs(size[0]):.2f} m within {lasts:.0f} {unit}"

    yield Hypothesis(
        "radio drift",
        "",
        unit="m",
        words=words,
        remedy="let the radio warm up before the survey, or calibrate it at the end too",
        correction=lambda size: Correction(longer_m=size[0] / lasts * of_ranges),
        is_linear=True,
        effect=of_cells(problem, -since / lasts),
    )


def people_in_between(problem: Linearized) -> Iterator[Hypothesis]:
    """Whoever carries the camera stands between the tag and the anchors behind."""
    on_map = problem.on_map
    is_behind = np.sum(on_map.from_anchor_m * on_map.world_from_cam[:, :, 2], axis=1) > 0

    def words(size: Array) -> str:
        return f"the ranges to anchors behind the camera read about {abs(size[0]):.2f} m too {_long(size[0])}"

    yield Hypothesis(
        "behind the camera",
        "",
        unit="m",
        words=words,
        remedy="carry the tag above the head, or see what stands behind it",
        correction=lambda size: Correction(longer_m=np.where(is_behind, size[0], 0.0)),
        is_linear=True,
        unawares=MISMEASURED_M,
        effect=of_cells(problem, -problem.cells.mean(is_behind.astype(np.float64))),
    )


def clocks(problem: Linearized) -> Iterator[Hypothesis]:
    """The clocks of camera and radio differ otherwise than assumed."""
    if problem.by_time is None:
        return
    since = problem.time_s - problem.time_s.mean()

    def offset(size: Array) -> str:
        return f"the clocks are off by about {abs(size[0]):.2f} s more than assumed ({size[0]:+.2f} s on the offset)"

    def drift(size: Array) -> str:
        return f"the radio's clock runs {1e6 * abs(size[0]):.0f} ppm too {'slow' if size[0] > 0 else 'fast'}"

    remedy = "let the offset be searched for (ranges_time_offset auto), or film a sharp turn at both ends"
    yield Hypothesis(
        "clock offset",
        "",
        unit="s",
        words=offset,
        remedy=remedy,
        correction=lambda size: Correction(time_shift_s=float(size[0])),
        effect=of_cells(problem, -problem.by_time),
    )
    of_ranges = problem.on_map.time_s - problem.time_s.mean()
    yield Hypothesis(
        "clock drift",
        "",
        unit="s/s",
        words=drift,
        remedy=remedy,
        correction=lambda size: Correction(time_shift_s=size[0] * of_ranges),
        unawares=_BAD_CLOCK,
        effect=of_cells(problem, -problem.by_time * since),
    )


def _long(size: float) -> str:
    return "long" if size > 0 else "short"


STANDING: tuple[Callable[[Linearized], Iterator[Hypothesis]], ...] = (
    anchor_places,
    anchor_biases,
    range_shares,
    anchors_in_another_scale,
    heights_never_measured,
    lever_arms,
    radios_warming,
    people_in_between,
    clocks,
)
"""Mistakes that last for the whole survey."""
