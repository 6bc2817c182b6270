"""A path of poses is bent to its ranges by steps that never make the map less likely."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.diagnostics.bent_path import bends_m, bent_to_ranges
from rangesfm.diagnostics.linearized import RangesOnMap, ranges_on_map
from rangesfm.geometry.trajectory import Trajectory, in_first_camera
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.bending import WalkBending
from rangesfm.ranging.range_log import RangeLog
from rangesfm.scale.initialize import initialize_scale

TAG_IN_CAM_M = (0.0, 0.0, 0.0)
ANCHOR_M = np.array([8.0, -6.0, 0.3])


def mown(seed: int) -> RangesOnMap:
    """A robot mows a level field, and hears one unknown anchor at nearly its own height, with coarse ranges."""
    rng = np.random.default_rng(seed)
    times = np.arange(300.0)
    row, along = np.divmod(times, 30.0)
    x = np.where(row % 2 == 0, along, 29.0 - along)
    centers = np.column_stack([0.8 * x, 2.0 * row, np.zeros(len(times))])
    heading = np.where(row % 2 == 0, 0.0, np.pi)
    turned = Rotation.from_euler("z", heading[:, None]).as_matrix()
    names = tuple(f"{k:03d}" for k in range(len(times)))
    path = Trajectory(np.arange(1, len(times) + 1), names, times, centers / 2.0, turned)
    at_s = np.sort(rng.uniform(0.0, times[-1], 1200))
    places = np.column_stack([np.interp(at_s, times, column) for column in centers.T])
    lasting_m = 0.3 * np.interp(at_s, times[::20], rng.standard_normal(len(times[::20])))
    range_m = np.linalg.norm(places - ANCHOR_M, axis=1) + 0.5 * rng.standard_normal(len(at_s)) + lasting_m
    log = RangeLog.from_arrays(np.full(len(at_s), "A"), np.maximum(range_m, 0.1), timestamp_s=at_s)
    anchors = [Anchor("A", None)]
    found = initialize_scale(associate(log, path, TAG_IN_CAM_M), path, anchors, anchor_frame="unknown")
    return ranges_on_map(known(found.problem), known(found.solution), WalkBending(in_first_camera(path)))


@pytest.mark.parametrize("seed", [3, 5])
def test_an_anchor_whose_height_nothing_determines_stays_near(seed: int) -> None:
    given = mown(seed)
    bent = bent_to_ranges(given)
    moved_m = float(np.linalg.norm(bent.state.anchors_m - given.state.anchors_m))
    assert moved_m < 5.0
    off_m = float(np.sqrt(np.mean(bent.residual_m**2)))
    assert off_m < 1.2 * float(np.sqrt(np.mean(given.residual_m**2)))


def on_map(steps: Array | None) -> Any:
    """Return what ``bends_m`` reads of ranges on a path of six poses, in a model of 2 m per unit."""
    along = np.arange(6.0)
    centers = np.column_stack([along, np.sin(along), 0.3 * along**2])
    names = tuple(f"{k}.jpg" for k in range(6))
    path = Trajectory(np.arange(6), names, along, centers, np.tile(np.eye(3), (6, 1, 1)))
    state = SimpleNamespace(metric_from_model=SimpleNamespace(scale=2.0))
    return SimpleNamespace(bending=WalkBending(path, steps), state=state)


def test_bends_are_in_metres_and_of_each_pose() -> None:
    steps = np.zeros((5, 7))
    steps[1, 5] = 0.1
    found = on_map(steps)
    walk = found.bending
    expected = 2.0 * np.sqrt(np.sum((walk.path.centers - walk.given.centers) ** 2, axis=1))
    assert expected.max() > 0
    assert bends_m(found) == pytest.approx(expected)
    assert not len(bends_m(on_map(None)))
