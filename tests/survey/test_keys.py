"""Every key of a survey file has its bounds, its flag, and its place in the reference and in the list of paths."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, get_args

import pytest

from rangesfm.cli import main
from rangesfm.cli.arguments import normalize, parse
from rangesfm.cli.survey_flags import survey_from_arguments
from rangesfm.errors import InputError
from rangesfm.option_model import Key
from rangesfm.options import CameraOptions, OutputOptions, ScaleOptions
from rangesfm.survey.settings import KEYS, Survey
from rangesfm.survey.survey_reader import input_paths, read_survey

EXTREMES = ("1e308", "-1e308", "1e-320", "9223372036854775807", "-9223372036854775808", "-1", "0", "nan", "inf", "-inf")


def numbers_in(hint: Any) -> bool:
    return hint in (int, float) or any(numbers_in(arg) for arg in get_args(hint))


NUMERIC = [item for item in KEYS if numbers_in(item.type)]


def in_toml(hint: Any, number: str) -> str:
    """Return a TOML value of this type, with the number wherever one may be."""
    args = get_args(hint)
    if hint in (int, float) or int in args or (float in args and str(hint).startswith("typing.Union")):
        return number
    if str(hint).startswith("dict"):
        return f"{{ a = {in_toml(args[1], number)} }}"
    return f"[{', '.join([number] * (2 if args[-1] is Ellipsis else len(args)))}]"


def survey_or_refusal(path: Path) -> Survey | InputError:
    try:
        return read_survey(path)
    except InputError as error:
        return error


def all_numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        value = list(value.values())
    return [n for item in value for n in all_numbers(item)] if isinstance(value, (list, tuple)) else [value]


def test_the_numeric_keys_are_found() -> None:
    names = {item.dotted for item in NUMERIC}
    assert {"output.seed", "ranges.time_offset", "mapper.num_threads", "tag.lever_arms_m", "camera.params"} <= names
    assert len(NUMERIC) > 25


@pytest.mark.parametrize("number", EXTREMES)
@pytest.mark.parametrize("item", NUMERIC, ids=lambda item: item.dotted)
def test_no_number_goes_through_that_could_end_as_an_internal_error(item: Key, number: str, tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(f"[{item.table}]\n{item.name} = {in_toml(item.type, number)}\n")
    survey = survey_or_refusal(path)
    if isinstance(survey, InputError):
        assert (survey.path, survey.line) == (path, 2)
        assert f"[{item.table}] {item.name}" in str(survey)
        assert ", expected " in str(survey)
        return
    found = all_numbers(getattr(getattr(survey, item.table), item.name))
    assert all(abs(value) <= 1e10 for value in found)
    if number == "1e-320":
        # Tiny values are only accepted for keys by which nothing is divided.
        assert item.name.endswith(
            ("interval_s", "gap_s", "difference_s", "share", "in_cam_m", "arms_m", "_height")
        ) or (item.name in ("t_off_s", "time_offset", "params", "heading_deg"))


@pytest.mark.parametrize("number", ["1e308", "9223372036854775807", "nan"])
@pytest.mark.parametrize("item", NUMERIC, ids=lambda item: item.dotted)
def test_nor_as_a_flag(
    item: Key, number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    value = in_toml(item.type, number).strip("[]").replace("{ a = [", "a:").replace("] }", "").replace(" ", "")
    assert main(["run", f"--{item.flag}={value}"]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "internal" not in err


def test_every_key_has_a_flag_and_an_explanation(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    for item in KEYS:
        assert f"\n  --{item.flag}" in text
        assert item.meaning
        assert item.expected


def test_no_two_keys_share_a_flag_but_the_two_forms_of_a_lever_arm() -> None:
    counts = Counter(item.flag for item in KEYS)
    assert {flag for flag, num in counts.items() if num > 1} == {"tag_in_cam"}


@pytest.mark.parametrize(
    ("flags", "key", "value"),
    [
        (["--no_refine"], "refine.enabled", False),
        (["--refine_intrinsics"], "camera.refine_intrinsics", True),
        (["--no-covariance"], "refine.covariance", False),
        (["--max-interpolation-gap-s", "0.5"], "ranges.max_interpolation_gap_s", 0.5),
        (["--formats", "tum,kitti"], "export.formats", ("tum", "kitti")),
        (["--origin_lat_lon_height", "47.1,-8.2,400"], "export.origin_lat_lon_height", (47.1, -8.2, 400.0)),
        (["--num_threads", "-1"], "mapper.num_threads", -1),
        (["--propagation_speed", "vacuum"], "ranges.propagation_speed", "vacuum"),
        (["--stamp_bits", "40"], "ranges.stamp_bits", 40),
        (
            ["--features", "max_image_size=1200, sift.num_octaves=3"],
            "mapper.features",
            {"max_image_size": 1200, "sift": {"num_octaves": 3}},
        ),
        (
            ["--bundle_adjustment", "refine_extra_params=true"],
            "refine.bundle_adjustment",
            {"refine_extra_params": True},
        ),
    ],
)
def test_flags_have_values_of_their_keys_type(flags: list[str], key: str, value: object) -> None:
    table, name = key.split(".")
    survey = survey_from_arguments(parse(normalize(["run", *flags])))
    assert getattr(getattr(survey, table), name) == value


def test_a_flag_for_options_of_colmap_that_is_no_table_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--features", "max_image_size"]) == 2
    assert "is not a list of options, expected as max_image_size=1200" in capsys.readouterr().err


def test_options_are_checked_wherever_they_are_made() -> None:
    with pytest.raises(InputError, match=r"\[output\] seed is -1, expected a whole number from 0"):
        OutputOptions(seed=-1)
    with pytest.raises(InputError, match=r"unknown key 'modl' in \[camera\]; the nearest known one is 'model'"):
        CameraOptions(modl="OPENCV")  # type: ignore[call-arg]
    with pytest.raises(InputError, match="seed is 'x'"):
        Survey().changed({"output.seed": "x"})
    assert ScaleOptions(max_relative_stddev=0.3).changed(method="two-candidate").max_relative_stddev == 0.3


def test_every_path_that_is_read_is_in_one_list(tmp_path: Path) -> None:
    files = [item for item in KEYS if item.role == "file"]
    assert {item.name for item in files} >= {"path", "times", "error_curve", "distances", "markers", "reference"}
    assert all(item.role for item in KEYS if item.type is Path)
    read = {**{item.dotted: item.dotted for item in files}, "images.model": "sparse", "images.path": "photos"}
    survey = Survey().changed({key: tmp_path / name for key, name in {**read, "output.path": "out"}.items()})
    listed = {path.name: role for _, role, path in input_paths(survey)}
    assert listed == {"sparse": "model", "photos": "photos", **{item.dotted: "file" for item in files}}
