"""Numbers that are formally right: beyond their bounds they are refused in one line, at them a command calculates."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers import read_anchors_in_log, read_ranges
from rangesfm.options import BIAS_M, COORDINATE_M, LENGTH_M, PIXEL, STDDEV_M, TIME_S
from rangesfm.sfm.image_times import find_image_times

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey

FLAGS = ("--anchors", "anchors.csv", "--reference", "reference.csv", "--output_path", "out", "--quiet")
TAPED = ("--distances", "distances.csv", "--markers", "markers.csv")
CURVE = ("--error_curve", "curve.csv")
# By file and column: the flags that have it read, and the bounds of its numbers.
COLUMNS = {
    ("uwb.csv", "timestamp_s"): ((), TIME_S),
    ("uwb.csv", "range_m"): ((), LENGTH_M),
    ("uwb.csv", "range_stddev_m"): ((), STDDEV_M),
    ("anchors.csv", "x_m"): ((), COORDINATE_M),
    ("anchors.csv", "position_stddev_m"): ((), STDDEV_M),
    ("anchors.csv", "range_bias_m"): ((), BIAS_M),
    ("anchors.csv", "range_bias_stddev_m"): ((), STDDEV_M),
    ("images.csv", "timestamp_s"): ((), TIME_S),
    ("reference.csv", "z_m"): ((), COORDINATE_M),
    ("distances.csv", "distance_m"): (TAPED, LENGTH_M),
    ("distances.csv", "stddev_m"): (TAPED, STDDEV_M),
    ("markers.csv", "x_px"): (TAPED, PIXEL),
    ("curve.csv", "distance_m"): (CURVE, LENGTH_M),
    ("curve.csv", "error_m"): (CURVE, BIAS_M),
    ("curve.csv", "stddev_m"): (CURVE, STDDEV_M),
    ("curve.csv", "noise_stddev_m"): (CURVE, STDDEV_M),
}
MORE_FILES = {
    "distances.csv": "from,to,distance_m,stddev_m\nframe_00001.jpg,frame_00011.jpg,9,0.02\nm,m2,1,0.02\n",
    "markers.csv": "marker,image_name,x_px,y_px\nm,frame_00001.jpg,9,9\nm,frame_00002.jpg,9,9\n",
    "curve.csv": "distance_m,error_m,stddev_m,noise_stddev_m\n1,0.02,0.01,0.03\n9,0.01,0.01,0.03\n20,0,0.01,0.03\n",
}


@pytest.fixture
def folder(own_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A survey in which every column has numbers."""
    monkeypatch.chdir(own_survey.folder)
    for name, text in MORE_FILES.items():
        Path(name).write_text(text)
    for name, more in (
        ("uwb.csv", {"range_stddev_m": "0.05"}),
        ("anchors.csv", {"position_stddev_m": "0.02", "range_bias_m": "0.01", "range_bias_stddev_m": "0.03"}),
    ):
        header, *rows = Path(name).read_text().splitlines()
        rows = [",".join([row, *more.values()]) for row in rows]
        Path(name).write_text("\n".join([",".join([header, *more]), *rows]) + "\n")
    return own_survey.folder


def put(path: Path, column: str, value: float, rows: slice) -> None:
    header, *lines = path.read_text().splitlines()
    cells = [line.split(",") for line in lines]
    for row in cells[rows]:
        row[header.split(",").index(column)] = repr(value)
    path.write_text("\n".join([header, *map(",".join, cells)]) + "\n")


