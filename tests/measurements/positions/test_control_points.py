"""Control points are read from the canonical CSV, from other tables and from ODM's list, and mistakes are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape_file import read_markers
from rangesfm.measurements.positions.control_point_file import read_control_points
from rangesfm.measurements.positions.control_points import ControlPoints
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError
from rangesfm.options import PointOptions


def read(folder: Path, text: str, markers: str | None = None, **options: object) -> ControlPoints:
    """Write a file and read it."""
    path, markers_path = folder / "points.txt", folder / "markers.csv"
    path.write_text(text)
    found = read_control_points(PointOptions().changed(path=path, **options))
    if markers is None:
        return found
    markers_path.write_text(f"marker,image_name,x_px,y_px\n{markers}")
    return found.with_more(read_markers(markers_path))


def test_the_canonical_table_has_coordinates_stddevs_and_kinds(tmp_path: Path) -> None:
    found = read(
        tmp_path,
        "marker,x_m,y_m,z_m,stddev_m,kind\nA,1,2,3,0.02,control\nB,4,5,6,,check\nC,7,8,9,0.01,\n",
        "A,a.jpg,1,2\nB,a.jpg,3,4\n",
    )
    assert [(p.name, p.stddev_m, p.kind, p.line) for p in found.points] == [
        ("A", 0.02, "control", 2),
        ("B", 0.01, "check", 3),
        ("C", 0.01, "control", 4),
    ]
    np.testing.assert_array_equal(found.positions_m, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert found.stddevs_are_given
    assert list(found.markers) == ["A", "B"]


def test_a_surveyors_table_is_recognised_by_its_columns(tmp_path: Path) -> None:
    found = read(tmp_path, "Punkt;Ost [mm];Nord [mm];Höhe [mm];kind\n7;1000;2000;-500;check\n8;0;0;0;control\n")
    assert [(p.name, p.kind) for p in found.points] == [("7", "check"), ("8", "control")]
    np.testing.assert_array_equal(found.positions_m, [[1, 2, -0.5], [0, 0, 0]])
    assert not found.stddevs_are_given


def test_columns_can_be_named_and_unclear_ones_are_asked_for_by_the_flags_of_points(tmp_path: Path) -> None:
    text = "a,b,c,d\nP,1,2,3\nQ,4,5,6\n"
    found = read(tmp_path, text, columns={"marker": "a", "x": "b", "y": "c", "z": "d"})
    assert [p.name for p in found.points] == ["P", "Q"]
    with pytest.raises(UnclearFileError) as error:
        read(tmp_path, "point,north,east,up,h\nP,1,2,3,4\nQ,4,5,6,5\n")
    assert "a table of points whose columns are not known for sure" in str(error.value)
    assert any("--point_columns marker=point," in choice for choice in map(str, error.value.choices))
    with pytest.raises(UnclearFileError) as error:
        read(tmp_path, text := "point,y,x,z,sigma\nP,1,2,3,0.1\nQ,4,5,6,0.2\n")
    chosen = error.value.choices[0].flags["point_columns"]
    found = read(tmp_path, text, columns=dict(pair.split("=") for pair in chosen.split(",")))
    assert [(p.name, p.stddev_m) for p in found.points] == [("P", 0.1), ("Q", 0.2)]


@pytest.mark.parametrize(
    ("first_line", "crs"),
    [
        ("EPSG:32632", "EPSG:32632"),
        ("WGS84 UTM 32N", "EPSG:32632"),
        ("WGS84 UTM 33S", "EPSG:32733"),
        ("+proj=utm +zone=10 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", None),
    ],
)
def test_the_list_of_odm_has_coordinates_pixels_and_a_coordinate_system(
    tmp_path: Path, first_line: str, crs: str | None
) -> None:
    text = f"{first_line}\n500 600 70.5 10 20 a.jpg north\n500 600 70.5 30 40 b.jpg north\n501 600 71 5 6 a.jpg\n"
    found = read(tmp_path, f"{text}501 600 71 7 8 b.jpg\n")
    assert found.crs == (crs or first_line)
    assert [p.name for p in found.points] == ["north", "point 2"]
    np.testing.assert_array_equal(found.positions_m, [[500, 600, 70.5], [501, 600, 71]])
    assert found.markers["point 2"].image_names == ("a.jpg", "b.jpg")
    np.testing.assert_array_equal(found.markers["north"].pixels, [[10, 20], [30, 40]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file is empty, expected a table with marker,x_m,y_m,z_m"),
        ("marker,x_m,y_m,z_m\n", "names no point, expected one per line"),
        ("marker,x_m,y_m,z_m\nA,1,2,3\nA,1,2,3\n", "points.txt:3: marker is 'A', expected each point once"),
        ("marker,x_m,y_m,z_m,kind\nA,1,2,3,held\n", "points.txt:2: kind is 'held', expected control or check"),
        ("marker,x_m,y_m,z_m\nA,1,,3\n", "points.txt:2: y_m is empty, expected"),
        ("marker,x_m,y_m,z_m,stddev_m\nA,1,2,3,-1\n", "points.txt:2: stddev_m is -1, expected"),
        (
            "EPSG:32632\n1 2 3 4 5 a.jpg\n1 2 three 4 5 a.jpg\n",
            "points.txt:3: geo_z is 'three', expected a number of metres",
        ),
        ("EPSG:32632\n1 2 3 4 5 a.jpg P\n1 2 4 4 5 b.jpg P\n", "points.txt:3: point P has other coordinates than in"),
        ("EPSG:32632\n1 2 3 4 5 a.jpg P\n1 2 3 4 6 a.jpg P\n", "points.txt:3: marker P is twice in a.jpg"),
    ],
)
def test_a_mistake_in_the_file_is_named_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert said in str(error.value)


METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1" enabled="true">
<cameras><camera id="3" label="IMG_1"><reference x="8" y="47" z="400"/></camera><camera id="7" label="IMG_2"/></cameras>
<markers>
<marker id="0" label="A"><reference x="1" y="2" z="3" sx="0.02" sy="0.02" sz="0.03" enabled="true"/></marker>
<marker id="1" label="B"><reference x="4" y="5" z="6" enabled="false"/></marker>
<marker id="2" label="C"/>
</markers>
<frames><frame id="0"><markers>
<marker marker_id="0"><location camera_id="3" pinned="true" x="10.5" y="20"/>
<location camera_id="7" x="11" y="21"/></marker>
<marker marker_id="2"><location camera_id="7" x="5" y="6"/></marker>
</markers></frame></frames>
<reference>PROJCS["WGS 84 / UTM zone 32N",GEOGCS["x",AUTHORITY["EPSG","4326"]],AUTHORITY["EPSG","32632"]]</reference>
</chunk></document>
"""


