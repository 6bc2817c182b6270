"""Undescribed tables are recognized by their names and values, and reported; for unclear ones, the user is asked."""

from __future__ import annotations

import contextlib
import gzip
import json
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import read_anchors_in_log, read_ranges

ANCHORS = {"A0": (0.0, 0.0, 2.0), "A1": (6.3, 0.2, 1.1), "A2": (5.9, 4.8, 2.3), "A3": (-0.4, 5.1, 0.4)}
NUM_ROUNDS = 60
Row = tuple[float, str, float]  # time, anchor, range in metres


def survey(step_s: float = 0.05, start_s: float = 12.0, seed: int = 3) -> list[Row]:
    """A walk among the anchors, with 5 cm of noise and one range at a time."""
    rng = np.random.default_rng(seed)
    rows: list[Row] = []
    for k in range(NUM_ROUNDS * len(ANCHORS)):
        time_s = start_s + k * step_s
        anchor_id = list(ANCHORS)[k % len(ANCHORS)]
        tag_m = np.array([2.7 + np.cos(time_s / 3), 2.2 + 1.4 * np.sin(time_s / 3), 1.3])
        rows.append((time_s, anchor_id, float(np.linalg.norm(tag_m - ANCHORS[anchor_id]) + rng.normal(0, 0.05))))
    return rows


ROWS = survey()
NUM = {anchor_id: str(index) for index, anchor_id in enumerate(ANCHORS)}


def lines(header: str | None, row: Callable[[float, str, float], str], rows: list[Row] | None = None) -> str:
    return "\n".join([*([] if header is None else [header]), *(row(*one) for one in rows or ROWS)]) + "\n"


def wide(header: str | None, begin: Callable[[float], str], separator: str = ",") -> str:
    rounds = [ROWS[k : k + 4] for k in range(0, len(ROWS), 4)]
    body = [separator.join([begin(one[0][0]), *(f"{r:.3f}" for *_, r in one)]) for one in rounds]
    return "\n".join([*([] if header is None else [header]), *body]) + "\n"


