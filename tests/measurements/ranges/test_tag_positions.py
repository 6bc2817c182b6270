"""The tag's position at each range, from a known path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.known_path import tag_positions
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.reference import Reference

TIMES_S = np.array([0.0, 0.4, 0.8, 2.0, 2.4])
PATH_M = np.outer(TIMES_S, [1.0, 0.0, -0.5])


def log_at(times: npt.ArrayLike) -> RangeLog:
    return RangeLog.from_arrays(["A"] * len(np.asarray(times)), np.full(len(np.asarray(times)), 5.0), timestamp_s=times)


def log_of(*names: str) -> RangeLog:
    return RangeLog.from_arrays(["A"] * len(names), np.full(len(names), 5.0), image_name=list(names))


def test_is_interpolated_at_the_time_of_the_range_plus_the_offset() -> None:
    found = tag_positions(
        log_at([-9.9, -9.3, -7.8]), Reference(PATH_M, ByTime(TIMES_S)), time_offset_s=10.0, max_gap_s=0.5
    )
    np.testing.assert_allclose(found, np.outer([0.1, 0.7, 2.2], [1.0, 0.0, -0.5]), atol=1e-12)


def test_is_unknown_in_gaps_and_beyond_the_ends() -> None:
    found = tag_positions(log_at([-0.1, 0.2, 1.4, 2.5]), Reference(PATH_M, ByTime(TIMES_S)), max_gap_s=0.5)
    assert np.isfinite(found[:, 0]).tolist() == [False, True, False, False]


def test_turns_the_lever_arm_with_the_camera() -> None:
    turns = Rotation.from_rotvec(np.outer(TIMES_S, [0.0, 0.0, 1.0])).as_matrix()
    path = Reference(PATH_M, ByTime(TIMES_S), world_from_cam=turns)
    found = tag_positions(log_at([0.6]), path, (0.1, 0.0, -0.2), max_gap_s=0.5)
    expected = np.array([0.6 + 0.1 * np.cos(0.6), 0.1 * np.sin(0.6), -0.3 - 0.2])
    np.testing.assert_allclose(found[0], expected, atol=1e-12)


def test_is_found_by_name() -> None:
    path = Reference(PATH_M[:2], ByPhoto(("p1", "p2")))
    found = tag_positions(log_of("p2", "p9"), path, max_gap_s=0.5)
    np.testing.assert_array_equal(found, [PATH_M[1], np.full(3, np.nan)])


@pytest.mark.parametrize(
    ("log", "path", "said"),
    [
        (log_of("p1"), Reference(PATH_M, ByTime(TIMES_S)), "ranges are by name and the positions by time"),
        (log_at([0.0]), Reference(PATH_M[:1], ByPhoto(("p1",))), "ranges are by time and the positions by name"),
        (log_of("a"), Reference(PATH_M[:1], ByPhoto(("b",))), "of photo 'b', the first of the ranges of photo 'a'"),
        (
            log_at([7.0, 9.0]),
            Reference(PATH_M, ByTime(TIMES_S)),
            "positions are known from 0.000 to 2.400 s, .* the ranges are from 7.000 to 9.000 s",
        ),
    ],
    ids=["by name", "by time", "other names", "other times"],
)
def test_says_why_it_is_known_nowhere(log: RangeLog, path: Reference, said: str) -> None:
    with pytest.raises(InputError, match=said):
        tag_positions(log, path, max_gap_s=0.5)


def test_lever_arm_needs_rotations() -> None:
    with pytest.raises(InputError, match="a lever arm needs the rotations qx,qy,qz,qw"):
        tag_positions(log_at([0.1]), Reference(PATH_M, ByTime(TIMES_S)), (0.1, 0.0, 0.0), max_gap_s=0.5)
