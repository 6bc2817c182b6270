"""Radio logs of all formats become the same range log, or are refused with the number of the wrong line."""

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
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import read_ranges, reader_names, write_ranges_csv
from rangesfm.measurements.ranges.readers.measured import REACH_M
from rangesfm.util.geometry.moments import ByPhoto

any_bytes_in_one_folder = settings(max_examples=150)


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "uwb.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


refusal = partial(refused, read_ranges)


def anchors_of(log: RangeLog) -> list[str]:
    return [log.anchor_ids[index] for index in log.anchor_index]


# The canonical CSV


def test_canonical_log_is_recognised_and_read(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "timestamp_s,anchor_id,range_m\n0.5, 7 ,2.83\n0.25,A1,1.5\n0.75,7,3\n"))
    assert log.format == "canonical"
    assert log.anchor_ids == ("7", "A1")
    assert anchors_of(log) == ["7", "A1", "7"]
    np.testing.assert_array_equal(log.timestamp_s, [0.5, 0.25, 0.75])
    np.testing.assert_array_equal(log.range_m, [2.83, 1.5, 3])
    assert np.all(np.isnan(log.range_stddev_m))
    assert np.all(log.los == -1)


def test_optional_columns_are_read(tmp_path: Path) -> None:
    log = read_ranges(
        write(
            tmp_path, "timestamp_s,anchor_id,range_m,tag_id,range_stddev_m,los\n0,a,1,t1,0.1,1\n1,a,2,t2,,0\n2,a,3,,,\n"
        )
    )
    assert [log.tag_ids[index] for index in log.tag_index] == ["t1", "t2", "tag"]
    np.testing.assert_array_equal(log.range_stddev_m, [0.1, np.nan, np.nan])
    np.testing.assert_array_equal(log.los, [1, 0, -1])


def test_image_names_may_take_the_place_of_times(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "image_name,anchor_id,range_m\nx/1.jpg,a,1\nx/2.jpg,a,0\nx/3.jpg,a,2\n"))
    assert log.moments == ByPhoto(("x/1.jpg", "x/3.jpg"))


def test_range_of_zero_is_counted_as_no_measurement_and_left_out(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "timestamp_s,anchor_id,range_m\n0,a,0\n1,b,2\n2,c,0.0\n"))
    assert log.num_no_measurement == 2
    assert log.anchor_ids == ("b",)
    np.testing.assert_array_equal(log.line, [3])


@pytest.mark.parametrize("cell", ["nan", "NaN", "inf", "-inf", "", "None"])
def test_a_word_for_no_number_is_counted_as_no_measurement(tmp_path: Path, cell: str) -> None:
    log = read_ranges(write(tmp_path, f"timestamp_s,anchor_id,range_m\n0,a,1\n1,a,{cell}\n2,a,2\n"))
    assert (log.range_m.tolist(), log.num_no_measurement) == ([1.0, 2.0], 1)


def test_range_that_cannot_be_is_refused_with_its_line(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, "timestamp_s,anchor_id,range_m\n0,a,1\n# pause\n1,a,x\n"))
    assert error.line == 4
    assert "expected a positive number of metres; 0 means no measurement" in str(error)


def test_negative_ranges_are_no_measurement_as_zeros_are(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "timestamp_s,anchor_id,range_m\n0,a,-1.2\n1,a,0\n2,a,1.2\n"))
    assert (len(log), log.num_no_measurement) == (1, 2)


@pytest.mark.parametrize(("cell", "unit"), [("1717961938397366000", "ns"), ("1717961938397366", "us")])
def test_times_that_cannot_be_seconds_are_noticed_under_any_name(tmp_path: Path, cell: str, unit: str) -> None:
    log = read_ranges(write(tmp_path, f"timestamp_s,anchor_id,range_m\n{cell},a,1\n"))
    np.testing.assert_allclose(log.timestamp_s, [1717961938.397366], atol=1e-6)
    assert log.notes == (f"timestamp_s has as many digits as {unit} since 1970: taken as {unit}",)


@pytest.mark.parametrize("cell", ["nan", "inf", "now", ""])
def test_time_that_cannot_be_is_refused_with_its_line(tmp_path: Path, cell: str) -> None:
    error = refusal(write(tmp_path, f"timestamp_s,anchor_id,range_m\n0,a,1\n{cell},a,1\n"))
    assert error.line == 3
    assert "timestamp_s" in str(error)


