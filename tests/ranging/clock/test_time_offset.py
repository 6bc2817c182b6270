"""The time offset between the camera's and the radio's clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rangesfm.errors import GeometryError, InputError
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import AssociationOptions
from rangesfm.progress import SilentProgress
from rangesfm.ranging.clock import time_offset
from rangesfm.ranging.clock.bursts import BurstPairing, Bursts
from rangesfm.ranging.clock.fit import Timing
from rangesfm.ranging.clock.search import CostCurve, TimedRanges, moving_path
from rangesfm.ranging.clock.time_offset import TimeOffset, estimate_time_offset
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = (0.1, -0.05, 0.03)
ANCHORS_M = np.array([[4.0, 3.0, 1.0], [-5.0, 2.0, 2.0], [1.0, -6.0, 0.0], [-3.0, -4.0, 2.0]])


@dataclass(frozen=True)
class Walk:
    """Camera centre and world_from_cam, in metres, as functions of the camera's clock."""

    center: Callable[[Array], Array]
    rotation: Callable[[Array], Rotation]

    def photos(self, times_s: Array, seed: int = 0, center_stddev_m: float = 0.01) -> Trajectory:
        """Keyframes in a world that is rotated and 0.45 m per unit."""
        world = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix()
        noise = np.random.default_rng(seed).normal(0, center_stddev_m, (len(times_s), 3))
        return Trajectory(
            frame_ids=np.arange(len(times_s)),
            image_names=tuple(f"{number:04d}.jpg" for number in range(len(times_s))),
            timestamps_s=times_s,
            centers=(self.center(times_s) + noise) / 0.45 @ world.T,
            world_from_cam=world @ self.rotation(times_s).as_matrix(),
        )

    def log(
        self,
        times_s: Array,
        offset_s: float,
        *,
        seed: int = 0,
        num_anchors: int = 4,
        outlier_share: float = 0.2,
        drift: float = 0.0,
        noise_m: float = 0.1,
        tag_in_cam_m: tuple[float, float, float] = TAG_IN_CAM_M,
    ) -> RangeLog:
        """Simulate a range at each time (camera's clock) to one of the anchors; some of them are far too long."""
        rng = np.random.default_rng([seed, 1])
        anchor = rng.integers(0, num_anchors, len(times_s))
        tag = self.center(times_s) + self.rotation(times_s).apply(tag_in_cam_m)
        ranges = np.linalg.norm(tag - ANCHORS_M[anchor], axis=1) + rng.normal(0, noise_m, len(times_s))
        ranges += (rng.random(len(times_s)) < outlier_share) * rng.exponential(1.5, len(times_s))
        radio_times = times_s - offset_s - drift * (times_s - times_s.mean())
        return RangeLog.from_arrays([f"A{k}" for k in anchor], np.maximum(ranges, 0.05), timestamp_s=radio_times)


def no_turn(times_s: Array) -> Rotation:
    return Rotation.from_rotvec(np.zeros((len(times_s), 3)))


def handheld(duration_s: float, seed: int = 0) -> Walk:
    """A walk in a room of about 8 x 8 m with a new direction every two seconds; still before and after it."""
    rng = np.random.default_rng([seed, 2])
    knots = 2.0 * np.arange(int(duration_s / 2) + 2)
    center = CubicSpline(knots, rng.normal(0, 1, (len(knots), 3)) * [2, 2, 0.4])
    rotation = RotationSpline(knots, Rotation.from_rotvec(rng.normal(0, 0.5, (len(knots), 3))))
    return Walk(
        lambda times: np.asarray(center(np.clip(times, 0, duration_s))),
        lambda times: rotation(np.clip(times, 0, duration_s)),
    )


def photo_times(duration_s: float) -> Array:
    return np.arange(0.3, duration_s, 1.0)


def range_times(start_s: float, end_s: float, rate_hz: float = 10, seed: int = 0) -> Array:
    return np.sort(np.random.default_rng([seed, 3]).uniform(start_s, end_s, int((end_s - start_s) * rate_hz)))


def times_of(log: RangeLog) -> Array:
    assert log.timestamp_s is not None
    return log.timestamp_s


def estimate(log: RangeLog, photos: Trajectory, tag_in_cam_m: tuple[float, float, float] = TAG_IN_CAM_M) -> TimeOffset:
    return estimate_time_offset(log, photos, tag_in_cam_m)


@pytest.mark.parametrize(("num_anchors", "offset_s"), [(4, 12.3), (4, -3600.37), (1, 12.3), (1, -1.7e9), (2, 1.7e9)])
def test_offset_is_found_through_outliers_whatever_the_epochs(num_anchors: int, offset_s: float) -> None:
    walk = handheld(60)
    found = estimate(walk.log(range_times(-3, 63), offset_s, num_anchors=num_anchors), walk.photos(photo_times(60)))
    assert found.value_s == pytest.approx(offset_s, abs=0.03)
    assert abs(found.value_s - offset_s) < 4 * found.stddev_s < 0.1
    assert found.offset_matters
    assert found.note is None


