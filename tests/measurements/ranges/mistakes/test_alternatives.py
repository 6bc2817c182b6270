"""Each reading of the axes of the anchors is the one that its words say."""

from __future__ import annotations

import numpy as np
import pytest
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import Mistake
from rangesfm.measurements.ranges.mistakes import alternatives as module


def places_of(found: Mistake) -> dict[str, list[float]]:
    """Corrected places of anchors, rounded to a nanometre."""
    return {name: np.round(known(at), 9).tolist() for name, at in found.correction(np.zeros(0)).anchors_m.items()}


def of_coordinates(given: dict[str, Array]) -> dict[str, Mistake]:
    return {each.words(np.zeros(0)): each for each in module._of_coordinates(given)}


@pytest.mark.parametrize(
    ("words", "of_first"),
    [
        ("in the anchors' coordinates x and y (east and north) are swapped, or heights are depths", [2.0, 1.0, 3.0]),
        ("in the anchors' coordinates y and z are swapped", [1.0, 3.0, 2.0]),
        ("in the anchors' coordinates x has the wrong sign", [-1.0, 2.0, 3.0]),
        (
            "in the anchors' coordinates heights have the wrong sign (they are depths), or x and y (east and north) "
            "are swapped",
            [1.0, 2.0, -3.0],
        ),
    ],
)
def test_axes_of_the_anchors_are_changed_as_the_words_say(words: str, of_first: list[float]) -> None:
    given = {"A": np.array([1.0, 2.0, 3.0]), "B": np.zeros(3), "C": np.array([0.0, 0, 5])}
    found = of_coordinates(given)[words]
    assert (found.name, found.subject) == ("anchors' axes", "")
    assert "sketch" in found.remedy
    corrected = places_of(found)
    assert corrected["A"] == of_first
    assert corrected["B"] == [0, 0, 0]
    assert [*corrected] == ["A", "B", "C"]
