"""The plane of the anchors, and on which side of it a path lies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.known import known
from tests.simulated.range_problem import range_problem

from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.scale.anchor_plane import anchor_plane, camera_side_of, is_on_side, mirrored_map
from rangesfm.scale.range_equation import RangeProblem, RangeState

Array = npt.NDArray[np.float64]
LEVEL_M = [(0, 0, 2), (4, 0, 2), (4, 5, 2), (0, 5, 2)]
GRAVITY = Gravity(np.array([0.0, 0.0, 1.0]), 0.01)
PATH = np.column_stack([np.linspace(0, 4, 20), np.sin(np.linspace(0, 5, 20)), 0.1 * np.cos(np.linspace(0, 9, 20))])


def problem(
    anchors_m: Sequence[Sequence[float]], centers: Array = PATH, gravity: Gravity | None = None
) -> RangeProblem:
    return range_problem(centers, np.array(anchors_m, dtype=np.float64), gravity=gravity)


def at(height_m: float, of: RangeProblem, scale: float = 1.0) -> RangeState:
    """Return the map with its path about so high."""
    placed = Similarity(scale, np.eye(3), np.array([0.0, 0.0, height_m]))
    return RangeState(placed, of.anchor_mean_m.copy(), np.zeros(of.num_anchors))


def test_level_anchors_have_a_plane_through_their_middle_whose_normal_is_up() -> None:
    point, normal = known(anchor_plane(problem([*LEVEL_M, (np.nan, np.nan, np.nan)])))
    np.testing.assert_allclose(point, (2, 2.5, 2))
    np.testing.assert_allclose(normal, (0, 0, 1), atol=1e-12)


@pytest.mark.parametrize(("off_m", "is_plane"), [(0.18, True), (0.22, False)])
def test_anchors_have_a_plane_if_they_are_near_one(off_m: float, is_plane: bool) -> None:
    """Off by up to a tenth of their standard deviation along the shorter side, which is 2 m here."""
    near = [(x, y, z + off_m * (-1) ** k) for k, (x, y, z) in enumerate(LEVEL_M)]
    assert (anchor_plane(problem(near)) is not None) == is_plane


def test_one_anchor_has_no_plane() -> None:
    assert anchor_plane(problem([(1, 2, 3)])) is None
    assert camera_side_of(problem([(1, 2, 3)]), at(0.0, problem([(1, 2, 3)]))) is None


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 69.0])
def test_anchors_on_a_line_have_a_plane_that_is_level_across_it_if_gravity_is_known(tilt_deg: float) -> None:
    along = np.array([np.cos(np.deg2rad(tilt_deg)), 0.0, np.sin(np.deg2rad(tilt_deg))])
    line = [tuple(4 * k * along) for k in range(3)]
    _, normal = known(anchor_plane(problem(line, gravity=GRAVITY)))
    assert normal @ along == pytest.approx(0, abs=1e-12)
    assert normal[1] == pytest.approx(0, abs=1e-12)
    assert normal[2] == pytest.approx(np.cos(np.deg2rad(tilt_deg)))
    assert anchor_plane(problem(line)) is None


@pytest.mark.parametrize(("lean_m", "is_plane"), [(1.5, False), (2.5, True)])
def test_a_line_that_is_nearly_upright_has_none(lean_m: float, is_plane: bool) -> None:
    """Less than 20 degrees from the vertical: 1.5 m over 5 m are 17 degrees, 2.5 m are 27."""
    assert (anchor_plane(problem([(0, 0, 0), (lean_m, 0, 5)], gravity=GRAVITY)) is not None) == is_plane


@pytest.mark.parametrize("height_m", [-1.0, 4.0])
def test_the_mirrored_map_has_its_path_as_far_on_the_other_side_with_the_same_ranges(height_m: float) -> None:
    flat = PATH * (1, 1, 0)
    of = problem(LEVEL_M, flat)
    before = at(height_m, of)
    after = known(mirrored_map(of, before))
    placed = after.metric_from_model
    np.testing.assert_allclose(placed.apply(flat), flat + np.array([0, 0, 4 - height_m]), atol=1e-12)
    assert np.linalg.det(placed.rotation) == pytest.approx(1)
    assert mirrored_map(problem([(1, 2, 3)], flat), before) is None
    solid = known(mirrored_map(problem(LEVEL_M), at(height_m, of, 2.0))).metric_from_model
    assert solid.scale == 2.0
    middle = at(height_m, of, 2.0).metric_from_model.apply(PATH.mean(axis=0))
    np.testing.assert_allclose(solid.apply(PATH.mean(axis=0)), middle * (1, 1, -1) + np.array([0, 0, 4]), atol=1e-12)


@pytest.mark.parametrize(
    ("height_m", "share_below", "side"),
    [
        (3, 0, "above"),
        (0, 0, "below"),
        (3, 0.05, "above"),
        (3, 0.3, "on both sides of"),
        (3, 0.95, "below"),
        (1.5, 0, "below"),
    ],
)
def test_a_path_is_on_the_side_where_nine_tenths_of_it_are(height_m: float, share_below: float, side: str) -> None:
    heights = np.where(np.arange(20) < 20 * share_below, -2.0, 0.0) * (1 if height_m > 2 else 0)
    of = problem(LEVEL_M, np.column_stack([PATH[:, :2], heights]))
    state = at(height_m, of)
    assert camera_side_of(of, state) == side
    for said in ("above", "below"):
        assert is_on_side(of, state, said) == (said == side)
    assert is_on_side(of, state, None)


@pytest.mark.parametrize("tilt_deg", [69.5, 70.5])
def test_an_upright_plane_has_nothing_above_it(tilt_deg: float) -> None:
    c, s = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    tilted = (np.array(LEVEL_M, dtype=np.float64) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]).T).tolist()
    of = problem(tilted)
    state = replace(at(0.0, of), metric_from_model=IDENTITY)
    if tilt_deg < 70:
        assert camera_side_of(of, state) in ("above", "below", "on both sides of")
    else:
        with pytest.raises(GeometryError, match="the anchors stand in an upright plane"):
            camera_side_of(of, state)
