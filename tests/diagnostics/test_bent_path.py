"""A path of poses is bent to its ranges by steps that never make the map less likely."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known

from rangesfm.diagnostics.bent_path import bent_to_ranges
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
