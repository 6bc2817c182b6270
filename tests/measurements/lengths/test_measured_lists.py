"""Tapes, marks, pairs and points are read as people have them: other names, separators, units and decimal commas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.measured_lists import LENGTHS, MARKS
from rangesfm.measurements.lengths.tape_file import read_markers, read_tape
from rangesfm.measurements.positions.control_point_file import read_control_points
from rangesfm.options import PointOptions
from rangesfm.pipeline.measure import read_point_pairs
from rangesfm.survey.discovery.found_files import POINTS, look_into

TAPES = {
    "semicolons": "from;to;distance_m;stddev_m;kind\nA1;A3;15,62;0,005;check\na.jpg;b.jpg;6,81;0,01;control\n",
    "german": "Von;Nach;Länge [m];Genauigkeit [mm];Art\nA1;A3;15,62;5;Check\na.jpg;b.jpg;6,81;10;control\n",
    "french": "de\tà\tlongueur (cm)\tsigma_mm\ttype\nA1\tA3\t1562,0\t5\tcheck\na.jpg\tb.jpg\t681,0\t10\tcontrol\n",
    "millimetres": "point_a,point_b,dist_mm,std_mm,kind\nA1,A3,15620,5,check\na.jpg,b.jpg,6810,10,control\n",
    "units in cells": "start;end;distance;sd;kind\nA1;A3;15,62 m;5 mm;check\na.jpg;b.jpg;6,81 m;10 mm;control\n",
    "quoted": 'From,To,"Distance, m",Sigma,Kind\nA1,A3,"15,62","0,005",check\na.jpg,b.jpg,"6,81","0,01",\n',
    "remarks": "Punkt 1;Punkt 2;Strecke;stddev_m;kind;Bemerkung\nA1;A3;15,62;0,005;check;ja\na.jpg;b.jpg;6,81;0,01;;\n",
}
MARK_FILES = {
    "semicolons": "marker;image_name;x_px;y_px\ndoor;a.jpg;1,5;2,25\ndoor;b.jpg;5;6,5\n",
    "german": "Punkt;Bild;x [px];y [px]\ndoor;a.jpg;1,5;2,25\ndoor;b.jpg;5;6,5\n",
    "pixels": "photo\tgcp\tu\tv\na.jpg\tdoor\t1.5\t2.25\nb.jpg\tdoor\t5\t6.5\n",
    "columns and rows": "image,target,pixel_col,pixel_row\na.jpg,door,1.5,2.25\nb.jpg,door,5,6.5\n",
    "no names": "door a.jpg 1.5 2.25\ndoor b.jpg 5 6.5\n",
}


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", TAPES)
def test_a_tape_is_read_and_found_as_people_write_it(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "d.csv", TAPES[name])
    first, second = read_tape(path).distances
    assert (first.ends, first.kind, second.ends, second.kind) == (("A1", "A3"), "check", ("a.jpg", "b.jpg"), "control")
    np.testing.assert_allclose([first.distance_m, second.distance_m], [15.62, 6.81], rtol=1e-12)
    np.testing.assert_allclose([first.stddev_m, second.stddev_m], [0.005, 0.01], rtol=1e-12)
    assert LENGTHS.is_such(path)
    assert look_into([tmp_path]).paths == {"scale.distances": [path]}
    assert read_point_pairs(path) == [("A1", "A3"), ("a.jpg", "b.jpg")]


@pytest.mark.parametrize("name", MARK_FILES)
def test_marks_are_read_as_people_write_them(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "m.csv", MARK_FILES[name])
    (marker,) = (found := read_markers(path)).values()
    assert (list(found), marker.image_names) == (["door"], ("a.jpg", "b.jpg"))
    np.testing.assert_array_equal(marker.pixels, [[1.5, 2.25], [5, 6.5]])
    if name != "no names":
        assert MARKS.is_such(path)
        assert look_into([tmp_path]).paths == {"scale.markers": [path]}


def test_how_another_tape_was_read_is_said(tmp_path: Path) -> None:
    (first, second) = read_tape(write(tmp_path / "d.csv", TAPES["german"])).notes
    assert (
        first
        == "d.csv: columns taken: from = Von, to = Nach, distance = Länge [m], stddev = Genauigkeit [mm], kind = Art"
    )
    assert second == "d.csv: numbers have decimal commas"


@pytest.mark.parametrize(
    "text",
    [
        "from;to;distance [mm]\nA1;A2;2.832\nA1;A3;850\n",  # 850 would have decimals, too
        "from;to;distance [mm];stddev [mm]\nA1;A2;2.832;2,5\nA1;A3;0850;3,5\n",  # commas are the decimal ones
        "from;to;distance [mm]\nA1;A2;2.832,0\nA1;A3;850,0\n",
        'from,to,distance_mm\nA1,A2,"2,832"\nA1,A3,850\n',
        "from,to,distance\nA1,A2,2.832 m\nA1,A3,85 cm\n",
        "from,to,distance_in\nA1,A2,111.4960630\nA1,A3,33.4645669\n",
        "von;nach;Länge in m\nA1;A2;2.832\nA1;A3;0.850\n",
    ],
)
def test_thousands_and_units_are_seen_by_other_numbers_and_by_the_unit(text: str, tmp_path: Path) -> None:
    lengths = [one.distance_m for one in read_tape(write(tmp_path / "d.csv", text)).distances]
    np.testing.assert_allclose(lengths, [2.832, 0.85], rtol=1e-9)


def test_a_number_of_millimetres_that_may_be_thousands_is_asked_about(tmp_path: Path) -> None:
    path = write(tmp_path / "d.csv", "from,to,distance_mm\nA1,A2,2.832\nA1,A3,12.400\n")
    with pytest.raises(InputError) as error:
        read_tape(path)
    assert str(error.value).endswith(
        "distance_mm is 2.832, which may be 2832 mm or less than 0.05 m: write it as 2832 or 2.8320"
    )
    path = write(tmp_path / "d.csv", "from,to,distance_mm\nA1,A2,2832\nA1,A3,12400\n")
    assert [one.distance_m for one in read_tape(path).distances] == [2.832, 12.4]
    path = write(tmp_path / "d.csv", "from,to,distance_mm,stddev_mm\nA1,A2,112.832,1.250\n")
    (length,) = read_tape(path).distances
    np.testing.assert_allclose([length.distance_m, length.stddev_m], [0.112832, 0.00125])
    assert (
        "d.csv: numbers of distance_mm such as 112.832 have decimals, not thousands set apart" in read_tape(path).notes
    )


def test_points_with_the_usual_names_may_have_decimal_commas(tmp_path: Path) -> None:
    path = write(tmp_path / "p.csv", "marker;x_m;y_m;z_m;stddev_m;kind\nP1;1,5;2;3;0,01;check\nP2;4;5,25;6;0,02;\n")
    points = read_control_points(PointOptions(path=path))
    assert points is not None
    np.testing.assert_array_equal(points.positions_m, [[1.5, 2, 3], [4, 5.25, 6]])
    assert [(point.stddev_m, point.kind) for point in points.points] == [(0.01, "check"), (0.02, "control")]
    assert look_into([tmp_path]).paths == {POINTS: [path]}


def test_a_column_may_be_called_by_its_unit_alone(tmp_path: Path) -> None:
    tape = read_tape(write(tmp_path / "d.csv", "from,to,cm\nA,B,150\nA,C,25.5\n"))
    assert [length.distance_m for length in tape.distances] == [1.5, 0.255]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("from;to;raw distance;mean distance\nA;B;1,5;1,5\n", "no columns of taped distances; found from, to, raw"),
        (
            "from;to;speed\nA;B;1,5\n",
            "no columns of taped distances; found from, to, speed; expected a table with from",
        ),
        ("Von;Nach;Länge [m]\nA;B;1,5\nA;C;-2\n", "d.csv:3: Länge [m] is -2, expected a number of metres"),
        ("Von;Nach;Länge [mm]\nA;B;1500\nA;C;0\n", "d.csv:3: Länge [mm] is 0, expected a number of metres"),
        ("just some words\n", "no table of taped distances, expected a table with from,to,distance_m"),
        ("", "the file is empty, expected a table with from,to,distance_m"),
    ],
)
def test_what_is_not_understood_is_refused_with_its_columns(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_tape(write(tmp_path / "d.csv", text))
    assert said in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        "time,from,to,distance\n0.1,T,A1,2.5\n0.2,T,A2,2.7\n",
        "from,to,distance,rssi\nT,A1,2.5,-80\nT,A2,2.7,-81\n",
        "anchor;x;y;z\nA1;1;2;3\nA2;2;3;4\n",
    ],
)
def test_a_log_and_a_list_of_anchors_are_no_tape(text: str, tmp_path: Path) -> None:
    path = write(tmp_path / "t.csv", text)
    assert not LENGTHS.is_such(path)
    assert not MARKS.is_such(path)
