"""Walls are crossed where a line leads through them, and enclose rooms."""

from __future__ import annotations

import numpy as np

from rangesfm.planning.walls import are_outside, lead_through

ROOM = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0], [0.0, 0.0]])
SHELF = np.array([[2.0, 2.0], [4.0, 2.0]])


def test_lines_lead_through_walls_that_they_cross_and_through_the_gaps_between_them() -> None:
    start, end = np.array([[1.0, 1.0], [3.0, 1.0], [5.0, 1.0]]), np.array([[1.0, 5.0], [3.0, 3.0], [5.0, 3.0]])
    assert lead_through(start, end, [ROOM, SHELF]).tolist() == [True, True, False]
    assert lead_through(start, end, []).tolist() == [False, False, False]


def test_a_place_is_outside_if_it_is_in_no_room_and_at_no_wall() -> None:
    places = np.array([[3.0, 1.0], [6.1, 2.0], [9.0, 2.0], [-1.0, 0.0]])
    assert are_outside(places, [ROOM]).tolist() == [False, False, True, True]
    other_room = ROOM + np.array([8.0, 0.0])
    assert are_outside(places, [ROOM, other_room]).tolist() == [False, False, False, True]
    assert not are_outside(places, [SHELF]).any()  # nothing is outside of a wall that encloses no room