def test_estimate_follows_a_shift_of_the_log() -> None:
    walk = handheld(40)
    log, photos = walk.log(range_times(0, 40), 0.0), walk.photos(photo_times(40))
    shifted = replace(log, timestamp_s=times_of(log) - 3600.37)
    assert estimate(shifted, photos).value_s - estimate(log, photos).value_s == pytest.approx(3600.37, abs=1e-3)


def test_same_seed_gives_the_same_offset() -> None:
    walk = handheld(40)
    log, photos = walk.log(range_times(0, 40, rate_hz=100), 5.0), walk.photos(photo_times(40))
    first, second = (estimate_time_offset(log, photos, TAG_IN_CAM_M, seed=3) for _ in range(2))
    assert (first.value_s, first.stddev_s) == (second.value_s, second.stddev_s)


def test_stddev_tells_the_actual_error() -> None:
    errors_in_stddevs = []
    for seed in range(6):
        walk = handheld(40, seed)
        log = walk.log(range_times(-1, 41, seed=seed), 7.0, seed=seed, num_anchors=2)
        found = estimate(log, walk.photos(photo_times(40), seed))
        errors_in_stddevs.append((found.value_s - 7.0) / found.stddev_s)
    assert 0.4 < np.sqrt(np.mean(np.square(errors_in_stddevs))) < 1.6
    assert np.max(np.abs(errors_in_stddevs)) < 3.5


def test_lever_arm_of_half_a_metre_does_not_shift_the_offset() -> None:
    walk, tag = handheld(60), (0.3, -0.4, 0.1)
    log = walk.log(range_times(0, 60), 2.0, tag_in_cam_m=tag)
    photos = walk.photos(photo_times(60))
    known, ignored = estimate(log, photos, tag), estimate(log, photos, (0.0, 0.0, 0.0))
    assert known.value_s == pytest.approx(2.0, abs=0.02)
    assert known.stddev_s < 0.7 * ignored.stddev_s


def both_tags(first: RangeLog, second: RangeLog) -> RangeLog:
    """Merge two logs into one log with two tags."""
    ids = [log.anchor_ids[k] for log in (first, second) for k in log.anchor_index]
    return RangeLog.from_arrays(
        ids,
        np.concatenate([first.range_m, second.range_m]),
        timestamp_s=np.concatenate([times_of(first), times_of(second)]),
        tag_id=["left"] * len(first) + ["right"] * len(second),
    )


def test_two_tags_with_their_own_lever_arms_find_one_offset() -> None:
    walk, left, right = handheld(60), (0.4, -0.4, 0.1), (-0.4, 0.3, -0.2)
    photos = walk.photos(photo_times(60))
    first = walk.log(range_times(0, 60), 2.0, tag_in_cam_m=left)
    second = walk.log(range_times(0, 60, seed=1), 2.0, seed=1, tag_in_cam_m=right)
    log = both_tags(first, second)
    known = estimate_time_offset(log, photos, [left, right])
    swapped = estimate_time_offset(log, photos, [right, left])
    assert known.value_s == pytest.approx(2.0, abs=0.02)
    assert known.stddev_s < 0.7 * swapped.stddev_s


def test_bursts_of_two_tags_are_centred_on_their_photos() -> None:
    left, right = (0.8, 0.0, 0.1), (-0.8, 0.2, 0.0)
    first = stop_and_go(20, 0.83, tag_in_cam_m=left)
    second = stop_and_go(20, 0.83, tag_in_cam_m=right)
    found = estimate_time_offset(both_tags(first.log, second.log), first.photos, [left, right])
    assert found.value_s == pytest.approx(0.83, abs=0.05)
    assert not found.offset_matters
    assert found.drift == 0


def test_curve_over_all_offsets_is_lowest_at_the_one_found() -> None:
    walk = handheld(40)
    found = estimate(walk.log(range_times(0, 40), 5.0), walk.photos(photo_times(40)))
    curve = found.curve
    assert 100 < len(curve.offsets_s) <= 400
    assert np.all(np.diff(curve.offsets_s) > 0)
    assert curve.offsets_s[0] < 5.0 - 15 < 5.0 + 15 < curve.offsets_s[-1]
    assert curve.offsets_s[np.argmin(curve.costs_m)] == pytest.approx(5.0, abs=0.1)
    # At the true offset, the cost is the noise of the ranges (0.1 m, one in five too long); elsewhere the motion adds
    # to it.
    assert 0.08 < curve.costs_m.min() < 0.2
    assert np.median(curve.costs_m[np.abs(curve.offsets_s - 5.0) > 5.0]) > 3 * curve.costs_m.min()


def test_log_that_covers_only_the_second_half_of_the_photos_is_enough() -> None:
    walk = handheld(100)
    found = estimate(walk.log(range_times(50, 150), -20.0), walk.photos(photo_times(100)))
    assert found.value_s == pytest.approx(-20.0, abs=0.03)