@pytest.mark.parametrize(("row", "column"), [("0,,1,0.1,1", "anchor_id"), ("0,a,1,0,1", "stddev"), ("0,a,1,,2", "los")])
def test_other_cells_that_cannot_be_are_refused(tmp_path: Path, row: str, column: str) -> None:
    error = refusal(write(tmp_path, f"timestamp_s,anchor_id,range_m,range_stddev_m,los\n0,a,1,,\n{row}\n"))
    assert error.line == 3
    assert column in str(error)


@pytest.mark.parametrize("rows", ["", "0,a,0\n1,a,0\n"])
def test_log_without_any_usable_range_is_refused(tmp_path: Path, rows: str) -> None:
    assert "no usable range" in str(refusal(write(tmp_path, "timestamp_s,anchor_id,range_m\n" + rows)))


def test_missing_and_empty_logs_are_refused(tmp_path: Path) -> None:
    assert "no such file" in str(refusal(tmp_path / "none.csv"))
    assert "empty" in str(refusal(write(tmp_path, "")))
    (tmp_path / "empty").mkdir()
    assert "no file there" in str(refusal(tmp_path / "empty"))
    assert "no file there" in str(refusal(tmp_path / "none*.csv"))


def test_missing_column_names_the_found_ones(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, "timestamp_s,anchor_id,range\n0,a,1\n"), format="canonical")
    assert "no column range_m; found timestamp_s, anchor_id, range" in str(error)


def test_stddev_is_not_less_than_that_of_rounding(tmp_path: Path) -> None:
    rows = "".join(f"{k},a,{k / 100 + 1:.2f},{stddev}\n" for k, stddev in enumerate([0.001, 0.2, ""] * 10))
    log = read_ranges(write(tmp_path, "timestamp_s,anchor_id,range_m,range_stddev_m\n" + rows))
    np.testing.assert_allclose(log.range_stddev_m[:3], [0.01 / np.sqrt(12), 0.2, np.nan])


def test_written_log_reads_the_same(tmp_path: Path) -> None:
    log = RangeLog.from_arrays(
        ["a,1", "b", "a,1"],
        [1 / 3, 2.5, 1e-3],
        timestamp_s=[1700000000.123456, 0.1, -2],
        range_stddev_m=[0.1, np.nan, 0.2],
        tag_id=["x", "y", "x"],
        los=[1, 0, -1],
    )
    write_ranges_csv(log, tmp_path / "out.csv")
    again = read_ranges(tmp_path / "out.csv")
    assert anchors_of(again) == anchors_of(log)
    assert again.tag_ids == log.tag_ids
    for name in ("range_m", "timestamp_s", "range_stddev_m", "tag_index", "los"):
        np.testing.assert_array_equal(getattr(again, name), getattr(log, name))


def test_written_log_has_no_column_that_says_nothing(tmp_path: Path) -> None:
    write_ranges_csv(RangeLog.from_arrays(["a"], [1.5], image_name=["1.jpg"]), tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text() == "image_name,anchor_id,range_m\n1.jpg,a,1.5\n"


def test_log_cannot_be_written_where_there_is_no_folder(tmp_path: Path) -> None:
    log = RangeLog.from_arrays(["a"], [1.0], timestamp_s=[0.0])
    with pytest.raises(InputError, match="cannot be written"):
        write_ranges_csv(log, tmp_path / "none" / "out.csv")


# Mapped columns

MAPPING = {"timestamp": "t", "anchor_id": "node", "range": "d"}


@pytest.mark.parametrize(
    ("unit", "cell", "seconds"),
    [
        ("s", "12.5", 12.5),
        ("ms", "12500", 12.5),
        ("us", "12500000", 12.5),
        ("ns", "12500000000", 12.5),
        ("iso", "1970-01-01T00:00:12.5Z", 12.5),
        ("iso", "1970-01-01 02:00:12.500+02:00", 12.5),
        ("iso", "1969-12-31T19:00:12.5-0500", 12.5),
        ("iso", "2026-01-31T12:00:00", 1769860800.0),
    ],
)
def test_time_units(tmp_path: Path, unit: str, cell: str, seconds: float) -> None:
    log = read_ranges(write(tmp_path, f"t,node,d\n{cell},7,3\n"), columns=MAPPING, timestamp_unit=unit)
    np.testing.assert_allclose(log.timestamp_s, [seconds], rtol=1e-12)
    assert log.format == "mapped"


@pytest.mark.parametrize(("unit", "metres"), [("m", 232.0), ("cm", 2.32), ("mm", 0.232)])
def test_range_units(tmp_path: Path, unit: str, metres: float) -> None:
    columns = {**MAPPING, "range_stddev": "e"}
    log = read_ranges(write(tmp_path, "t,node,d,e\n0,7,232,10\n"), columns=columns, range_unit=unit)
    np.testing.assert_allclose(log.range_m, [metres])
    np.testing.assert_allclose(log.range_stddev_m, [metres * 10 / 232])


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", "|"])
def test_separators(tmp_path: Path, separator: str) -> None:
    content = f"t,node,d\n{0.5},7,3\n".replace(",", separator)
    given = "" if separator in ",;\t " else separator
    log = read_ranges(write(tmp_path, content), columns=MAPPING, separator=given)
    np.testing.assert_array_equal(log.range_m, [3])


def test_mapped_log_may_have_negative_and_empty_ranges_as_no_measurement(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "t,node,d\n0,7,-0.4\n1,7,\n2,7,0\n3,7,1.5\n"), columns=MAPPING)
    assert log.num_no_measurement == 3
    np.testing.assert_array_equal(log.range_m, [1.5])


