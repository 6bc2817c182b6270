"""Arguments in either spelling reach the commands; for a wrong one, the nearest right one is suggested."""

from __future__ import annotations

from pathlib import Path

import pytest

from rangesfm.cli.arguments import normalize, parse
from rangesfm.cli.survey_flags import survey_from_arguments
from rangesfm.errors import InputError
from rangesfm.survey.settings import Survey


def survey_of(*argv: str) -> Survey:
    return survey_from_arguments(parse(normalize(argv)))


def test_option_names_may_have_dashes_and_values_keep_theirs() -> None:
    assert normalize(["run", "a-b.toml", "--every-nth", "3", "--output-path=my-out", "--images", "a-b"]) == [
        "run",
        "a-b.toml",
        "--every_nth",
        "3",
        "--output_path=my-out",
        "--images",
        "a-b",
    ]


def test_nothing_is_changed_after_two_dashes() -> None:
    assert normalize(["ranges", "--", "--odd-name", "-1"]) == ["ranges", "--", "--odd-name", "-1"]


def test_a_switch_takes_no_value() -> None:
    assert survey_of("run", "--adopt").scale.adopt
    assert not survey_of("run").scale.adopt


@pytest.mark.parametrize("spelling", ["--tag_in_cam", "--tag-in-cam"])
@pytest.mark.parametrize("value", ["-0.0012,-0.09,-0.0663", "-.0012 -9e-2 -0.0663"])
def test_value_may_begin_with_a_minus_sign(spelling: str, value: str) -> None:
    assert survey_of("refine", spelling, value).tag.tag_in_cam_m == (-0.0012, -0.09, -0.0663)


@pytest.mark.parametrize(("text", "seconds"), [("auto", None), ("-3600.37", -3600.37), ("12.8", 12.8)])
def test_time_offset_is_auto_or_seconds(text: str, seconds: float | None) -> None:
    assert survey_of("scale", "--ranges-time-offset", text).ranges.time_offset_s == seconds


def test_flags_override_the_survey_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "survey.toml").write_text('[images]\npath = "photos"\nevery_nth = 3\n[output]\npath = "a"\nseed = 1\n')
    monkeypatch.chdir(tmp_path)
    survey = survey_of("run", "survey.toml", "--every_nth", "5", "--output_path", "b", "--num_threads", "2")
    assert survey.images.every_nth == 5
    assert survey.output.path == tmp_path / "b"
    assert survey.mapper.num_threads == 2
    assert (survey.images.path, survey.output.seed) == (tmp_path / "photos", 1)


def test_images_are_a_folder_of_photos_or_a_file_of_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "images.csv").touch()
    monkeypatch.chdir(tmp_path)
    survey = survey_of("run", "--images", "photos", "--image-times", "images.csv")
    assert (survey.images.path, survey.images.times) == (tmp_path / "photos", tmp_path / "images.csv")
    survey = survey_of("refine", "--input_path", "sparse/0", "--images", "images.csv")
    assert (survey.images.path, survey.images.times) == (None, tmp_path / "images.csv")
    assert survey.images.model == tmp_path / "sparse" / "0"
    with pytest.raises(InputError, match=r"there is no file .*none\.csv"):
        survey_of("refine", "--images", "none.csv")


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "a command is missing"),
        (["rum"], "'rum'"),
        (["run", "--anchor", "x"], "unknown option --anchor; the nearest known one is --anchors"),
        (["run", "--tag-in-cm=1,2,3"], "unknown option --tag_in_cm; the nearest known one is --tag_in_cam"),
        (["run", "a.toml", "b.toml"], "unexpected argument 'b.toml'"),
        (["run", "--every_nth", "x"], "--every_nth"),
        (["run", "--every_nth"], "--every_nth"),
        (["run", "--anchor_frame", "sight"], "sight"),
        (["run", "--tag_in_cam", "1,2"], "has 2 numbers, expected X,Y,Z in metres"),
        (["run", "--tag_in_cam", "1,2,x"], "is not a list of numbers"),
        (["run", "--ranges_time_offset", "soon"], "neither auto nor a number"),
        (["ranges"], "LOG"),
        (["ranges", "a.csv", "--columns", "t"], "is not a mapping"),
    ],
)
def test_wrong_arguments_are_named(argv: list[str], said: str) -> None:
    with pytest.raises(InputError) as caught:
        parse(normalize(argv))
    assert said in str(caught.value)
    assert " -h)" in str(caught.value)