def test_markers_of_metashape_have_coordinates_and_pixels(tmp_path: Path) -> None:
    found = read(tmp_path, METASHAPE)
    assert [(p.name, p.stddev_m, p.kind, p.line) for p in found.points] == [
        ("A", 0.03, "control", 5),
        ("B", 0.01, "check", 6),
    ]
    np.testing.assert_array_equal(found.positions_m, [[1, 2, 3], [4, 5, 6]])
    assert found.crs == "EPSG:32632"
    assert {name: marker.image_names for name, marker in found.markers.items()} == {
        "A": ("IMG_1", "IMG_2"),
        "C": ("IMG_2",),
    }
    np.testing.assert_array_equal(found.markers["A"].pixels, [[10.5, 20], [11, 21]])
    assert read_markers(tmp_path / "points.txt")["C"].lines == (12,)


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ('z="3"', 'z="high"', 5, "a value is missing or no number"),
        ('marker_id="2"', 'marker_id="9"', 12, "a value is missing or no number"),
        ('camera_id="7" x="11"', 'camera_id="3" x="11"', 11, "marker A is twice in IMG_1"),
        ("</chunk></document>", "</chunk><chunk/></document>", 15, "holds several chunks"),
        ("</chunk></document>", "", 16, "no whole XML file"),
    ],
)
def test_damaged_markers_of_metashape_are_named_with_their_line(
    old: str, new: str, line: int, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said) as refused:
        read(tmp_path, METASHAPE.replace(old, new))
    assert refused.value.line == line