def test_radio_that_runs_for_an_hour_around_a_short_walk_is_placed() -> None:
    walk = handheld(60)
    found = estimate(walk.log(range_times(-1800, 1800, rate_hz=5), 100.0), walk.photos(photo_times(60)))
    assert found.value_s == pytest.approx(100.0, abs=0.03)


def test_radio_clock_that_is_set_during_the_log_is_followed_after_that() -> None:
    walk = handheld(60)
    log = walk.log(range_times(-10, 60), 100.0)
    was_set = times_of(log) - np.where(np.arange(len(log)) < 150, 1.6e9, 0.0)
    found = estimate(replace(log, timestamp_s=was_set), walk.photos(photo_times(60)))
    assert found.value_s == pytest.approx(100.0, abs=0.03)


def test_photos_lost_for_ten_seconds_do_no_harm() -> None:
    walk, times = handheld(60), photo_times(60)
    kept = times[(times < 20) | (times > 30)]
    found = estimate(walk.log(range_times(0, 60), -4.0), walk.photos(kept))
    assert found.value_s == pytest.approx(-4.0, abs=0.03)


def test_drift_of_200_ppm_is_noticed_and_named_and_followed() -> None:
    walk = handheld(600)
    times, photos = range_times(0, 600, rate_hz=5), walk.photos(photo_times(600))
    log = walk.log(times, 30.0, drift=200e-6)
    found = estimate(log, photos)
    assert found.value_s == pytest.approx(30.0, abs=0.01)
    assert found.drift == pytest.approx(200e-6, abs=40e-6)
    assert abs(found.drift - 200e-6) < 4 * found.drift_stddev
    assert found.note is not None
    assert "the clocks drift: the camera's gains +" in found.note
    assert "ppm on the radio's" in found.note
    # The offset changes by 0.12 s over the log, and is known to a few milliseconds everywhere.
    np.testing.assert_allclose(found.at(times_of(log)), times - times_of(log), atol=0.015)


def test_clocks_that_run_alike_are_not_said_to_drift() -> None:
    walk = handheld(600)
    times = range_times(0, 600, rate_hz=5)
    found = estimate(walk.log(times, 30.0), walk.photos(photo_times(600)))
    assert found.note is None
    assert not found.drift_is_followed
    assert abs(found.drift) < 3 * found.drift_stddev < 100e-6
    assert np.all(found.at(times) == found.value_s)


def test_photos_with_whole_seconds_only_make_the_offset_less_certain() -> None:
    walk, times = handheld(120), np.arange(0.3, 120, 1.37)
    log, photos = walk.log(range_times(0, 120), 3.0), walk.photos(times)
    exact = estimate(log, photos)
    rounded = estimate(log, replace(photos, timestamps_s=np.rint(times)))
    assert rounded.stddev_s > 3 * exact.stddev_s
    assert abs(rounded.value_s - 3.0) < 3 * rounded.stddev_s


@pytest.mark.parametrize(("photos_are_rounded", "log_is_rounded"), [(True, False), (False, True)])
def test_stddev_covers_what_whole_seconds_do_to_the_offset(photos_are_rounded: bool, log_is_rounded: bool) -> None:
    errors_in_stddevs, stddevs = [], []
    for seed in range(4):
        walk, times = handheld(80, seed), np.cumsum(np.random.default_rng(seed).uniform(1.05, 1.3, 66))
        log, photos = walk.log(range_times(0, 80, seed=seed), 3.0, seed=seed), walk.photos(times)
        if photos_are_rounded:
            photos = replace(photos, timestamps_s=np.rint(times), time_resolution_s=1.0)
        if log_is_rounded:
            log = replace(log, timestamp_s=np.rint(times_of(log)))
        found = estimate(log, photos)
        errors_in_stddevs.append((found.value_s - 3.0) / found.stddev_s)
        stddevs.append(found.stddev_s)
    assert 0.3 < np.sqrt(np.mean(np.square(errors_in_stddevs))) < 1.5
    assert np.mean(np.abs(errors_in_stddevs) < 1.96) >= 3 / 4
    # Rounding adds 0.29 s per photo, so at least 0.036 s for 65 photos. Ranges share a second, so that their rounding
    # averages out better.
    assert np.median(stddevs) > (0.02 if photos_are_rounded else 0.003)


def test_photos_three_seconds_apart_along_a_smooth_way_are_enough() -> None:
    way = Walk(
        lambda t: np.stack([8 * np.sin(t / 9), 6 * np.sin(t / 13 + 1), 1 + 0.5 * np.sin(t / 5)], axis=1), no_turn
    )
    found = estimate(way.log(range_times(0, 150), 9.0), way.photos(np.arange(0.0, 150.0, 3.0)))
    assert found.value_s == pytest.approx(9.0, abs=0.1)
    assert found.offset_matters


@dataclass(frozen=True)
class StopAndGo:
    """Stops of two seconds, six seconds apart, with a burst of ranges at each and a photo in its middle."""

    log: RangeLog
    photos: Trajectory