def write(folder: Path, content: str | bytes, name: str = "uwb.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def clock(seconds: float) -> str:
    """Format a time as hh:mm:ss.mmm."""
    return f"{int(seconds // 3600) % 24:02d}:{int(seconds // 60) % 60:02d}:{seconds % 60:06.3f}"


def check_times(log: RangeLog, rows: list[Row] = ROWS) -> None:
    found = log.timestamp_s - log.timestamp_s[0]
    np.testing.assert_allclose(found, np.array([time_s for time_s, *_ in rows]) - rows[0][0], atol=1.1e-3)


PLAIN = lines("time,anchor,range", lambda t, a, r: f"{t:.3f},{a},{r:.3f}")
LONG = {
    "hobby": lines("timestamp,tag_id,anchor_id,range,quality", lambda t, a, r: f"{t:.3f},7,{a},{r:.3f},93"),
    "short names": lines("t,node,d", lambda t, a, r: f"{t:.3f},{a},{r:.3f}"),
    "spoken units": lines("Time (s);Beacon;Distance (m)", lambda t, a, r: f"{t:.3f};{a};{r:.3f}"),
    "decimal commas": lines("Zeit;Anker;Abstand", lambda t, a, r: f"{t:.3f};{a};{r:.3f}".replace(".", ",")),
    "rostopic echo -p": lines(
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.id,field.distanceFromTag,field.rssi",
        lambda t, a, r: f"{int((t + 1.7e9) * 1e9) + 9999},5,{round((t + 1.7e9) * 1e3)}000000,uwb,{a},{r:.6f},-79.5",
    ),
    "secs and nsecs": lines(
        "secs,nsecs,from_id,to_id,range",
        lambda t, a, r: f"{1700000000 + int(t)},{round(t % 1 * 1e9)},9,{a},{r:.3f}",
    ),
    "pandas' index": lines(
        ",anchor,distance,timestamp", lambda t, a, r: f"{round(t * 20)},{a},{r:.3f},2026-01-31T10:00:{t:09.6f}"
    ),
    "requester and responder": lines(
        "t, vicX, vicY, vicZ, uwbD, uwbRspdrId, uwbRqstrId",
        lambda t, a, r: f"{t:.6f},{0.1 * t:.4f},-1.2,0.9,{r:.4f},{NUM[a]}.000,9.000",
    ),
    "raw and filtered": lines(
        "timestamp_system,timestamp_device,tag_id,anchor_id,distance_raw_cm,distance_filtered_cm,rssi_dbm",
        lambda t, a, r: f"{t + 1.7e9:.3f},{int(t * 1000)},1,{a},{r * 100:.1f},{r * 100 + 3:.1f},-80.2",
    ),
    "truth beside it": lines(
        "time_s,range,gt_range,bias,to_id,range_std", lambda t, a, r: f"{t:.3f},{r:.3f},{r:.3f},0.1,{a},0.2"
    ),
    "tabs and text before": "Logger v2\nstarted by hand\n"
    + lines("Time\tAddress\tRange\tRxPower", lambda t, a, r: f"{t:.3f}\t{a}\t{r:.3f}\t-70.1"),
    "spreadsheet filled up with empty cells": ";;;;\nHall 3;12.03.2026;;;\n"
    + lines(";Anchor;Time [s];Range [m];Remark", lambda t, a, r: f";{a};{t:.3f};{r:.3f};".replace(".", ",")),
    "date and time": lines("Date,Time,AnchorID,Dist", lambda t, a, r: f"2026-01-31,{clock(t + 36000)},{a},{r:.3f}"),
    "names in a comment": lines("# time anchor range", lambda t, a, r: f"{t:.3f} {a} {r:.3f}"),
    "no names": lines(None, lambda t, a, r: f"  {t:.16e}\t  {2:.16e}\t  {int(NUM[a]):.16e}\t  {r:.16e}\t").replace(
        "e+0", "e+00"
    ),
    "quoted": lines('"time","anchor","range"', lambda t, a, r: f'"{t:.3f}","{a}","{r:.3f}"'),
    "years of two digits": lines(
        "Zeit;Anker;Abstand", lambda t, a, r: f"31.01.26 {clock(t)};{a};" + f"{r:.3f}".replace(".", ",")
    ),
    "day first": lines("when,anchor,range", lambda t, a, r: f"31/01/2026 {clock(t)},{a},{r:.3f}"),
    "month first, in halves of a day": lines(
        "time,anchor,range", lambda t, a, r: f"1/31/2026 {clock(t)[1:]} PM,{a},{r:.3f}"
    ),
    "time of day, in halves of a day": lines("time,anchor,range", lambda t, a, r: f"{clock(t)[1:]} PM,{a},{r:.3f}"),
    "day first with points": lines("Datum;Uhrzeit;Anker;Distanz", lambda t, a, r: f"1.2.2026;{clock(t)};{a};{r:.3f}"),
    "row of units": lines("time,anchor,range\n[ms],[],[cm]", lambda t, a, r: f"{t * 1000:.0f},{a},{r * 100:.1f}"),
    "ros2 topic echo --csv": lines(
        None, lambda t, a, r: f"{1700000000 + int(t)},{round(t % 1 * 1e9)},uwb,{r:.4f},{NUM[a]}"
    ),
    "rostopic echo": lines(
        None,
        lambda t, a, r: (
            f"header: \n  seq: {round(t * 20)}\n  stamp: \n    secs: {1700000000 + int(t)}\n"
            f"    nsecs: {round(t % 1 * 1e9)}\n  frame_id: uwb\nrange: {r:.4f}\nto_id: {NUM[a]}\n---"
        ),
    ),
    "JSON": lines(None, lambda t, a, r: json.dumps({"ts": t, "tag": "T", "meas": [{"anchor": a, "dist": r}]})),
    "JSON of Pozyx": lines(
        None, lambda t, a, r: json.dumps({"timestamp": t, "ranges": [{"anchor": a, "range": r, "rss": -80 - t}]})
    ),
    "JSON array": json.dumps([{"t": t, "id": a, "range": r} for t, a, r in ROWS]),
    "named values": lines(None, lambda t, a, r: f"2026-01-31 09:{clock(t)[3:]} INFO anchor={a}, range={r:.3f} m"),
    "words in each row": lines(None, lambda t, a, r: f"{clock(t)} -> {a} dist: {r:.3f} m"),
    "lost ones in words": lines("time,anchor,range", lambda t, a, r: f"{t:.3f},{a},{r:.3f}") + "15,A0,TIMEOUT\n",
    "JSON with lists of other things": lines(
        None,
        lambda t, a, r: json.dumps(
            {"t": t, "id": 0, "nodes": [{"id": NUM[a], "dis": r}], "imu": [{"x": 0.1}, {"x": 0.2}], "q": [[1], [2]]}
        ),
    ),
    "units in the cells": lines("time,anchor,range", lambda t, a, r: f"{t * 1000:.0f} ms,{a},{r * 100:.1f}cm"),
    "header twice, and a line cut off": PLAIN.replace("12.500", "time,anchor,range\n12.4\n12.500"),
    "comments of MATLAB": lines(
        "% made by hand\n% time anchor range", lambda t, a, r: f"{t:.3f} {a} {r:.3f}" + "\n% half" * (t == 13)
    ),
    "comments of C": "// made by hand\n" + PLAIN + "// end\n",
    "months in words": lines("Time;anchor;range", lambda t, a, r: f"31-Jan-2026 {clock(t)};{a};{r:.3f}"),
    "dates of digits alone": lines(
        "time,anchor,range", lambda t, a, r: f"20260131{clock(t + 39590).translate({58: None, 46: None})},{a},{r:.3f}"
    ),
    "days of Excel": lines("Time,anchor,range", lambda t, a, r: f"{46023 + t / 86400:.10f},{a},{r:.3f}"),
    "days of MATLAB": lines("datenum,anchor,range", lambda t, a, r: f"{739983 + t / 86400:.10f},{a},{r:.3f}"),
    "minutes and feet": lines("time_min,anchor,range (feet)", lambda t, a, r: f"{t / 60:.7f},{a},{r / 0.3048:.4f}"),
    "PlotJuggler": lines("__time,/uwb/to_id,/uwb/range", lambda t, a, r: f"{t + 1.7e9:.3f},{NUM[a]},{r:.3f}"),
}


@pytest.mark.parametrize("kind", LONG)
def test_row_a_range_is_understood(tmp_path: Path, kind: str) -> None:
    log = read_ranges(write(tmp_path, LONG[kind]))
    check_times(log)
    np.testing.assert_allclose(log.range_m, [r for *_, r in ROWS], atol=6e-4)
    ids = [log.anchor_ids[k] for k in log.anchor_index]
    assert ids in ([a for _, a, _ in ROWS], [NUM[a] for _, a, _ in ROWS])
    assert any("columns taken" in note for note in log.notes)


WIDE = {
    "b1d": wide("timestamp,wearabletimestamp,b0d,b1d,b2d,b3d", lambda t: f"{clock(t)},{int(t * 1000)}"),
    "d1": wide("t,d0,d1,d2,d3", lambda t: f"{t:.3f}"),
    "dist_A0": wide("time dist_A0 dist_A1 dist_A2 dist_A3", lambda t: f"{t:.3f}", separator=" "),
    "addresses": wide(
        "time_sec,time_nanosec,distance_44AE,distance_06A5,distance_CBB0,distance_4F9B",
        lambda t: f"{int(t)},{round(t % 1 * 1e9)}",
    ),
    "anchors": wide("Time,Anchor 0,Anchor 1,Anchor 2,Anchor 3", lambda t: f"2026-01-31 9:37:{t:06.3f}"),
    "ros": wide("%time,field.ranges0,field.ranges1,field.ranges2,field.ranges3", lambda t: f"{int((t + 1.7e9) * 1e9)}"),
    "an anchor in each row": lines(
        "t,id1,d1,id2,d2",
        lambda t, a, r: (
            f"{t:.3f},{a},{r:.3f},{ROWS[round((t - 12) * 20) + 1][1]},{ROWS[round((t - 12) * 20) + 1][2]:.3f}"
        ),
        ROWS[::2],
    ),
    "lists side by side": lines(
        None,
        lambda t, a, r: json.dumps(
            {
                "t": t,
                "anchors": [a, ROWS[round((t - 12) * 20) + 1][1]],
                "distances": [r, ROWS[round((t - 12) * 20) + 1][2]],
            }
        ),
        ROWS[::2],
    ),
    "names that come again": lines(
        None,
        lambda t, a, r: (
            f"t={t:.3f} anchor={a} range={r:.3f} anchor={ROWS[round((t - 12) * 20) + 1][1]} "
            f"range={ROWS[round((t - 12) * 20) + 1][2]:.3f}"
        ),
        ROWS[::2],
    ),
    "cm": wide("t_ms,r0_cm,r1_cm,r2_cm,r3_cm", lambda t: f"{t * 1000:.0f}"),
}


@pytest.mark.parametrize("kind", WIDE)
def test_column_an_anchor_is_understood(tmp_path: Path, kind: str) -> None:
    log = read_ranges(write(tmp_path, WIDE[kind]))
    per_metre = 100 if kind == "cm" else 1
    np.testing.assert_allclose(log.range_m * per_metre, [r for *_, r in ROWS], atol=6e-4)
    np.testing.assert_allclose(np.diff(log.timestamp_s[::4]), 0.2, atol=1.1e-3)
    order = [log.anchor_ids[k] for k in log.anchor_index[:4]]
    assert order in (["b0", "b1", "b2", "b3"], [*"0123"], [*ANCHORS], ["44AE", "06A5", "CBB0", "4F9B"])
    assert log.tag_ids == ("tag",)


@pytest.mark.parametrize(
    ("name", "per_metre"),
    [
        *(("range_in", 1 / 0.0254), ("dist (inch)", 1 / 0.0254), ("Abstand [Zoll]", 1 / 0.0254), ("d_ft", 1 / 0.3048)),
        *(("distance_yd", 1 / 0.9144), ("range_dm", 10), ("distance in m", 1), ("range_km", 1e-3)),
    ],
)
def test_each_unit_that_a_column_names_is_read(tmp_path: Path, name: str, per_metre: float) -> None:
    content = lines(f"time_s,anchor_id,{name}", lambda t, a, r: f"{t:.3f},{a},{r * per_metre:.6f}")
    np.testing.assert_allclose(read_ranges(write(tmp_path, content)).range_m, [r for *_, r in ROWS], atol=1e-3)


def test_ranges_in_units_of_their_own_are_in_metres(tmp_path: Path) -> None:
    each = {"A0": (1, "m"), "A1": (100, "cm"), "A2": (1000, "mm"), "A3": (1, "m")}
    header = "time_s," + ",".join(f"range_{anchor}_{unit}" for anchor, (_, unit) in each.items())
    factors = [factor for factor, _ in each.values()]
    rounds = [
        "{:.3f},{:.4f},{:.4f},{:.4f},{:.4f}".format(one[0][0], *(r * f for (*_, r), f in zip(one, factors)))
        for one in (ROWS[k : k + 4] for k in range(0, len(ROWS), 4))
    ]
    log = read_ranges(write(tmp_path, "\n".join([header, *rounds]) + "\n"))
    np.testing.assert_allclose(log.range_m, [r for *_, r in ROWS], atol=1e-3)
    cells = lines("time_s,anchor_id,range", lambda t, a, r: f"{t:.3f},{a},{r * each[a][0]:.4f} {each[a][1]}")
    log = read_ranges(write(tmp_path, cells))
    np.testing.assert_allclose(log.range_m, [r for *_, r in ROWS], atol=1e-3)
    assert "numbers of range have units of their own (cm, m, mm)" in log.notes
    with pytest.raises(InputError, match="range_A3 has no unit, and other columns of ranges are in m, cm, mm"):
        read_ranges(write(tmp_path, "\n".join([header.replace("A3_m", "A3"), *rounds]) + "\n"))


@pytest.mark.parametrize("times", [100, 1000])
def test_ranges_that_change_their_unit_are_refused_with_a_line_of_each(tmp_path: Path, times: int) -> None:
    content = lines("timestamp_s,anchor_id,range_m", lambda t, a, r: f"{t:.3f},{a},{r * (times if t > 20 else 1):.4f}")
    with pytest.raises(InputError) as error:
        read_ranges(write(tmp_path, content))
    assert f"uwb.csv:163: the range is {times * ROWS[161][2]:g} m here and {ROWS[0][2]:.4g}" in str(error.value)
    assert f"79 of 240 ranges are {times} times as long as the others, as in " in str(error.value)


def test_lists_in_messages_of_rostopic_are_a_row_each(tmp_path: Path) -> None:
    content = "".join(
        f"header:\n  stamp:\n    sec: {1700000000 + k}\n    nanosec: 5\n  frame_id: uwb\nranges:\n"
        + "".join(f"- anchor_id: {anchor}\n  range: {2.5 + anchor}\n  raw: [1.0, 2.0]\n" for anchor in (7, 8))
        + "tag_id: 3\n---\n"
        for k in range(30)
    )
    log = read_ranges(write(tmp_path, content))
    assert (len(log), log.anchor_ids, log.tag_ids) == (60, ("7", "8"), ("3",))
    np.testing.assert_array_equal(log.range_m[:2], [9.5, 10.5])


def test_items_of_lists_whose_dash_is_alone_in_its_line_are_a_row_each(tmp_path: Path) -> None:
    content = "".join(
        f"id: 0\nsystem_time: {1000 * k}\nnodes: \n"
        + "".join(f"  - \n    role: 1\n    id: {anchor}\n    dis: {2.5 + anchor}\n" for anchor in (7, 8))
        + "---\n"
        for k in range(30)
    )
    log = read_ranges(write(tmp_path, content))
    assert (len(log), log.anchor_ids, log.tag_ids) == (60, ("7", "8"), ("0",))
    np.testing.assert_array_equal(log.range_m[:2], [9.5, 10.5])


def test_lines_of_an_esp32_have_the_time_of_the_board(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, lines(None, lambda t, a, r: f"I ({t * 1000:.0f}) uwb: anchor={a} dist={r:.3f}")))
    check_times(log)
    assert [log.anchor_ids[k] for k in log.anchor_index] == [a for _, a, _ in ROWS]


