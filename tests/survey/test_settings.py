"""A survey file determines what a run does; its errors are named with their line."""

from __future__ import annotations

import contextlib
import json
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.refused import refused

from rangesfm.errors import InputError
from rangesfm.mapper_options import MapperOptions
from rangesfm.measurements.ranges.twr import DW1000_TICK_S, VACUUM_M_PER_S, StampOptions
from rangesfm.options import OutputOptions
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import input_paths, read_survey, survey_from_tables

WHOLE = """
[images]
path = "images"            # folder
times = "images.csv"
every_nth = 3
[camera]
model = "OPENCV"
params = [377.25, 431.78, 308, 231.32, -0.0138, 0.0603, -0.0011, 0.0039]
[ranges]
path = "uwb.csv"
time_offset = "auto"
columns = { timestamp = "t", anchor_id = "node", range = "d" }
range_unit = "cm"
max_interpolation_gap_s = 1
range_stddev_m = 0.1
[anchors]
path = "anchors.csv"
frame = "site"
[tag]
tag_in_cam_m = [-0.0012, -0.0900, -0.0663]
[mapper]
matching = "sequential"
ba_refine_focal_length = false
[mapper.pipeline]
min_num_matches = 20
[mapper.features]
max_image_size = 1200
[scale]
method = "two-candidate"
[refine]
enabled = false
[refine.bundle_adjustment]
refine_extra_params = false
[export]
formats = ["tum"]
[report]
reference = "truth.csv"
enabled = false
[output]
path = "result"
seed = 7
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("images.csv", "uwb.csv", "anchors.csv", "truth.csv"):
        (tmp_path / name).touch()
    return tmp_path


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "survey.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


refusal = partial(refused, read_survey)


def test_whole_survey_is_read(folder: Path) -> None:
    survey = read_survey(write(folder, WHOLE))
    assert survey.images.path == folder / "images"
    assert survey.images.times == folder / "images.csv"
    assert survey.images.every_nth == 3
    assert survey.camera.model == "OPENCV"
    assert survey.camera.params
    assert survey.camera.params[:3] == (377.25, 431.78, 308.0)
    assert survey.ranges.path == folder / "uwb.csv"
    assert survey.ranges.time_offset_s is None
    assert survey.ranges.columns == {"timestamp": "t", "anchor_id": "node", "range": "d"}
    assert survey.ranges.range_unit == "cm"
    assert survey.ranges.max_interpolation_gap_s == 1.0
    assert survey.ranges.range_stddev_m == 0.1
    assert (survey.anchors.path, survey.anchors.frame) == (folder / "anchors.csv", "site")
    assert survey.tag.tag_in_cam_m == (-0.0012, -0.09, -0.0663)
    assert survey.scale.method == "two-candidate"
    assert not survey.refine.enabled
    assert survey.refine.bundle_adjustment == {"refine_extra_params": False}
    assert (survey.export.formats, survey.report.enabled) == (("tum",), False)
    assert (survey.report.reference, survey.output.path, survey.output.seed) == (
        folder / "truth.csv",
        folder / "result",
        7,
    )


SEVERAL_CAMERAS = """
[[camera]]
images = "left"
model = "PINHOLE"
[[camera]]
model = "OPENCV"
[[camera]]
images = "right*.png"
mode = "single"
"""


def test_several_cameras_are_one_for_all_photos_and_others_by_pattern(folder: Path) -> None:
    camera = read_survey(write(folder, SEVERAL_CAMERAS), {"camera.mode": "per_image"}).camera
    assert (camera.model, camera.mode, camera.images) == ("OPENCV", "per_image", "")
    assert [(table.images, table.model, table.mode) for table in camera.others] == [
        ("left", "PINHOLE", "auto"),
        ("right*.png", "", "single"),
    ]
    assert camera.of_photo("left/1.jpg") is camera.others[0]
    assert camera.of_photo("leftover/1.jpg") is camera
    wrong = refusal(write(folder, SEVERAL_CAMERAS.replace('"single"', '"singel"')))
    assert (wrong.line, str(wrong).count("[camera] mode is 'singel'")) == (9, 1)
    assert "2 [[camera]] tables have no key images" in str(refusal(write(folder, SEVERAL_CAMERAS + "[[camera]]")))


def test_mapper_keys_that_are_not_ours_are_the_pipelines(folder: Path) -> None:
    assert read_survey(write(folder, WHOLE)).mapper == MapperOptions(
        matching="sequential",
        features={"max_image_size": 1200},
        pipeline={"ba_refine_focal_length": False, "min_num_matches": 20},
    )


def test_words_on_gravity_and_side_are_read(folder: Path) -> None:
    survey = read_survey(write(folder, '[scale]\nup_in_first_camera = [0, -1, 0]\ncamera_side = "below"\n'))
    assert survey.scale.up_in_first_camera == (0.0, -1.0, 0.0)
    assert survey.scale.camera_side == "below"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("up_in_first_camera = [0, 0, 0]", "a direction, not 0,0,0"),
        ("up_in_first_camera = [0, 1]", "3"),
        ('camera_side = "left"', "one of above, below"),
    ],
)
def test_a_word_on_gravity_or_side_that_says_nothing_is_refused(folder: Path, line: str, said: str) -> None:
    error = refusal(write(folder, f"[scale]\n{line}\n"))
    assert said in str(error)
    assert error.line == 2


def test_empty_survey_has_the_defaults(folder: Path) -> None:
    assert read_survey(write(folder, "")) == Survey(output=OutputOptions(path=folder / "out"))


def test_relative_path_of_the_survey_still_gives_absolute_paths(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder, '[images]\npath = "photos"')
    monkeypatch.chdir(folder)
    assert read_survey("survey.toml").images.path == folder / "photos"


@pytest.mark.parametrize(("given", "seconds"), [('"auto"', None), ("-3600.37", -3600.37), ("12", 12.0)])
def test_time_offset_is_auto_or_seconds(folder: Path, given: str, seconds: float | None) -> None:
    assert read_survey(write(folder, f"[ranges]\ntime_offset = {given}")).ranges.time_offset_s == seconds


def test_several_tags_have_a_lever_arm_each(folder: Path) -> None:
    survey = read_survey(write(folder, "[tag.lever_arms_m]\n7 = [1, 2, 3]\nB2 = [0.1, 0, 0]\n"))
    assert survey.tag.lever_arms_m == {"7": (1.0, 2.0, 3.0), "B2": (0.1, 0.0, 0.0)}


def test_lever_arms_given_by_flag_take_the_place_of_those_in_the_file(folder: Path) -> None:
    one, several = "[tag]\ntag_in_cam_m = [1, 2, 3]\n", "[tag.lever_arms_m]\n7 = [1, 2, 3]\n"
    survey = read_survey(write(folder, one), {"tag.lever_arms_m": {"8": [0, 0, 1]}})
    assert (survey.tag.tag_in_cam_m, survey.tag.lever_arms_m) == ((0.0, 0.0, 0.0), {"8": (0.0, 0.0, 1.0)})
    survey = read_survey(write(folder, several), {"tag.tag_in_cam_m": [0, 0, 1]})
    assert (survey.tag.tag_in_cam_m, survey.tag.lever_arms_m) == ((0.0, 0.0, 1.0), {})


def test_time_stamps_are_described_in_the_survey(folder: Path) -> None:
    ranges = read_survey(
        write(
            folder,
            '[ranges]\nstamp_unit = "ticks"\nstamp_bits = 40\npropagation_speed = "vacuum"\nt_off_s = 1e-8\n'
            "ranging_interval_s = 0.1\n",
        )
    ).ranges
    assert StampOptions.from_log_options(ranges) == StampOptions(
        DW1000_TICK_S, 2**40 * DW1000_TICK_S, VACUUM_M_PER_S, 1e-8
    )
    assert ranges.ranging_interval_s == 0.1
    assert StampOptions.from_log_options(read_survey(write(folder, "")).ranges) == StampOptions()
    speed = StampOptions.from_log_options(read_survey(write(folder, "[ranges]\npropagation_speed = 299.7e6\n")).ranges)
    assert speed.propagation_speed_m_per_s == 299.7e6


def test_overrides_replace_keys_and_their_paths_are_relative_to_the_working_directory(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "other.csv").touch()
    monkeypatch.chdir(elsewhere)
    overrides = {"ranges.path": "other.csv", "output.path": Path("o"), "scale.method": "robust", "tag.tag_id": "t"}
    survey = read_survey(write(folder, WHOLE), overrides)
    assert survey.ranges.path == elsewhere / "other.csv"
    assert survey.output.path == elsewhere / "o"
    assert (survey.scale.method, survey.tag.tag_id) == ("robust", "t")
    assert survey.anchors.path == folder / "anchors.csv"


def test_survey_can_be_made_from_tables(folder: Path) -> None:
    survey = survey_from_tables({"images": {"path": "images"}, "camera": {"params": (1, 2)}}, folder)
    assert survey.images.path == folder / "images"
    assert survey.camera.params == (1.0, 2.0)


def test_settings_are_plain_json(folder: Path) -> None:
    settings_of_run = read_survey(write(folder, WHOLE)).to_dict()
    assert json.loads(json.dumps(settings_of_run)) == settings_of_run
    assert settings_of_run["images"]["path"] == str(folder / "images")
    assert settings_of_run["ranges"]["range_stddev_m"] == 0.1


@pytest.mark.parametrize(
    ("content", "line", "said"),
    [
        ('[images]\npth = "x"', 2, "unknown key 'pth' in [images]; the nearest known one is 'path'"),
        ("\n[imges]\n", 2, "unknown table [imges]; the nearest known one is 'images'"),
        ("images = 3", 1, "images is 3, expected a table [images]"),
        ("[images]\nevery_nth = '3'", 2, "[images] every_nth is '3', expected a whole number"),
        ("[images]\n\nevery_nth = 0", 3, "every_nth is 0, expected a whole number from 1 to 1000000"),
        ("[images]\nevery_nth = true", 2, "expected a whole number"),
        ("[images]\nevery_nth = 1.5", 2, "expected a whole number"),
        ("[images]\npath = ''", 2, "expected a path"),
        ("[camera]\nparams = [1, 'x']", 2, "expected a list of numbers"),
        ("[camera]\nrefine_intrinsics = 1", 2, "expected true or false"),
        ("[ranges]\ntime_offset = 'later'", 2, "time_offset is 'later', expected \"auto\" or seconds"),
        ("[ranges]\nrange_stddev_m = nan", 2, "range_stddev_m is nan, expected a number of metres from 1e-06 to 1000"),
        ("[ranges]\nrange_stddev_m = 0", 2, "expected a number of metres from 1e-06 to 1000"),
        ("[ranges.columns]\nrange = 3", 2, "[ranges] columns.range is 3, expected text"),
        ("[ranges]\ncolumns = 3", 2, "[ranges] columns is 3, expected a table in which each value is text"),
        ("[anchors]\nframe = 'sight'", 2, "expected one of site, first_camera, unknown"),
        ("[tag]\ntag_in_cam_m = [1, 2]", 2, "expected a list of 3 numbers"),
        (
            "[tag]\ntag_in_cam_m = [1, 2, 3]\nlever_arms_m = { a = [1, 2, 3] }",
            2,
            "either one lever arm or one by tag id",
        ),
        ("[tag]\nlever_arms_m = { a = [1, 2] }", 2, "[tag] lever_arms_m.a is [1, 2], expected a list of 3 numbers"),
        ("[tag.lever_arms_m]\na = 1", 2, "[tag] lever_arms_m.a is 1, expected a list of 3 numbers"),
        ("[ranges]\nstamp_bits = 33", 2, "expected one of 32, 40"),
        ("[ranges]\nstamp_unit = 'hours'", 2, "expected one of ns, us, ms, s, ticks"),
        ("[ranges]\npropagation_speed = 'sound'", 2, "expected air, vacuum or a speed of light in m/s"),
        ("[ranges]\npropagation_speed = 340", 2, "expected air, vacuum or a speed of light in m/s"),
        ("[ranges]\nranging_interval_s = 0", 2, "expected a number of seconds from 1e-06 to 1000000"),
        ("[mapper]\nmatchng = 'auto'", 2, "unknown key 'matchng' in [mapper]; the nearest known one is 'matching'"),
        ("[mapper]\nfeatures = 3", 2, "features is 3, expected a table"),
        ("[refine]\nbundle_adjustmnt.x = 1", 2, "nearest known one is 'bundle_adjustment'"),
        ("[refine.bundle_adjustmnt]\nx = 1", 1, "nearest known one is 'bundle_adjustment'"),
        ("[scale]\nmethod = 'guess'", 2, "expected one of robust, two-candidate"),
        ("[export]\nformats = 'tum'", 2, "expected a list of texts"),
        ("[output]\nseed = -1", 2, "expected a whole number from 0 to 2147483647"),
        ("[images]\npath = ", 2, "not a TOML file"),
        ("[images]\npath = 'a'\n[images]\n", 3, "not a TOML file"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(folder: Path, content: str, line: int, said: str) -> None:
    error = refusal(write(folder, content))
    assert said in str(error)
    assert error.line == line


def test_key_is_looked_for_in_its_own_table(folder: Path) -> None:
    error = refusal(write(folder, '[images]\npath = "x"\n[output]\npath = 3\n'))
    assert error.line == 4


@pytest.mark.parametrize(
    "key", ["[images]\ntimes", "[ranges]\npath", "[anchors]\npath", "[report]\nreference"], ids=lambda key: key[:5]
)
def test_missing_files_are_named_with_the_line_that_asks_for_them(folder: Path, key: str) -> None:
    error = refusal(write(folder, f"{key} = 'none.csv'\n"))
    assert error.line == 2
    assert f"there is no file {folder / 'none.csv'}" in str(error)


def test_log_may_be_files_in_a_folder_and_an_empty_one_is_refused(folder: Path) -> None:
    (folder / "logs").mkdir()
    error = refusal(write(folder, "[ranges]\npath = 'logs'\n"))
    assert f"[ranges] path: {folder / 'logs'}: no file there, expected the files of a log" in str(error)
    for anchor_id in ("1", "2"):
        (folder / "logs" / f"anchor_{anchor_id}.csv").touch()
    for path in ("logs", "logs/anchor_*.csv"):
        survey = read_survey(write(folder, f"[ranges]\npath = '{path}'\n"))
        assert [path.name for _, _, path in input_paths(survey)] == ["anchor_1.csv", "anchor_2.csv"]


def test_folder_in_place_of_a_file_is_named_as_one(folder: Path) -> None:
    (folder / "curves").mkdir()
    error = refusal(write(folder, "[ranges]\nerror_curve = 'curves'\n"))
    assert f"[ranges] error_curve: {folder / 'curves'} is a folder, expected a file" in str(error)


def test_marks_without_distances_are_refused(folder: Path) -> None:
    (folder / "marks.csv").touch()
    error = refusal(write(folder, "[scale]\nmarkers = 'marks.csv'\n"))
    assert error.line == 2
    assert "expected distances beside it" in str(error)


def test_wrong_flag_is_not_blamed_on_the_file(folder: Path) -> None:
    error = refusal(write(folder, "[images]\nevery_nth = 2\n"), {"images.every_nth": 0})
    assert error.path is None
    assert "every_nth is 0" in str(error)


@settings(max_examples=200)
@given(
    st.one_of(
        st.binary(max_size=100),
        st.text("[]=\".'\n{},# 0123456789-+einftruapths_", max_size=80).map(str.encode),
        st.builds(
            "[{}]\n{} = {}\n".format,
            st.sampled_from(["images", "ranges", "tag", "mapper", "refine", "output", "ranges.columns", "camera"]),
            st.sampled_from(["path", "every_nth", "time_offset", "params", "tag_in_cam_m", "seed", "x", "pipeline"]),
            st.sampled_from(["1", "-1.5", '"x"', '"\\u0000"', "[1, 2, 3]", "{ a = 1 }", "inf", "1979-05-27", "true"]),
        ).map(str.encode),
        st.just(b"a = " + b"[" * 5000),
        st.just(b"a = " + b"9" * 5000),
    )
)
def test_any_bytes_are_a_survey_or_an_input_error(tmp_path: Path, content: bytes) -> None:
    with contextlib.suppress(InputError):
        json.dumps(read_survey(write(tmp_path, content)).to_dict())