def test_time_that_is_not_iso_is_refused_with_its_line(tmp_path: Path) -> None:
    path = write(tmp_path, "t,node,d\n2026-01-31T12:00:00Z,7,3\n2026-13-31T12:00:00Z,7,3\n")
    error = refusal(path, columns=MAPPING, timestamp_unit="iso")
    assert error.line == 3


def test_starloc_log_is_recognised_and_its_sides_told_apart_by_role(tmp_path: Path) -> None:
    head = "time_s,range,from_id,to_id\n"
    log = read_ranges(write(tmp_path, head + "0.1,1.86,1,5\n0.2,2.5,1,6\n"))
    assert (log.format, log.tag_ids, log.anchor_ids) == ("starloc", ("1",), ("5", "6"))
    log = read_ranges(write(tmp_path, head + "0.1,1.86,5,1\n0.2,2.5,6,1\n"))
    assert (log.tag_ids, log.anchor_ids) == (("1",), ("5", "6"))


def test_known_anchors_decide_which_side_is_the_tag(tmp_path: Path) -> None:
    path = write(tmp_path, "time_s,range,from_id,to_id\n0.1,1.86,1,5\n0.2,2.5,5,1\n0.3,2,1,6\n")
    log = read_ranges(path, anchor_ids=["5", "6"])
    assert log.tag_ids == ("1",)
    assert anchors_of(log) == ["5", "5", "6"]


def test_uwb_init_log_is_recognised(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "t,ID_Tag,ID_Anchor,range\n0,1,10,17.6881566529905\n"))
    assert (log.format, log.tag_ids, log.anchor_ids) == ("uwb_init", ("1",), ("10",))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"format": "dxf"}, "no log format is named 'dxf'"),
        ({"columns": {"range": "d"}}, "columns must name"),
        ({"columns": {**MAPPING, "colour": "c"}}, "'colour'"),
        ({"columns": {**MAPPING, "tag_id": "who"}}, "no column who"),
        ({"columns": MAPPING, "timestamp_unit": "hours"}, "timestamp_unit is 'hours'"),
        ({"columns": MAPPING, "range_unit": "feet"}, "range_unit is 'feet'"),
        ({"columns": MAPPING, "separator": "ab"}, "separator is 'ab'"),
        ({"format": "canonical", "timestamp_unit": "ms"}, "fixed columns"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, options: dict[str, object], said: str) -> None:
    assert said in str(refusal(write(tmp_path, "t,node,d\n0,7,3\n"), **options))


def test_miluv_log_is_recognised_whatever_the_order_of_its_columns(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, "range,from_id,to_id,tx1,std,timestamp\n2.328209,21,10,4624.5,0.18,1.1735\n"))
    assert (log.format, log.tag_ids, log.anchor_ids) == ("miluv", ("21",), ("10",))
    np.testing.assert_array_equal(log.timestamp_s, [1.1735])


INROL = """\
# index timestamp anchor_id r
0 0.032284736633 6 2.410469089846
1 0.012478828430 2 1.746998299780
2 0.012478828430 1 1.003056942908
3 0.032284736633 7 3.113442167141
"""


def test_inrols_text_is_recognised_by_its_comment(tmp_path: Path) -> None:
    log = read_ranges(write(tmp_path, INROL))
    assert (log.format, log.anchor_ids, log.tag_ids) == ("inrol", ("1", "2", "6", "7"), ("tag",))
    np.testing.assert_array_equal(log.timestamp_s, [0.032284736633, 0.012478828430, 0.012478828430, 0.032284736633])
    np.testing.assert_array_equal(log.range_m, [2.410469089846, 1.746998299780, 1.003056942908, 3.113442167141])
    np.testing.assert_array_equal(log.line, [2, 3, 4, 5])