@pytest.mark.parametrize(
    ("name", "column", "number"),
    [
        (name, column, number)
        for (name, column), (_, bounds) in COLUMNS.items()
        for number in (1e-300, 1e-20, -1e-160, 1e12, 1e160, -1e300)
        # A range that no radio can measure is no measurement, and is left out.
        if not bounds.hold(number) and column != "range_m"
    ],
)
def test_a_cell_beyond_the_bounds_is_refused_in_one_line(
    name: str,
    column: str,
    number: float,
    folder: Path,
    own_survey: WalkedSurvey,
    capfd: pytest.CaptureFixture[str],
) -> None:
    flags, _ = COLUMNS[name, column]
    put(folder / name, column, number, slice(1, 2))
    assert main(["refine", *own_survey.flags, *FLAGS, *flags]) == 2
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"rangesfm: error: {folder / name}:3: {column} is ")
    assert ", expected " in err
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("name", "column", "number"),
    [
        ("uwb.csv", "range_stddev_m", STDDEV_M.least),
        ("uwb.csv", "range_stddev_m", STDDEV_M.most),
        ("anchors.csv", "position_stddev_m", STDDEV_M.least),
        ("anchors.csv", "range_bias_stddev_m", STDDEV_M.least),
        ("anchors.csv", "x_m", COORDINATE_M.most),
        ("curve.csv", "stddev_m", STDDEV_M.most),
    ],
)
def test_cells_at_the_bounds_are_calculated_with(
    name: str,
    column: str,
    number: float,
    folder: Path,
    own_survey: WalkedSurvey,
    capfd: pytest.CaptureFixture[str],
) -> None:
    put(folder / name, column, number, slice(None))
    flags, _ = COLUMNS[name, column]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["scale", *own_survey.flags, *FLAGS, *flags]) in (0, 2, 3)
    assert capfd.readouterr().err.count("rangesfm: error: internal") == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("range2 1.5 5.0 1e-300 1 2 A 0\n", "range_stddev_m is 1e-150, expected a number of metres from 1e-06"),
        ("range2 99999999999 5.0 0.01 1 2 A 0\n", "timestamp_s is 1e\\+11, expected a number of seconds from"),
    ],
)
def test_numbers_that_a_radio_prints_have_the_same_bounds(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=f"log.txt:1: {said}"):
        read_ranges(path, format="librsf")


def test_places_of_anchors_in_a_log_have_the_same_bounds_as_in_a_table(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text("range3 1.5 5.0 0.01 1 2 1e300 A 0\n")
    with pytest.raises(InputError, match=r"log.txt: the position of anchor A is not one, expected a number of metres"):
        read_anchors_in_log(path, format="librsf")


@pytest.mark.parametrize("name", ["9" * 400, "9" * 5000, f"{'9' * 30}.500"])
def test_a_photos_name_of_very_many_digits_is_no_time(name: str) -> None:
    times = find_image_times("nowhere", [*(f"{k}.{k}00.jpg" for k in range(1, 4)), f"{name}.jpg"])
    assert times.num_left_out == 1


def test_a_photo_of_the_year_1_is_taken_to_have_no_time(tmp_path: Path) -> None:
    for k, date in enumerate(["0001:01:01 00:00:00", "2020:01:01 00:00:00", "2020:01:01 00:00:01"]):
        image, exif = Image.new("L", (8, 8)), Image.Exif()
        exif.get_ifd(0x8769).update({0x9003: date, 0x9011: "+14:00"})
        image.save(tmp_path / f"{k}.jpg", exif=exif)
    times = find_image_times(tmp_path, ["0.jpg", "1.jpg", "2.jpg"])
    assert times.image_names == ("1.jpg", "2.jpg")


PLAN = "[anchors.places]\nA = [-4, -4, 0.5]\nB = [4, -4, 2.5]\nC = [4, 4, 0.7]\nD = [-4, 4, 2.2]\n"
WAY = "waypoints = [[-2, -2, 1.5], [2, -2, 1.6], [2, 2, 1.4], [-2, 2, 1.5]]\n"


@pytest.mark.parametrize(
    ("text", "status", "said"),
    [
        (PLAN.replace("[", "[anchors]\nposition_stddev_m = 1e-160\n[", 1) + f"[path]\n{WAY}", 2, "position_stddev_m"),
        (PLAN + f"[path]\nspeed_m_per_s = 100.0\n{WAY}", 3, "0 of 0 ranges"),
        (PLAN + f"[path]\n{WAY}[radio]\nrate_hz = 0.001\n", 3, "0 of 0 ranges"),
        (PLAN + f"[path]\n{WAY}[photos]\nseen_m = [0.01, 0.010001]\n", 3, "no two photos see the same point"),
        (
            f"[anchors]\nnum_to_place = 2\nwalls_m = [[[0, 0], [1e-320, 0]]]\nheights_m = [0, 2]\n[path]\n{WAY}",
            2,
            "walls_m is ",
        ),
    ],
)
def test_a_plan_at_the_bounds_of_its_keys_ends_in_one_line_or_in_a_page_that_refuses_it(
    text: str,
    status: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plan.toml").write_text(text)
    assert main(["plan", "plan.toml", "--output_path", "out", "--quiet"]) == status
    err = capfd.readouterr().err
    if status == 2:
        assert err.count("\n") == 1
        assert said in err
    else:
        assert err == ""
        assert said in json.loads(Path("out/plan.json").read_text())["reasons"][0]
        assert Path("out/plan.html").exists()


def test_bounds_hold_for_each_number_of_an_array() -> None:
    assert STDDEV_M.hold(np.array([0.0, 1e-6, 1e3, 1e4, np.nan])).tolist() == [False, True, True, False, False]
