"""``rangesfm ranges`` summarizes a log, plots it and writes it in the canonical format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.cli import main
from rangesfm.measurements.ranges.readers import read_ranges


def test_faults_and_noise_of_a_log_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ranges = np.round(5 + np.random.default_rng(1).normal(0, 0.05, 200), 2).tolist()
    rows = [f"{k / 10},a,{range_m}" for k, range_m in enumerate(ranges)]
    rows += [rows[7]]
    (tmp_path / "uwb.csv").write_text("\n".join(["timestamp_s,anchor_id,range_m", *rows]))
    assert main(["ranges", str(tmp_path / "uwb.csv")]) == 0
    text = capsys.readouterr().out
    assert "1 ranges are in the log twice" in text
    assert "1 ranges are earlier than the one before them" in text
    assert "the log's times go back 1 time by a quarter of its length or more: was its clock restarted?" in text
    assert "all ranges are multiples of 0.01 m" in text
    noise_m = float(text.splitlines()[-1].split()[5])
    assert noise_m == pytest.approx(0.05, rel=0.2)


def test_device_log_is_written_as_canonical_csv_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out, plot = tmp_path / "uwb.log", tmp_path / "out.csv", tmp_path / "out.png"
    log.write_text("1.5 022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49\n")
    assert main(["ranges", str(log), "--output-path", str(out), "--plot", str(plot)]) == 0
    assert read_ranges(out).range_m.tolist() == [3.38, 5.49]
    assert plot.read_bytes().startswith(b"\x89PNG")
    text = capsys.readouterr().out
    assert "format  dwm1001_les" in text
    assert "  022E  7.940  8.030  0.000" in text


def test_time_stamps_are_converted_as_told(tmp_path: Path) -> None:
    log, out = tmp_path / "uwb.csv", tmp_path / "out.csv"
    told = ["--columns", "timestamp=t,anchor_id=node", "--stamp_unit", "us", "--t_off_s", "1e-7"]
    log.write_text("t,node,tx1,rx1,tx2,rx2\n0,a,0,1000,2000,1000.5\n")
    assert main(["ranges", str(log), *told, "--propagation_speed", "vacuum", "--output_path", str(out)]) == 0
    assert read_ranges(out).range_m[0] == pytest.approx(299_792_458 / 2 * (0.5e-6 - 1e-7), abs=1e-4)


@pytest.mark.parametrize("speed", ["5", "3e9", "nan"])
def test_speed_that_is_not_lights_is_refused(speed: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ranges", "uwb.csv", "--propagation_speed", speed]) == 2
    assert "expected air, vacuum or a speed of light in m/s" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flag", "value", "said"),
    [
        ("--propagation_speed", "fast", "'fast' is neither air, vacuum nor a number"),
        ("--stamp_bits", "33", "'33' is not a choice, expected one of 32, 40"),
        ("--stamp_bits", "many", "'many' is not a choice, expected one of 32, 40"),
        ("--ranging_interval_s", "0", "expected a number of seconds from 1e-06 to 1000000"),
        ("--separator", "ab", "expected one character"),
    ],
)
def test_description_of_a_log_that_cannot_be_is_refused(
    flag: str, value: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ranges", "uwb.csv", flag, value]) == 2
    assert said in capsys.readouterr().err


def test_counted_rounds_are_as_long_as_told(tmp_path: Path) -> None:
    log, out = tmp_path / "uwb.log", tmp_path / "out.csv"
    log.write_text('{"Block":7, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":61}]}\n')
    assert main(["ranges", str(log), "--ranging_interval_s", "0.5", "--output_path", str(out)]) == 0
    times = read_ranges(out).timestamp_s
    assert times is not None
    assert times.tolist() == [3.5]


def test_ranges_between_known_anchors_are_labelled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, anchors = tmp_path / "uwb.csv", tmp_path / "anchors.csv"
    log.write_text("timestamp_s,anchor_id,range_m,tag_id\n0,A,1,t\n1,B,2,t\n2,B,4.5,A\n3,A,4.7,B\n")
    anchors.write_text("anchor_id,x_m,y_m,z_m\nA,,,\nB,,,\n")
    assert main(["ranges", str(log), "--anchors", str(anchors)]) == 0
    text = capsys.readouterr().out
    assert "tags    t" in text
    assert "2 ranges are between two anchors" in text
    assert text.splitlines()[-1].split() == ["anchor-anchor", "A", "-", "B", "2", "4.500", "4.600", "4.700"]
