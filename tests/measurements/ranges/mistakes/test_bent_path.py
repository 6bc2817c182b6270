"""A path of poses is bent to its ranges by steps that never make the map less likely."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.mistakes.bent_path import bent_to_ranges
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.options import ScaleOptions
from rangesfm.util.geometry.similarity import align_points, rmse
from rangesfm.util.geometry.trajectory import Trajectory

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
    return known(find_kind(found.on_map.kinds, RangeScale)).solved


@pytest.mark.parametrize("seed", [3, 5])
def test_an_anchor_whose_height_nothing_determines_stays_near(seed: int) -> None:
    given = mown(seed)
    bent = bent_to_ranges(given)
    moved_m = float(np.linalg.norm(bent.state.anchors_m - given.state.anchors_m))
    assert moved_m < 5.0
    off_m = float(np.sqrt(np.mean(bent.residual_m**2)))
    assert off_m < 1.2 * float(np.sqrt(np.mean(given.residual_m**2)))


def drifting(share: float, seed: int) -> tuple[ScaleEstimate, Array, Array]:
    """A walk of three rounds whose scale shrinks by a share from its start to its end, among four surveyed anchors.

    Returns the estimate for the path as one piece, its ranges, and the unscaled and the true places (n, 3).
    """
    rng = np.random.default_rng(seed)
    times = np.arange(240.0)
    angle = 2 * np.pi * times / 80
    places = np.column_stack([6 * np.cos(angle), 4 * np.sin(angle), 1.5 + 0.5 * np.sin(3 * angle)])
    steps = np.diff(places, axis=0) * (1 - share * times[1:, None] / times[-1])
    drifted = np.vstack([places[:1], places[0] + np.cumsum(steps, axis=0)])
    turned = Rotation.from_euler("z", angle[:, None]).as_matrix()
    names = tuple(f"{k:03d}" for k in range(len(times)))
    path = Trajectory(np.arange(1, len(times) + 1), names, times, drifted / 2.0, turned)
    anchors_m = np.array([(9, 7, 2.5), (-9, 7, 0.3), (-9, -7, 2.8), (9, -7, 0.4)], dtype=np.float64)
    at_s = np.sort(rng.uniform(0.0, times[-1], 1600))
    tags = np.column_stack([np.interp(at_s, times, column) for column in places.T])
    which = rng.integers(4, size=len(at_s))
    range_m = np.linalg.norm(tags - anchors_m[which], axis=1) + 0.05 * rng.standard_normal(len(at_s))
    log = RangeLog.from_arrays(np.array(list("ABCD"))[which], range_m, timestamp_s=at_s)
    anchors = [Anchor(name, at) for name, at in zip("ABCD", anchors_m, strict=True)]
    found = initialize_scale(associate(log, path, TAG_IN_CAM_M), path, anchors, anchor_frame="site")
    return found, path.centers, places


def test_a_path_that_drifts_is_placed_as_its_bent_form_lies_and_says_by_how_much() -> None:
    rigid, path, places = drifting(0.3, seed=0)
    placed = rigid.where_bent(ScaleOptions())
    bent_by_m = known(find_kind(rigid.on_map.kinds, RangeScale)).bends_m(rigid.on_map)
    best = align_points(path, places)
    off_m = rmse(best.apply(path) - places)
    assert off_m > 0.5
    assert rmse(placed.metric_from_sfm.apply(path) - places) < 1.02 * off_m
    # As one piece, the path leaves the scale open by what it drifts; the bent one knows it several times better.
    half_width = placed.uncertainty.half_width_95
    assert half_width < 0.5 * rigid.uncertainty.half_width_95
    assert abs(np.log(placed.value / best.scale)) < half_width
    assert placed.reasons[-1] == "the path drifts by 0.52 m (root mean square) from where the ranges have it"
    assert rmse(bent_by_m[:, None]) == pytest.approx(off_m, abs=0.02)
    used = placed.ranges.observations.status == RangeStatus.USED
    assert used.mean() > 0.95
    np.testing.assert_allclose(placed.ranges.errors.stddev_m, 0.05, rtol=0.2)


def test_a_path_that_does_not_drift_stays_as_it_was() -> None:
    rigid, _, _ = drifting(0.0, seed=1)
    assert [*known(find_kind(rigid.on_map.kinds, RangeScale)).bent(rigid.on_map)] == []
    assert rigid.where_bent(ScaleOptions()).metric_from_sfm is rigid.metric_from_sfm
