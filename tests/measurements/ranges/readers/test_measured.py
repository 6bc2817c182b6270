"""Numbers that no radio can measure are no measurements: failure codes, numbers without sign, kilometres."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers import read_ranges

TIMES_S = 0.05 * np.arange(400)
RANGES_M = np.round(6 + 3 * np.sin(TIMES_S / 3 + np.arange(400) % 4) + np.random.default_rng(4).normal(0, 0.04, 400), 3)


def log_with(path: Path, wrong: Iterable[float], *, unit: str = "m") -> Path:
    """Write ranges to four anchors, in which ``wrong`` numbers, in the unit of the file, replace some."""
    per_metre = {"m": 1, "cm": 100, "mm": 1000}[unit]
    numbers = RANGES_M * per_metre if unit == "m" else np.round(RANGES_M * per_metre)
    wrong = list(wrong)
    numbers[np.random.default_rng(1).choice(400, len(wrong), replace=False)] = wrong
    rows = (f"{time:.3f},A{k % 4},{number:.10g}" for k, (time, number) in enumerate(zip(TIMES_S, numbers)))
    path.write_text("\n".join([f"time_s,anchor_id,range_{unit}", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("unit", "wrong"),
    [
        ("m", [4294967.295]),  # 0xffffffff mm, once
        ("mm", [0xFFFFFFFF]),
        ("mm", [0x7FFFFFFF] * 2),
        ("mm", [0xFFFFFFFB, 0xFFFFFFF0]),  # -5 and -16 without sign
        ("cm", [65535]),
        ("m", [655.35]),
        ("m", [65535.0, 65534.0] * 40),  # two codes
        ("m", [655.35, 655.34] * 40),
        ("cm", [9999, 9998, 8888] * 20),
        ("m", [65.535] * 30),  # all bits set need no gap
        ("m", np.random.default_rng(2).uniform(3e5, 4e5, 20).round(3)),  # garbage, never twice the same
        ("mm", [*np.random.default_rng(3).integers(10**7, 10**9, 40), 0, -1, 65535 * 1000]),
    ],
)
def test_numbers_that_no_radio_measures_are_left_out_and_said_once(
    tmp_path: Path, unit: str, wrong: list[float]
) -> None:
    log = read_ranges(log_with(tmp_path / "uwb.csv", wrong, unit=unit))
    assert (len(log), log.num_no_measurement) == (400 - len(wrong), len(wrong))
    assert np.all(np.isin(log.range_m.round(3), RANGES_M.round(2 if unit == "cm" else 3)))
    assert sum("no measurement" in note for note in log.notes) == 1


def test_outliers_that_a_radio_can_measure_are_kept(tmp_path: Path) -> None:
    log = read_ranges(log_with(tmp_path / "uwb.csv", [41.25, 87.5, 250.0, 12.5]))
    assert (len(log), log.num_no_measurement) == (400, 0)


def test_an_anchor_that_is_far_away_is_measured(tmp_path: Path) -> None:
    rows = [f"{0.1 * k:.1f},A{k % 2},{(0.3, 5.1)[k % 2] + 0.1 * (k // 2 % 3 == 0):.1f}" for k in range(200)]
    (tmp_path / "uwb.csv").write_text("\n".join(["time_s,anchor_id,range_m", *rows]) + "\n")
    assert len(read_ranges(tmp_path / "uwb.csv")) == 200


@pytest.mark.parametrize("name", ["time_s", "timestamp_s"])
def test_a_column_beyond_all_reach_has_another_unit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = log_with(tmp_path / "uwb.csv", [], unit="mm")
    path.write_text(path.read_text().replace("range_mm", "range_m").replace("time_s", name))
    with pytest.raises(InputError, match=r"beyond 2000 m, where no UWB radio reaches.*is their unit right") as caught:
        read_ranges(path)
    command = next(line for line in caught.value.advice if line.endswith("mm"))
    assert main(command.split()[1:]) == 0
    assert "ranges  400," in capsys.readouterr().out
