"""Every kind of measurement: its derivatives are those of its residuals, and its cost is what its weights say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.measurements.conftest import KINDS, Scene, marker_of, moved

from rangesfm.measurements.kind import Block, Linearization, MapState, Measurements
from rangesfm.measurements.marks import add_marks, remove_marks
from rangesfm.measurements.points import NamedPoints
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import bundle_adjustment
from rangesfm.util.geometry.trajectory import pose_of

Array = npt.NDArray[np.float64]
STEP = 1e-5

BROUGHT_BY = {"prior": "range", "bias walk": "inertial"}
"""What brings the blocks of a prior into a problem."""


def difference(kind: Measurements, at: Callable[[float], MapState]) -> Array:
    plus, minus = (kind.linearize(at(sign * STEP)).residual for sign in (1, -1))
    return np.asarray((plus - minus) / (2 * STEP))


def by_keyframe(linear: Linearization, frame: int) -> Array:
    """Return the (g, d, 6) derivatives by one keyframe, which a group may name twice."""
    is_it = (linear.pose == frame)[:, None, :, None]
    return np.asarray(np.sum(np.where(is_it, linear.by_pose, 0.0), axis=2))


@pytest.mark.parametrize("name", KINDS)
def test_derivatives_by_keyframes_are_those_of_the_residuals(name: str, scene: Scene) -> None:
    kind, state = scene.kinds[name], scene.state
    linear = kind.linearize(state)
    for frame in range(len(state.poses)):
        expected = [difference(kind, turned_or_shifted(state, frame, unit)) for unit in np.eye(6)]
        np.testing.assert_allclose(by_keyframe(linear, frame), np.stack(expected, axis=2), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", KINDS)
def test_derivatives_by_blocks_are_those_of_the_residuals(name: str, scene: Scene) -> None:
    kind, state = scene.kinds[name], scene.state
    linear = kind.linearize(state)
    for block, at in state.blocks.items():
        found = np.zeros((*linear.residual.shape, len(at)))
        for by in linear.by_block:
            if block in by.blocks:
                found += np.where((by.index == by.blocks.index(block))[:, None, None], by.values, 0.0)
        expected = [difference(kind, changed(state, block, unit)) for unit in np.eye(len(at))]
        np.testing.assert_allclose(found, np.stack(expected, axis=2), rtol=1e-5, atol=1e-7)


def turned_or_shifted(state: MapState, frame: int, unit: Array) -> Callable[[float], MapState]:
    return lambda step: replace(state, poses=moved(state.poses, frame, step * unit))


def changed(state: MapState, block: Block, unit: Array) -> Callable[[float], MapState]:
    return lambda step: replace(state, blocks={**state.blocks, block: state.blocks[block] + step * unit})


@pytest.mark.parametrize("name", KINDS)
def test_the_compiled_cost_is_that_of_the_weights(name: str, scene: Scene) -> None:
    """Half the squares of each group's residuals in the cost are its cost by residual, weight and loss."""
    model, kind = pycolmap.Reconstruction(scene.model), scene.kinds[name]
    camera = CameraOptions(refine_intrinsics=False)
    ids = add_marks(model, scene.markers)
    adjustment = bundle_adjustment(model, camera, RefineOptions(), num_threads=1, marker_ids=ids.values())
    blocks = {block: at.copy() for block, at in scene.state.blocks.items()}
    blocks |= {("mark", mark): model.point3D(id_).xyz for mark, id_ in ids.items()}
    poses = [pose_of(model.frame(int(frame_id))).params for frame_id in scene.path.frame_ids]
    if name in BROUGHT_BY:
        scene.kinds[BROUGHT_BY[name]].add_to(adjustment, poses, blocks)
    first = adjustment.adjuster.problem.num_residuals()
    kind.add_to(adjustment, poses, blocks)
    residuals = np.asarray(adjustment.adjuster.problem.evaluate_residuals())[first:] / adjustment.pixel_stddev
    weights, linear = kind.weights, kind.linearize(replace(scene.state, blocks=blocks))
    scaled = weights.whitened(linear.residual)
    expected = 0.5 * weights.share * weights.loss.rho(np.sum(scaled**2, axis=1))[0]
    # The residuals of a group are together; groups may be in another order.
    found = 0.5 * np.sum(residuals.reshape(scaled.shape) ** 2, axis=1)
    np.testing.assert_allclose(np.sort(found), np.sort(expected), rtol=1e-6)
    assert expected.sum() > 0
    remove_marks(model, ids)


def test_rays_of_exact_marks_meet_in_the_point(scene: Scene) -> None:
    points = [point for point in scene.model.points3D.values() if point.track.length() > 3]
    exact = {f"P{k}": marker_of(scene.model, point) for k, point in enumerate(points)}
    named = NamedPoints.in_model(scene.model, exact, first_ids=scene.path.frame_ids)
    at = [named.at(name, scene.state).position_m for name in exact]
    assert len(at) > 10
    np.testing.assert_allclose(at, [point.xyz for point in points], atol=1e-6)
