"""Bad input ends in one line that names it, the right exit status, and no half-written file."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from PIL import Image
from tests.outputs import names_in, paths_below
from tests.result_document import result_document

from rangesfm.cli import main
from rangesfm.util.files.output_folder import LOCK_NAME

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

Spoil = Callable[[Path], object]
# What places the anchors with the least work: in the first camera's frame the map need not find its place.
ANCHORS = ("--anchors", "anchors_first_camera.csv", "--anchor_frame", "first_camera")
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")


def write(name: str, text: str) -> Spoil:
    return lambda folder: (folder / name).write_text(text)


def remove(name: str) -> Spoil:
    return lambda folder: (folder / name).unlink()


def set_line(name: str, number: int, text: str) -> Spoil:
    """Return a function that replaces one line of a file."""

    def spoil(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[number - 1] = text
        (folder / name).write_text("\n".join(lines) + "\n")

    return spoil


def keep_lines(name: str, numbers: slice) -> Spoil:
    """Return a function that keeps the header row and some of the lines below it."""

    def spoil(folder: Path) -> None:
        header, *lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([header, *lines[numbers]]) + "\n")

    return spoil


def add_tags(folder: Path) -> None:
    header, *lines = (folder / "uwb.csv").read_text().splitlines()
    tagged = [f"{line},T{number % 2}" for number, line in enumerate(lines)]
    (folder / "uwb.csv").write_text("\n".join([f"{header},tag_id", *tagged]) + "\n")


def change_model(change: Callable[[pycolmap.Reconstruction], object]) -> Spoil:
    def spoil(folder: Path) -> None:
        model = pycolmap.Reconstruction(folder / "sparse" / "0")
        change(model)
        model.write(folder / "sparse" / "0")

    return spoil


def stand_still(model: pycolmap.Reconstruction) -> None:
    for frame_id in model.reg_frame_ids():
        model.frame(frame_id).rig_from_world = pycolmap.Rigid3d()


def lose_a_pose(model: pycolmap.Reconstruction) -> None:
    model.frame(3).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.full(3, np.nan))


def remove_points(model: pycolmap.Reconstruction) -> None:
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)


class Refusal:
    """Runs commands that must fail in one folder, and checks what they print and leave."""

    def __init__(self, folder: Path, capfd: pytest.CaptureFixture[str]):
        self._folder = folder
        self._capfd = capfd

    def __call__(self, *argv: str, status: int = 2) -> str:
        """Return the text after ``rangesfm: error:``.

        The output must be one line, and no file may be new, changed or gone.
        """
        before = self._files()
        assert main([*argv, "--quiet"]) == status
        out, err = self._capfd.readouterr()
        assert out == ""
        assert err.count("\n") == 1, err
        assert err.startswith("rangesfm: error: ")
        assert self._files() == before
        return err.removeprefix("rangesfm: error: ").rstrip("\n")

    def _files(self) -> dict[str, int]:
        return {str(path): path.stat().st_mtime_ns for path in paths_below(self._folder) if path.is_file()}


@pytest.fixture
def refusal(own_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Refusal:
    monkeypatch.chdir(own_survey.folder)
    return Refusal(own_survey.folder, capfd)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (remove("uwb.csv"), r"\[ranges\] path: there is no file .*/uwb.csv"),
        (write("uwb.csv", ""), r"/uwb.csv: the file is empty, expected a log of ranges"),
        (write("uwb.csv", "timestamp_s,anchor_id,range_m\n"), r"/uwb.csv: no usable range: no records"),
        (
            set_line("uwb.csv", 7, "103.0,A9,3.0"),
            r"/uwb.csv:7: anchor_id is 'A9', expected one of .*: A1, .*--use_anchors",
        ),
        (set_line("uwb.csv", 9, "103.0,A1,x"), r"/uwb.csv:9: range_m is 'x', expected a positive number of metres"),
        (set_line("uwb.csv", 9, "now,A1,3"), r"/uwb.csv:9: timestamp_s is 'now', expected a time in s"),
        (write("anchors.csv", ""), r"/anchors.csv: "),
        (set_line("anchors.csv", 3, "A2,far,2,3"), r"/anchors.csv:3: x_m is 'far', expected a number of metres"),
        (
            set_line("anchors.csv", 3, "A2,1,,3"),
            r"/anchors.csv:3: y_m is empty, expected all three coordinates or none",
        ),
        (set_line("anchors.csv", 3, "A1,1,2,3"), r"/anchors.csv:3: anchor A1 is in line 2 already"),
        (set_line("images.csv", 4, "frame_00001.jpg,7"), r"/images.csv:4: frame_00001.jpg is in line 2 already"),
        (set_line("images.csv", 4, "frame_00003.jpg,x"), r"/images.csv:4: timestamp_s is 'x', expected a time in s"),
        (
            write("images.csv", "image_name,timestamp_s\nother.jpg,1\n"),
            r"/images.csv: none of the photos has a time, the first is frame_00001.jpg",
        ),
        (set_line("reference.csv", 5, "frame_00004.jpg,1,b,2"), r"/reference.csv:5: y_m is 'b', expected a number"),
        (
            write("reference.csv", "image_name,x_m,y_m,z_m\nother.jpg,1,2,3\n"),
            r"/reference.csv: none of the keyframes is at a known position: .* is of photo 'other.jpg'",
        ),
        (
            write("reference.csv", "timestamp_s,x_m,y_m,z_m\n1,1,2,3\n2,1,2,3\n"),
            r"/reference.csv: none of the keyframes is at a known position: positions are known from 1.000 to 2.000 s",
        ),
        (add_tags, r"/uwb.csv: the log has several tags \(T0, T1\): give each its lever arm"),
        (change_model(lose_a_pose), r"/sparse/0: the pose of frame_00003.jpg is not finite"),
        (change_model(remove_points), r"/sparse/0: the model has no 3-D points to refine"),
    ],
)
def test_spoilt_file_is_named_with_its_line(
    spoil: Spoil, said: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    spoil(own_survey.folder)
    flags = ("--anchors", "anchors.csv", "--reference", "reference.csv", "--output_path", "out")
    assert re.search(said, refusal("refine", *own_survey.flags, *flags))


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--ranges_time_offset", "5000"], r"/uwb.csv: the log's times \(97.000 to .* do not overlap the photos'"),
        (["--tag_id", "T9"], r"/uwb.csv: tag 'T9' is not in the log"),
        (["--use_anchors", "A1,A7"], r"/uwb.csv: anchor 'A7' to be used is not in the log \(A1, A2, A3, A4\)"),
        (["--anchor_frame", "first_camera"], r"anchor frame 'first_camera' needs anchor positions and there are none"),
        (
            ["--tag_in_cam", "-1.2,-90,-66.3"],
            r"tag_in_cam_m is \[-1.2, -90.0, -66.3\], expected .* metres from -20 to 20",
        ),
        (["--tag_in_cam", "nan,0,0"], r"tag_in_cam_m is \[nan, 0.0, 0.0\], expected a list of 3 numbers of"),
        (["--input_path", "."], r"not a COLMAP model, expected cameras, images and points3D files"),
        (["--input_path", "sparse"], r"/sparse: not a COLMAP model, .*; is it .*/sparse/0\?"),
        (["--input_path", "none"], r"/none: no such folder of a COLMAP model, or file of a trajectory"),
        (["--output_path", "uwb.csv"], r"/uwb.csv: cannot write to this output folder"),
        (["--output_path", "uwb.csv/out"], r"/uwb.csv/out: cannot write to this output folder \(Not a directory\)"),
        (["--output_path", "."], r"/images.csv: the results would overwrite this input, expected another output path"),
        (["--images", "sparse"], r"/sparse: no time for frame_00001.jpg: expected a CSV file"),
    ],
)
def test_wrong_flag_is_explained(flags: list[str], said: str, own_survey: WalkedSurvey, refusal: Refusal) -> None:
    output = () if "--output_path" in flags else ("--output_path", "out")
    assert re.search(said, refusal("scale", *own_survey.flags, *flags, *output))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            '[ranges]\npath = "uwb.csv"\nrange_stdev_m = 1\n',
            "s.toml:3: unknown key 'range_stdev_m' in [ranges]; the near",
        ),
        ('[export]\nformats = ["tum", "dxf"]\n', "unknown export format 'dxf', expected one of: colmap, "),
    ],
)
def test_slip_in_the_survey_file_is_found_before_the_work(
    text: str, said: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    (own_survey.folder / "s.toml").write_text(text)
    assert said in refusal("refine", "s.toml", *own_survey.flags, "--output_path", "out")
    assert not (own_survey.folder / "out").exists()


@pytest.mark.parametrize(
    ("spoil", "flags", "said"),
    [
        (change_model(stand_still), (), "the scale is not determined: the camera hardly moved"),
        (keep_lines("uwb.csv", slice(80, 85)), (), "the scale is not determined: 5 of 5 ranges lie on the path"),
        (keep_lines("images.csv", slice(3)), (), "the scale is not determined: .* near 3 keyframes"),
    ],
    ids=["still camera", "few ranges", "few photos"],
)
def test_geometry_that_determines_nothing_is_status_3(
    spoil: Spoil, flags: tuple[str, ...], said: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    spoil(own_survey.folder)
    given = (*own_survey.flags, "--anchors", "anchors.csv", *flags, "--output_path", "out")
    assert re.search(said, refusal("refine", *given, status=3))


@pytest.mark.parametrize("name", MODEL_FILES)
@pytest.mark.parametrize("damage", ["cut", "noise", "gone"])
def test_damaged_model_is_refused_at_once(name: str, damage: str, own_survey: WalkedSurvey, refusal: Refusal) -> None:
    path = own_survey.folder / "sparse" / "0" / name
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(data[: 2 * len(data) // 3] if damage == "cut" else b"\xff" * len(data))
    said = refusal("scale", *own_survey.flags, "--output_path", "out")
    assert re.fullmatch(rf"{own_survey.folder}/sparse/0(/{name})?: .*", said)
    assert not (own_survey.folder / "out").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (keep_lines("anchors.csv", slice(1)), "1 surveyed anchor"),
        (keep_lines("anchors.csv", slice(2)), "2 surveyed anchors"),
    ],
    ids=["one anchor", "two anchors"],
)
def test_anchors_that_cannot_hold_the_site_frame_still_give_the_scale_with_a_warning(
    spoil: Spoil,
    said: str,
    own_survey: WalkedSurvey,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    spoil(own_survey.folder)
    anchors = (own_survey.folder / "anchors.csv").read_text().splitlines()[1:]
    ids = ",".join(line.split(",")[0] for line in anchors)
    monkeypatch.chdir(own_survey.folder)
    flags = ("--anchors", "anchors.csv", "--use_anchors", ids, "--anchor_frame", "site", "--output_path", "out")
    assert main(["scale", *own_survey.flags, *flags]) == 0
    warning = next(line for line in capfd.readouterr().err.splitlines() if said in line)
    assert "the map gets metres, but no place in the site" in warning
    result = json.loads((own_survey.folder / "out" / "result.json").read_text())
    assert result["frame"] == "first_camera"
    assert warning in result["warnings"]
    assert result["scale"]["value"] == pytest.approx(own_survey.site_from_sfm.scale, rel=0.02)


@pytest.mark.parametrize("output", ["loop", "loop/out"])
@pytest.mark.parametrize("command", ["scale", "init"])
def test_links_in_a_circle_are_refused_as_an_output(
    command: str, output: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    (own_survey.folder / "loop").symlink_to("loop")
    flags = (".",) if command == "init" else own_survey.flags
    assert f"/{output}: " in refusal(command, *flags, "--output_path", output)


@pytest.mark.parametrize(("table", "key"), [("output", "path"), ("ranges", "path"), ("mapper", "pairs")])
def test_a_path_that_no_file_can_have_is_refused_with_its_line(
    table: str, key: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    (own_survey.folder / "survey.toml").write_text(f'[{table}]\n{key} = "a\\u0000b"\n')
    assert refusal("check", "survey.toml") == f"survey.toml:2: [{table}] {key} is 'a?b', expected a path"


def test_anchors_that_were_not_where_the_survey_puts_them_are_refused(
    own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    table = "anchor_id,x_m,y_m,z_m\nA1,0,0,1\nA2,2,0,1\nA3,4,0,1\nA4,9,0,1\n"
    (own_survey.folder / "anchors.csv").write_text(table)
    said = refusal("scale", *own_survey.flags, "--anchors", "anchors.csv", "--output_path", "out", status=3)
    assert said.startswith("the scale is only known to ")
    assert not (own_survey.folder / "out" / "result.json").exists()


def test_model_photos_without_a_time_are_counted(
    own_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    set_line("images.csv", 4, "not_there.jpg,102")(own_survey.folder)
    monkeypatch.chdir(own_survey.folder)
    assert main(["scale", *own_survey.flags, *ANCHORS, "--output_path", "out"]) == 0
    assert "1 of 40 photos of the model have no time and are left out\n" in capfd.readouterr().err


def test_failure_leaves_an_earlier_result_as_it_was(
    own_survey: WalkedSurvey, refusal: Refusal, rangesfm_command: Command
) -> None:
    flags = (*own_survey.flags, "--output_path", "out")
    rangesfm_command("scale", *flags, *ANCHORS, cwd=own_survey.folder)
    assert "tag 'T9'" in refusal("refine", *flags, "--tag_id", "T9")
    keep_lines("uwb.csv", slice(80, 85))(own_survey.folder)
    assert "not determined" in refusal("refine", *flags, status=3)
    assert (own_survey.folder / "out" / "result.json").is_file()


@pytest.mark.parametrize("command", ["compare", "export", "report"])
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (write("result.json", '{"frame":\n'), "out/result.json:2: not JSON"),
        (write("result.json", "{}\n"), "out/result.json: 'scale' is missing"),
        (write("sparse_scaled/0/images.bin", "x" * 99), "out/sparse_scaled/0/images.bin: is damaged or cut off"),
    ],
    ids=["cut", "empty", "model"],
)
def test_damaged_result_is_named(
    command: str, spoil: Spoil, said: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    out = own_survey.folder / "out"
    shutil.copytree(own_survey.folder / "sparse", out / "sparse_scaled")
    (out / "result.json").write_text(json.dumps(result_document()))
    spoil(out)
    reference = ("--reference", "reference.csv") if command == "compare" else ()
    assert said in refusal(command, "out", *reference)


class TestPhotos:
    """Folders of photos from which nothing can be reconstructed."""

    @pytest.fixture
    def photos(self, own_survey: WalkedSurvey) -> Path:
        """Five pictures of different patterns, a second apart, in the folder of the survey."""
        folder = own_survey.folder / "photos"
        folder.mkdir()
        rng = np.random.default_rng(0)
        for number in range(5):
            cells = Image.fromarray(rng.integers(0, 255, (48, 64), dtype=np.uint8))
            cells.resize((320, 240), Image.Resampling.BICUBIC).save(folder / f"{number}.png")
        times = "".join(f"{number}.png,{110 + number}\n" for number in range(5))
        (own_survey.folder / "photos.csv").write_text("image_name,timestamp_s\n" + times)
        return folder

    flags = ("--images", "photos", "--image_times", "photos.csv", "--ranges", "uwb.csv", "--output_path", "out")

    def test_that_are_not_there(self, refusal: Refusal, own_survey: WalkedSurvey) -> None:
        flags = ("--ranges", "uwb.csv", "--output_path", "out")
        assert "/photos: no such folder of photos" in refusal("run", "--images", "photos", *flags)
        (own_survey.folder / "photos").mkdir()
        assert "/photos: no photos (jpg " in refusal("run", "--images", "photos", *flags)

    @pytest.mark.usefixtures("photos")
    @pytest.mark.parametrize(
        ("line", "text", "said"),
        [
            (3, "0.png,111", r"/photos.csv:3: 0.png is in line 2 already, expected one row per photo"),
            (3, "1b.png,111", r"/photos.csv:3: image_name is '1b.png', expected the name of a photo in the folder"),
            (3, "1.png,110", r"/photos.csv:3: 1.png has the same time as 0.png in line 2, expected another"),
        ],
    )
    def test_whose_times_are_wrong(
        self, line: int, text: str, said: str, own_survey: WalkedSurvey, refusal: Refusal
    ) -> None:
        set_line("photos.csv", line, text)(own_survey.folder)
        assert re.search(said, refusal("run", *self.flags))

    @pytest.mark.usefixtures("photos")
    @pytest.mark.parametrize(
        ("flags", "said"),
        [
            (("--ranges_time_offset", "999"), r"/uwb.csv: the log's times .* do not overlap the photos'"),
            (("--reference", "reference.csv"), r"/reference.csv: none of the keyframes is at a known position"),
            (("--camera_model", "PINHOL"), r"\[camera\] model is 'PINHOL', expected .* the nearest is 'PINHOLE'"),
            (
                ("--camera_model", "PINHOLE", "--camera_params", "300,160,120"),
                r"\[camera\] params has 3 numbers, expected 4 for PINHOLE \(fx, fy, cx, cy\)",
            ),
            (("--camera_params", "300,160,120"), r"\[camera\] has params but no model"),
            (("--max_num_keyframes", "2"), r"max_num_keyframes is 2, expected a whole number from 3 to 1000000"),
            (("--output_path", "uwb.csv/out"), r"/uwb.csv/out: cannot write to this output folder"),
        ],
    )
    def test_whose_flags_are_wrong_are_not_even_looked_at(
        self, flags: tuple[str, ...], said: str, own_survey: WalkedSurvey, refusal: Refusal
    ) -> None:
        assert re.search(said, refusal("run", *self.flags, *flags))
        assert not (own_survey.folder / "out").exists()

    @pytest.mark.parametrize("kind", ["unrelated", "black", "no pictures"])
    def test_that_do_not_reconstruct_are_status_4(
        self,
        kind: str,
        photos: Path,
        own_survey: WalkedSurvey,
        monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str],
    ) -> None:
        for path in photos.iterdir():
            if kind == "black":
                Image.new("L", (320, 240)).save(path)
            elif kind == "no pictures":
                path.write_text("not a photo")
        monkeypatch.chdir(own_survey.folder)
        assert main(["run", *self.flags, "--quiet"]) == 4
        out, err = capfd.readouterr()
        assert out == ""
        said = {
            "unrelated": "no two of 5 photos match: .*/mapper.log.*",
            "black": "0 of 5 photos have 50 features or more, .*",
            "no pictures": ".*: 0 of 5 photos can be used, expected .*",
        }
        assert re.fullmatch(f"rangesfm: error: {said[kind]}\n", err)
        assert_nothing_half_written(own_survey.folder / "out")
        assert not (own_survey.folder / "out" / "sparse").exists()


def assert_nothing_half_written(folder: Path) -> None:
    """Check that nothing here could be taken for a result, or for a part of one."""
    names = [path.name for path in paths_below(folder)]
    assert "result.json" not in names
    assert not [name for name in names if name.endswith((".part", ".old")) or name.startswith(".")]


def test_format_that_cannot_be_written_costs_neither_the_result_nor_the_others(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    flags = (*ANCHORS, "--formats", "undistorted,kml,ply", "--output_path", "out", "--quiet")
    done = rangesfm_command("scale", *own_survey.flags, *flags, cwd=own_survey.folder, status=2)
    first, second, written = done.stderr.splitlines()
    assert "2 of 3 formats could not be written: undistorted: the format 'undistorted' needs the photos" in first
    assert "kml: the format 'kml' needs a georeferenced map" in second
    assert written == "  these were written: ply"
    names = set(names_in(own_survey.folder / "out"))
    assert {"result.json", "report.html", "points.ply"} <= names


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Return a function that starts a command as a terminal does, so that Ctrl-C is not ignored."""
    started = []

    def start_command(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "rangesfm", *arguments],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        started.append(process)
        return process

    yield start_command
    for process in started:
        process.kill()
        process.communicate()