def test_an_id_behind_the_word_for_an_anchor_names_it(tmp_path: Path) -> None:
    row = "{} -> Anchor 0x{} distance: {:.3f} m RSSI: -78.2 dBm"
    log = read_ranges(write(tmp_path, lines(None, lambda t, a, r: row.format(clock(t), NUM[a], r))))
    assert [log.anchor_ids[k] for k in log.anchor_index] == [f"0x{NUM[a]}" for _, a, _ in ROWS]
    np.testing.assert_allclose(log.range_m, [r for *_, r in ROWS], atol=6e-4)


@pytest.mark.parametrize("nothing", ["65535", "4294967.295", "9999"])
def test_a_value_far_above_all_others_that_comes_again_is_no_measurement(tmp_path: Path, nothing: str) -> None:
    log = read_ranges(write(tmp_path, PLAIN + f"15,A0,{nothing}\n16,A0,{nothing}\n17,A0,{nothing}\n"))
    assert (len(log), log.num_no_measurement) == (len(ROWS), 3)
    assert any("3 times, far above all other ranges: it is taken to mean no measurement" in note for note in log.notes)


def test_pairs_of_columns_without_names_among_others_are_asked_with_a_command_that_reads_them(tmp_path: Path) -> None:
    rows = [
        f"{12 + k / 10:.1f},6,1.5{k % 7},2.3{k % 5},1,{3 + k % 9 / 10},2,{4 + k % 7 / 10},3,{5 + k % 5 / 10}"
        for k in range(40)
    ]
    path = write(tmp_path, "\n".join(rows))
    with pytest.raises(InputError) as caught:
        read_ranges(path)
    columns = caught.value.advice[-1].partition("--columns ")[2].strip("'")
    log = read_ranges(path, columns=dict(pair.split("=") for pair in columns.split(",")))
    assert (len(log), log.anchor_ids) == (120, ("1", "2", "3"))


