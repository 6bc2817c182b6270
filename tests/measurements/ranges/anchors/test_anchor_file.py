"""An anchors' file gives the anchors and what is known of each, or is refused with the number of the wrong line."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.known import known
from tests.refused import refused

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor, default_anchor_frame
from rangesfm.measurements.ranges.anchors.anchor_file import (
    ANCHORS,
    find_points,
    read_anchor_list,
    read_anchors,
    write_anchors,
)
from rangesfm.measurements.ranges.readers.layout import find_layout
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError, flags_typed

HEADER = "anchor_id,x_m,y_m,z_m"
FULL_HEADER = HEADER + ",position_stddev_m,range_bias_m,range_bias_stddev_m"


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "anchors.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


refusal = partial(refused, read_anchors)


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
def test_a_stddev_is_that_of_the_position_unless_its_name_says_bias(tmp_path: Path, words: str, quantity: str) -> None:
    columns = known(columns_of(table(tmp_path, f"Point,X,Y,Z,{words}/A,1,2,3,0.1/B,4,5,6,0.2")))
    assert columns[quantity] == words


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


@settings(max_examples=150)
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


def table(folder: Path, text: str, name: str = "points.csv") -> Path:
    """Write a table whose lines are set apart by slashes."""
    path = folder / name
    path.write_text(text.replace("/", "\n") + "\n")
    return path


def columns_of(path: Path) -> dict[str, str] | None:
    return find_points(ANCHORS, path, known(find_layout(path)))


def doubts_about(path: Path) -> tuple[str, dict[str, str]]:
    """Return what is not sure, and the flags of each choice by the case in which it is right."""
    with pytest.raises(UnclearFileError) as caught:
        columns_of(path)
    return caught.value.about[1], {choice.when: " ".join(flags_typed(choice.flags)) for choice in caught.value.choices}


ROWS = "/A,1.5,2.5,3.5/B,4.5,5.5,6.5"
XYZ = {"anchor_id": "Point", "x": "X", "y": "Y", "z": "Z"}


def test_columns_of_another_table_are_told_with_those_that_are_not_used(tmp_path: Path) -> None:
    path = table(tmp_path, "Point,E [cm],N [cm],H [cm],Code/A,150,250,350,q/B,1,2,3,r")
    found = read_anchor_list(path)
    np.testing.assert_allclose(known(found[0][0].position_m), [1.5, 2.5, 3.5])
    assert found[1] == (
        "points.csv: columns taken: anchor_id = Point, x = E [cm], y = N [cm], z = H [cm]; not used: Code",
        "points.csv: coordinates are in cm",
    )
    assert [str(anchor) for anchor in read_anchors(path)] == [str(anchor) for anchor in found[0]]


def test_nothing_is_told_about_a_canonical_file(tmp_path: Path) -> None:
    assert read_anchor_list(table(tmp_path, HEADER + ROWS))[1] == ()


def test_a_table_without_names_is_taken_as_x_y_z_and_that_is_told_unless_columns_are_given(tmp_path: Path) -> None:
    path = table(tmp_path, ROWS[1:])
    found = read_anchor_list(path)
    np.testing.assert_array_equal(known(found[0][1].position_m), [4.5, 5.5, 6.5])
    assert "x = 2, y = 3, z = 4 (by their numbers and values: the table has no names)" in found[1][0]
    typed = read_anchor_list(path, columns={"z": "2", "x": "3", "y": "4", "anchor_id": "1"})
    np.testing.assert_array_equal(known(typed[0][1].position_m), [5.5, 6.5, 4.5])
    assert typed[1] == ("points.csv: columns taken: anchor_id = 1, x = 3, y = 4, z = 2",)


def test_a_unit_or_columns_that_are_given_count_in_a_canonical_file_too(tmp_path: Path) -> None:
    path = table(tmp_path, HEADER + ROWS)
    in_feet = read_anchor_list(path, unit="ft")
    np.testing.assert_allclose(known(in_feet[0][0].position_m), np.array([1.5, 2.5, 3.5]) * 0.3048)
    assert in_feet[1][-1] == "points.csv: coordinates are in ft"
    swapped = read_anchor_list(path, columns={"anchor_id": "anchor_id", "x": "y_m", "y": "x_m", "z": "z_m"})
    np.testing.assert_array_equal(known(swapped[0][0].position_m), [2.5, 1.5, 3.5])


@pytest.mark.parametrize(
    ("header", "unit", "position_m", "stddev_m", "bias_m"),
    [
        ("Point,X,Y,Z,Sigma,Bias,Bias Sigma", None, [10, 20, 30], 4, 5),
        ("Point,X,Y,Z,Sigma,Bias,Bias Sigma", "cm", [0.1, 0.2, 0.3], 0.04, 0.05),
        ("Point,X [cm],Y [cm],Z [cm],Sigma,Bias [mm],Bias Sigma", None, [0.1, 0.2, 0.3], 0.04, 0.005),
        ("Point,X [mm],Y [mm],Z [mm],Sigma [m],Bias,Bias Sigma", "cm", [0.1, 0.2, 0.3], 4, 0.05),
    ],
)
def test_lengths_are_in_their_own_unit_or_else_in_that_of_the_coordinates(
    tmp_path: Path, header: str, unit: str | None, position_m: list[float], stddev_m: float, bias_m: float
) -> None:
    (anchor,) = read_anchors(table(tmp_path, header + "/A,10,20,30,4,5,6"), unit=unit)
    np.testing.assert_allclose(known(anchor.position_m), position_m)
    assert anchor.position_stddev_m == pytest.approx(stddev_m)
    assert anchor.range_bias_m == pytest.approx(bias_m)
    assert anchor.range_bias_stddev_m == pytest.approx(6 / (100 if "cm" in f"{header} {unit}" else 1))


def test_words_for_nothing_and_the_minus_of_typesetting_are_read_in_the_usual_table_too(tmp_path: Path) -> None:
    first, second = read_anchors(table(tmp_path, "anchor_id,x_m,y_m,z_m/A,NaN,nan,-/B,\u22121.5,2,\u2212.5"))
    assert first.position_m is None
    np.testing.assert_array_equal(known(second.position_m), [-1.5, 2, -0.5])


def test_the_unit_of_each_coordinate_is_told(tmp_path: Path) -> None:
    found = read_anchor_list(table(tmp_path, "Point,X [mm],Y [cm],Z [m]/A,1000,200,3"))
    np.testing.assert_allclose(known(found[0][0].position_m), [1, 2, 3])
    assert found[1][-1] == "points.csv: coordinates: x in mm, y in cm, z in m"
    assert read_anchor_list(table(tmp_path, "Point,X m,Y m,Z mm/A,1,2,3"))[1][-1].endswith("x in m, y in m, z in mm")


def test_points_between_thousands_are_no_decimal_ones(tmp_path: Path) -> None:
    rows = ["A;0;1.200;500", "B;5.200;0;2.832", "C;1.105.200;4.100;950,5"]
    anchors, notes = read_anchor_list(table(tmp_path, "/".join(["Anker;X [mm];Y [mm];Z [mm]", *rows])))
    places = [known(anchor.position_m) for anchor in anchors]
    np.testing.assert_allclose(places, [[0, 1.2, 0.5], [5.2, 0, 2.832], [1105.2, 4.1, 0.9505]])
    assert "points.csv: numbers of Y [mm] have their thousands set apart: 1.200 is 1200" in notes


def test_files_without_a_table_of_anchors_and_columns_that_miss_some_are_refused(tmp_path: Path) -> None:
    expected = "expected a table with anchor_id,x_m,y_m,z_m"
    assert refusal(table(tmp_path, "/ /", "none.csv")).args[0].endswith(f"none.csv: the file is empty, {expected}")
    assert f"no table of anchors, {expected}" in str(refusal(table(tmp_path, "# nothing")))
    assert f"no columns of anchors; found a, b; {expected}" in str(refusal(table(tmp_path, "a,b/1,2/3,4")))
    path = table(tmp_path, "Point,X,Y,Z" + ROWS)
    with pytest.raises(InputError, match="columns do not name y, z, expected anchor_id, x, y and z"):
        read_anchors(path, columns={"anchor_id": "Point", "x": "X"})
    with pytest.raises(InputError, match="no column W; found Point, X, Y, Z"):
        read_anchors(path, columns={**XYZ, "z": "W"})


def test_lengths_beyond_all_bounds_are_refused_in_their_own_unit(tmp_path: Path) -> None:
    most = read_anchors(table(tmp_path, f"{HEADER}/A,1e9,-1e9,0"))
    np.testing.assert_array_equal(known(most[0].position_m), [1e9, -1e9, 0])
    error = refusal(table(tmp_path, f"{HEADER}/A,1,2,3/B,1,1.1e9,3"))
    assert "y_m is 1.1e9, expected a number of metres from -1000000000 to 1000000000, or nothing" in str(error)
    assert error.line == 3
    assert str(error).endswith("or nothing")
    in_mm = "Point,X [mm],Y [mm],Z [mm]/A,1,2,3/B,1,2,"
    assert known(read_anchors(table(tmp_path, in_mm + "1e12"))[1].position_m)[2] == 1e9
    error = refusal(table(tmp_path, in_mm + "1.1e12"))
    assert "Z [mm] is 1.1e12" in str(error)
    assert str(error).endswith("or nothing (here in mm)")


@pytest.mark.parametrize(("cells", "axis"), [(",2,3", "x_m"), ("1,,3", "y_m"), ("1,2,", "z_m"), ("1,,", "y_m")])
def test_the_first_missing_coordinate_of_an_incomplete_position_is_named(tmp_path: Path, cells: str, axis: str) -> None:
    error = refusal(table(tmp_path, f"{HEADER}/A,1,2,3/B,,,/C,{cells}"))
    assert f"{axis} is empty, expected all three coordinates or none" in str(error)
    assert error.line == 4


def test_written_cells_have_tenths_of_millimetres_or_nothing(tmp_path: Path) -> None:
    anchors = [Anchor("A", np.array([1.0, -2.00004, 3.0]), 0.5, 0.1, 0.2), Anchor("B", None, 0.3, 0.1, None)]
    write_anchors(anchors, tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines == [FULL_HEADER, "A,1.0000,-2.0000,3.0000,0.5000,0.1000,0.2000", "B,,,,,,"]


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("Point,X,Y,Z" + ROWS, XYZ),
        ("id,X,Y,Z" + ROWS, XYZ | {"anchor_id": "id"}),
        ("Nr,Point,X,Y,Z/1,A,1,2,3/2,B,4,5,6", XYZ),
        ("Mark,X,Y,Z" + ROWS, XYZ | {"anchor_id": "Mark"}),  # the only texts, and all differ
        ("Point,Y pos,X pos,Z/A,1,2,3", XYZ | {"x": "X pos", "y": "Y pos"}),
        ("Point,N,E,Z/A,1,2,3", XYZ | {"x": "E", "y": "N"}),
        ("Point,X,Y,Z,Latitude,Longitude/A,1,2,3,47.5,8.5", XYZ),
        ("Point,X,Y,Z,Sigma/A,1,2,3,4", XYZ | {"position_stddev": "Sigma"}),
        ("Point,Time,X,Y,Z/A,1.5,1,2,3/B,2.5,1,2,3", XYZ),
        ("Point,X,Y,Z,Distance/A,1,2,3,4/B,5,6,7,8", XYZ),
    ],
)
def test_columns_of_anchors_are_recognized_by_their_names(tmp_path: Path, text: str, columns: dict[str, str]) -> None:
    found = columns_of(table(tmp_path, text))
    assert found == columns


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("points.csv", "id,X,Y/A,1,2"),
        ("points.csv", "Point,X,Why/A,1,2"),
        ("points.csv", "Name,X,Y,Why/A,1,2,3"),
        ("points.csv", "Mark,What,X,Y,Z/A,a,1,2,3/B,b,1,2,3"),  # either may be the id
        ("points.csv", "Mark,X,Y,Z/A,1,2,3/A,4,5,6"),
        ("points.csv", "id,Latitude,Longitude/A,47,8"),
        ("points.csv", "Point,Latitude/A,47"),
        ("points.csv", "X,Y,Z/1,2,3/4,5,6"),
        ("anchors.csv", "Point,Why/A,b"),  # no numbers
        ("anchors.csv", "Anchor,Time,Distance/A,1.5,2.5/B,2.5,3.5"),
        ("anchors.csv", "Anchor,Time,X,Y,Z/A,1.5,1,2,3/A,2.5,1,2,3"),
        ("anchors.csv", "Anchor,Time,Distance,X,Y,Z/A,1.5,9,1,2,3/B,2.5,9,1,2,3"),
        ("anchors.csv", "Time,X,Y,Z/1.5,1,2,3/2.5,1,2,3"),
    ],
)
def test_tables_of_other_things_are_none_of_anchors(tmp_path: Path, name: str, text: str) -> None:
    assert columns_of(table(tmp_path, text, name)) is None


def test_a_file_about_anchors_is_asked_about_where_its_columns_are_not_known(tmp_path: Path) -> None:
    doubts, choices = doubts_about(table(tmp_path, "What,X,Size/A,1,2/A,3,4", "my_anchors.csv"))
    assert doubts == (
        "not sure: no column seems to be the anchor's id; no column seems to be y; no column seems to be z (height)"
    )
    assert choices == {"with the names of the columns": "--anchor_columns anchor_id=NAME,x=X,y=NAME,z=NAME"}


def test_points_without_heights_are_asked_about(tmp_path: Path) -> None:
    doubts, choices = doubts_about(table(tmp_path, "Point,X,Y,Sigma/A,1,2,3"))
    assert doubts == "not sure: no column seems to be z (height)"
    flags = "--anchor_columns anchor_id=Point,x=X,y=Y,z=NAME,position_stddev=Sigma"
    assert choices == {"with the names of the columns": flags}


def test_of_two_columns_for_one_quantity_the_user_chooses(tmp_path: Path) -> None:
    doubts, choices = doubts_about(table(tmp_path, "Point,X,East,Y,Z,Height/A,1,2,3,4,5"))
    assert doubts == "not sure: any of X, East may be x; any of Z, Height may be z (height)"
    start = "--anchor_columns anchor_id=Point,"
    assert choices == {
        "if X is x": start + "x=X,y=Y,z=Z",
        "if East is x": start + "x=East,y=Y,z=Z",
        "if Z is z (height)": start + "x=X,y=Y,z=Z",
        "if Height is z (height)": start + "x=X,y=Y,z=Height",
    }


def test_degrees_are_asked_about_as_those_of_wgs_84_if_there_are_heights(tmp_path: Path) -> None:
    doubts, choices = doubts_about(table(tmp_path, "Point,Lat,Lon,Height/A,47.5,8.5,400"))
    assert doubts == "not sure: Lat and Lon are degrees, of no known coordinate system"
    flags = "--anchor_columns anchor_id=Point,x=Lon,y=Lat,z=Height --anchor_crs EPSG:4979"
    assert choices == {"if that is WGS 84": flags}
    _, flat = doubts_about(table(tmp_path, "Point,Lat,Lon/A,47.5,8.5"))
    assert flat == {"with the names of the columns": "--anchor_columns anchor_id=Point,x=Lon,y=Lat,z=NAME"}
    # With only one of the axes in metres, the degrees are still those of the position.
    _, half = doubts_about(table(tmp_path, "Point,X,Lat,Lon,Height/A,1,47.5,8.5,400"))
    assert half == choices
    several, _ = doubts_about(table(tmp_path, "Point,Anchor,Lat,Lon,Height/A,B,47.5,8.5,400"))
    assert several == "not sure: any of Point, Anchor may be the anchor's id"


@pytest.mark.parametrize(("y", "x", "z"), [("Y", "X", "Z"), ("Y [m]", "X [m]", "Z [m]")])
def test_y_before_x_is_asked_about_because_surveyors_call_north_x(tmp_path: Path, y: str, x: str, z: str) -> None:
    doubts, choices = doubts_about(table(tmp_path, f"Point,{y},{x},{z}/A,1,2,3"))
    assert doubts == f"not sure: {y} comes before {x}, as where surveyors call north x"
    assert choices == {
        f"if {x} is north": f"--anchor_columns anchor_id=Point,x={y},y={x},z={z}",
        f"if {x} is east and {y} is north": f"--anchor_columns anchor_id=Point,x={x},y={y},z={z}",
    }


@pytest.mark.parametrize(
    ("axes", "told"), [("X [cm],Y,Z", ["cm"]), ("X,Y [mm],Z [cm]", ["cm", "mm"]), ("X [cm],Y [m],Z [m]", [])]
)
def test_units_of_some_coordinates_only_are_asked_about(tmp_path: Path, axes: str, told: list[str]) -> None:
    path = table(tmp_path, f"Point,{axes}/A,1,2,3")
    x, y, z = axes.split(",")
    if not told:
        assert columns_of(path) == {"anchor_id": "Point", "x": x, "y": y, "z": z}
        return
    doubts, choices = doubts_about(path)
    assert doubts == f"not sure: some of the coordinates are in {' and '.join(told)}, others have no unit"
    columns = f"--anchor_columns anchor_id=Point,x={x},y={y},z={z}"
    assert choices == {f"if all are in {unit}": f"{columns} --anchor_unit {unit}" for unit in told}


UNNAMED = {"anchor_id": "1", "x": "2", "y": "3", "z": "4"}


def numbered(num: int) -> str:
    return "/".join(f"{k},{k}.5,2,3" for k in range(num))


@pytest.mark.parametrize(
    ("text", "is_one"),
    [
        ("A,1,2,3/B,4,5,6", True),
        ("7,1,2,3/8,4,5,6", True),
        ("7.5,1,2,3/8.5,4,5,6", False),  # no ids
        ("A,1,2,3/A,4,5,6", False),
        ("A,1,2,3,4/B,4,5,6,7", False),
        ("A,1,2/B,4,5", False),
        ("A,q,1,2,3/B,r,4,5,6", False),
        (numbered(64), True),
        (numbered(65), False),
        ("A,1,2,3,q,r/B,4,5,6,s,t", False),
    ],
)
def test_a_short_table_without_names_may_be_an_id_and_three_numbers(tmp_path: Path, text: str, is_one: bool) -> None:
    assert columns_of(table(tmp_path, text)) == (UNNAMED if is_one else None)


@pytest.mark.parametrize("cells", ["500.5,1,2", "1,-500.5,2", "1,2,500.5", "1,2,3,wall"])
def test_a_grid_or_a_code_without_names_may_have_north_before_east(tmp_path: Path, cells: str) -> None:
    code = ",door" if "wall" in cells else ""
    doubts, choices = doubts_about(table(tmp_path, f"A,{cells}/B,500,-500,3{code}"))
    assert doubts == "not sure: a table without names, in which either east or north may come first"
    assert choices == {
        "if the numbers are x, y, z or east, north, height": "--anchor_columns anchor_id=1,x=2,y=3,z=4",
        "if they are north, east, height (PNEZD)": "--anchor_columns anchor_id=1,x=3,y=2,z=4",
    }
    assert columns_of(table(tmp_path, "A,500,1,2/B,3,-500,4")) == UNNAMED


# Lists as total stations and drawing programs export them: names of the columns, a row, and which cell is which.
EXPORTS = {
    "English": "Point;Easting;Northing;Elevation;Code/S1;{x};{y};{z};ST/1;{x};{y};{z};PR",
    "German": "Punktnummer;Rechtswert;Hochwert;Höhe/S1;{x};{y};{z}/101;{x};{y};{z}",
    "French": "N° de point;Est;Nord;Altitude/S1;{x};{y};{z}/1;{x};{y};{z}",
    "French register": "Matricule;X (m);Y (m);Z (m)/S1;{x};{y};{z}/1;{x};{y};{z}",
    "Italian": "N. punto;Est (m);Nord (m);Quota;Codice/S1;{x};{y};{z};P/1;{x};{y};{z};P",
    "Spanish": "Nº de punto;Coordenada X;Coordenada Y;Cota/S1;{x};{y};{z}/1;{x};{y};{z}",
    "Dutch": "Puntnummer;X-coördinaat;Y-coördinaat;Hoogte/S1;{x};{y};{z}/1;{x};{y};{z}",
    "north first": "Punkt;Hochwert;Rechtswert;Höhe/S1;{y};{x};{z}/1;{y};{x};{z}",
    "code first": "Nr.;Code;Ost;Nord;Höhe/S1;7;{x};{y};{z}/1;7;{x};{y};{z}",
    "unit once": "Punto;Este (m);Norte (m);Cota/S1;{x};{y};{z}/1;{x};{y};{z}",
    "row of units": "Point;East;North;Height/;m;m;m/S1;{x};{y};{z}/1;{x};{y};{z}",
}


@pytest.mark.parametrize("separator", [";", "\t", "|", " "])
@pytest.mark.parametrize("number", ["{:.3f}", "{:.3f},"], ids=["points", "commas"])
@pytest.mark.parametrize("name", EXPORTS)
def test_lists_of_total_stations_begin_with_their_station(
    tmp_path: Path, name: str, separator: str, number: str
) -> None:
    places = [(1010.0, 5000.0, 100.0), (1004.125, 5003.5, 101.25)]
    header, *rows = EXPORTS[name].split("/")
    units = rows[:-2]
    cells = [[number.format(value) for value in place] for place in places]
    if number.endswith(","):
        cells = [[cell.rstrip(",").replace(".", ",") for cell in row] for row in cells]
    lines = [row.format(x=x, y=y, z=z) for row, (x, y, z) in zip(rows[-2:], cells, strict=True)]
    text = "\n".join([header, *units, *lines])
    if separator == " ":
        text = text.replace(" ", "_").replace("\n;", "\n-;")
    found = read_anchor_list(table(tmp_path, "Site: hall 4/" + text.replace(";", separator)))
    np.testing.assert_array_equal([known(anchor.position_m) for anchor in found[0]], places)
    assert [anchor.anchor_id for anchor in found[0]] == [row.partition(";")[0] for row in rows[-2:]]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
@pytest.mark.parametrize("apart", [" ", "'", "\xa0"])
@pytest.mark.parametrize("end", ["", ";"])
def test_lists_come_in_the_encodings_and_with_the_thousands_of_their_country(
    tmp_path: Path, encoding: str, apart: str, end: str
) -> None:
    rows = [f"{k};2{apart}600{apart}01{k},25;1{apart}200{apart}030,5;40{k},75{end}" for k in (1, 2, 3)]
    text = "\r\n".join(["Relevé du 12.03.2026", "", f"N°;Est;Nord;Altitude{end}", *rows])
    anchors = read_anchors(write(tmp_path, text.encode(encoding)))
    expected = [[2600010.25 + k, 1200030.5, 400.75 + k] for k in (1, 2, 3)]
    np.testing.assert_array_equal([known(anchor.position_m) for anchor in anchors], expected)


def test_header_may_end_in_a_separator_where_the_rows_do_not_and_the_last_row_may_lack_a_line_end(
    tmp_path: Path,
) -> None:
    path = write(tmp_path, "Point;East;North;Height;\nA1;1.5;2.5;3.5\nA2;4.5;5.5;6.5\nA3;1\xa0007.5;8.5;9.5")
    np.testing.assert_array_equal(known(read_anchors(path)[2].position_m), [1007.5, 8.5, 9.5])


def test_a_single_height_of_unknown_name_is_offered_with_its_column(tmp_path: Path) -> None:
    _, choices = doubts_about(table(tmp_path, "Point,East,North,Level/1,1.5,2.5,3.5/2,4.5,5.5,6.5"))
    assert choices == {"if Level is z": "--anchor_columns anchor_id=Point,x=East,y=North,z=Level"}


def test_whole_numbers_as_names_of_columns_stay_names(tmp_path: Path) -> None:
    layout = known(find_layout(table(tmp_path, "time,101,102/0.5,1.25,2.5/0.6,1.5,2.75", "log.csv")))
    assert [column.name for column in layout.columns] == ["time", "101", "102"]
