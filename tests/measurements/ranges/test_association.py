"""Every range gets its place on the path, or a status that says why it has none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus
from rangesfm.options import RangesOptions
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
TAG_IN_CAM_M = np.array([0.1, -0.2, 0.05])
WITHOUT_SNAPPING = RangesOptions(max_time_difference_s=0.0)


def trajectory_of(times: Array | None, centers: Array, world_from_cam: Array | None = None) -> Trajectory:
    n = len(centers)
    rotations = np.tile(np.eye(3), (n, 1, 1)) if world_from_cam is None else world_from_cam
    return Trajectory(np.arange(n), tuple(f"{i:03d}.jpg" for i in range(n)), times, centers, rotations)


def log_at(times: npt.ArrayLike, range_m: npt.ArrayLike = 5.0) -> RangeLog:
    """A log of one range at each time, all to one anchor."""
    times = np.asarray(times, dtype=np.float64)
    return RangeLog.from_arrays(["A"] * len(times), np.broadcast_to(range_m, times.shape), timestamp_s=times)


def statuses(observations: RangeObservations) -> list[str]:
    return [RangeStatus(status).label for status in observations.status]


def straight(times: Array) -> Array:
    centers: Array = np.array([1.0, 2.0, 3.0]) + np.outer(times, [0.5, -1.0, 0.25])
    return centers


def curved(times: Array) -> Array:
    """A walk in a circle of 2 m radius at 1.2 m/s, going up and down."""
    return np.stack([2 * np.cos(0.6 * times), 2 * np.sin(0.6 * times), 0.1 * np.sin(1.5 * times)], axis=1)


class TestBetweenKeyframes:
    def test_places_on_a_straight_line_are_exact(self) -> None:
        keyframe_times = np.array([0.0, 0.4, 1.1, 1.5, 2.9, 3.2, 4.0])
        range_times = np.linspace(0.0, 4.0, 57)
        path = trajectory_of(keyframe_times, straight(keyframe_times))
        found = associate(log_at(range_times), path, TAG_IN_CAM_M, options=WITHOUT_SNAPPING)
        np.testing.assert_allclose(found.centers, straight(range_times), atol=1e-12)
        np.testing.assert_allclose(found.tag_from_center, np.tile(TAG_IN_CAM_M, (57, 1)), atol=1e-12)
        assert set(statuses(found)) == {"used"}

    def test_places_on_a_curve_are_far_better_than_on_chords(self) -> None:
        keyframe_times = np.arange(0.0, 20.0, 0.5)
        range_times = np.arange(1.0, 19.0, 0.07)
        path = trajectory_of(keyframe_times, curved(keyframe_times))
        found = associate(log_at(range_times), path, np.zeros(3), options=WITHOUT_SNAPPING)
        off = np.linalg.norm(found.centers - curved(range_times), axis=1)
        off_chords = np.linalg.norm(found.centers - found.center_offsets - curved(range_times), axis=1)
        assert off_chords.max() > 0.02
        assert off.max() < 0.05 * off_chords.max()

    def test_stated_stddev_is_about_the_error_of_a_jerky_path(self) -> None:
        fine = np.arange(0.0, 120.0, 0.05)
        # The acceleration is random at every time, so that the keyframes do not determine the path between them.
        bends = 0.01 * np.random.default_rng(0).standard_normal((len(fine), 3))
        walk = np.cumsum(np.cumsum(bends, axis=0), axis=0)
        found = associate(log_at(fine[10:-10]), trajectory_of(fine[::10], walk[::10]), np.zeros(3))
        between = found.before != found.after
        normalized = (found.centers - walk[10:-10])[between] / found.center_stddev[between, None]
        assert 0.8 < np.sqrt(np.mean(normalized**2)) < 1.25
        assert np.all(found.center_stddev[~between] == 0)

    @pytest.mark.parametrize("num_photos", [3, 8, 15])
    def test_a_straight_walk_seen_in_bursts_of_noisy_photos_is_known_half_way_as_well_as_stated(
        self, num_photos: int
    ) -> None:
        """Two bursts at 15 Hz are 1.33 s apart; keyframes have an error of 2 cm in each coordinate."""
        burst = np.arange(num_photos) / 15
        keyframe_times = np.concatenate([burst, burst[-1] + 1.33 + burst])
        half_way = np.array([burst[-1] + 1.33 / 2])
        errors, stddevs = [], []
        for seed in range(60):
            noise = 0.02 * np.random.default_rng(seed).standard_normal((len(keyframe_times), 3))
            path = trajectory_of(keyframe_times, straight(keyframe_times) + noise)
            found = associate(log_at(half_way), path, np.zeros(3))
            errors.append(found.centers - straight(half_way))
            stddevs.append(found.center_stddev)
        error, stated = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(stddevs)))
        assert 0.8 < error / stated < 1.25
        # A straight line between the two keyframes would have an error of 0.02 / sqrt(2).
        assert error < 0.035

    def test_a_lever_arm_turns_as_well_as_stated_where_turns_begin_and_end(self) -> None:
        """The camera turns to and fro about its vertical axis, at a randomly changing rate."""
        rng = np.random.default_rng(3)
        fine = np.arange(0.0, 120.0, 0.1)
        rate = np.cumsum(0.2 * np.sqrt(0.1) * rng.standard_normal(len(fine)))
        turned = Rotation.from_rotvec(np.outer(np.cumsum(0.1 * rate), [0.0, 1.0, 0.0]))
        arm_m = np.array([0.3, 0.0, 0.4])
        path = trajectory_of(fine[::10], np.zeros((len(fine[::10]), 3)), turned[::10].as_matrix())
        found = associate(log_at(fine[15:-15]), path, arm_m)
        error = found.tag_from_center - turned[15:-15].apply(arm_m)
        between = found.before != found.after
        shortest = Rotation.from_matrix(np.swapaxes(path.world_from_cam[:-1], 1, 2) @ path.world_from_cam[1:])
        part = Rotation.from_rotvec(found.fraction[between, None] * shortest[found.before[between]].as_rotvec())
        at = Rotation.from_matrix(path.world_from_cam[found.before[between]])
        of_shortest = (at * part).apply(arm_m) - turned[15:-15].apply(arm_m)[between]
        assert np.mean(error[between] ** 2) < 0.7 * np.mean(of_shortest**2)
        # The turn has only one axis of three, but the arm is at right angles to it.
        normalized = error[between] / found.arm_stddev_m[between, None]
        assert 0.5 < np.sqrt(np.mean(normalized**2)) < 2.0

    def test_the_lever_arm_turns_with_the_camera(self) -> None:
        keyframe_times = np.arange(0.0, 5.0)
        turned = Rotation.from_rotvec(np.outer(keyframe_times, [0.0, 0.0, 0.3]))
        path = trajectory_of(keyframe_times, straight(keyframe_times), turned.as_matrix())
        range_times = np.linspace(0.0, 4.0, 23)
        found = associate(log_at(range_times), path, TAG_IN_CAM_M)
        expected = Rotation.from_rotvec(np.outer(range_times, [0.0, 0.0, 0.3])).apply(TAG_IN_CAM_M)
        np.testing.assert_allclose(found.tag_from_center, expected, atol=1e-12)

    def test_offset_is_added_to_the_times_of_ranges(self) -> None:
        keyframe_times = np.arange(0.0, 5.0)
        path = trajectory_of(keyframe_times, straight(keyframe_times))
        found = associate(log_at([-8.3]), path, TAG_IN_CAM_M, time_offset_s=10.0)
        np.testing.assert_allclose(found.centers[0], straight(np.array([1.7]))[0], atol=1e-12)

    def test_order_of_the_log_does_not_matter(self) -> None:
        keyframe_times = np.arange(0.0, 20.0, 0.5)
        path = trajectory_of(keyframe_times, curved(keyframe_times))
        range_times = np.linspace(-1.0, 21.0, 101)
        order = np.random.default_rng(0).permutation(101)
        found, shuffled = (associate(log_at(times), path, TAG_IN_CAM_M) for times in (range_times, range_times[order]))
        np.testing.assert_array_equal(shuffled.centers, found.centers[order])
        np.testing.assert_array_equal(shuffled.status, found.status[order])

    def test_a_model_in_another_unit_gives_the_same_places_in_that_unit(self) -> None:
        keyframe_times = np.arange(0.0, 20.0, 0.5)
        path = trajectory_of(keyframe_times, curved(keyframe_times))
        rotation = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
        log = log_at(np.linspace(0.0, 19.0, 50))
        found = associate(log, path, TAG_IN_CAM_M)
        moved = associate(log, path.transformed(Similarity(100.0, rotation, np.ones(3))), TAG_IN_CAM_M)
        np.testing.assert_allclose(moved.centers, 100.0 * found.centers @ rotation.T + 1.0, atol=1e-9)
        np.testing.assert_allclose(moved.tag_from_center, found.tag_from_center @ rotation.T, atol=1e-12)
        np.testing.assert_allclose(moved.center_stddev, 100.0 * found.center_stddev, atol=1e-9)
        np.testing.assert_allclose(moved.arm_stddev_m, found.arm_stddev_m, atol=1e-12)


class TestNextToAKeyframe:
    def test_a_range_at_the_time_of_a_keyframe_was_taken_there(self) -> None:
        keyframe_times = np.array([0.0, 1.0, 2.0])
        path = trajectory_of(keyframe_times, straight(keyframe_times))
        found = associate(log_at([0.0, 1.0, 1.00005, 2.0]), path, TAG_IN_CAM_M)
        assert found.before.tolist() == found.after.tolist() == [0, 1, 1, 2]
        assert found.fraction.tolist() == [0.0] * 4
        np.testing.assert_array_equal(found.centers, path.centers[[0, 1, 1, 2]])

    def test_a_range_counts_as_taken_there_where_nothing_can_be_interpolated(self) -> None:
        keyframe_times = np.array([0.0, 10.0, 20.0])
        path = trajectory_of(keyframe_times, straight(keyframe_times))
        found = associate(log_at([9.985, 10.0, 10.015, 10.03]), path, TAG_IN_CAM_M)
        assert statuses(found) == ["used", "used", "used", "no-keyframe-near"]
        assert found.before.tolist() == found.after.tolist() == [1, 1, 1, -1]
        np.testing.assert_array_equal(found.centers[:3], path.centers[[1, 1, 1]])

    def test_a_single_keyframe_is_enough(self) -> None:
        path = trajectory_of(np.array([3.0]), np.array([[1.0, 2.0, 3.0]]))
        found = associate(log_at([2.99, 3.5]), path, TAG_IN_CAM_M)
        assert statuses(found) == ["used", "outside-path"]


class TestCoarseTimes:
    """A walk at 1.2 m/s, where the times of photos or ranges are rounded and their stddev includes the rounding."""

    def error_in_stddevs(self, photo_step_s: float, range_step_s: float, seed: int) -> tuple[float, float]:
        """Return the root mean square error of the coordinates in stated stddevs, and the median stated stddev."""
        rng = np.random.default_rng(seed)
        photo_times = np.cumsum(rng.uniform(1.2, 1.9, 80))
        range_times = np.sort(rng.uniform(photo_times[2], photo_times[-3], 2000))

        def walk(times: Array) -> Array:
            turn = 0.04 * times
            return np.stack([30 * np.cos(turn), 30 * np.sin(turn), 0 * times], axis=1)

        written = np.rint(photo_times / photo_step_s) * photo_step_s if photo_step_s else photo_times
        path = replace(trajectory_of(written, walk(photo_times)), time_resolution_s=photo_step_s)
        log = log_at(np.rint(range_times / range_step_s) * range_step_s if range_step_s else range_times)
        found = associate(log, path, np.zeros(3), options=RangesOptions(max_interpolation_gap_s=5.0))
        error = np.sqrt(np.sum((found.centers - walk(range_times)) ** 2, axis=1) / 3)
        return float(np.sqrt(np.mean((error / found.center_stddev) ** 2))), float(np.median(found.center_stddev))

    @pytest.mark.parametrize(("photo_step_s", "range_step_s"), [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
    def test_stddev_of_a_place_includes_the_rounding(self, photo_step_s: float, range_step_s: float) -> None:
        found = [self.error_in_stddevs(photo_step_s, range_step_s, seed) for seed in range(5)]
        assert 0.6 < np.mean([error for error, _ in found]) < 1.5
        # 1.2 m/s for 0.29 s, spread over three coordinates, with the times of photos, of ranges or of both rounded.
        assert 0.1 < np.mean([stddev for _, stddev in found]) < 0.4


class TestLongGaps:
    TIMES = np.concatenate([np.arange(0.0, 10.0, 0.5), np.arange(14.0, 24.0, 0.5)])

    def test_nothing_is_interpolated_across(self) -> None:
        path = trajectory_of(self.TIMES, curved(self.TIMES))
        found = associate(log_at([9.2, 9.49, 10.0, 12.0, 13.9, 14.0, 14.2]), path, TAG_IN_CAM_M)
        expected = ["used", "used", *["no-keyframe-near"] * 3, "used", "used"]
        assert statuses(found) == expected
        gone = found.status == RangeStatus.NO_KEYFRAME_NEAR
        assert np.all(np.isnan(found.centers[gone]))
        assert np.all(found.before[gone] == -1)
        assert not found.has_place[gone].any()

    def test_a_gap_of_the_limit_is_none_whatever_the_date(self) -> None:
        """Seconds since 1970 have steps of 2.4e-7 s, so photos every 2 s are sometimes slightly further apart."""
        times = 1.7e9 + 0.1 + 2.0 * np.arange(20) + 1e-7 * np.arange(20)
        assert np.ptp(np.diff(times)) > 0
        found = associate(log_at(times[:-1] + 1.0), trajectory_of(times, straight(times - times[0])), TAG_IN_CAM_M)
        assert statuses(found) == ["used"] * 19
        np.testing.assert_allclose(found.fraction, 0.5, atol=1e-6)

    def test_the_limit_is_an_option(self) -> None:
        path = trajectory_of(self.TIMES, straight(self.TIMES))
        found = associate(log_at([12.0]), path, TAG_IN_CAM_M, options=RangesOptions(max_interpolation_gap_s=5.0))
        np.testing.assert_allclose(found.centers[0], straight(np.array([12.0]))[0], atol=1e-9)


class TestStopAndGo:
    """Photos every 8 s; ranges at 10 Hz, for 2 s around each photo or all the time."""

    PHOTOS = np.linspace(0.0, 88.0, 12)
    ANCHOR = np.array([6.0, 5.0, 2.0])

    def log(self, position_at: Callable[[Array], Array], times: Array) -> RangeLog:
        ranges = np.linalg.norm(position_at(times) - self.ANCHOR, axis=1)
        return log_at(times, ranges + 0.05 * np.random.default_rng(0).standard_normal(len(times)))

    def test_bursts_around_photos_taken_standing_still_belong_to_the_photos(self) -> None:
        times = (self.PHOTOS[:, None] + np.linspace(-1.0, 1.0, 20)).ravel()
        log = self.log(lambda t: straight(8.0 * np.round(t / 8.0)), times)
        found = associate(log, trajectory_of(self.PHOTOS, straight(self.PHOTOS)), TAG_IN_CAM_M)
        assert set(statuses(found)) == {"used"}
        np.testing.assert_array_equal(found.before, np.repeat(np.arange(12), 20))
        np.testing.assert_array_equal(found.before, found.after)

    def test_the_same_ranges_taken_walking_belong_to_none(self) -> None:
        times = (self.PHOTOS[:, None] + np.linspace(-1.0, 1.0, 20)).ravel()
        found = associate(self.log(straight, times), trajectory_of(self.PHOTOS, straight(self.PHOTOS)), TAG_IN_CAM_M)
        assert not found.has_place.any()
        assert "no-keyframe-near" in statuses(found)


class TestLogsThatNamePhotos:
    def log(self, image_names: list[str]) -> RangeLog:
        return RangeLog.from_arrays(["A"] * len(image_names), np.full(len(image_names), 5.0), image_name=image_names)

    @pytest.mark.parametrize("times", [None, np.arange(4.0)], ids=["without times", "with times"])
    def test_ranges_belong_to_the_photos_they_name(self, times: Array | None) -> None:
        path = trajectory_of(times, straight(np.arange(4.0)))
        found = associate(self.log(["002.jpg", "000.jpg", "002.jpg"]), path, TAG_IN_CAM_M)
        assert found.before.tolist() == found.after.tolist() == [2, 0, 2]
        np.testing.assert_array_equal(found.centers, path.centers[[2, 0, 2]])

    @pytest.mark.parametrize("times", [None, np.arange(4.0)], ids=["without times", "with times"])
    def test_the_tag_sits_at_its_lever_arm_in_the_axes_of_that_photo(self, times: Array | None) -> None:
        turned = Rotation.from_rotvec(np.outer(np.arange(4.0), [0.1, 0.0, 0.3]))
        path = trajectory_of(times, straight(np.arange(4.0)), turned.as_matrix())
        found = associate(self.log(["002.jpg", "000.jpg"]), path, TAG_IN_CAM_M)
        np.testing.assert_allclose(found.tag_from_center, turned[[2, 0]].apply(TAG_IN_CAM_M), atol=1e-12)

    def test_a_photo_that_is_not_in_the_model_is_told(self) -> None:
        path = trajectory_of(None, straight(np.arange(4.0)))
        found = associate(self.log(["001.jpg", "else.jpg"]), path, TAG_IN_CAM_M)
        assert statuses(found) == ["used", "unknown-image"]
        assert found.before.tolist() == [1, -1]
        assert np.isnan(found.centers[1]).all()


def test_each_tag_has_its_own_lever_arm() -> None:
    keyframe_times = np.arange(0.0, 5.0)
    turned = Rotation.from_rotvec(np.outer(keyframe_times, [0.0, 0.0, 0.3]))
    path = trajectory_of(keyframe_times, straight(keyframe_times), turned.as_matrix())
    range_times, tags = np.array([0.5, 1.25, 3.75]), np.array([[0.1, 0.0, 0.0], [0.0, -0.3, 0.2]])
    log = RangeLog.from_arrays(["A"] * 3, np.full(3, 5.0), timestamp_s=range_times, tag_id=["left", "right", "left"])
    found = associate(log, path, tags)
    expected = Rotation.from_rotvec(np.outer(range_times, [0.0, 0.0, 0.3])).apply(tags[[0, 1, 0]])
    np.testing.assert_allclose(found.tag_from_center, expected, atol=1e-12)


@pytest.mark.parametrize("lever_arms", [np.zeros(2), np.zeros((2, 3)), np.zeros((3, 1))])
def test_lever_arms_that_do_not_suit_the_tags_of_the_log_are_refused(lever_arms: Array) -> None:
    keyframe_times = np.arange(0.0, 5.0)
    path = trajectory_of(keyframe_times, straight(keyframe_times))
    with pytest.raises(InputError, match=r"a log of 1 tag\(s\), expected \(3,\) or \(1, 3\)"):
        associate(log_at([1.5]), path, lever_arms)


def test_ranges_between_two_of_a_kind_have_no_place_and_say_why() -> None:
    keyframe_times = np.arange(0.0, 5.0)
    log = RangeLog.from_arrays(
        ["A", "B", "u", "A"], np.full(4, 5.0), timestamp_s=[0.0, 1.5, 2.0, 9.0], tag_id=["t", "A", "t", "B"]
    ).with_anchors({"A", "B"})
    found = associate(log, trajectory_of(keyframe_times, straight(keyframe_times)), TAG_IN_CAM_M)
    assert statuses(found) == ["used", "anchor-anchor", "tag-tag", "anchor-anchor"]
    assert found.has_place.tolist() == [True, False, False, False]
    assert found.before.tolist() == [0, -1, -1, -1]
    assert np.isnan(found.tag_from_center[1:]).all()


def test_anchors_that_range_with_each_other_do_not_make_the_camera_stand_still() -> None:
    keyframe_times = np.arange(0.0, 50.0, 10.0)
    times = np.concatenate([time + np.linspace(-0.5, 0.5, 12) for time in keyframe_times])
    moving = 5.0 + 0.8 * np.tile(np.linspace(-0.5, 0.5, 12), 5)
    path = trajectory_of(keyframe_times, straight(keyframe_times))
    alone = associate(log_at(times, moving), path, TAG_IN_CAM_M)
    static = np.full((4, len(times)), 7.0)
    log = RangeLog.from_arrays(
        ["A"] * len(times) + ["B", "C", "D", "E"] * len(times),
        np.concatenate([moving, static.T.ravel()]),
        timestamp_s=np.concatenate([times, np.repeat(times, 4)]),
        tag_id=["t"] * len(times) + ["C", "D", "E", "B"] * len(times),
    ).with_anchors({"A", "B", "C", "D", "E"})
    beside = associate(log, path, TAG_IN_CAM_M)
    assert "no-keyframe-near" in statuses(alone)
    assert statuses(beside)[: len(times)] == statuses(alone)


def test_times_without_times_of_photos_are_refused() -> None:
    with pytest.raises(InputError, match="image times"):
        associate(log_at([1.0]), trajectory_of(None, straight(np.arange(4.0))), TAG_IN_CAM_M)
