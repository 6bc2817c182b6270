"""An error curve is written, read and subtracted from ranges; beyond its ends it gets less certain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.errors.error_curve import (
    ErrorCurve,
    correct_ranges,
    read_error_curve,
    write_error_curve,
)
from rangesfm.measurements.ranges.range_log import RangeLog

CURVE = ErrorCurve(
    np.array([1.0, 2.0, 4.0]), np.array([-0.1, 0.0, 0.1]), np.array([0.03, 0.02, 0.02]), np.array([0.1, 0.1, 0.1])
)


def test_it_is_read_as_written(tmp_path: Path) -> None:
    write_error_curve(CURVE, tmp_path / "curve.csv")
    read = read_error_curve(tmp_path / "curve.csv")
    for name in ("distance_m", "error_m", "stddev_m", "noise_stddev_m"):
        np.testing.assert_allclose(getattr(read, name), getattr(CURVE, name), atol=1e-5)


def test_ranges_become_the_distances_that_gave_them() -> None:
    true = np.linspace(1.0, 4.0, 31)
    distance, stddev = CURVE.true_distance(true + np.interp(true, CURVE.distance_m, CURVE.error_m))
    np.testing.assert_allclose(distance, true, atol=1e-9)
    assert np.all((stddev >= 0.02 - 1e-12) & (stddev <= 0.03 + 1e-12))


def test_beyond_its_ends_it_keeps_the_last_value_and_grows_uncertain() -> None:
    distance, stddev = CURVE.true_distance(np.array([0.3, 0.5, 4.1, 10.0, 100.0]))
    np.testing.assert_allclose(distance, [0.4, 0.6, 4.0, 9.9, 99.9])
    assert stddev[0] > stddev[1] > 0.03
    assert stddev[4] > stddev[3] > stddev[2] == pytest.approx(0.02)


def test_ranges_beyond_its_ends_are_counted_for_the_user() -> None:
    log = RangeLog.from_arrays(["a"] * 10, [3.0] * 5 + [9.0] * 5, timestamp_s=np.arange(10.0))
    corrected, notes = correct_ranges(log, CURVE)
    assert notes == [
        "50 % of the ranges are shorter or longer than the 1.00 to 4.00 m at which the error curve was learnt: "
        "they weigh less"
    ]
    assert corrected.subset(np.arange(5, 10)).shared_stddev_m == pytest.approx(corrected.shared_stddev_m[5:])
    assert correct_ranges(log.subset(np.arange(5)), CURVE)[1] == []


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1,0,0.1\n", "has 1 distances, expected two or more"),
        ("1,0,0.1\n1,0,0.1\n", ":3: distance_m is 1, expected more than the distance before it"),
        ("0,0,0.1\n1,0,0.1\n", ":2: distance_m is 0, expected a number of metres from 1e-06 to 1000000"),
        ("1,0,0.1\n2,0,-0.1\n", ":3: stddev_m is -0.1, expected 0, or a number of metres from 1e-06 to 1000"),
        ("1,0,0.1\n2,-1.5,0.1\n", ":3: error_m is -1.5, expected one at which a longer distance gives a longer range"),
        ("1,0,0.1\n2,x,0.1\n", ":3: error_m is 'x', expected a number of metres from -1000 to 1000"),
    ],
)
def test_a_curve_that_is_none_is_refused_with_its_line(tmp_path: Path, rows: str, message: str) -> None:
    path = tmp_path / "curve.csv"
    path.write_text(f"distance_m,error_m,stddev_m\n{rows}")
    with pytest.raises(InputError) as error:
        read_error_curve(path)
    assert str(error.value).endswith(message)


@pytest.mark.parametrize("rows", ["1,-1,0.1\n2,0,0.1\n", "1,0.5,0.1\n2,-0.5,0.1\n"])
def test_a_curve_on_which_two_distances_give_one_range_is_refused(tmp_path: Path, rows: str) -> None:
    path = tmp_path / "curve.csv"
    path.write_text(f"distance_m,error_m,stddev_m\n{rows}")
    with pytest.raises(InputError, match="expected one at which a longer distance gives a longer range"):
        read_error_curve(path)