def stop_and_go(
    num_stops: int,
    offset_s: float,
    seed: int = 0,
    first_photo: int = 0,
    speed_m_s: float = 0,
    tag_in_cam_m: tuple[float, float, float] = TAG_IN_CAM_M,
) -> StopAndGo:
    rng = np.random.default_rng([seed, 4])
    stop_times = np.linspace(1000, 1000 + 6 * (num_stops - 1), num_stops)
    angle = np.linspace(0, 5, num_stops)
    stops = np.stack([5 * np.cos(angle), 5 * np.sin(angle), 0 * angle], axis=1) + rng.normal(0, 0.5, (num_stops, 3))
    turns = Rotation.from_rotvec(rng.normal(0, 0.4, (num_stops, 3)))

    def stop_at(times: Array) -> npt.NDArray[np.int64]:
        return np.asarray(np.rint((times - 1000) / 6), dtype=np.int64)

    def center(times: Array) -> Array:
        since = (times - stop_times[stop_at(times)])[:, None]
        return np.asarray(stops[stop_at(times)] + speed_m_s * since * [0.6, 0.8, 0])

    walk = Walk(center, lambda times: turns[stop_at(times)])
    burst_times = (stop_times[:, None] + np.linspace(-1, 1, 80)).ravel()
    log = walk.log(burst_times, offset_s, seed=seed, tag_in_cam_m=tag_in_cam_m)
    return StopAndGo(log, walk.photos(stop_times[first_photo:], center_stddev_m=0.003))


@pytest.mark.parametrize(("num_stops", "first_photo"), [(11, 0), (20, 0), (20, 4)])
def test_bursts_around_still_photos_are_centred_on_them(num_stops: int, first_photo: int) -> None:
    survey = stop_and_go(num_stops, 0.83 - 1.6e9, first_photo=first_photo)
    found = estimate(survey.log, survey.photos)
    assert found.value_s == pytest.approx(0.83 - 1.6e9, abs=0.05)
    assert not found.offset_matters
    assert found.drift == 0
    # A burst of two seconds can be moved by two seconds either way before it is half-way to the next photo.
    assert found.stddev_s == pytest.approx(4 / np.sqrt(12), abs=0.05)
    assert found.note is not None
    assert "stands still" in found.note
    best = found.curve.costs_m == found.curve.costs_m.min()
    assert np.ptp(found.curve.offsets_s[best]) == pytest.approx(4.0, abs=0.2)


def test_bursts_of_a_moving_camera_are_not_said_to_be_still() -> None:
    survey = stop_and_go(20, 0.83, speed_m_s=1.0)
    found = estimate(survey.log, survey.photos)
    assert found.offset_matters
    assert found.value_s == pytest.approx(0.83, abs=0.3)
    assert found.note is None


def test_bursts_that_suit_several_photos_leave_several_offsets() -> None:
    """The ranges cover two rounds past six stops, of which only the first was photographed.

    After half a round, the stops are a rotated copy of themselves, which gives a third offset.
    """
    stop_times = np.linspace(1000, 1066, 12)
    turn = np.pi / 3 * np.arange(12)
    stops = 4 * np.stack([np.cos(turn), np.sin(2 * turn), 0.5 * np.sin(turn)], axis=1)
    walk = Walk(lambda times: stops[np.rint((times - 1000) / 6).astype(int)], no_turn)
    log = walk.log((stop_times[:, None] + np.linspace(-1, 1, 80)).ravel(), 0.5, outlier_share=0)
    found = estimate(log, walk.photos(stop_times[:6], center_stddev_m=0.003))
    offsets_s = sorted([found.value_s, *(rival.value_s for rival in found.rivals)])
    assert offsets_s == pytest.approx([-35.5, -17.5, 0.5], abs=0.1)
    assert found.probability + sum(rival.probability for rival in found.rivals) == pytest.approx(1.0)
    assert found.probability < 0.95


def still(times: Array) -> Array:
    return np.tile([1.0, 2.0, 1.5], (len(times), 1))


def even_line(times: Array) -> Array:
    return np.stack([-10 + 0.3 * times, 0.1 * times, 1.5 + 0 * times], axis=1)


def even_circle(times: Array) -> Array:
    return np.stack([2 * np.cos(times / 8), 2 * np.sin(times / 8), 1.5 + 0 * times], axis=1)


def repeated_figure(times: Array) -> Array:
    turn = 2 * np.pi * times / 9
    return np.stack([2 * np.cos(turn), 2 * np.sin(2 * turn), 1.5 + 0.5 * np.sin(turn)], axis=1)