def test_two_tags_with_a_column_for_each_anchor(tmp_path: Path) -> None:
    header = "t," + ",".join(f"T{tag}_A{anchor}" for tag in range(2) for anchor in range(2))
    log = read_ranges(write(tmp_path, wide(header, lambda t: f"{t:.3f}")))
    assert (log.tag_ids, log.anchor_ids) == (("T0", "T1"), ("A0", "A1"))
    np.testing.assert_array_equal(log.tag_index[:4], [0, 0, 1, 1])


@pytest.mark.parametrize(("unit", "cell", "step"), [("cm", "{:.0f}", 100), ("mm", "{:.0f}", 1000)])
def test_whole_numbers_are_centimetres_where_they_can_be_nothing_else(
    tmp_path: Path, unit: str, cell: str, step: float
) -> None:
    far = 1.0 if unit == "cm" else 15.0
    content = lines("time,anchor,range", lambda t, a, r: f"{t:.3f},{a},{cell.format(r * step * far)}")
    log = read_ranges(write(tmp_path, content))
    np.testing.assert_allclose(log.range_m, [r * far for *_, r in ROWS], atol=0.6 / step)
    assert f"range looks like {unit}" in " ".join(log.notes)


def test_whole_numbers_that_may_be_cm_or_mm_are_asked(tmp_path: Path) -> None:
    path = write(tmp_path, lines("time,anchor,range", lambda t, a, r: f"{t:.3f},{a},{r * 1000:.0f}"))
    with pytest.raises(InputError, match="may be cm or mm; say which by --range_unit") as caught:
        read_ranges(path)
    assert caught.value.advice[1] == f"rangesfm ranges {path} --range_unit mm"
    np.testing.assert_allclose(read_ranges(path, range_unit="mm").range_m, [r for *_, r in ROWS], atol=6e-4)


