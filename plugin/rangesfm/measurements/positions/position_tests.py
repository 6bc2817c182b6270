"""Tests of known positions: each control point against all others, and those of an antenna together."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from rangesfm.measurements.joint_map import JointMap
from rangesfm.measurements.positions.grouped_positions import at_point
from rangesfm.measurements.positions.known_positions import MIN_NUM_POSITIONS
from rangesfm.options import LEVER_ARM_M
from rangesfm.solver.linear_map import FALSE_ALARM_RATE
from rangesfm.solver.mistakes import MistakeTest, MistakeTests, in_axes, row_of_mistake
from rangesfm.util.processes.threads import with_one_blas_thread

if TYPE_CHECKING:  # which imports this module
    from rangesfm.measurements.positions.position_scale import PositionScale

LOOK_AGAIN = "look whether its coordinates were mistyped, or its marks are of another point"
_POINT, _CHECK_POINT = "control point", "check point"
_ARM, _CLOCK, _DATUM = "antenna's lever arm", "antenna's clock", "datum shift"
# Words, remedy and unit of the mistakes of an antenna's positions.
_OF_ANTENNA = {
    _ARM: (
        "the antenna sits elsewhere on the camera, by {} (right, down, forward)",
        "measure from lens to antenna again ([positions] antenna_in_cam_m)",
        "m",
    ),
    _CLOCK: (
        "the times of the positions are {} LATE",
        "look for leap seconds, or let the offset be searched for ([positions] time_offset)",
        "s",
    ),
    _DATUM: (
        "the positions and the control points have frames that are shifted by {}",
        "look which coordinate system and which height each of them has",
        "m",
    ),
}


@with_one_blas_thread
def tests_of_positions(positions: PositionScale, on_map: JointMap, against: Sequence[MistakeTest]) -> MistakeTests:
    """Return the tests of known positions.

    Args:
        on_map: all that is measured in the map. against: tests that compare the positions with other kinds.
    """
    left_out = positions.names_left_out
    rows = [*_of_points(positions, on_map, left_out), *_of_antenna(positions, on_map)]
    # Beside others that place the map, check points are compared with the map that all hold.
    if not any(each.places_map and each.kind != positions.kind for each in on_map.kinds):
        rows += _of_check_points(positions, on_map, left_out)
    reasons = [
        f"probably {row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}; it is left out"
        for row in rows
        if row.rejected and row.subject in left_out
    ]
    likely = [*_likeliest(rows), *(row for row in rows if row.rejected and row.name == _CHECK_POINT)]
    reasons += [f"probably {row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}" for row in likely]
    if doubted := [row.words for row in rows if row.rejected and row.name == _POINT and row.subject not in left_out]:
        reasons.append(f"either {'; or '.join(doubted)}: {LOOK_AGAIN}")
    reasons += [f"{row.words}: {row.remedy}" for row in against if row.rejected]
    rows += against
    rows.sort(key=lambda row: row.threshold - row.statistic)
    return MistakeTests(tuple(rows), tuple(reasons), of_place=tuple(reasons))


def _of_points(positions: PositionScale, on_map: JointMap, left_out: Collection[str]) -> Iterator[MistakeTest]:
    """Yield the test of each control point against all others."""
    known = positions.known
    for row in np.flatnonzero(known.is_mark).tolist():
        if not known.is_check[row] or known.names[row] in left_out:
            yield _of_point(positions, on_map, _POINT, row, positions.threshold)


def _of_check_points(positions: PositionScale, on_map: JointMap, left_out: Collection[str]) -> Iterator[MistakeTest]:
    """Yield the test of each check point against the control points, which it does not move."""
    known = positions.known
    rows = [row for row in np.flatnonzero(known.is_mark & known.is_check).tolist() if known.names[row] not in left_out]
    threshold = float(special.chdtri(3, FALSE_ALARM_RATE / max(len(rows), 1)))
    for row in rows:
        yield replace(_of_point(positions, on_map, _CHECK_POINT, row, threshold), effect_on_scale=0.0)


def _of_point(positions: PositionScale, on_map: JointMap, kind: str, row: int, threshold: float) -> MistakeTest:
    columns, name = positions.columns_of(on_map, at_point(positions.known, row)), positions.known.names[row]
    found = on_map.problem.mistake(columns)
    far = f"{np.linalg.norm(found.sizes):.2f} m from its coordinates ({in_axes(-found.sizes)})"
    return row_of_mistake(kind, name, found, threshold, f"the {kind} {name} is {far}", LOOK_AGAIN)


def _likeliest(rows: Sequence[MistakeTest]) -> Sequence[MistakeTest]:
    """Return the mistake of the antenna with the largest statistic, if any was found."""
    found = [row for row in rows if row.rejected and row.name in _OF_ANTENNA]
    return sorted(found, key=lambda row: -row.statistic)[:1]


def _of_antenna(positions: PositionScale, on_map: JointMap) -> Iterator[MistakeTest]:
    """Yield the tests of mistakes that change all positions of an antenna."""
    known, placed = positions.known, on_map.estimate
    rotation, is_antenna = placed.rotation, ~known.is_mark & positions.used
    if not is_antenna.any():
        return
    shown = is_antenna[:, None, None]
    columns = {_ARM: np.where(shown, rotation @ known.world_from_cam, 0.0)}
    if known.velocity.any() and not known.clock_stddev_s.any():  # an offset that was searched for has no mistake
        moves = placed.scale * known.velocity @ rotation.T
        columns[_CLOCK] = np.where(shown, moves[:, :, None], 0.0)
    if (known.is_mark & positions.used).sum() >= MIN_NUM_POSITIONS:
        columns[_DATUM] = np.where(shown, np.eye(3), 0.0)
    # Clocks that differ by more than the positions last have no moment in common.
    most = {_ARM: LEVER_ARM_M.most, _CLOCK: float(np.ptp(known.time_s[is_antenna]))}
    for name, of_all in columns.items():
        by = of_all.reshape(3 * len(known), -1)
        found = on_map.problem.learnt(in_problem := positions.columns_of(on_map, by)).mistake(in_problem)
        threshold = float(special.chdtri(max(found.num, 1), FALSE_ALARM_RATE / len(columns)))
        words, remedy, unit = _OF_ANTENNA[name]
        if np.linalg.norm(found.sizes) > most.get(name, np.inf):
            found = replace(found, statistic=0.0)
        said = words.format(in_axes(found.sizes) if len(found.sizes) == 3 else f"{abs(found.sizes[0]):.2f} s")
        if name == _CLOCK:
            said = said.replace("LATE", "late" if found.sizes[0] < 0 else "early")
        yield row_of_mistake(name, "", found, threshold, said, remedy, unit)
