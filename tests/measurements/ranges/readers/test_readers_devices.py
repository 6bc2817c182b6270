"""The output of radios is read as they print it; of damaged lines, the intact parts are used."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.refused import refused

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.range_summary import summarize_ranges
from rangesfm.measurements.ranges.readers import read_anchors_in_log, read_ranges, reader_names

LEC = (
    "DIST,4,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,0.00,5.68,AN2,DCAE,0.00,8.03,0.00,7.76,"
    "AN3,5431,0.00,0.00,0.00,8.73,POS,6.95,5.37,-1.97,52"
)
LEC_DAMAGED = (
    "DIST,4,AN0,2F2F,3.05,2.68,0.00,2.20,AN1,2ED0,3.02,0.00,0.00,2.23,AN2,0487,0.00,0.00,0.00,0.18,"
    "AN3,15BA,0.00,0,AN3,15BA,0.00,0.00,0.00,0.00"
)
LES = (
    "022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49 DCAE[0.00,8.03,0.00]=7.73 5431[0.00,0.00,0.00]=9.01 "
    "le_us=3082 est[6.97,5.17,-1.77,53]"
)
MEAS = "POS,4.07,-2.85,0.59,74,MEAS,2,AN0,8EAA,5.14,-2.16,0.00,100,1.41,AN1,5886,0.10,-2.00,0.00,87,2.07"
LEA = (
    "POS[4.11,-2.97,-0.49,81] 8EAA[5.14,-2.16,0.00,100]=1.41 loc_az_pdoa:0.00 cfo_ppm:0.00 "
    "5886[0.10,-2.00,0.00,100]=2.07"
)
ARDUINO = "from: D325\t Range: 29.40 m\t RX power: -84.57 dBm"
LINKS = '{"links":[{"A":"1782","R":"1.2"},{"A":"1783","R":"2.0"}]}'
MAUWB = "AT+RANGE=tid:0,mask:03,seq:182,range:(232,401,0,0),rssi:(-79.80,-81.10,0,0),ancid:(0,1,-1,-1)"
QORVO = (
    "SESSION_INFO_NTF: {session_handle=1, sequence_number=163, block_index=163, n_measurements=2\n"
    ' [mac_address=0x0001, status="SUCCESS", distance[cm]=152]\n'
    ' [mac_address=0x0002, status="RX_TIMEOUT"]}\n'
)
QORVO_ANGLES = (
    "SESSION_INFO_NTF: {session_handle=1, sequence_number=166, block_index=166, n_measurements=1\n"
    ' [mac_address=0x0001, status="SUCCESS", distance[cm]=91, loc_az_pdoa=65.35, loc_az=24.90, RSSI[dBm]=-66.5]}\n'
)
QORVO_JSON = (
    '{"Block":7, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":61,"LPDoA_deg":0.00,"LFoM":0,"CFO_100ppm":-639},'
    '{"Addr":"0x0002","Status":"Err","D_cm":0}]}\n'
)
ALL = (LEC, LEC_DAMAGED, LES, MEAS, LEA, ARDUINO, LINKS, MAUWB, QORVO, QORVO_JSON)


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "uwb.log"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


refusal = partial(refused, read_ranges)


def ranges_by_anchor(log: RangeLog) -> dict[str, list[float]]:
    return {name: log.range_m[log.anchor_index == k].tolist() for k, name in enumerate(log.anchor_ids)}


@pytest.mark.parametrize(
    ("line", "format", "ranges"),
    [
        (LEC, "dwm1001_lec", {"022E": [3.44], "9280": [5.68], "DCAE": [7.76], "5431": [8.73]}),
        (LES, "dwm1001_les", {"022E": [3.38], "9280": [5.49], "DCAE": [7.73], "5431": [9.01]}),
        (MEAS, "leaps_meas", {"8EAA": [1.41], "5886": [2.07]}),
        (LEA, "leaps_lea", {"8EAA": [1.41], "5886": [2.07]}),
        (ARDUINO, "arduino", {"D325": [29.4]}),
        (LINKS, "makerfabs_json", {"1782": [1.2], "1783": [2.0]}),
        (MAUWB, "mauwb", {"0": [2.32], "1": [4.01]}),
        (QORVO_ANGLES, "qorvo", {"0x0001": [0.91]}),
    ],
)
def test_lines_with_the_hosts_time_are_recognised_and_read(
    tmp_path: Path, line: str, format: str, ranges: dict[str, list[float]]
) -> None:
    log = read_ranges(write(tmp_path, f"shell ready\n1615984968.807 {line}\n"))
    assert log.format == format
    assert ranges_by_anchor(log) == ranges
    np.testing.assert_array_equal(log.timestamp_s, [1615984968.807] * len(log))
    np.testing.assert_array_equal(log.line, [2] * len(log))


def test_line_without_a_fix_has_ranges_all_the_same(tmp_path: Path) -> None:
    line = "DIST,3,AN0,2F2F,3.05,2.68,0.00,2.20,AN1,2ED0,3.02,0.00,0.00,2.23,AN2,0487,0.00,0.00,0.00,3.18"
    log = read_ranges(write(tmp_path, f"1.5 {line}\n"))
    assert ranges_by_anchor(log) == {"2F2F": [2.2], "2ED0": [2.23], "0487": [3.18]}


def test_name_of_the_command_before_a_line_is_no_time_and_no_hindrance(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1.5 les : {LES}\n2.5 les : {LES}\n"))
    np.testing.assert_array_equal(log.timestamp_s, [1.5] * 4 + [2.5] * 4)


def test_lines_that_come_twice_are_kept_and_counted(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1.5 {LEC}\n1.5 {LEC}\n"))
    assert summarize_ranges(log).num_duplicates == 4


def test_tenths_of_a_metre_are_noticed(tmp_path: Path) -> None:
    lines = [f'{k} {{"links":[{{"A":"1782","R":"{1 + (k % 7) / 10:.1f}"}}]}}' for k in range(30)]
    log = read_ranges(write(tmp_path, "\n".join(lines)))
    assert summarize_ranges(log).quantization_m == 0.1


@pytest.mark.parametrize(
    "prefix",
    [
        "1645870039.5 ",
        "1645870039500,",
        "[1645870039500000] ",
        "t=1645870039500000000: ",
        "2022-02-26T10:07:19.500Z ",
        "[2022-02-26 12:07:19,500+02:00] INFO ",
        "tag 2022-02-26 10:07:19.5 - ",
    ],
)
def test_hosts_time_in_any_spelling(tmp_path: Path, prefix: str) -> None:
    log = read_ranges(write(tmp_path, f"{prefix}{ARDUINO}\n"))
    np.testing.assert_allclose(log.timestamp_s, [1645870039.5], rtol=1e-15)


def test_unit_of_the_hosts_time_can_be_given(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1500 {ARDUINO}\n"), timestamp_unit="ms")
    np.testing.assert_allclose(log.timestamp_s, [1.5])


def test_time_of_day_goes_on_after_midnight(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"23:59:59.5 -> {ARDUINO}\n00:00:00.5 -> {ARDUINO}\n"))
    np.testing.assert_allclose(log.timestamp_s, [86399.5, 86400.5])


@pytest.mark.parametrize("line", [LEC, LES, MEAS, LEA, ARDUINO, LINKS, MAUWB])
def test_line_without_the_hosts_time_is_refused_saying_what_is_needed(tmp_path: Path, line: str) -> None:
    error = refusal(write(tmp_path, f"1.5 {line}\n{line}\n"))
    assert error.line == 2
    assert "record the log with the host's time" in str(error)


def test_damaged_line_keeps_its_whole_ranges_and_counts_the_others(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1.5 {LEC_DAMAGED}\n"))
    assert ranges_by_anchor(log) == {"2F2F": [2.2], "2ED0": [2.23], "0487": [0.18]}
    assert log.num_no_measurement == 2  # one was cut off, one is 0.00


def test_number_that_was_cut_off_is_no_range(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "1 DIST,2,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,0.00,5.6\n"))
    assert ranges_by_anchor(log) == {"022E": [3.44]}
    assert log.num_no_measurement == 1


def test_bytes_that_are_no_text_damage_only_what_they_stand_in(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, b"1 " + LEC.encode().replace(b"9280", b"92\xff0") + b"\n"))
    assert "9280" not in log.anchor_ids
    assert len(log) == 3


def test_anchors_are_offered_from_the_lines_at_their_median(tmp_path: Path) -> None:
    path = write(tmp_path, f"1 {LEC}\n2 {LEC}\n3 {LEC.replace('022E,7.94', '022E,9.94')}\n")
    anchors = {anchor.anchor_id: anchor.position_m for anchor in read_anchors_in_log(path)}
    np.testing.assert_allclose(anchors["022E"], [7.94, 8.03, 0])  # type: ignore[arg-type]
    assert set(anchors) == {"022E", "9280", "DCAE", "5431"}


@pytest.mark.parametrize("line", [LES, MEAS, LEA])
def test_anchors_are_offered_by_every_format_that_tells_them(tmp_path: Path, line: str) -> None:
    anchors = read_anchors_in_log(write(tmp_path, f"1 {line}\n"))
    assert all(anchor.position_m is not None for anchor in anchors)
    assert len(anchors) == len(read_ranges(write(tmp_path, f"1 {line}\n")).anchor_ids)


def test_anchors_that_nobody_set_up_are_unknown(tmp_path: Path) -> None:
    line = "1 022E[0.00,0.00,0.00]=3.38 9280[0.00,0.00,0.00]=5.49\n"
    assert [anchor.position_m for anchor in read_anchors_in_log(write(tmp_path, line))] == [None, None]


def test_formats_without_positions_offer_no_anchors(tmp_path: Path) -> None:
    assert read_anchors_in_log(write(tmp_path, f"1 {MAUWB}\n")) == ()


def test_negative_range_of_an_arduino_is_no_measurement(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1 {ARDUINO.replace('29.40', '-0.21')}\n2 {ARDUINO}\n"))
    assert (len(log), log.num_no_measurement) == (1, 1)


# MaUWB


def test_mauwb_without_anchor_ids_has_them_by_slot_and_mask(tmp_path: Path) -> None:
    line = "AT+RANGE=tid:4,mask:05,seq:218,range:(3,77,412,0,0,0,0,0),rssi:(-79.31,0,0,0,0,0,0,0)"
    log = read_ranges(write(tmp_path, f"1 {line}\n"))
    assert ranges_by_anchor(log) == {"0": [0.03], "2": [4.12]}
    assert log.tag_ids == ("4",)


def test_mauwb_of_old_firmware_without_rssi(tmp_path: Path) -> None:
    line = "AT+RANGE=tid:0,mask:01,seq:65,range:(92,0,0,0,0,0,0,0),ancid:(0,-1,-1,-1,-1,-1,-1,-1)"
    assert ranges_by_anchor(read_ranges(write(tmp_path, f"1 {line}\n"))) == {"0": [0.92]}


def test_mauwb_ranges_whose_anchor_ids_are_lost_are_not_given_to_any(tmp_path: Path) -> None:
    cut = MAUWB[: MAUWB.index("ancid:") + len("ancid:(0,1")]
    log = read_ranges(write(tmp_path, f"1 {MAUWB}\n2 {cut}\n"))
    assert len(log) == 2
    assert log.num_no_measurement == 4


def test_mauwb_with_blanks_is_read(tmp_path: Path) -> None:
    for line in (
        "AT+RANGE=tid:0, mask:03, seq: 182, range: (232,401,0,0), rssi: (-79.80,-81.10,0,0), ancid: (0,1,-1,-1)",
        "AT+RANGE= tid: 0 ,mask: 03,seq:182,range: ( 232, 401, 0, 0),rssi:(-79.80,-81.10,0,0)",
    ):
        assert ranges_by_anchor(read_ranges(write(tmp_path, f"1 {line}\n"))) == {"0": [2.32], "1": [4.01]}


@pytest.mark.parametrize(("first", "per_s", "bits"), [(12345, 1000, 32), (2**32 - 2 * 10**6, 10**6, 32)])
def test_counts_of_the_board_in_front_of_lines_are_times(tmp_path: Path, first: int, per_s: int, bits: int) -> None:
    times = [(first + k * per_s // 10) % 2**bits for k in range(60)]
    log = read_ranges(write(tmp_path, "".join(f"{time} {ARDUINO}\n" for time in times)))
    np.testing.assert_allclose(log.timestamp_s - log.timestamp_s[0], 0.1 * np.arange(60), atol=1e-6)


def test_lines_that_are_not_understood_are_not_said_to_be_no_measurements(tmp_path: Path) -> None:
    path = write(tmp_path, "1 AT+RANGE=tid:0;mask:03;range:(232;401)\n" * 5)
    with pytest.raises(InputError, match=r"begins as a line of mauwb, and is not understood: .* expected such as AT"):
        read_ranges(path)


def test_several_tags_are_kept_apart(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1 {MAUWB}\n2 {MAUWB.replace('tid:0', 'tid:7')}\n"))
    assert log.tag_ids == ("0", "7")


# TREK1000
TREK_MR = "mr 07 00000407 0000082b 000007a3 00000000 6cba 09 40414041 a0:0"
TREK_MA = "ma 0e 00000000 000006d9 0000069c 0000026b 6cbd 51 00a0641e a0:0"
TREK_MC = "mc 07 000004ec 000008ee 0000087e 00000000 6cc0 0a 00a0642b a0:0"


def test_trek1000_lines_are_read_with_the_radios_clock(tmp_path: Path) -> None:
    later = TREK_MC.replace("642b", "648f").replace("0000087e", "ffffffff")
    log = read_ranges(write(tmp_path, "\n".join([TREK_MR, TREK_MA, TREK_MC, "mc 07 0000", later]) + "\n"))
    assert (log.format, log.tag_ids, log.anchor_ids) == ("trek1000", ("T0",), ("A0", "A1", "A2"))
    between = log.subset(log.kind == RangeKind.ANCHOR_ANCHOR)
    assert [*zip(*between.end_ids(), between.range_m)] == [
        ("A0", "A1", 1.753),
        ("A0", "A2", 1.692),
        ("A1", "A2", 0.619),
    ]
    of_tag = log.subset(log.kind == RangeKind.TAG_ANCHOR)
    assert of_tag.range_m.tolist() == [1.26, 2.286, 2.174, 1.26, 2.286]
    assert np.ptp(log.timestamp_s) == pytest.approx(0.113)
    assert log.num_no_measurement == 1


def test_trek1000_lines_with_eight_anchors_decimal_clock_and_no_mask(tmp_path: Path) -> None:
    line = "mc 00 00000807 00000991 ffffffff 00000815 00000000 0000095e ffffffff ffffffff 00b6 b7 000213{} t1:0 0000"
    path = write(tmp_path, "".join(line.format(32 + 10 * k) + "\r\n$NKT0,2.06,LO=[no solution]\r\n" for k in range(5)))
    log = read_ranges(path)
    assert (log.tag_ids, log.anchor_ids) == (("T1",), ("A0", "A1", "A3", "A5"))
    np.testing.assert_allclose(np.unique(log.timestamp_s), 21.332 + 0.01 * np.arange(5))


def test_trek1000_lines_are_read_with_the_hosts_time_and_inside_json(tmp_path: Path) -> None:
    lines = "".join(f"2026-01-31 12:00:0{k}.5 {TREK_MC}\n" for k in range(3))
    log = read_ranges(write(tmp_path, lines))
    assert log.timestamp_s[-1] == 1769860802.5
    messages = [TREK_MC.replace("642b", f"64{k}b") for k in range(3)]
    records = ", ".join(f'{{"message": "{message}\\r\\n", "position": [0.25, 0.5]}}' for message in messages)
    assert len(read_ranges(write(tmp_path, f"[{records}]"))) == 9
    with pytest.raises(InputError, match="no time before the range"):
        read_ranges(write(tmp_path, TREK_MR + "\n"))


# Qorvo


def test_qorvo_failed_measurements_are_counted(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, f"1.5 {QORVO}"))
    assert ranges_by_anchor(log) == {"0x0001": [1.52]}
    assert log.num_no_measurement == 1


def test_qorvo_without_the_hosts_time_counts_ranging_intervals(tmp_path: Path) -> None:
    path = write(tmp_path, QORVO + QORVO_ANGLES)
    np.testing.assert_allclose(read_ranges(path).timestamp_s, [163 * 0.2, 166 * 0.2])
    log = read_ranges(path, ranging_interval_s=0.1)
    np.testing.assert_allclose(log.timestamp_s, [16.3, 16.6])
    np.testing.assert_array_equal(log.line, [1, 4])


def test_qorvo_count_that_goes_back_is_refused_with_its_line(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, QORVO_ANGLES + QORVO))
    assert error.line == 3
    assert "restarted" in str(error)


def test_qorvo_json_is_read(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, QORVO_JSON))
    assert ranges_by_anchor(log) == {"0x0001": [0.61]}
    np.testing.assert_allclose(log.timestamp_s, [1.4])
    assert log.num_no_measurement == 1


def test_qorvo_record_that_was_cut_off_keeps_its_whole_measurements(tmp_path: Path) -> None:
    cut = QORVO_ANGLES[: QORVO_ANGLES.index("=91") + 2] + "\n"
    log = read_ranges(write(tmp_path, QORVO + cut + QORVO_ANGLES.replace("166", "168")))
    np.testing.assert_array_equal(log.range_m, [1.52, 0.91])
    assert log.num_no_measurement == 2


@pytest.mark.parametrize("interval", [0.0, -1.0, np.nan, np.inf])
def test_ranging_interval_is_positive(tmp_path: Path, interval: float) -> None:
    assert "ranging_interval_s" in str(refusal(write(tmp_path, QORVO), ranging_interval_s=interval))


# Logs that cannot give ranges


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 POS,7.10,5.24,-2.03,53", "positions"),
        ("POS,0,022E,7.10,5.24,-2.03,53,x1", "positions"),
        (
            '[{"version":"2.0","tagId":"30331","timestamp":1615984968.8,"data":{"tagData":{"blinkIndex":127},'
            '"anchorData":[{"tagId":"30331","anchorId":"28205","rss":-82.12}]}}]',
            "positions",
        ),
        ("timestamp,idA,idB,data\n0,1,2,0.5", "TDoA"),
        ("time tdoa_01 tdoa_12\n0 1 2", "TDoA"),
    ],
)
def test_logs_that_cannot_give_ranges_are_refused_with_the_reason(tmp_path: Path, line: str, reason: str) -> None:
    assert reason in str(refusal(write(tmp_path, f"{line}\n")))


def test_format_of_its_own_takes_no_columns(tmp_path: Path) -> None:
    assert "format is not a table" in str(refusal(write(tmp_path, f"1 {LEC}\n"), range_unit="mm"))
    assert "timestamp_unit is 'y'" in str(refusal(write(tmp_path, f"1 {LEC}\n"), timestamp_unit="y"))


def test_format_can_be_given_against_what_the_content_looks_like(tmp_path: Path) -> None:
    path = write(tmp_path, f"1 {LES}\n2 {LEC}\n")
    assert read_ranges(path, format="dwm1001_les").range_m.tolist() == [3.38, 5.49, 7.73, 9.01]
    assert read_ranges(path, format="dwm1001_lec").range_m.tolist() == [3.44, 5.68, 7.76, 8.73]


# Any bytes

prefixes = st.one_of(
    st.text("0123456789.:-T Z,[]+", max_size=24), st.floats(0, 2e9).map(lambda t: f"{t} "), st.just("1.5 ")
)


@settings(max_examples=300)
@given(data=st.data())
def test_damaged_logs_are_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    lines = data.draw(st.lists(st.tuples(prefixes, st.sampled_from(ALL)).map("".join), min_size=1, max_size=3))
    content = bytearray("\n".join(lines).encode())
    for position, byte in data.draw(st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)))):
        content[position] = byte
    format = data.draw(st.sampled_from([None, *reader_names()]))
    path = write(tmp_path, bytes(content))
    with contextlib.suppress(InputError):
        assert len(read_ranges(path, format=format)) > 0
    with contextlib.suppress(InputError):
        read_anchors_in_log(path, format=format or "")