def test_line_of_inrols_text_that_was_cut_off_is_left_out_and_a_wrong_one_refused_with_its_number(
    tmp_path: Path,
) -> None:
    log = read_ranges(write(tmp_path, INROL[:-16]))
    assert len(log) == 3
    assert log.notes == ("1 lines that are not rows of the table are left out, the first is line 5",)
    error = refusal(write(tmp_path, INROL.replace("1.7469", "1.7x469")))
    assert error.line == 3
    assert "r is '1.7x46998299780'" in str(error)


def test_other_texts_of_inrols_are_no_log(tmp_path: Path) -> None:
    for header in ("# anchor_id tx ty tz", "# index timestamp x y"):
        error = refusal(write(tmp_path, f"{header}\n1 2.5 3 4\n2 2.6 3 4.5\n"))
        assert "not known for sure" in str(error)


def test_text_that_is_no_table_is_refused_with_its_beginning(tmp_path: Path) -> None:
    assert "distances 7.10" in str(refusal(write(tmp_path, "distances 7.10 5.24\n")))


# Any bytes


@any_bytes_in_one_folder
@given(content=st.binary(max_size=200), format=st.sampled_from([None, *reader_names()]))
def test_any_bytes_are_a_log_or_an_input_error(tmp_path: Path, content: bytes, format: str | None) -> None:
    with contextlib.suppress(InputError):
        assert len(read_ranges(write(tmp_path, content), format=format)) > 0


cells = st.one_of(
    st.text("0123456789.-+eEnaif_\"' #\t\x00\u0663", max_size=8), st.floats().map(repr), st.sampled_from(["", "1", "a"])
)


@any_bytes_in_one_folder
@given(rows=st.lists(st.lists(cells, min_size=3, max_size=6), max_size=5), unit=st.sampled_from(["s", "ns", "iso"]))
def test_any_cells_under_a_good_header_are_a_log_or_an_input_error(
    tmp_path: Path, rows: list[list[str]], unit: str
) -> None:
    body = "\n".join(",".join(row) for row in rows)
    for header in ("timestamp_s,anchor_id,range_m", "timestamp_s,anchor_id,range_m,tag_id,range_stddev_m,los"):
        path = write(tmp_path, f"{header}\n{body}".encode())
        columns = {"timestamp": "timestamp_s", "anchor_id": "anchor_id", "range": "range_m"}
        for options in ({}, {"columns": columns, "timestamp_unit": unit, "range_unit": "mm"}):
            with contextlib.suppress(InputError):
                assert len(read_ranges(path, **options)) > 0  # type: ignore[arg-type]


@any_bytes_in_one_folder
@given(
    good=st.integers(0, 6),
    row=st.lists(cells, min_size=1, max_size=5),
    format=st.sampled_from(["canonical", "starloc", "uwb_init", "inrol"]),
)
def test_only_a_wrong_line_can_spoil_a_good_log_and_is_told(
    tmp_path: Path, good: int, row: list[str], format: str
) -> None:
    header, line = {
        "canonical": ("timestamp_s,anchor_id,range_m", "0.5,a,1.5"),
        "starloc": ("time_s,range,from_id,to_id", "0.5,1.5,t,a"),
        "uwb_init": ("t,ID_Tag,ID_Anchor,range", "0.5,t,a,1.5"),
        "inrol": ("# index timestamp anchor_id r", "0 0.5 a 1.5"),
    }[format]
    spoilt = (" " if format == "inrol" else ",").join(row)
    lines = [header, *[line] * (good + 1), spoilt]
    told = len(lines)
    try:
        read_ranges(write(tmp_path, "\n".join(lines).encode()))
    except InputError as error:
        told = error.line or 0
    assert told >= len(lines)


@any_bytes_in_one_folder
@given(
    st.lists(
        st.tuples(
            st.floats(-1e10, 1e10),
            st.text(min_size=1).map(str.strip).filter(lambda text: text.isprintable() and text),
            st.floats(1e-6, REACH_M),
        ),
        min_size=1,
    )
)
def test_any_log_survives_writing_and_reading(tmp_path: Path, rows: list[tuple[float, str, float]]) -> None:
    times, ids, ranges = zip(*rows)
    log = RangeLog.from_arrays(list(ids), list(ranges), timestamp_s=list(times))
    write_ranges_csv(log, tmp_path / "out.csv")
    again = read_ranges(tmp_path / "out.csv")
    np.testing.assert_array_equal(again.timestamp_s, log.timestamp_s)
    np.testing.assert_array_equal(again.range_m, log.range_m)
    assert anchors_of(again) == anchors_of(log)
