"""The motion of a map as a whole, or keyframe by keyframe with its points."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.model import synthetic_model
from tests.simulated.path import orbit_path

from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import pose_of
from rangesfm.refine import graph_presolve
from rangesfm.refine.graph_presolve import (
    _as_a_whole,
    _bend,
    _carried,
    _move,
    _tolerance_m,
    _triangulated,
    carry_model,
    presolve_with_loops,
)
from rangesfm.refine.vision_information import Observations, Poses, costs_of_points, model_observations, model_poses

Array = npt.NDArray[np.float64]
WHOLE = Similarity(1.3, Rotation.from_rotvec([0.4, -0.2, 0.7]).as_matrix(), np.array([3.0, -2.0, 1.0]))


def poses(seed: int = 0) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(Rotation.random(8, rng).as_matrix(), rng.normal(0, 5, (8, 3)))


def moved(before: Poses, by: Similarity) -> Poses:
    return Poses(by.rotation @ before.world_from_rig, by.apply(before.centers))


def test_a_similarity_is_found() -> None:
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    by = Similarity(1.1, turn, np.array([1.0, -2.0, 0.5]))
    found = _as_a_whole(poses(), moved(poses(), by), None)
    assert found.scale == pytest.approx(1.1, abs=1e-12)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(found.translation, by.translation, atol=1e-12)


def test_a_keyframe_that_is_held_stays() -> None:
    before = poses()
    by = Similarity(0.8, np.eye(3), 0.2 * before.centers[3])
    found = _as_a_whole(before, moved(before, by), 3)
    assert found.scale == pytest.approx(0.8, abs=1e-12)
    np.testing.assert_allclose(found.apply(before.centers[3]), before.centers[3], atol=1e-12)


def test_a_path_turned_inside_out_or_of_one_place_keeps_its_scale() -> None:
    before = poses()
    inside_out = Poses(before.world_from_rig, -before.centers)
    assert _as_a_whole(before, inside_out, None).scale == 1.0
    one_place = Poses(before.world_from_rig, np.ones((8, 3)))
    assert _as_a_whole(one_place, one_place, None).scale == 1.0
    elsewhere = np.random.default_rng(1).choice(np.array([0.1, 0.1 + 1e-16, 0.1 - 1e-16]), (7, 3))
    before, after = (Poses(poses().world_from_rig[:7], at) for at in (np.full((7, 3), 0.1), elsewhere))
    for held_frame in (None, 0):
        assert _as_a_whole(before, after, held_frame).scale == 1.0
        assert _as_a_whole(after, before, held_frame).scale == 1.0


def a_map() -> tuple[pycolmap.Reconstruction, Poses, Observations]:
    """Return an exact map of six photos, its poses and the observations of its points."""
    times, path = np.arange(6.0), orbit_path(8.0)
    given = (times, path.centers(times), path.world_from_cam(times))
    metric = synthetic_model(*given, num_observations=20).reconstruction
    frame_ids = np.arange(1, 7)
    return metric, model_poses(metric, frame_ids), model_observations(metric, frame_ids)


def points_of(metric: pycolmap.Reconstruction, rays: Observations) -> Array:
    return np.array([metric.point3D(point_id).xyz for point_id in rays.point_ids.tolist()])


def test_a_map_that_is_carried_as_a_whole_stays_the_same_map() -> None:
    metric, before, rays = a_map()
    arrays = [pose_of(metric.frame(k)).params for k in range(1, 7)]
    after = moved(before, WHOLE)
    carry_model(metric, np.arange(1, 7), rays, before, after, np.full(6, 1.3))
    found = model_poses(metric, np.arange(1, 7))
    np.testing.assert_allclose(found.centers, after.centers, atol=1e-9)
    np.testing.assert_allclose(found.world_from_rig, after.world_from_rig, atol=1e-9)
    np.testing.assert_allclose(points_of(metric, rays), WHOLE.apply(rays.points), atol=1e-6)
    # A solver that has the arrays sees the change.
    np.testing.assert_array_equal(arrays, [pose_of(metric.frame(k)).params for k in range(1, 7)])
    assert np.abs(arrays[0][4:]).max() > 0


def test_frames_that_turn_or_shift_are_moved_and_others_not_touched() -> None:
    metric, before, rays = a_map()
    turns, centers = before.world_from_rig.copy(), before.centers.copy()
    turns[1] = turns[1] @ Rotation.from_rotvec([0.0, 1e-3, 0.0]).as_matrix()
    centers[3, 1] += 1e-3
    at_start = [pose_of(metric.frame(k)).params.copy() for k in range(1, 7)]
    carry_model(metric, np.arange(1, 7), rays, before, Poses(turns, centers), np.ones(6))
    found = model_poses(metric, np.arange(1, 7))
    np.testing.assert_allclose(found.centers, centers, atol=1e-12)
    np.testing.assert_allclose(found.world_from_rig, turns, atol=1e-12)
    same = [np.array_equal(pose_of(metric.frame(k)).params, at_start[k - 1]) for k in range(1, 7)]
    assert same == [True, False, True, False, True, True]


def rays_of(frame: list[int], point: list[int], points: Array) -> Observations:
    """Return exact observations from cameras without a rig, whose poses are moved later."""
    num = len(frame)
    return Observations(
        np.array(frame), np.array(point), np.zeros((num, 2)), np.full(num, 100.0), np.tile(np.eye(3), (num, 1, 1)),
        np.zeros((num, 3)), points, np.arange(len(points)),
    )  # fmt: skip


def test_a_point_is_carried_by_the_first_keyframe_that_sees_it() -> None:
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    rays = rays_of([0, 1, 1], [0, 0, 2], points)  # nothing sees the second point
    before = Poses(np.tile(np.eye(3), (2, 1, 1)), np.array([[1.0, 0.0, 0.0], [7.0, 8.0, 0.0]]))
    quarter = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix()
    after = Poses(np.array([quarter, np.eye(3)]), np.array([[10.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    found = _carried(rays, before, after, np.array([2.0, 3.0]))
    # (0, 2, 3) from the first keyframe, turned and doubled; (0, 0, 9) from the second, tripled.
    np.testing.assert_allclose(found, [[6.0, 0.0, 6.0], [4.0, 5.0, 6.0], [0.0, 0.0, 28.0]], atol=1e-12)
    np.testing.assert_array_equal(rays.points, points)


def test_points_that_are_off_are_triangulated_anew() -> None:
    _, before, rays = a_map()
    off = rays.points + 0.05 * np.random.default_rng(0).normal(size=rays.points.shape)
    np.testing.assert_allclose(_triangulated(rays, before, off), rays.points, atol=1e-6)
    assert costs_of_points(rays, before, off).min() > 1


def test_triangulation_makes_no_point_worse_even_from_behind_a_camera() -> None:
    _, before, rays = a_map()
    start = rays.points + 3.0 * np.random.default_rng(1).normal(size=rays.points.shape)
    cost = costs_of_points(rays, before, start)
    assert np.isinf(cost).any()
    found = _triangulated(rays, before, start)
    after = costs_of_points(rays, before, found)
    assert np.all((after <= cost) | np.isinf(cost))
    assert np.mean(after < cost) > 0.5
    assert np.isfinite(found).all()


def test_the_tolerance_is_a_share_of_the_smallest_error_of_a_range() -> None:
    errors: Any = SimpleNamespace(stddev_m=np.array([0.5, 0.2, 0.3]))
    assert _tolerance_m(errors) == pytest.approx(0.001 * 0.2)
    assert _tolerance_m(errors, 0.05) == pytest.approx(0.05 * 0.2)


SQUARE = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])
SADDLE = np.array([0.0, 0.0, 1.0]) * np.array([1.0, -1.0, 1.0, -1.0])[:, None]


def test_a_bend_is_what_no_similarity_explains() -> None:
    assert _bend(SQUARE, WHOLE.apply(SQUARE)) == pytest.approx(0.0, abs=1e-12)
    assert _bend(SQUARE, SQUARE + 0.2 * SADDLE) == pytest.approx(0.2)
    assert _bend(SQUARE[:3], SQUARE[:3] * [1.0, 2.0, 1.0]) > 0.1
    assert _bend(SQUARE[:2], SADDLE[:2] + 7.0) == 0.0


@pytest.mark.parametrize("first_pose_is_fixed", [True, False])
@pytest.mark.parametrize(("bend_m", "is_bent"), [(0.0149, False), (0.0151, True)])
def test_a_map_is_moved_as_a_whole_if_it_bends_less_than_a_twentieth_of_a_range(
    bend_m: float, is_bent: bool, first_pose_is_fixed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    metric, _, rays = a_map()
    carried: list[Any] = []
    monkeypatch.setattr(graph_presolve, "carry_model", lambda *given: carried.append(given))
    monkeypatch.setattr(graph_presolve, "local_scales", lambda vision, after: (vision, after))
    before = Poses(np.tile(np.eye(3), (4, 1, 1)), SQUARE)
    after = Poses(before.world_from_rig, 2.0 * SQUARE + 5.0 + bend_m * SADDLE)
    vision: Any = SimpleNamespace(origin=before)
    problem: Any = SimpleNamespace(
        metric=metric, held_frame=None, frame_ids=np.arange(1, 5), first_frame_id=2,
        first_pose_is_fixed=first_pose_is_fixed,
    )  # fmt: skip
    errors: Any = SimpleNamespace(stddev_m=np.array([0.1, 0.3, 0.9]))
    held = pose_of(metric.frame(2)).params.copy()
    _move(problem, rays, vision, after, errors)
    if is_bent:
        ((*_, scales),) = carried
        assert carried[0][0] is metric
        assert scales == (vision, after)
        np.testing.assert_array_equal(points_of(metric, rays), rays.points)
    else:
        assert carried == []
        np.testing.assert_allclose(points_of(metric, rays), 2.0 * rays.points + 5.0, atol=1e-9)
    # Only the solver's own frame is put back, if it holds the gauge.
    is_same = np.array_equal(pose_of(metric.frame(2)).params, held)
    assert is_same == (is_bent or first_pose_is_fixed)


def test_without_ranges_the_graph_closes_no_loop() -> None:
    radio = SimpleNamespace(anchors=())
    nothing: Any = SimpleNamespace(ranges=SimpleNamespace(rows=np.zeros(0, dtype=np.int64)), radio=radio)
    unused: Any = None
    found, is_near = presolve_with_loops(nothing, unused, unused, unused, unused, 1.0)
    assert (found.bend_m, found.num_steps, is_near) == (0.0, 0, False)
