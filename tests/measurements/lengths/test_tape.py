"""Files of taped distances and markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape_file import read_markers, read_tape


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_distances_are_control_and_good_to_a_centimetre_unless_said_otherwise(tmp_path: Path) -> None:
    path = write(
        tmp_path / "d.csv",
        "from,to,distance_m,stddev_m,kind\na.jpg,b.jpg,2.5,,\ndoor,wall,1.25,0.002,check\nA1,A2,7,0.05,control\n",
    )
    first, second, third = read_tape(path).distances
    assert (first.ends, first.distance_m, first.stddev_m, first.kind) == (("a.jpg", "b.jpg"), 2.5, 0.01, "control")
    assert (second.ends, second.stddev_m, second.kind, second.line) == (("door", "wall"), 0.002, "check", 3)
    assert (third.stddev_m, third.kind) == (0.05, "control")
    assert read_tape(write(path, "from,to,distance_m\na,b,1\n")).distances[0].kind == "control"


def test_marks_are_gathered_by_marker(tmp_path: Path) -> None:
    markers = write(
        tmp_path / "m.csv", "marker,image_name,x_px,y_px\ndoor,a.jpg,1,2\nwall,a.jpg,3,4\ndoor,b.jpg,5,6.5\n"
    )
    found = read_markers(markers)
    assert found["door"].image_names == ("a.jpg", "b.jpg")
    np.testing.assert_array_equal(found["door"].pixels, [[1, 2], [5, 6.5]])
    assert found["door"].lines == (2, 4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("from,to,distance_m\n", "holds no distance"),
        ("from,to,distance_m\na,a,1\n", "d.csv:2: to is 'a', expected another end"),
        ("from,to,distance_m\na,b,0\n", "d.csv:2: distance_m is 0, expected a number of metres from 1e-06 to 1000000"),
        ("from,to,distance_m,stddev_m\na,b,1,-1\n", "d.csv:2: stddev_m is -1, expected a number of metres"),
        ("from,to,distance_m,kind\na,b,1,chek\n", "d.csv:2: kind is 'chek', expected control or check"),
        ("from,to\na,b\n", "distance_m"),
    ],
)
def test_a_wrong_table_of_distances_is_named(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_tape(write(tmp_path / "d.csv", text))
    assert said in str(refused.value)


def test_a_marker_twice_in_one_photo_is_refused(tmp_path: Path) -> None:
    markers = write(tmp_path / "m.csv", "marker,image_name,x_px,y_px\ndoor,a.jpg,1,2\ndoor,a.jpg,5,6.5\n")
    with pytest.raises(InputError, match=r"m.csv:3: marker door is twice in a.jpg, expected once"):
        read_markers(markers)