@pytest.mark.parametrize(("num_anchors", "center_stddev_m"), [(4, 0.0), (1, 0.01)])
@pytest.mark.parametrize("center", [still, even_line, even_circle, repeated_figure])
def test_motion_that_does_not_determine_the_offset_is_refused(
    center: Callable[[Array], Array], center_stddev_m: float, num_anchors: int
) -> None:
    walk = Walk(center, no_turn)
    log = walk.log(range_times(-1, 71), 3.0, num_anchors=num_anchors)
    with pytest.raises(GeometryError, match="--ranges_time_offset"):
        estimate(log, walk.photos(photo_times(70), center_stddev_m=center_stddev_m))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_offset_that_the_motion_tells_but_loosely_is_given_with_its_stddev(seed: int) -> None:
    """A later time looks nearly the same as a place further round, on a third of an even walk around an ellipse."""

    def center(times: Array) -> Array:
        turn = 2 * np.pi * times / 33
        return np.stack([4.4 * np.cos(turn), 3.1 * np.sin(turn), 1.6 + 0 * times], axis=1)

    walk = Walk(center, no_turn)
    log = walk.log(range_times(-3, 17, rate_hz=50, seed=seed), 3.0, seed=seed, noise_m=0.02, outlier_share=0)
    found = estimate(log, walk.photos(photo_times(14), seed))
    assert abs(found.value_s - 3.0) < 3 * found.stddev_s
    assert not found.is_certain
    assert "too even to tell the time offset well" in (found.note or "")


def test_laps_that_differ_by_twice_the_noise_are_told_apart() -> None:
    """One lap off, the residuals are about twice as large."""

    def center(times: Array) -> Array:
        wander = np.stack([np.sin(times / 5), np.cos(times / 7), np.sin(times / 3)], axis=1)
        return repeated_figure(times) + 0.15 * wander

    walk = Walk(center, no_turn)
    found = estimate(walk.log(range_times(-1, 71), 3.0), walk.photos(photo_times(70)))
    lap_off = np.abs(np.abs(found.curve.offsets_s - 3.0) - 9.0) < 0.5
    assert found.curve.costs_m[lap_off].min() < 3 * found.curve.costs_m.min()
    assert found.value_s == pytest.approx(3.0, abs=0.03)
    assert found.probability > 0.99
    assert not found.rivals


@pytest.mark.parametrize("num_anchors", [1, 4])
def test_log_of_another_walk_is_refused(num_anchors: int) -> None:
    log = handheld(60, seed=1).log(range_times(0, 60), 0.0, num_anchors=num_anchors)
    with pytest.raises(GeometryError, match="--ranges_time_offset"):
        estimate(log, handheld(60, seed=2).photos(photo_times(60)))


def test_empty_log_is_refused() -> None:
    for times in (photo_times(20), 4 * photo_times(5)):
        with pytest.raises(GeometryError, match="--ranges_time_offset"):
            estimate(RangeLog.from_arrays([], [], timestamp_s=[]), handheld(20).photos(times))


@pytest.mark.parametrize("num_ranges", [1, 7, 30])
def test_too_few_ranges_are_refused(num_ranges: int) -> None:
    walk = handheld(60)
    with pytest.raises(GeometryError, match="--ranges_time_offset"):
        estimate(walk.log(np.linspace(5, 50, num_ranges), 1.0), walk.photos(photo_times(60)))


def test_too_few_photos_are_refused() -> None:
    walk = handheld(60)
    with pytest.raises(GeometryError, match="3 photos and 600 ranges are too few"):
        estimate(walk.log(range_times(0, 60), 1.0), walk.photos(photo_times(60)[:3]))


def test_log_by_photos_and_photos_without_times_have_no_offset() -> None:
    walk = handheld(20)
    photos = walk.photos(photo_times(20))
    by_photo = RangeLog.from_arrays(["A"], [1.0], image_name=["0000.jpg"])
    with pytest.raises(InputError, match="no timestamps"):
        estimate(by_photo, photos)
    with pytest.raises(InputError, match="photos have no times"):
        estimate(walk.log(range_times(0, 20), 0.0), replace(photos, timestamps_s=None))


def test_progress_is_told_to_the_end() -> None:
    class Counter:
        updates: list[tuple[int, int | None]]

        def __init__(self) -> None:
            self.updates = []

        def stage(self, name: str) -> None:
            pass

        def update(self, num_done: int, num_total: int | None = None) -> None:
            self.updates.append((num_done, num_total))

        def message(self, text: str) -> None:
            pass

    walk, counter = handheld(40), Counter()
    log = walk.log(range_times(0, 40), 5.0)
    estimate_time_offset(log, walk.photos(photo_times(40)), TAG_IN_CAM_M, progress=counter)
    done, total = counter.updates[-1]
    assert done == total
    assert [number for number, _ in counter.updates] == sorted(number for number, _ in counter.updates)


HUNDRED = TimedRanges(
    np.arange(100, dtype=np.float64), np.ones(100), np.zeros(100, dtype=np.int64), np.zeros(100, dtype=np.int64)
)
# A path that is known from 0 to 100 s.
KNOWN: Any = SimpleNamespace(knows=lambda times: (times >= 0) & (times < 100), is_known=np.ones(100, dtype=bool))


def a_fit(offset_s: float, score: float = 1.0, *, stddev_s: float = 0.01, drift: float = 0.0, **changed: Any) -> Any:
    """Return what stands for a fit of the hundred ranges at an offset."""
    told: dict[str, Any] = {
        "offset_s": offset_s,
        "score": score,
        "is_testable": True,
        "num_independent": 10.0,
        "observed": HUNDRED,
        "times_s": HUNDRED.times_s,
        "weights": np.ones(100),
        "losses": lambda *_: np.full(100, -score),
        "residual_stddev_m": 1.0,
        "timing": lambda: Timing(stddev_s, drift, 1e-5),
        "explains": lambda: True,
    }
    return SimpleNamespace(**{**told, **changed})