HANGS_AFTER_S = 600.0  # much longer than a loaded machine takes


def interrupt_when(happened: Callable[[], bool], process: subprocess.Popen[str], by: signal.Signals) -> list[str]:
    """Send a signal as soon as something has happened; return the process's messages."""
    deadline = time.monotonic() + HANGS_AFTER_S
    while not happened():
        assert process.poll() is None, "the process ended before"
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(by)
    out, err = process.communicate(timeout=HANGS_AFTER_S)
    assert process.returncode == 130
    assert out == ""
    assert "Traceback" not in err
    return err.splitlines()


@pytest.mark.skipif(sys.platform != "linux", reason="sees in /proc what has been loaded")
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_ctrl_c_or_sigterm_ends_a_command_in_one_line(
    by: signal.Signals, own_survey: WalkedSurvey, start: Callable[..., subprocess.Popen[str]]
) -> None:
    flags = ("--anchors", "anchors.csv", "--output_path", "out")
    process = start("refine", *own_survey.flags, *flags, cwd=own_survey.folder)
    maps = Path(f"/proc/{process.pid}/maps")
    lock = own_survey.folder / "out" / LOCK_NAME
    # These two libraries would print a stack trace.
    lines = interrupt_when(lambda: lock.exists() and {"_core", "pyceres"} <= loaded(maps.read_text()), process, by)
    assert lines[-1] == "rangesfm: error: interrupted; stages that were done are kept"
    assert all(line.startswith(("scale", "refinement", "judgement", "rangesfm: error")) for line in lines)
    assert not (own_survey.folder / "out").exists()


