"""An anchors' file gives the anchors and what is known of each, or is refused with the number of the wrong line."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rangesfm.errors import InputError
from rangesfm.ranging.anchors.anchor import Anchor, default_anchor_frame
from rangesfm.ranging.anchors.anchor_file import _named_quantity, read_anchors, write_anchors

HEADER = "anchor_id,x_m,y_m,z_m"
FULL_HEADER = HEADER + ",position_stddev_m,range_bias_m,range_bias_stddev_m"


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "anchors.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        read_anchors(path)
    assert "\n" not in str(caught.value)
    return caught.value


def test_positions_are_read(tmp_path: Path) -> None:
    first, second = read_anchors(write(tmp_path, f"{HEADER}\n1,1.5,-2,0.25\nA2, 3,4,5\n"))
    assert (first.anchor_id, second.anchor_id) == ("1", "A2")
    np.testing.assert_array_equal(first.position_m, [1.5, -2, 0.25])
    np.testing.assert_array_equal(second.position_m, [3, 4, 5])
    assert (first.position_stddev_m, first.range_bias_m, first.range_bias_stddev_m) == (0.0, 0.0, None)


def test_optional_columns_are_read(tmp_path: Path) -> None:
    first, second = read_anchors(write(tmp_path, f"{FULL_HEADER}\n1,1,2,3,0.02,-0.1,0.03\n2,1,2,3,,,\n"))
    assert (first.position_stddev_m, first.range_bias_m, first.range_bias_stddev_m) == (0.02, -0.1, 0.03)
    assert (second.position_stddev_m, second.range_bias_m, second.range_bias_stddev_m) == (0.0, 0.0, None)


@pytest.mark.parametrize(
    ("words", "quantity"),
    [("sigma", "position_stddev"), ("bias", "range_bias"), ("bias sigma", "range_bias_stddev")],
)
def test_a_stddev_is_that_of_the_position_unless_its_name_says_bias(words: str, quantity: str) -> None:
    assert _named_quantity({*words.split()}) == quantity


def test_empty_coordinates_are_those_of_an_unknown_anchor(tmp_path: Path) -> None:
    anchors = read_anchors(write(tmp_path, f"{HEADER}\n1,,,\n2,1,2,3\n"))
    assert anchors[0].position_m is None
    assert default_anchor_frame(anchors) == "site"
    assert default_anchor_frame(anchors[:1]) == "unknown"


def test_unnamed_column_of_ids_and_plain_coordinate_names_are_understood(tmp_path: Path) -> None:
    (anchor,) = read_anchors(write(tmp_path, ",x,y,z\n10,-3.03,3.04,2.07\n"))
    assert anchor.anchor_id == "10"
    np.testing.assert_array_equal(anchor.position_m, [-3.03, 3.04, 2.07])


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("2,1,,3,,,", "y_m is empty, expected all three coordinates or none"),
        ("2,1,abc,3,,,", "y_m is 'abc'"),
        ("2,1,nan,3,,,", "y_m is nan"),
        (",1,2,3,,,", "anchor_id is empty"),
        ("1,1,2,3,,,", "anchor 1 is in line 2 already"),
        ("2,1,2,3,-0.1,,", "position_stddev_m is -0.1"),
        ("2,1,2,3,,,-1", "range_bias_stddev_m is -1"),
        ("2,1,2,3", "has 4 cells, the header row has 7"),
    ],
)
def test_wrong_row_is_refused_with_its_line(tmp_path: Path, row: str, said: str) -> None:
    error = refusal(write(tmp_path, f"{FULL_HEADER}\n1,1,2,3,,,\n{row}\n"))
    assert error.line == 3
    assert said in str(error)


def test_file_that_names_no_anchor_is_refused(tmp_path: Path) -> None:
    assert "names no anchor" in str(refusal(write(tmp_path, HEADER)))
    assert "empty" in str(refusal(write(tmp_path, "")))
    assert "no such file" in str(refusal(tmp_path / "none.csv"))


def test_missing_coordinate_column_is_named(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, "anchor_id,x_m,y_m\n1,2,3\n"))
    assert "not sure: no column seems to be z (height)" in error.advice


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.one_of(st.binary(max_size=100), st.text('0123456789,.-\n\r#" naif', max_size=80).map(str.encode)))
@pytest.mark.parametrize("header", [b"", FULL_HEADER.encode() + b"\n", HEADER.encode() + b"\n"])
def test_any_bytes_are_anchors_or_an_input_error(tmp_path: Path, header: bytes, content: bytes) -> None:
    with contextlib.suppress(InputError):
        assert read_anchors(write(tmp_path, header + content))


def test_written_anchors_are_read_back(tmp_path: Path) -> None:
    anchors = (
        Anchor("A1", np.array([1.5, -2.25, 0.125]), 0.05, 0.02, 0.01),
        Anchor("A2", np.array([0.0, 7.0, 1.0])),
        Anchor("A3", None, 0.0, -0.1, 0.03),
        Anchor("A4"),
    )
    write_anchors(anchors, tmp_path / "anchors.csv")
    for written, read in zip(anchors, read_anchors(tmp_path / "anchors.csv"), strict=True):
        assert str(read) == str(written)


def test_anchors_that_cannot_be_written_are_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_anchors([Anchor("A1")], tmp_path / "none" / "anchors.csv")