@pytest.mark.parametrize(
    ("stddev_s", "kept"),
    [
        (0.01, [0.0, 0.6, 4.9]),  # the same within half a second
        (0.19, [0.0, 0.6, 4.9]),
        (0.21, [0.0, 4.9]),  # or within three standard deviations
        (np.inf, [0.0, 4.9]),  # of which none is larger than a second
    ],
)
def test_fits_that_end_at_the_same_offset_count_once(
    stddev_s: float, kept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_offset, "_log_odds", lambda *_: 0.0)
    monkeypatch.setattr(time_offset, "_MAX_NUM_LIKELY", 9)
    fits = [a_fit(offset_s, 9 - offset_s, stddev_s=stddev_s) for offset_s in (5.1, 0.26, 0.0, 0.24, 4.9, 0.6)]
    found = time_offset._likely_fits(fits, HUNDRED.times_s, KNOWN, "give it")
    assert [fit.offset_s for fit, _ in found] == kept


def test_an_offset_that_puts_fewer_ranges_on_the_path_is_less_likely_from_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Seven tenths of the ranges of the best offset are enough; with fewer, its prior is a twentieth."""
    monkeypatch.setattr(time_offset, "_log_odds", lambda best, fit, path: 1.0 if fit.offset_s > 0 else 0.0)
    fits = [a_fit(31.0, 2.7), a_fit(0.0, 2.0), a_fit(30.0, 2.8), a_fit(-20.0, 9.0, is_testable=False)]
    found = time_offset._likely_fits(fits, HUNDRED.times_s, KNOWN, "give it")
    weights = np.array([1.0, np.exp(-1), 0.05 * np.exp(-1)])
    assert [fit.offset_s for fit, _ in found] == [0.0, 30.0, 31.0]
    assert [probability for _, probability in found] == pytest.approx((weights / weights.sum()).tolist())


def test_two_offsets_are_compared_by_the_ranges_they_share_or_else_by_their_scores() -> None:
    def of(values: Array) -> Any:
        return lambda *_: values

    losses = of(np.where(np.arange(100) < 40, 5.0, -1.0))
    best = a_fit(0.0, 3.0, losses=losses, num_independent=30.0)
    # At 40 s, the ranges from 0 to 60 s are on the path; of those that were there, all are at 0 s.
    rival = a_fit(40.0, 2.5, losses=of(np.full(100, 7.0)), num_independent=20.0)
    own = (40 * 5.0 - 20 * 1.0) / 60
    assert time_offset._log_odds(best, rival, KNOWN) == pytest.approx(20 * 0.6 * (7.0 - own))
    quarter = a_fit(75.0, 2.5, losses=of(np.full(100, 7.0)))
    assert time_offset._log_odds(best, quarter, KNOWN) == pytest.approx(10 * 0.25 * (7.0 - 5.0))
    far = a_fit(76.0, 2.5, losses=of(np.full(100, 7.0)), num_independent=50.0)
    assert time_offset._log_odds(best, far, KNOWN) == pytest.approx(30 * 0.5)
    # Ranges of the rival that are off the path at the best offset do not count.
    early = a_fit(0.0, times_s=HUNDRED.times_s - 30, losses=of(np.where(np.arange(100) < 30, 9, 2)))
    assert time_offset._log_odds(a_fit(0.0, 1.0), early, KNOWN) == pytest.approx(10 * 0.7 * (2 + 1))


def test_ranges_stay_at_a_photo_if_they_are_near_the_same_one_at_all_offsets() -> None:
    photos = Walk(lambda times: np.outer(times, [1.0, 0, 0]), no_turn).photos(np.array([0.0, 4.0, 8.0, 12.0]))
    times = np.array([-1.2, 0.0, 0.4, 0.6, 3.4, 3.6, 5.4, 6.1, 12.0])
    log = RangeLog.from_arrays(["A"] * len(times), np.ones(len(times)), timestamp_s=times)
    options = AssociationOptions(max_interpolation_gap_s=0.5, max_time_difference_s=1.0)
    assert time_offset._num_at_same_photo(log, photos, options, 0.0) == 6
    assert time_offset._num_at_same_photo(log, photos, options, 0.0, 0.5) == 5
    assert time_offset._num_at_same_photo(log, photos, options, 0.0, 0.5, -0.5) == 4
    assert time_offset._num_at_same_photo(log, photos, options, 0.0, 4.0) == 0  # the next photo is another one


PAIRING = BurstPairing(7.0, np.array([0, 2]), np.array([0, 1]), variance=1e-3, num_spare=8.0, chance=1e-9)
BURSTS = Bursts(
    np.array([0.0, 4.0, 8.0]),
    np.array([1.0, 5.0, 12.0]),
    np.array([60, 7, 40]),
    np.ones((3, 1)),
    np.zeros(1, dtype=np.int64),
    np.zeros(1, dtype=np.int64),
)


def offset_of_bursts(
    monkeypatch: pytest.MonkeyPatch, pairings: list[BurstPairing], kept_s: tuple[float, float], num_staying: int
) -> TimeOffset | None:
    """Run the estimate from bursts with the results of its parts given."""
    curve = CostCurve(np.zeros(1), np.zeros(1))
    asked: list[tuple[float, ...]] = []

    def num_at_same_photo(_log: Any, _path: Any, _options: Any, *offsets_s: float) -> int:
        asked.append(offsets_s)
        return num_staying

    monkeypatch.setattr(time_offset, "pair_bursts", lambda *_: pairings)
    monkeypatch.setattr(time_offset, "offsets_that_keep", lambda *_: kept_s)
    monkeypatch.setattr(time_offset, "_num_at_same_photo", num_at_same_photo)
    monkeypatch.setattr(time_offset, "curve_of", lambda *_: curve)
    photos: Any = [None] * 5
    log: Any = None
    found = time_offset._offset_of_bursts(BURSTS, log, photos, np.zeros((1, 3)), AssociationOptions())
    assert all(set(kept_s) <= set(offsets_s) for offsets_s in asked)
    return found


@pytest.mark.parametrize(("kept_s", "value_s"), [((6.0, 9.0), 7.0), ((7.5, 9.0), 7.5), ((3.0, 6.5), 6.5)])
def test_bursts_give_the_offset_nearest_to_their_middles_at_which_they_stay(
    kept_s: tuple[float, float], value_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rival = replace(PAIRING, offset_s=-9.0, variance=PAIRING.variance * np.sqrt(2))  # of odds 2^2
    found = offset_of_bursts(monkeypatch, [PAIRING, rival], kept_s, 95)
    assert found is not None
    assert found.value_s == value_s
    assert found.stddev_s == pytest.approx((kept_s[1] - kept_s[0]) / np.sqrt(12))
    assert not found.offset_matters
    assert found.reference_s == pytest.approx((0.5 + 4.5 + 10) / 3)
    assert found.probability == pytest.approx(0.8)
    (other,) = found.rivals
    assert other.value_s == -9.0
    assert other.probability == pytest.approx(0.2)
    assert found.note == (
        f"the camera stands still at every photo: any time offset from {kept_s[0]:+.2f} s to {kept_s[1]:+.2f} s "
        f"gives the same result; {value_s:+.2f} s centres the ranges on the photos"
    )


@pytest.mark.parametrize(
    ("kept_s", "num_staying", "is_found"),
    [((6.0, 9.0), 95, True), ((6.0, 9.0), 94, False), ((7.0, 7.0), 100, False), ((7.0, 6.9), 100, False)],
)
def test_bursts_give_no_offset_if_a_twentieth_of_their_ranges_leaves_its_photo(
    kept_s: tuple[float, float], num_staying: int, is_found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paired bursts have 100 ranges."""
    assert (offset_of_bursts(monkeypatch, [PAIRING], kept_s, num_staying) is not None) == is_found


