"""Derivatives of the distance from anchor to tag."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.measurements.ranges.range_gradient import RangeGradient

Array = npt.NDArray[np.float64]
NUM = 6
RNG = np.random.default_rng(0)
SCALE, TAG_IN_CAM, ANCHOR = 1.7, 0.3 * RNG.normal(size=3), 5 * RNG.normal(size=(NUM, 3))
CENTERS, WORLD_FROM_CAM = RNG.normal(size=(NUM, 3)), Rotation.random(NUM, rng=RNG).as_matrix()
LEVERS = WORLD_FROM_CAM @ TAG_IN_CAM


def turned(vector: Array) -> Array:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def distance_after(from_anchor: Callable[[Array], Array], step: Array) -> Array:
    return np.asarray(np.linalg.norm(from_anchor(step), axis=1))


@pytest.mark.parametrize(
    ("size", "from_anchor", "slopes"),
    [
        (3, lambda x: SCALE * CENTERS + LEVERS + x - ANCHOR, lambda by: by.by_tag),
        (3, lambda x: SCALE * CENTERS + LEVERS - ANCHOR - x, lambda by: by.by_anchor),
        (
            1,
            lambda x: np.exp(x[0]) * SCALE * CENTERS + LEVERS - ANCHOR,
            lambda by: by.by_log_scale(SCALE * CENTERS)[:, None],
        ),
        (
            3,
            lambda x: (SCALE * CENTERS + LEVERS) @ turned(x).T - ANCHOR,
            lambda by: by.by_turn_of_world(SCALE * CENTERS + LEVERS),
        ),
        (
            3,
            lambda x: SCALE * CENTERS + WORLD_FROM_CAM @ (TAG_IN_CAM + x) - ANCHOR,
            lambda by: by.by_tag_in_cam(WORLD_FROM_CAM),
        ),
    ],
    ids=["tag", "anchor", "scale", "turn of the world", "lever arm"],
)
def test_slopes_are_finite_differences(
    size: int, from_anchor: Callable[[Array], Array], slopes: Callable[[RangeGradient], Array]
) -> None:
    by = RangeGradient.of(from_anchor(np.zeros(size)))
    np.testing.assert_allclose(by.distance_m, distance_after(from_anchor, np.zeros(size)), rtol=1e-15)
    steps = 1e-6 * np.eye(size)
    differences = [distance_after(from_anchor, step) - distance_after(from_anchor, -step) for step in steps]
    np.testing.assert_allclose(slopes(by), np.stack(differences, axis=1) / 2e-6, rtol=1e-6, atol=1e-8)


def test_with_the_tag_on_the_anchor_all_numbers_are_finite() -> None:
    by = RangeGradient.of(np.zeros((1, 3)))
    assert by.distance_m == [0.0]
    np.testing.assert_array_equal(by.by_tag, 0.0)