def test_counter_of_milliseconds_is_noticed(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, lines("time,anchor,range", lambda t, a, r: f"{t * 1000:.0f},{a},{r:.3f}")))
    check_times(log)
    assert "time looks like ms" in " ".join(log.notes)


def test_time_that_may_be_seconds_or_milliseconds_is_asked(tmp_path: Path) -> None:
    rows = survey(step_s=0.003)
    path = write(tmp_path, lines("time,anchor,range", lambda t, a, r: f"{t * 1000:.0f},{a},{r:.3f}", rows))
    with pytest.raises(InputError, match="may be s or ms; say which by --timestamp_unit"):
        read_ranges(path)
    check_times(read_ranges(path, timestamp_unit="ms"), rows)


def test_times_of_day_go_on_after_midnight(tmp_path: Path) -> None:
    rows = survey(start_s=86395.0)
    log = read_ranges(write(tmp_path, lines("time,anchor,range", lambda t, a, r: f"{clock(t)},{a},{r:.3f}", rows)))
    check_times(log, rows)
    assert any("times of day without a date" in note for note in log.notes)


def test_zone_of_civil_times_counts_and_its_lack_is_said(tmp_path: Path) -> None:
    named = ((" CEST", 7200, False), (" EST", -18000, False), (" GMT", 0, False), (" UTC+2", 7200, False))
    for zone, seconds, said in (("+02:00", 7200, False), ("Z", 0, False), ("", 0, True), *named):
        row = "2026-01-31 {}" + zone + ",{},{:.3f}"
        content = lines("time,anchor,range", lambda t, a, r, row=row: row.format(clock(t + 36000), a, r))  # type: ignore[misc]
        log = read_ranges(write(tmp_path, content))
        assert log.timestamp_s[0] == pytest.approx(1769817600 + 36012 - seconds)
        assert ("civil times without a zone are read as UTC" in log.notes) is said