def loaded(maps: str) -> set[str]:
    """Return the names of the libraries that a process has loaded, up to their first dot."""
    return {Path(line.split()[-1]).name.partition(".")[0] for line in maps.splitlines() if "/" in line}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            "[refine]\n[refine.bundle_adjustment]\nrefine_extra_parms = true",
            r"^survey.toml:3: unknown key 'refine_extra_parms' in .*; the nearest known one is 'refine_extra_params'",
        ),
        (
            "[refine]\nbundle_adjustment.print_summary = 3",
            r"^survey.toml:2: .* print_summary is 3, expected true or false",
        ),
        ("[refine.bundle_adjustment.ceres]\nloss_scle = 1", r"^survey.toml:2: unknown key 'loss_scle' in \[refine.bun"),
    ],
)
def test_option_that_the_adjustment_does_not_take_is_named_with_its_line(
    content: str, said: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    (own_survey.folder / "survey.toml").write_text(content)
    assert re.search(said, refusal("refine", "survey.toml", *own_survey.flags, "--output_path", "out"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[mapper]\n\nmin_num_machtes = 3", r"^survey.toml:3: unknown key 'min_num_machtes'"),
        ("[mapper]\nranges_in_mapping = true", r"^survey.toml:2: unknown key 'ranges_in_mapping' in \[mapper"),
        (
            "[mapper.pipeline]\nmin_num_matches = 'x'",
            r"^survey.toml:2: .* min_num_matches is 'x', expected a whole numb",
        ),
        ("[mapper]\n[mapper.features.sift]\nnum_octavs = 3", r"^survey.toml:3: unknown key 'num_octavs'"),
        ("[mapper.matcher]\nnum_threads = 0\nuse_gpuu = true", r"^survey.toml:3: unknown key 'use_gpuu'"),
    ],
)
def test_option_that_the_mapper_does_not_take_is_named_with_its_line(
    content: str, said: str, own_survey: WalkedSurvey, refusal: Refusal
) -> None:
    (own_survey.folder / "photos").mkdir()
    for name in "abc":
        (own_survey.folder / "photos" / f"{name}.jpg").touch()
    (own_survey.folder / "survey.toml").write_text(content)
    assert re.search(said, refusal("reconstruct", "survey.toml", "--images", "photos", "--output_path", "out"))
