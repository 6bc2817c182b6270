"""Time stamps of two-way ranging become the range that they were made from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.measurements.ranges.twr import (
    AIR_M_PER_S,
    DW1000_TICK_S,
    VACUUM_M_PER_S,
    StampOptions,
    double_sided_range,
    single_sided_range,
)

Array = npt.NDArray[np.float64]
TENTH_OF_A_MILLIMETRE = 1e-4
CRYSTAL = 20e-6  # no range is more accurate than the clock that measured it
RANGES_M = np.linspace(0.3, 80, 2000)


def simulate(
    options: StampOptions, *, third_from_a: bool = False, rate_of_a: float = 1 + 17e-6, rate_of_b: float = 1 - 12e-6
) -> dict[str, Array]:
    """Stamps of an exchange for each of RANGES_M, on two wrapping clocks that started at different times."""
    generator = np.random.default_rng(3)
    flight = (RANGES_M / options.propagation_speed_m_per_s) + options.t_off_s / 2
    delay = generator.uniform(2e-4, 3e-3, (2, len(RANGES_M)))
    start = generator.uniform(0, 1, len(RANGES_M))  # many wraps
    poll_received = start + flight
    answer_sent = poll_received + delay[0]
    answer_received = answer_sent + flight
    third_sent = (answer_received if third_from_a else answer_sent) + delay[1]

    def stamp(time: Array, rate: float, offset: float) -> Array:
        return np.mod((time + offset) * rate, options.wrap_s) / options.unit_s

    def by_a(time: Array) -> Array:
        return stamp(time, rate_of_a, 0.0123)

    def by_b(time: Array) -> Array:
        return stamp(time, rate_of_b, 0.0456)

    third = (by_a, by_b) if third_from_a else (by_b, by_a)
    return {
        "tx1": by_a(start),
        "rx1": by_b(poll_received),
        "tx2": by_b(answer_sent),
        "rx2": by_a(answer_received),
        "tx3": third[0](third_sent),
        "rx3": third[1](third_sent + flight),
    }


def first_four(stamps: dict[str, Array]) -> dict[str, Array]:
    return {name: stamps[name] for name in ("tx1", "rx1", "tx2", "rx2")}


@pytest.mark.parametrize("third_from_a", [False, True])
@pytest.mark.parametrize(
    "options",
    [
        StampOptions(),
        StampOptions(unit_s=DW1000_TICK_S, wrap_s=2**40 * DW1000_TICK_S),
        StampOptions(propagation_speed_m_per_s=VACUUM_M_PER_S, t_off_s=10e-9),
    ],
    ids=["ns", "40-bit ticks", "vacuum and delays"],
)
def test_double_sided_ranging_recovers_the_range_whatever_the_clocks(options: StampOptions, third_from_a: bool) -> None:
    stamps = simulate(options, third_from_a=third_from_a)
    assert options.wrap_s > 1 or np.any(stamps["rx2"] < stamps["tx1"])  # some exchanges do wrap
    np.testing.assert_allclose(double_sided_range(**stamps, options=options), RANGES_M, CRYSTAL, TENTH_OF_A_MILLIMETRE)


def test_shorter_wrap_serves_a_longer_counter() -> None:
    options = StampOptions(unit_s=DW1000_TICK_S, wrap_s=2**40 * DW1000_TICK_S)
    ranges = double_sided_range(**simulate(options), options=StampOptions(unit_s=DW1000_TICK_S))
    np.testing.assert_allclose(ranges, RANGES_M, CRYSTAL, TENTH_OF_A_MILLIMETRE)


def test_single_sided_ranging_recovers_the_range_if_the_rates_are_known() -> None:
    stamps = first_four(simulate(StampOptions()))
    rate = (1 + 17e-6) / (1 - 12e-6)
    ranges = single_sided_range(**stamps, options=StampOptions(), rate_of_a=rate)
    np.testing.assert_allclose(ranges, RANGES_M, CRYSTAL, TENTH_OF_A_MILLIMETRE)
    uncorrected = single_sided_range(**stamps, options=StampOptions())
    assert np.max(np.abs(uncorrected - RANGES_M)) > 5.0  # 29 ppm of 3 ms are 13 m


def test_range_a_little_below_zero_is_not_a_whole_wrap() -> None:
    options = StampOptions(t_off_s=0.0)
    wrap = options.wrap_s / options.unit_s
    ranges = single_sided_range([0.0], [0.0], [wrap - 1.0], [wrap - 3.0], options)
    np.testing.assert_allclose(ranges, [-AIR_M_PER_S * 1e-9], atol=1e-6)


def test_computed_range_is_the_one_that_a_real_radio_logged() -> None:
    logged_m = 2.4042000770568848
    ranges = double_sided_range(
        [462462989.5958534],
        [874962214.4650191],
        [875274624.211238],
        [462775414.9764624],
        [876813342.159956],
        [464314130.9063252],
        StampOptions(),
    )
    np.testing.assert_allclose(ranges, [logged_m], atol=TENTH_OF_A_MILLIMETRE)


def test_stamps_of_another_unit_are_refused() -> None:
    with pytest.raises(InputError, match="fit no third message"):
        double_sided_range(**simulate(StampOptions()), options=StampOptions(unit_s=1e-6))


# In a log


def write_stamps(path: Path, stamps: dict[str, Array], rename: dict[str, str] | None = None) -> Path:
    names = [(rename or {}).get(name, name) for name in stamps]
    rows = (f"{k},7,{','.join(map(repr, map(float, row)))}" for k, row in enumerate(zip(*stamps.values())))
    path.write_text("\n".join([f"t,node,{','.join(names)}", *rows]) + "\n")
    return path


COLUMNS = {"timestamp": "t", "anchor_id": "node"}


def test_log_without_ranges_has_them_from_its_stamps(tmp_path: Path) -> None:
    log = read_ranges(write_stamps(tmp_path / "log.csv", simulate(StampOptions())), columns=COLUMNS)
    np.testing.assert_allclose(log.range_m, RANGES_M, CRYSTAL, TENTH_OF_A_MILLIMETRE)


def test_log_of_single_sided_stamps_under_other_names_and_units(tmp_path: Path) -> None:
    options = StampOptions(unit_s=DW1000_TICK_S, propagation_speed_m_per_s=VACUUM_M_PER_S, t_off_s=1e-9)
    stamps = first_four(simulate(options, rate_of_a=1.0, rate_of_b=1.0))
    path = write_stamps(tmp_path / "log.csv", stamps, {"tx1": "sent"})
    log = read_ranges(
        path, columns={**COLUMNS, "tx1": "sent"}, stamp_unit="ticks", propagation_speed="vacuum", t_off_s=1e-9
    )
    np.testing.assert_allclose(log.range_m, RANGES_M, CRYSTAL, TENTH_OF_A_MILLIMETRE)


def test_range_column_counts_where_a_log_has_both(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,node,d,tx1,rx1,tx2,rx2\n0,7,2.5,0,0,0,0\n")
    assert read_ranges(path, columns={**COLUMNS, "range": "d"}).range_m.tolist() == [2.5]


def test_exchange_that_failed_is_no_measurement(tmp_path: Path) -> None:
    stamps = {name: values.copy() for name, values in simulate(StampOptions()).items()}
    path = write_stamps(tmp_path / "log.csv", stamps)
    lines = path.read_text().split("\n")
    lines[5] = "4,7,12.5,,,,,"
    path.write_text("\n".join(lines))
    log = read_ranges(path, columns=COLUMNS)
    assert (len(log), log.num_no_measurement) == (len(RANGES_M) - 1, 1)


def test_log_without_range_and_stamps_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,node,d\n0,7,2.5\n")
    with pytest.raises(InputError, match="name neither range nor the time stamps tx1, rx1, tx2, rx2"):
        read_ranges(path, columns=COLUMNS)


def test_wrong_stamp_in_a_log_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,node,tx1,rx1,tx2,rx2\n0,7,1,2,3,4\n0,7,1,2,x,4\n")
    with pytest.raises(InputError, match="tx2 is 'x'") as caught:
        read_ranges(path, columns=COLUMNS)
    assert caught.value.line == 3