@pytest.mark.parametrize(
    ("header", "begin"),
    [
        ("timestamp_iso,timestamp_unix", "{civil},{unix:.3f}"),
        ("datetime,epoch_ms", "{civil},{ms:.0f}"),
        ("Date,Time,Timestamp_ns", "{civil},{ms:.0f}000000"),
        ("unix,local_time", "{unix:.3f},{civil}"),
    ],
)
def test_times_since_1970_are_taken_before_civil_times_without_a_zone(tmp_path: Path, header: str, begin: str) -> None:
    start_s = 1780931061.5

    def row(time: float, anchor_id: str, range_m: float) -> str:
        local = np.datetime64(round((start_s + time + 3 * 3600) * 1000), "ms")
        civil = str(local).replace("T", "," if "Date" in header else " ")
        return f"{begin.format(civil=civil, unix=start_s + time, ms=1000 * (start_s + time))},{anchor_id},{range_m:.3f}"

    log = read_ranges(write(tmp_path, lines(f"{header},anchor,range_m", row)))
    assert log.timestamp_s[0] == pytest.approx(start_s + ROWS[0][0], abs=2e-3)
    assert not any("zone" in note for note in log.notes)


@pytest.mark.parametrize("nothing", ["0", "-1", "", "nan", "None"])
def test_no_measurement_is_counted_whatever_stands_for_it(tmp_path: Path, nothing: str) -> None:
    content = wide("t,d0,d1,d2,d3", lambda t: f"{t:.3f}").split("\n")
    content[7] = ",".join([*content[7].split(",")[:2], nothing, nothing, "3.5"])
    log = read_ranges(write(tmp_path, "\n".join(content)))
    assert (len(log), log.num_no_measurement) == (len(ROWS) - 2, 2)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_encodings_line_endings_and_packed_files(tmp_path: Path, encoding: str) -> None:
    content = LONG["short names"].replace("\n", "\r\n").encode(encoding)
    for path in (write(tmp_path, content), write(tmp_path, gzip.compress(content), "uwb.csv.gz")):
        np.testing.assert_allclose(read_ranges(path).range_m, [r for *_, r in ROWS], atol=6e-4)


def test_antennas_of_a_tag_are_tags_of_their_own(tmp_path: Path) -> None:
    content = lines(
        "t,dist,antId,rspdrId,rqstrId", lambda t, a, r: f"{t:.3f},{r:.3f},{round(t * 20) // 4 % 2}.0,{NUM[a]}.0,9.0"
    )
    assert read_ranges(write(tmp_path, content)).tag_ids == ("9/0", "9/1")


# Several files


@pytest.mark.parametrize("has_column", [True, False])
def test_file_an_anchor_is_one_log(tmp_path: Path, has_column: bool) -> None:
    for anchor_id in ANCHORS:
        rows = [row for row in ROWS if row[1] == anchor_id]
        column = ",Address" if has_column else ""
        text = lines(f"Time,Range{column}", lambda t, a, r: f"{t:.3f},{r:.3f}{',' + a if has_column else ''}", rows)
        write(tmp_path, text, f"uwb_anchor_{anchor_id}.csv")
    write(tmp_path, "name,x,y\nhall,1,2\n", "notes.csv")
    files = sorted(tmp_path.glob("uwb*.csv"))
    for path in (tmp_path, tmp_path / "uwb_*.csv", files):
        log = read_ranges(path)
        check_times(log)
        assert [log.anchor_ids[k] for k in log.anchor_index] == [a for _, a, _ in ROWS]
        assert "4 files as one log" in log.notes


def test_folder_with_logs_of_several_formats_is_refused(tmp_path: Path) -> None:
    write(tmp_path, LONG["hobby"], "a.csv")
    write(tmp_path, "timestamp_s,anchor_id,range_m\n1,A0,2\n", "b.csv")
    with pytest.raises(InputError, match=r"logs of several formats: a.csv \(table\), b.csv \(canonical\)"):
        read_ranges(tmp_path)


# Unclear tables


def tags_side_by_side() -> str:
    """Eight columns without names: ranges of two tags to each of four anchors, which differ by centimetres."""
    rounds = [ROWS[k : k + 4] for k in range(0, len(ROWS), 4)]
    cells = [
        [f"{r + 0.12 * tag * (-1) ** k:.2f}" for k, (*_, r) in enumerate(one) for tag in range(2)] for one in rounds
    ]
    return "".join(f"2026-01-31 9:{k // 60:02d}:{k % 60:02d}.5,{','.join(row)}\n" for k, row in enumerate(cells))


QUESTIONS = {
    "wide without names": (wide(None, lambda t: f"{t:.3f}"), 1),
    "tags without names": (tags_side_by_side(), 2),
    "unknown names": (lines("when,who,what", lambda t, a, r: f"{t:.3f},{a},{r:.3f}"), 1),
    "letters": (wide("t,a0,a1,a2,a3", lambda t: f"{t:.3f}"), 1),
}