def test_bursts_that_fit_no_better_than_by_chance_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(GeometryError, match="do the 3 bursts of ranges fit the 5 photos better than by chance: give"):
        offset_of_bursts(monkeypatch, [replace(PAIRING, chance=0.5)], (6.0, 9.0), 100)


def offset_of_motion(
    monkeypatch: pytest.MonkeyPatch,
    *,
    fits: list[Any],
    final_stddev_s: float = 0.01,
    drift: float = 0.0,
    followed: float = 0.0,
    num_known: int = 100,
    num_near: int = 100,
) -> TimeOffset:
    """Run the estimate from motion with the results of its parts given: one fit for each candidate."""
    curve = SimpleNamespace(
        peaks=lambda *_: [fit.offset_s for fit in fits],
        around=lambda best_s: CostCurve(np.array([best_s]), np.ones(1)),
    )
    left = iter(fits)
    path: Any = SimpleNamespace(knows=KNOWN.knows, is_known=np.arange(100) < num_known, step_s=0.5)
    final = a_fit(
        2.0,
        rates=np.tile([3.0, -4.0], 50),  # of root mean square sqrt(12.5)
        residual_stddev_m=0.1 * np.sqrt(12.5),
    )
    timing = Timing(final_stddev_s, drift, 2e-5)
    monkeypatch.setattr(time_offset, "on_path", lambda *_: HUNDRED.take(np.arange(num_near)))
    monkeypatch.setattr(time_offset, "refine_offset", lambda *_: next(left))
    scan: Any = lambda *_: curve  # noqa: E731
    ranges = time_offset._RANGES._replace(scan=scan, fit_clocks=lambda *_: (final, timing, followed, 50.0))
    return time_offset.offset_of_motion(HUNDRED, path, ranges, seed=0, progress=SilentProgress())


