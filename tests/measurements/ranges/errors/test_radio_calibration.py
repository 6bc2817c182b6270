"""The error curve of a radio is learnt with its stddev, and subtracted from ranges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.errors.radio_calibration import (
    RadioCalibration,
    calibrate_ranges,
)
from rangesfm.measurements.ranges.range_log import RangeLog

Array = npt.NDArray[np.float64]

ANCHORS = [
    Anchor(name, np.array(position))
    for name, position in {
        "a": (0.0, 0.0, 2.0),
        "b": (6.0, 0.0, 0.3),
        "c": (6.0, 5.0, 2.0),
        "d": (0.0, 5.0, 0.3),
    }.items()
]


def short_at_short_range(distance_m: Array) -> Array:
    error: Array = -0.2 * np.exp(-distance_m / 1.5) + 0.02
    return error


def falling(distance_m: Array) -> Array:
    error: Array = 0.1 - 0.03 * distance_m
    return error


def simulated(curve: object, *, seed: int, obstructed_share: float = 0.0) -> tuple[RangeLog, Array]:
    """Simulate 5000 ranges on a random walk among the anchors; each anchor has a delay, and errors last for seconds."""
    rng = np.random.default_rng(seed)
    times = np.repeat(np.arange(1250) / 10, 4)
    phase = times[:, None] * [0.31, 0.47, 0.83] + rng.uniform(0, 6, 3)
    tags = np.array([3.0, 2.5, 1.2]) + np.array([2.8, 2.3, 0.8]) * np.sin(phase)
    index = np.tile(np.arange(4), 1250)
    distance = np.linalg.norm(tags - np.array([anchor.position_m for anchor in ANCHORS])[index], axis=1)
    assert callable(curve)
    ranges = distance + curve(distance) + rng.normal(0, 0.02, 4)[index] + rng.normal(0, 0.05, len(distance))
    ranges += 0.03 * np.sin(2 * np.pi * times / 7 + rng.uniform(0, 6, 4)[index])
    ranges += (rng.random(len(distance)) < obstructed_share) * rng.exponential(1.0, len(distance))
    ids = [ANCHORS[k].anchor_id for k in index]
    return RangeLog.from_arrays(ids, np.maximum(ranges, 0.05), timestamp_s=times), tags


@pytest.mark.parametrize("curve", [short_at_short_range, falling, np.zeros_like], ids=["short", "falling", "none"])
def test_a_known_curve_is_recovered_within_its_stddev(curve: object) -> None:
    assert callable(curve)
    z = []
    for seed in range(6):
        calibration = calibrate_ranges(*simulated(curve, seed=seed), ANCHORS)
        found = calibration.curve
        z.append((found.error_m - curve(found.distance_m)) / found.stddev_m)
        assert found.stddev_m.max() < 0.08
    assert np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.3
    assert np.abs(np.concatenate(z)).max() < 4.0


def test_ranges_without_line_of_sight_have_little_say() -> None:
    found = calibrate_ranges(*simulated(short_at_short_range, seed=1, obstructed_share=0.2), ANCHORS)
    assert 0.05 < found.outlier_share < 0.2
    np.testing.assert_allclose(found.curve.error_m, short_at_short_range(found.curve.distance_m), atol=0.05)
    assert found.noise_stddev_m == pytest.approx(0.06, abs=0.02)


def test_ranges_where_the_path_is_unknown_are_left_out() -> None:
    log, tags = simulated(short_at_short_range, seed=2)
    tags[::3] = np.nan
    found = calibrate_ranges(log, tags, ANCHORS)
    assert found.num_ranges == np.isfinite(tags[:, 0]).sum()
    assert np.isfinite(found.curve.error_m).all()


def test_what_cannot_be_learnt_is_refused() -> None:
    log, tags = simulated(np.zeros_like, seed=0)
    with pytest.raises(InputError, match="anchor d of the log has no position"):
        calibrate_ranges(log, tags, ANCHORS[:3])
    with pytest.raises(GeometryError, match="50 ranges of known length, expected 100 or more"):
        calibrate_ranges(log.subset(np.arange(50)), tags[:50], ANCHORS)
    with pytest.raises(GeometryError, match="a curve needs ranges of different lengths"):
        calibrate_ranges(
            log,
            np.tile([0.0, 0.0, 5.0], (len(log), 1)),
            [Anchor(anchor.anchor_id, ANCHORS[0].position_m) for anchor in ANCHORS],
        )


def test_the_curve_takes_out_what_it_was_learnt_from() -> None:
    log, tags = simulated(short_at_short_range, seed=3)
    calibration: RadioCalibration = calibrate_ranges(log, tags, ANCHORS)
    distance, _ = calibration.curve.true_distance(log.range_m)
    short = calibration.distance_m < 2.0
    before = log.range_m - calibration.distance_m
    after = distance - calibration.distance_m
    assert np.mean(before[short]) < -0.05
    assert np.mean(after[short]) == pytest.approx(0.0, abs=0.02)


def test_a_tag_that_stands_on_an_anchor_but_for_rounding_is_no_end_of_the_curve() -> None:
    log, tags = simulated(np.zeros_like, seed=4)
    on_it = np.arange(0, len(log), 40)
    assert np.all(log.anchor_index[on_it] == 0)
    assert ANCHORS[0].position_m is not None
    tags[on_it] = ANCHORS[0].position_m + 1e-16
    found = calibrate_ranges(log, tags, ANCHORS)
    assert found.num_ranges == len(log) - len(on_it)
    assert found.curve.distance_m[0] == pytest.approx(found.distance_m.min())


def test_a_hundred_ranges_are_needed() -> None:
    log, tags = simulated(np.zeros_like, seed=0)
    with pytest.raises(GeometryError, match=r"^99 ranges of known length, expected 100 or more to learn from$"):
        calibrate_ranges(log.subset(np.arange(99)), tags[:99], ANCHORS)
    assert calibrate_ranges(log.subset(np.arange(100)), tags[:100], ANCHORS).num_ranges == 100