@pytest.mark.parametrize("kind", QUESTIONS)
def test_doubt_is_asked_in_five_lines_whose_last_is_a_command_that_reads_the_log(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    content, num_tags = QUESTIONS[kind]
    path = write(tmp_path, content, "my log.csv")
    assert main(["ranges", str(path)]) == 2
    said = capsys.readouterr().err.rstrip("\n").split("\n")
    assert len(said) == 5
    assert "found: " in said[1]
    assert "closest guess: timestamp = " in said[2]
    _, _, command = said[4].partition("if that is right: rangesfm ")
    assert main(shlex.split(command)) == 0
    assert f"ranges  {num_tags * len(ROWS)}," in capsys.readouterr().out


def test_column_that_is_missing_is_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path, lines("range,anchor", lambda t, a, r: f"{r:.3f},{a}"))
    with pytest.raises(InputError) as caught:
        read_ranges(path)
    assert "not sure: no column seems to be the timestamp" in caught.value.advice
    assert caught.value.advice[-1] == "no other column of numbers can be the timestamp, which a log needs"


def test_the_cell_that_keeps_a_column_from_being_numbers_is_shown(tmp_path: Path) -> None:
    path = write(tmp_path, lines("time;anchor;range", lambda t, a, r: f"{t:.3f};{a};{r:.3f}") + "30.1;A0;02. Mar\n")
    with pytest.raises(InputError, match="columns are not known") as caught:
        read_ranges(path)
    assert "range (text, '02. Mar')" in caught.value.advice[0]


def test_commands_name_the_columns_that_may_be_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, lines("count,range,anchor", lambda t, a, r: f"{-t:.3f},{r:.3f},{a}"))
    assert main(["ranges", str(path)]) == 2
    command = capsys.readouterr().err.rstrip("\n").split("perhaps: rangesfm ")[-1]
    assert main(shlex.split(command)) == 0
    assert f"ranges  {len(ROWS)}," in capsys.readouterr().out


# Records of JSON
def test_ranges_beside_a_position_are_found(tmp_path: Path) -> None:
    pose = '"position": {{"x": 1.5, "y": 2.25, "z": 0.5}}, "quat": [0.1, 0.2, 0.3, 0.9]'
    record = '{{"t": {:.3f}, "anc": "{}", "val": {:.3f}, ' + pose + "}}"
    with pytest.raises(InputError, match="not known for sure") as caught:
        read_ranges(write(tmp_path, lines(None, record.format)))
    assert "closest guess: timestamp = t, anchor_id = anc, range = val" in caught.value.advice
    only = lines(None, lambda t, a, r: f'{{"t": {t:.3f}, "position": {{"x": {r:.3f}, "y": {t / 3:.3f}, "z": 1.0}}}}')
    with pytest.raises(InputError, match="holds positions that the radio computed"):
        read_ranges(write(tmp_path, only))


@pytest.mark.parametrize("names", ["", "# timestamp tx ty tz qx qy qz qw\n"])
def test_a_trajectory_is_no_log(names: str, tmp_path: Path) -> None:
    rows = "".join(f"{1e9 + 0.1 * k:.3f} {k / 7:.3f} 1.5 {2 + k / 9:.3f} 0.5 0.5 0.5 0.5\n" for k in range(30))
    with pytest.raises(InputError, match=r"holds poses over time \(a trajectory\) and no ranges"):
        read_ranges(write(tmp_path, names + rows))


def test_ranges_within_a_record_by_anchor_are_read(tmp_path: Path) -> None:
    def record(rows: list[Row]) -> str:
        by_anchor = ", ".join(
            f'"0{NUM[a]}9E": {{"anc_id": "0{NUM[a]}9E", "x": 1.0, "y": 2.0, "dist_to": {r:.3f}}}' for _, a, r in rows
        )
        return f'{{"ts": {rows[0][0]:.3f}, {by_anchor}, "est_pos": {{"x": 1.0, "y": 2.0}}}}'

    content = "\n".join(record(ROWS[k : k + 4]) for k in range(0, len(ROWS), 4)) + "\n"
    for written in (content, content.replace('"', "'")):  # as JSON, and as Python prints it
        log = read_ranges(write(tmp_path, written))
        assert len(log) == len(ROWS)
        assert len(log.anchor_ids) == len(ANCHORS)


@pytest.mark.parametrize("prompt", [False, True])
def test_json_of_uwb_core_is_read_behind_other_lines_of_the_board(tmp_path: Path, prompt: bool) -> None:
    content = lines(
        "main(): started\n> range start" if prompt else None,
        lambda t, a, r: (
            f'{{"utime": {t * 1e6:.0f},"c": {t * 20:.0f},"uid": 6699,"ouid": {4660 + int(NUM[a])},'
            f'"raz": [{r:.6f},0.5,-0.25],"los": [{0.5 * (t % 2 > 1):.6f}]}}'
        ),
    )
    if prompt:
        content = content.replace('\n{"utime"', '\n> {"utime"', 1)
    log = read_ranges(write(tmp_path, content))
    assert log.tag_ids == ("6699",)
    assert log.anchor_ids == ("4660", "4661", "4662", "4663")
    np.testing.assert_allclose(log.range_m, [r for *_, r in ROWS], atol=1e-5)
    check_times(log, ROWS)