def test_an_offset_from_motion_is_told_with_its_rivals_and_the_curve_about_it(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = [a_fit(-9.0, 1.0 - np.log(4) / 10), a_fit(2.1, 1.0)]
    found = offset_of_motion(monkeypatch, fits=fits, drift=1e-5)
    assert (found.value_s, found.stddev_s, found.reference_s) == (2.0, 0.01, 50.0)
    # The scores differ by log 4 over ten independent ranges, of which 91 % are at both offsets.
    assert found.probability == pytest.approx(1 / (1 + 4**-0.91), rel=1e-3)
    assert [rival.value_s for rival in found.rivals] == [-9.0]
    assert (found.drift, found.drift_stddev, found.drift_is_followed) == (1e-5, 2e-5, False)
    assert (found.offset_matters, found.is_certain, found.note) == (True, True, None)
    assert found.curve.offsets_s[0] == 2.0
    followed = offset_of_motion(monkeypatch, fits=[a_fit(2.1)], drift=1e-6, followed=1e-4, final_stddev_s=0.09)
    assert (followed.drift, followed.drift_is_followed) == (1e-4, True)
    assert (followed.note or "").startswith("the clocks drift: the camera's gains +100 ppm on the radio's (within 39")


@pytest.mark.parametrize(("stddev_s", "is_certain"), [(0.099, True), (0.101, False), (0.49, False)])
def test_an_offset_is_certain_if_it_moves_the_ranges_less_than_their_noise(
    stddev_s: float, is_certain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tenth of a second moves them by as much."""
    found = offset_of_motion(monkeypatch, fits=[a_fit(2.0)], final_stddev_s=stddev_s)
    assert found.is_certain == is_certain
    within = f"{1.96 * stddev_s:.2g}"
    assert found.note == (
        None
        if is_certain
        else f"the motion is too even to tell the time offset well (about +2.00 s, within {within} s, 95 %): "
        "give the time offset (--ranges_time_offset) if you know it better"
    )


def test_motion_that_tells_no_offset_is_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    even = r"the motion is too even to tell the time offset \(about \+2.00 s, within 1 s, 95 %\): give"
    with pytest.raises(GeometryError, match=even):
        offset_of_motion(monkeypatch, fits=[a_fit(2.0)], final_stddev_s=0.51)
    with pytest.raises(GeometryError, match="no part of the path can be compared with the log"):
        offset_of_motion(monkeypatch, fits=[a_fit(2.0)], num_known=1)
    assert offset_of_motion(monkeypatch, fits=[a_fit(2.0)], num_known=2).value_s == 2.0
    for fits, num_near in (([a_fit(2.0, is_testable=False)], 100), ([a_fit(2.0)], 0)):
        lasting = rf"\(the log lasts {np.ptp(HUNDRED.times_s):.4g} s, the photos 49.5 s\)"
        few = f"too few ranges along the camera's path to find the time offset {lasting}: give"
        with pytest.raises(GeometryError, match=few):
            offset_of_motion(monkeypatch, fits=fits, num_near=num_near)
    with pytest.raises(GeometryError, match="at no time offset do the ranges follow the camera's path"):
        offset_of_motion(monkeypatch, fits=[a_fit(2.0, explains=lambda: False)])


@pytest.mark.parametrize(
    ("gap_s", "bursts", "found", "max_gap_s"),
    [
        (1.0, "bursts", "found", 2.0),  # photos so close together need no bursts
        (1.6, None, None, 2.4),
        (3.0, None, "found", 4.5),
        (3.0, "bursts", None, 4.5),
        (3.0, "bursts", "found", None),
    ],
)
def test_bursts_are_looked_for_where_photos_are_far_apart_and_then_motion(
    gap_s: float, bursts: str | None, found: str | None, max_gap_s: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motion is interpolated across one and a half times the usual gap."""
    given: list[Any] = []

    def path_to_search(*arguments: Any) -> Any:
        given.extend(arguments)
        return moving_path(*arguments)

    def offset_of_motion(ranges: TimedRanges, *_: Any, seed: int, progress: Any) -> str:
        given.extend([ranges, seed])
        return "motion"

    monkeypatch.setattr(time_offset, "find_bursts", lambda *_: bursts)
    monkeypatch.setattr(time_offset, "_offset_of_bursts", lambda *_: found)
    monkeypatch.setattr(time_offset, "moving_path", path_to_search)
    monkeypatch.setattr(time_offset, "offset_of_motion", offset_of_motion)
    walk = Walk(still, no_turn)
    log = walk.log(range_times(0, 9), 0.0)
    answer: Any = estimate(log, walk.photos(gap_s * np.arange(4, dtype=np.float64)))
    if max_gap_s is None:
        assert (answer, given) == ("found", [])
        return
    assert answer == "motion"
    _, arms_m, association, ranges, seed = given
    assert association.max_interpolation_gap_s == pytest.approx(max_gap_s)
    assert seed == 0
    np.testing.assert_array_equal(arms_m, [TAG_IN_CAM_M])
    np.testing.assert_array_equal(np.sort(ranges.range_m), np.sort(log.range_m))
