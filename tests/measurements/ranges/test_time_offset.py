"""The time offset between the camera's and the radio's clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.time_offset import estimate_time_offset
from rangesfm.progress import Progress
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.trajectory import Trajectory

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


def estimate(log: RangeLog, photos: Trajectory, tag_in_cam_m: tuple[float, float, float] = TAG_IN_CAM_M) -> TimeOffset:
    return estimate_time_offset(log, photos, tag_in_cam_m)


@pytest.mark.parametrize(("num_anchors", "offset_s"), [(4, 12.3), (4, -3600.37), (1, 12.3), (1, -1.7e9), (2, 1.7e9)])
def test_offset_is_found_through_outliers_whatever_the_epochs(num_anchors: int, offset_s: float) -> None:
    walk = handheld(60)
    found = estimate(walk.log(range_times(-3, 63), offset_s, num_anchors=num_anchors), walk.photos(photo_times(60)))
    assert found.value_s == pytest.approx(offset_s, abs=0.03)
    assert abs(found.value_s - offset_s) < 4 * found.stddev_s < 0.1
    assert found.offset_matters
    assert not found.note


def test_estimate_follows_a_shift_of_the_log() -> None:
    walk = handheld(40)
    log, photos = walk.log(range_times(0, 40), 0.0), walk.photos(photo_times(40))
    shifted = replace(log, moments=ByTime(log.timestamp_s - 3600.37))
    assert estimate(shifted, photos).value_s - estimate(log, photos).value_s == pytest.approx(3600.37, abs=1e-3)


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
        timestamp_s=np.concatenate([first.timestamp_s, second.timestamp_s]),
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


def test_radio_that_runs_for_an_hour_around_a_short_walk_is_placed() -> None:
    walk = handheld(60)
    found = estimate(walk.log(range_times(-1800, 1800, rate_hz=5), 100.0), walk.photos(photo_times(60)))
    assert found.value_s == pytest.approx(100.0, abs=0.03)


def test_radio_clock_that_is_set_during_the_log_is_followed_after_that() -> None:
    walk = handheld(60)
    log = walk.log(range_times(-10, 60), 100.0)
    was_set = log.timestamp_s - np.where(np.arange(len(log)) < 150, 1.6e9, 0.0)
    found = estimate(replace(log, moments=ByTime(was_set)), walk.photos(photo_times(60)))
    assert found.value_s == pytest.approx(100.0, abs=0.03)


def test_drift_of_200_ppm_is_noticed_and_named_and_followed() -> None:
    walk = handheld(600)
    times, photos = range_times(0, 600, rate_hz=5), walk.photos(photo_times(600))
    log = walk.log(times, 30.0, drift=200e-6)
    found = estimate(log, photos)
    assert found.value_s == pytest.approx(30.0, abs=0.01)
    assert found.drift == pytest.approx(200e-6, abs=40e-6)
    assert abs(found.drift - 200e-6) < 4 * found.drift_stddev
    assert "the clocks drift: the camera's gains +" in found.note
    assert "ppm on the radio's" in found.note
    # The offset changes by 0.12 s over the log, and is known to a few milliseconds everywhere.
    np.testing.assert_allclose(found.at(log.timestamp_s), times - log.timestamp_s, atol=0.015)


def test_clocks_that_run_alike_are_not_said_to_drift() -> None:
    walk = handheld(600)
    times = range_times(0, 600, rate_hz=5)
    found = estimate(walk.log(times, 30.0), walk.photos(photo_times(600)))
    assert not found.note
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
            log = replace(log, moments=ByTime(np.rint(log.timestamp_s)))
        found = estimate(log, photos)
        errors_in_stddevs.append((found.value_s - 3.0) / found.stddev_s)
        stddevs.append(found.stddev_s)
    assert 0.3 < np.sqrt(np.mean(np.square(errors_in_stddevs))) < 1.5
    assert np.mean(np.abs(errors_in_stddevs) < 1.96) >= 3 / 4
    # Rounding adds 0.29 s per photo, so at least 0.036 s for 65 photos. Ranges share a second, so that their rounding
    # averages out better.
    assert np.median(stddevs) > (0.02 if photos_are_rounded else 0.003)


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
    assert "stands still" in found.note
    best = found.curve.costs == found.curve.costs.min()
    assert np.ptp(found.curve.offsets_s[best]) == pytest.approx(4.0, abs=0.2)


def test_bursts_of_a_moving_camera_are_not_said_to_be_still() -> None:
    survey = stop_and_go(20, 0.83, speed_m_s=1.0)
    found = estimate(survey.log, survey.photos)
    assert found.offset_matters
    assert found.value_s == pytest.approx(0.83, abs=0.3)
    assert not found.note


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


def test_one_offset_of_two_laps_is_far_likelier_if_log_and_photos_were_begun_and_ended_together() -> None:
    """A lap off, half of the ranges are beside the path; with a shorter log, that may be so, and is not ruled out."""

    def center(times: Array) -> Array:
        turn = 2 * np.pi * times / 35
        x, y = 2 * np.cos(turn) + 0.7 * np.cos(2 * turn), 1.5 * np.sin(turn) + 0.4 * np.cos(3 * turn)
        return np.stack([x, y, 1.5 + 0.5 * np.sin(turn + 1)], axis=1)

    walk = Walk(center, no_turn)
    photos = walk.photos(photo_times(70))
    found = estimate(walk.log(range_times(-1, 71), 3.0), photos)
    assert found.value_s == pytest.approx(3.0, abs=0.1)
    assert found.probability > 0.95
    half = estimate(walk.log(range_times(20, 66), 3.0), photos)
    assert any(abs(offset_s - 3.0) < 0.1 for offset_s in (half.value_s, *(rival.value_s for rival in half.rivals)))


def test_a_walk_on_a_level_floor_tells_the_offset_and_how_well() -> None:
    walk = handheld(60)
    level = Walk(lambda times: walk.center(times) * [1.0, 1.0, 0.0], no_turn)
    found = estimate(level.log(range_times(0, 60), 2.0), level.photos(photo_times(60), center_stddev_m=0.0))
    assert abs(found.value_s - 2.0) < 4 * found.stddev_s < 0.1


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
    assert found.curve.costs[lap_off].min() < 3 * found.curve.costs.min()
    assert found.value_s == pytest.approx(3.0, abs=0.03)
    assert found.probability > 0.99
    assert not found.rivals


@pytest.mark.parametrize("num_anchors", [1, 4])
def test_log_of_another_walk_is_refused(num_anchors: int) -> None:
    log = handheld(60, seed=1).log(range_times(0, 60), 0.0, num_anchors=num_anchors)
    with pytest.raises(GeometryError, match="--ranges_time_offset"):
        estimate(log, handheld(60, seed=2).photos(photo_times(60)))


def test_empty_log_is_refused() -> None:
    empty = RangeLog.from_arrays(["A"], [1.0], timestamp_s=[0.0]).subset(np.zeros(1, dtype=bool))
    for times in (photo_times(20), 4 * photo_times(5)):
        with pytest.raises(GeometryError, match="--ranges_time_offset"):
            estimate(empty, handheld(20).photos(times))


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
    class Counter(Progress):
        updates: list[tuple[int, int]]

        def __init__(self) -> None:
            self.updates = []

        def update(self, num_done: int, num_total: int = 0) -> None:
            self.updates.append((num_done, num_total))

    walk, counter = handheld(40), Counter()
    log = walk.log(range_times(0, 40), 5.0)
    estimate_time_offset(log, walk.photos(photo_times(40)), TAG_IN_CAM_M, progress=counter)
    done, total = counter.updates[-1]
    assert done == total
    assert [number for number, _ in counter.updates] == sorted(number for number, _ in counter.updates)
