"""The motion of a map as a whole, or keyframe by keyframe with its points."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.geometry.similarity import Similarity
from rangesfm.refine.graph_presolve import (
    _as_a_whole,
    presolve_with_loops,
)
from rangesfm.refine.vision_information import Poses


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


def test_without_ranges_the_graph_closes_no_loop() -> None:
    radio = SimpleNamespace(anchors=())
    nothing: Any = SimpleNamespace(ranges=SimpleNamespace(rows=np.zeros(0, dtype=np.int64)), radio=radio)
    unused: Any = None
    found, is_near = presolve_with_loops(nothing, unused, unused, unused, unused, 1.0)
    assert (found.bend_m, found.num_steps, is_near) == (0.0, 0, False)
