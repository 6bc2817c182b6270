"""``rangesfm trilaterate`` locates anchors, and the other commands can read the file it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.simulated.path import loop_path

from rangesfm.cli import main
from rangesfm.demo.simulated_radio import Radio, simulate_ranges
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.sfm.image_times import read_image_times_csv
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.reference import Reference, write_reference
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

Array = npt.NDArray[np.float64]

ANCHORS_M = {"A1": (-6.0, -5.0, 4.5), "A2": (6.0, -5.0, -1.5)}
TAG_IN_CAM_M = (0.1, -0.2, 0.05)
TIME_OFFSET_S = 3.0


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a flight: ``uwb.csv``, and its positions as ``flight.csv`` (camera) and ``tag.csv`` (tag)."""
    path = loop_path(40.0, height_amplitude_m=1.5, seed=3)
    radio = Radio(rate_hz=4.0, range_stddev_m=0.03, obstructed_share=0.1, time_offset_s=TIME_OFFSET_S)
    write_ranges_csv(simulate_ranges(path, ANCHORS_M, TAG_IN_CAM_M, radio, seed=5), tmp_path / "uwb.csv")
    times = np.arange(0.0, 40.0, 0.1)
    centers, turns = path.centers(times), path.world_from_cam(times)
    write_reference(Reference(centers, ByTime(times), world_from_cam=turns), tmp_path / "flight.csv")
    write_reference(Reference(centers + turns @ TAG_IN_CAM_M, ByTime(times)), tmp_path / "tag.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def positions_in(path: Path) -> dict[str, Array | None]:
    return {anchor.anchor_id: anchor.position_m for anchor in read_anchors(path)}


def write_flat(folder: Path) -> None:
    """Write ranges taken at named places in a plane: ``places.csv`` and ``uwb_places.csv``."""
    places = np.array([(x, y, 1.0) for x in (-3.0, 0.0, 3.0) for y in (-2.0, 0.0, 2.0, 4.0)])
    names = [f"p{k}" for k in range(len(places))]
    write_reference(Reference(places, ByPhoto(tuple(names))), folder / "places.csv")
    ids = [anchor_id for anchor_id in ANCHORS_M for _ in names]
    ranges = [float(np.linalg.norm(place - anchor)) for anchor in ANCHORS_M.values() for place in places]
    write_ranges_csv(RangeLog.from_arrays(ids, ranges, image_name=names * len(ANCHORS_M)), folder / "uwb_places.csv")


@pytest.mark.parametrize(
    "positions",
    [("tag.csv",), ("flight.csv", "--tag_in_cam", ",".join(map(str, TAG_IN_CAM_M)))],
    ids=["tag", "camera and lever arm"],
)
def test_anchors_are_found_and_written(
    positions: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ("--positions", *positions, "--time-offset", "3", "--output_path", "anchors.csv")
    assert main(["trilaterate", "uwb.csv", *flags]) == 0
    text = capsys.readouterr().out
    for anchor in read_anchors("anchors.csv"):
        assert anchor.position_m is not None
        off_m = float(np.linalg.norm(anchor.position_m - ANCHORS_M[anchor.anchor_id]))
        assert off_m < min(2 * anchor.position_stddev_m, 0.1)
        assert 0 < anchor.position_stddev_m < 0.2  # range errors that depend on direction may bias the position
        assert anchor.range_bias_stddev_m is not None
        assert f"\n{anchor.anchor_id}    " in text
    assert "written to anchors.csv" in text


def test_written_anchors_hold_a_survey_in_their_frame(
    walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    photo_times = read_image_times_csv(walked_survey.folder / "images.csv").by_name()
    model = pycolmap.Reconstruction(walked_survey.folder / "sparse" / "0")
    placed = walked_survey.site_from_sfm
    path = trajectory_from_reconstruction(model, photo_times).transformed(placed)
    known = Reference(path.centers, ByTime(path.times_s), path.world_from_cam)
    write_reference(known, tmp_path / "known.csv")
    offset = walked_survey.flags[-1]
    flags = ("--positions", tmp_path / "known.csv", "--tag_in_cam", walked_survey.flags[-3], "--time_offset", offset)
    given = ("--max_interpolation_gap_s", "1.5", "--side", "A1=below,A2=above,A3=below,A4=above")
    output = ("--output_path", tmp_path / "anchors.csv")
    rangesfm_command("trilaterate", "uwb.csv", *flags, *given, *output, cwd=walked_survey.folder)
    survey = (*walked_survey.flags, "--anchors", tmp_path / "anchors.csv", "--output_path", tmp_path / "out")
    rangesfm_command("scale", *survey, cwd=walked_survey.folder)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["frame"] == "site"
    assert result["scale"]["value"] == pytest.approx(walked_survey.site_from_sfm.scale, rel=0.02)


class TestPlacesInAPlane:
    def test_both_answers_are_printed_and_neither_is_written(
        self, folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_flat(folder)
        assert main(["trilaterate", "uwb_places.csv", "--positions", "places.csv", "--output_path", "a.csv"]) == 0
        lines = capsys.readouterr().out.splitlines()
        row = next(number for number, line in enumerate(lines) if line.startswith("A1"))
        heights = sorted([float(lines[row].split()[6]), float(lines[row + 1].split()[3])])
        np.testing.assert_allclose(heights, [-2.5, 4.5], atol=0.01)
        assert "choose with --side" in lines[row + 1]
        assert positions_in(folder / "a.csv") == {"A1": None, "A2": None}

    @pytest.mark.parametrize(
        ("side", "heights"),
        [
            ("above", {"A1": 4.5, "A2": 3.5}),
            ("z-", {"A1": -2.5, "A2": -1.5}),
            ("above,A2=below", {"A1": 4.5, "A2": -1.5}),
        ],
    )
    def test_a_word_chooses(self, side: str, heights: dict[str, float], folder: Path) -> None:
        write_flat(folder)
        flags = ("--positions", "places.csv", "--side", side, "--output_path", "a.csv")
        assert main(["trilaterate", "uwb_places.csv", *flags]) == 0
        for anchor_id, position in positions_in(folder / "a.csv").items():
            assert position is not None
            np.testing.assert_allclose(position, [*ANCHORS_M[anchor_id][:2], heights[anchor_id]], atol=0.01)

    @pytest.mark.parametrize("height", ["A1=4.5,A2=-1.5", "4.5,A2=-1.5"])
    def test_a_known_height_leaves_one_place(self, height: str, folder: Path) -> None:
        write_flat(folder)
        flags = ("--positions", "places.csv", "--height", height, "--output_path", "a.csv")
        assert main(["trilaterate", "uwb_places.csv", *flags]) == 0
        for anchor_id, position in positions_in(folder / "a.csv").items():
            assert position is not None
            np.testing.assert_allclose(position, ANCHORS_M[anchor_id], atol=0.01)


def test_an_anchor_that_is_not_determined_is_told_beside_the_others(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (folder / "uwb.csv").open("a") as file:
        file.writelines(f"{time},A9,5.0\n" for time in (1.0, 2.0))
    flags = ("--positions", "tag.csv", "--time_offset", "3", "--output_path", "a.csv")
    assert main(["trilaterate", "uwb.csv", *flags]) == 0
    assert "2 ranges at known positions of the tag, 4 are needed" in capsys.readouterr().out
    assert positions_in(folder / "a.csv")["A9"] is None


class TestRefusal:
    def refusal(self, capfd: pytest.CaptureFixture[str], *flags: str, status: int = 2) -> str:
        given = flags if "--positions" in flags else (*flags, "--positions", "tag.csv")
        assert main(["trilaterate", "uwb.csv", *given, "--output_path", "a.csv", "--quiet"]) == status
        out, err = capfd.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert not Path("a.csv").exists()
        return err

    @pytest.mark.parametrize(
        ("flags", "said"),
        [
            (("--positions", "none.csv"), "none.csv: no such file"),
            (
                ("--time_offset", "1000"),
                "uwb.csv: none of the ranges is at a known position: positions are known from ",
            ),
            (("--time_offset", "nan"), "'nan' is not a number of seconds from -1e+10 to 1e+10"),
            (("--max_interpolation_gap_s", "1e300"), "'1e300' is not a number of seconds from 0 to"),
            (("--tag_in_cam", "0.1,0,0"), "a lever arm needs the rotations"),
            (("--side", "left"), "'left' is not a side, expected one of above, below"),
            (("--side", "A7=above"), "--side: anchor 'A7' is not in the log (A1, A2)"),
            (("--height", "high"), "'high' is not a number of metres from"),
            (("--height", "A1=inf"), "'inf' is not a number of metres from"),
            (("--height", "A7=1"), "--height: anchor 'A7' is not in the log (A1, A2)"),
            (("--tag_id", "T"), "tag 'T' is not in the log"),
            (("--range_stddev_m", "0"), "'0' is not a number of metres from 1e-06 to 1000"),
            (("--range_bias_stddev_m", "-1"), "'-1' is not 0, or a number of metres from 1e-06 to 1000"),
            (("--positon", "tag.csv"), "the nearest known one is --positions"),
        ],
    )
    def test_of_bad_input_is_one_line(
        self, flags: tuple[str, ...], said: str, folder: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        assert said in self.refusal(capfd, *flags)

    def test_of_a_spoilt_position_names_its_line(self, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
        (folder / "tag.csv").write_text("timestamp_s,x_m,y_m,z_m\n0,1,2,3\n1,1,b,3\n")
        assert "tag.csv:3: y_m is 'b', expected a number" in self.refusal(capfd)

    def test_of_positions_on_a_line_is_status_3(self, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
        line = np.outer(np.arange(0.0, 40.0, 0.1), [0.1, 0.05, 0.0])
        write_reference(Reference(line, ByTime(np.arange(0.0, 40.0, 0.1))), folder / "tag.csv")
        distances = np.linalg.norm(line[::4] - [1.0, 4.0, 2.0], axis=1)
        log = RangeLog.from_arrays(["A1"] * len(distances), distances, timestamp_s=np.arange(0.0, 40.0, 0.4))
        write_ranges_csv(log, folder / "uwb.csv")
        assert "anchor A1: the position is not determined: the tag's positions lie on a line" in self.refusal(
            capfd, status=3
        )
