"""The time offset of an antenna's positions: found where the motion tells it, and never taken for sure elsewhere."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline

from rangesfm.errors import GeometryError
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.measurements.positions.clock import find_antenna_offset
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.options import RangesOptions
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Places = Callable[[Array], Array]
METRES_PER_UNIT, NOISE_M, AHEAD_S = 0.4, 0.03, -12.0
PHOTOS_S = np.arange(0.0, 60.0, 0.5)
LAP_S = 20.0


def walk(times_s: Array) -> Array:
    """Return (n, 3) places of somebody who walks about, in metres."""
    knots_s = np.arange(-40.0, 110.0, 3.0)
    return np.asarray(CubicSpline(knots_s, np.random.default_rng(2).normal(0.0, 2.0, (len(knots_s), 3)))(times_s))


def other_walk(times_s: Array) -> Array:
    return walk(-times_s)


def circle(times_s: Array) -> Array:
    """Return (n, 3) places on a circle that is walked at an even speed."""
    angle = 2 * np.pi * times_s / LAP_S
    return np.column_stack([2 * np.cos(angle), 2 * np.sin(angle), np.zeros_like(angle)])


def eight(times_s: Array) -> Array:
    """Return (n, 3) places on an eight, which is the same after half a lap but for a half turn."""
    angle = 2 * np.pi * times_s / LAP_S
    return np.column_stack([3 * np.sin(angle), 1.5 * np.sin(2 * angle), np.zeros_like(angle)])


def there_and_back(times_s: Array) -> Array:
    """Return (n, 3) places on a bent way that is walked there and back, twice."""
    share = np.abs(np.mod(times_s / LAP_S, 2.0) - 1.0)
    return np.column_stack([6 * share, np.sin(np.pi * share), np.zeros_like(share)])


def track(places: Places, times_s: Array, num_wrong: int = 0, offset_s: float | None = None) -> AntennaTrack:
    """Return positions at the photos' times ``times_s``, by a clock that is behind."""
    rng = np.random.default_rng(1)
    at_m = places(times_s) + [1012.0, 5003.0, 413.0] + NOISE_M * rng.standard_normal((len(times_s), 3))
    at_m[rng.permutation(len(at_m))[:num_wrong]] += rng.normal(0.0, 20.0, (num_wrong, 3))
    log = PositionLog(at_m, np.full((len(at_m), 3, 3), np.nan), ByTime(times_s + AHEAD_S), np.arange(len(at_m)))
    offset = None if offset_s is None else TimeOffset.given(offset_s)
    return AntennaTrack(log, np.zeros(3), offset, RangesOptions())


def photos(places: Places, times_s: Array = PHOTOS_S) -> Trajectory:
    num = len(times_s)
    centers, turns = places(times_s) / METRES_PER_UNIT, np.tile(np.eye(3), (num, 1, 1))
    return Trajectory(np.arange(num), tuple(map(str, range(num))), times_s, centers, turns)


@pytest.mark.parametrize("end_s", [60.0, 35.0])
@pytest.mark.parametrize("num_wrong", [0, 20])
def test_the_offset_of_a_walk_is_found_by_all_or_some_of_its_time_and_in_spite_of_outliers(
    end_s: float, num_wrong: int
) -> None:
    search = find_antenna_offset(track(walk, np.arange(0.0, end_s, 0.2), num_wrong), photos(walk)).offset
    assert search is not None
    assert abs(search.value_s + AHEAD_S) < min(3 * search.stddev_s, 0.1)
    assert search.is_certain
    assert search.rivals == ()


@pytest.mark.parametrize("places", [circle, eight, there_and_back])
@pytest.mark.parametrize(("start_s", "end_s"), [(0.0, 60.0), (0.0, 32.0), (20.0, 70.0)])
def test_the_offset_on_a_path_that_repeats_itself_is_refused_or_told_with_its_rivals(
    places: Places, start_s: float, end_s: float
) -> None:
    search = None
    with contextlib.suppress(GeometryError):
        search = find_antenna_offset(track(places, np.arange(start_s, end_s, 0.2)), photos(places)).offset
    if search is None:
        return
    offsets_s = [search.value_s, *(rival.value_s for rival in search.rivals)]
    assert any(abs(offset_s + AHEAD_S) < 3 * search.stddev_s for offset_s in offsets_s)
    assert search.rivals or not search.is_certain or abs(search.value_s + AHEAD_S) < 3 * search.stddev_s


def laps(times_s: Array) -> Array:
    """Return (n, 3) places on a bent lap that is walked again and again in the same way."""
    angle = 2 * np.pi * times_s / LAP_S
    return eight(times_s) + np.outer(0.5 * np.cos(angle) + 0.3 * np.cos(2 * angle), [0.0, 0.3, 1.0])


def test_an_offset_that_explains_all_positions_is_likelier_than_those_that_explain_half_of_them() -> None:
    search = find_antenna_offset(track(laps, np.arange(0.0, 40.0, 0.2)), photos(laps, PHOTOS_S[:80])).offset
    assert search is not None
    assert search.value_s == pytest.approx(-AHEAD_S, abs=0.05)
    assert all(search.probability > 10 * rival.probability for rival in search.rivals)


def test_positions_of_another_walk_are_refused() -> None:
    with pytest.raises(GeometryError, match=r"at no time offset do the positions|does not distinguish"):
        find_antenna_offset(track(other_walk, np.arange(0.0, 60.0, 0.2)), photos(walk))


def test_few_positions_or_photos_tell_no_offset() -> None:
    with pytest.raises(GeometryError, match="too few positions along the camera's path"):
        find_antenna_offset(track(walk, np.array([3.0, 4.0])), photos(walk))
    with pytest.raises(GeometryError, match="3 photos and 300 positions are too few"):
        find_antenna_offset(track(walk, np.arange(0.0, 60.0, 0.2)), photos(walk, PHOTOS_S[:3]))


@pytest.mark.parametrize(("given_s", "other_s"), [(-AHEAD_S, None), (-AHEAD_S + 18.0, -AHEAD_S)])
def test_a_given_offset_stays_unless_another_fits_much_better(given_s: float, other_s: float | None) -> None:
    found = find_antenna_offset(track(walk, np.arange(0.0, 60.0, 0.2), offset_s=given_s), photos(walk))
    assert found.offset_s == given_s
    assert found.other_offset_s == (other_s if other_s is None else pytest.approx(other_s, abs=0.05))
