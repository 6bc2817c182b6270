"""The scale is right although most ranges are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from tests.simulated.outliers import spoilt
from tests.simulated.path import loop_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.demo.simulated_radio import Radio
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import ScaleOptions
from rangesfm.util.geometry.trajectory import Trajectory

SCALE = 2.0
ANCHOR_M = np.array([7.0, 4.0, 3.0])
TAG_IN_CAM_M = (0.05, -0.12, -0.03)
NUM_RANGES = 300
KINDS = ("long", "short", "clustered")


@pytest.mark.parametrize(
    ("kind", "share", "max_median_percent"),
    [("long", 0.8, 2.0), ("short", 0.8, 1.5), ("clustered", 0.7, 2.5)],
)
def test_scale_is_found_though_most_ranges_are_wrong(kind: str, share: float, max_median_percent: float) -> None:
    found = [scale_of(kind, share, seed) for seed in range(8)]
    assert 100 * np.median(np.abs(np.array(found) / SCALE - 1)) < max_median_percent


def scale_of(kind: str, share: float, seed: int) -> float:
    """Return the scale found on a walk past one anchor that is known in the first camera's frame."""
    rng = np.random.default_rng([seed, KINDS.index(kind), round(100 * share)])
    times = np.linspace(0.0, 60.0, NUM_RANGES)
    walk = loop_path(60.0, height_amplitude_m=0.6, unsteadiness_m=0.1, start_deg=360 * rng.random(), seed=seed)
    centers_m, world_from_cam = walk.centers(times), walk.world_from_cam(times)
    radio, anchors = Radio(range_stddev_m=0.1), {"A": ANCHOR_M}
    log = simulate_ranges_at(times, centers_m, world_from_cam, anchors, TAG_IN_CAM_M, radio, seed)
    log = RangeLog.from_arrays(["A"] * NUM_RANGES, spoilt(log.range_m, kind, share, rng), timestamp_s=times)
    cam_from_world = world_from_cam[0].T
    centers = (centers_m - centers_m[0]) @ cam_from_world.T / SCALE
    names = tuple(f"{k:04d}.jpg" for k in range(NUM_RANGES))
    path = Trajectory(np.arange(1, NUM_RANGES + 1), names, times, centers, cam_from_world @ world_from_cam)
    anchor = Anchor("A", cam_from_world @ (ANCHOR_M - centers_m[0]))
    ranges = associate(log, path, np.array(TAG_IN_CAM_M))
    options = ScaleOptions()
    return initialize_scale(ranges, path, [anchor], anchor_frame="first_camera", options=options, seed=seed).value