def test_time_in_front_of_json_is_the_time(tmp_path: Path) -> None:
    for begin in ("{:.3f} ", "[{:.3f}] ", "{:.3f},"):
        record = begin + '{{"anchor": "{}", "range": {:.3f}}}'
        check_times(read_ranges(write(tmp_path, lines(None, record.format))), ROWS)


def test_an_id_that_never_changes_is_not_the_anchors(tmp_path: Path) -> None:
    path = write(tmp_path, lines("time,id,peerid,range", lambda t, a, r: f"{t:.3f},7,{int(NUM[a]) + 20},{r:.3f}"))
    with pytest.raises(InputError, match="not known for sure") as caught:
        read_ranges(path)
    assert any("anchor_id = peerid, tag_id = id" in line for line in caught.value.advice)


def test_columns_are_told_by_number_and_in_spans(tmp_path: Path) -> None:
    path = write(tmp_path, tags_side_by_side())
    log = read_ranges(path, columns={"timestamp": "1", "range:0-3:T0-T1": "2-9"})
    assert (log.anchor_ids, log.tag_ids, len(log)) == (("0", "1", "2", "3"), ("T0", "T1"), 2 * len(ROWS))
    with pytest.raises(InputError, match="range:0-3:T0-T1 names 7 columns, expected 4 x 2"):
        read_ranges(path, columns={"timestamp": "1", "range:0-3:T0-T1": "2-8"})


# libRSF and PyFactorGraph


def test_librsf_text_is_read(tmp_path: Path) -> None:
    place = ANCHORS["A1"]
    text = lines(None, lambda t, a, r: f"range3 {t:.15f} {r:.14f} 0.04 {' '.join(map(str, ANCHORS[a]))} {NUM[a]} 0 ")
    log = read_ranges(write(tmp_path, text + "odom2 1.0 0.1 0 0 0 0 0 0 0 0 0\n", "input.txt"))
    check_times(log)
    assert (log.format, log.anchor_ids, len(log)) == ("librsf", ("0", "1", "2", "3"), len(ROWS))
    np.testing.assert_allclose(log.range_stddev_m, 0.2)
    anchors = {anchor.anchor_id: anchor.position_m for anchor in read_anchors_in_log(tmp_path / "input.txt")}
    assert tuple(anchors["1"] if anchors["1"] is not None else ()) == pytest.approx(place)


def test_factor_graph_is_read_as_ranges_of_robots(tmp_path: Path) -> None:
    poses = "".join(f"VERTEX_SE2 {t:.6f} A{k} 0.0 0.0 0.1\n" for k, (t, *_) in enumerate(ROWS))
    text = lines(None, lambda t, a, r: f"EDGE_RANGE {t:.11f} A7 L{NUM[a]} {r:.14f} 0.09")
    log = read_ranges(write(tmp_path, f"{poses}VERTEX_XY L0 1.5 2.5\n{text}", "graph.pyfg"))
    check_times(log)
    assert (log.format, log.tag_ids, log.anchor_ids) == ("pyfg", ("A",), ("L0", "L1", "L2", "L3"))
    np.testing.assert_allclose(log.range_stddev_m, 0.3)


# Any bytes

cells = st.one_of(
    st.text("0123456789.,-+eEna:_\"'; #\t\x00\u0663", max_size=8),
    st.floats().map(repr),
    st.sampled_from(["", "1", "a", "9:00:01"]),
)
HEADERS = (
    "t,anchor,range",
    "%time,field.id,d",
    "t,d1,d2",
    "",
    "when,who,what",
    "date,time,nsecs,range",
    "b1d,b2d,t",
    "a0,a1,a2",
)


@settings(max_examples=150)
@given(header=st.sampled_from(HEADERS), rows=st.lists(st.lists(cells, min_size=2, max_size=4), max_size=6))
def test_any_cells_of_any_table_are_a_log_or_an_input_error(tmp_path: Path, header: str, rows: list[list[str]]) -> None:
    path = write(tmp_path, (header + "\n" + "\n".join(",".join(row) for row in rows)).encode())
    with contextlib.suppress(InputError):
        assert len(read_ranges(path)) > 0


def test_paths_that_are_no_files_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path in ("/proc/kmsg", "/dev/zero", "a\0b", str(tmp_path / "loop")):
        assert main(["ranges", path]) == 2
        assert capsys.readouterr().err.count("\n") == 1
