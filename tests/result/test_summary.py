"""result.json: its model, its published schema, and the errors for files that no run wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema
import numpy as np
import pytest
from tests.result_document import REFINE, anchor_entry, result_document

from rangesfm.errors import InputError, number_text
from rangesfm.result.comparison_row import ComparisonRow, format_table
from rangesfm.result.entries import AnchorEntry
from rangesfm.result.summary import ResultSummary, schema

if TYPE_CHECKING:
    from tests.conftest import PhotoRun

SCHEMA_PATH = Path(__file__).parents[2] / "examples" / "result.schema.json"
GEOREFERENCE = {"lat_deg": 47.4, "lon_deg": 8.5, "height_m": 430.0, "crs": "EPSG:2056"}


def test_published_schema_is_that_of_the_model() -> None:
    """The command ``python -m rangesfm.result.summary > examples/result.schema.json`` writes the schema anew."""
    assert SCHEMA_PATH.read_text(encoding="utf-8") == schema()


def test_a_run_leaves_what_the_schema_says(photo_run: PhotoRun) -> None:
    text = (photo_run.output_path / "result.json").read_text(encoding="utf-8")
    jsonschema.validate(json.loads(text, parse_constant=pytest.fail), json.loads(schema()))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"refine": REFINE, "georeference": GEOREFERENCE, "frame": "first_camera"},
        {
            "anchors": {
                "A1": anchor_entry([1.0, 2.0, 3.0], mirror_position_m=[1.0, 2.0, -3.0]),
                "A2": anchor_entry(None),
            }
        },
        {"settings": {"output": {"seed": 0}, "mapper": {"matching": "auto"}, "images": {"path": "caf\udce9"}}},
        {"time_offset": {"value_s": None, "stddev_s": None}},
    ],
)
def test_what_is_read_is_written_again(changes: dict[str, Any], tmp_path: Path) -> None:
    document = result_document(**changes)
    (tmp_path / "first.json").write_text(json.dumps(document))
    path = tmp_path / "result.json"
    ResultSummary.read(tmp_path / "first.json").write(path)
    assert json.loads(path.read_text(encoding="utf-8")) == document
    jsonschema.validate(document, json.loads(schema()))


def test_a_key_of_a_later_version_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text(json.dumps(result_document(later={"verdict": "good"}, scale={"new": 1})))
    assert ResultSummary.read(tmp_path / "result.json") == ResultSummary.model_validate(result_document())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": {"value": "wide"}}, "'scale.value' is \"wide\", expected a valid number"),
        ({"scale": {"value": None}}, "'scale.value' is null, expected a valid number"),
        ({"scale": None}, "'scale' is null, expected a JSON object"),
        ({"scale": {"verdict": "fine"}}, "'scale.verdict' is \"fine\", expected 'good' or 'doubtful'"),
        ({"frame": "moon"}, "'frame' is \"moon\", expected 'site' or 'first_camera'"),
        ({"anchors": [1]}, "'anchors' is [1], expected a JSON object"),
        ({"anchors": {"A1": anchor_entry([1, 2])}}, "'anchors.A1.position_m.2' is missing"),
        ({"anchors": {"A1": {"position_m": None}}}, "'anchors.A1.stddev_m' is missing"),
        (
            {"metric_from_sfm": {"rotation_xyzw": [0, 0, 0, 0]}},
            "'metric_from_sfm.rotation_xyzw' is [0, 0, 0, 0], expected a unit quaternion",
        ),
        ({"map": {"num_photos": 1.5}}, "'map.num_photos' is 1.5, expected a valid integer"),
        ({"refine": {**REFINE, "converged": 1}}, "'refine.converged' is 1, expected a valid boolean"),
        ({"warnings": "none"}, "'warnings' is \"none\", expected a JSON array"),
        ({"warnings": [3]}, "'warnings.0' is 3, expected text"),
        ({"warnings": [[1234567] * 9]}, f"'warnings.0' is [{6 * '1234567, '}12345..., expected text"),
        (
            {"settings": {"tag": {"lever_arms_m": {"T": [1, 2, 3, 4]}}}},
            "'settings.tag.lever_arms_m.T' is [1, 2, 3, 4], expected 3 items",
        ),
    ],
)
def test_a_damaged_result_is_named_by_its_key(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result_document(**changes)))
    with pytest.raises(InputError) as caught:
        ResultSummary.read(path)
    assert str(caught.value) == f"{path}: {message}"


def test_similarity_is_that_of_its_keys() -> None:
    half_turn = {"scale": 2.0, "rotation_xyzw": [0.0, 0.0, 1.0, 0.0], "translation_m": [1.0, 2.0, 3.0]}
    summary = ResultSummary.model_validate(result_document(metric_from_sfm=half_turn))
    moved = summary.metric_from_sfm.similarity.apply(np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved, [-1.0, 2.0, 3.0], atol=1e-12)


@pytest.mark.parametrize(
    ("interval_95", "words"),
    [
        ([1.485, 1.5153], "10 m in this map are 9.90 to 10.10 m"),
        ([1.4, 1.7], "10 m in this map are 9.33 to 11.33 m"),
        ([1.49985, 1.50018], "10 m in this map are 9.9990 to 10.0012 m"),
        (None, "how long 10 m in this map are is open"),
    ],
)
def test_the_accuracy_is_told_for_ten_metres(interval_95: list[float] | None, words: str) -> None:
    summary = ResultSummary.model_validate(result_document(scale={"value": 1.5, "interval_95": interval_95}))
    assert summary.scale.in_words == words
    assert words in repr(summary)
    assert len(repr(summary)) < 100
    assert any(words in line for line in summary.lines(Path("out"))) == (interval_95 is not None)


def test_a_number_that_rounds_to_zero_has_no_sign() -> None:
    assert [number_text(value, "+.3f") for value in (-1e-5, 1e-5, -0.0, -0.0006)] == ["0.000"] * 3 + ["-0.001"]
    assert number_text(-3e-7, ".2e") == "-3.00e-07"
    assert number_text(-float("inf"), "+.1f") == "-inf"
    row = {"name": "true scale", "num_keyframes": 9, "rmse_m": None, "rmse_se3_m": -0.0, "rmse_sim3_m": 0.1}
    table = format_table((ComparisonRow.model_validate({**row, "scale_error_percent": -2e-9}),), "site")
    assert "-0.000" not in table
    assert "0.000 %" in table


def test_lines_for_people_tell_what_is_known() -> None:
    sensitive = {"sensitivity": {"short_range_per_cm": -0.6, "common_bias_per_cm": 0.5}, "interval_95": None}
    row = {"name": "scaled", "num_keyframes": 9, "rmse_m": None, "rmse_se3_m": 0.02, "rmse_sim3_m": 0.01}
    document = result_document(
        scale=sensitive,
        refine=REFINE,
        ranges={"num": 9, "num_used": 7, "rms_m": 0.0512},
        comparison=[{**row, "scale_error_percent": 0.5}],
    )
    lines = list(ResultSummary.model_validate(document).lines(Path("out")))
    assert lines == [
        "scale: 1.5 m per SfM unit, no interval",
        "verdict: good: the scale is known to 2 % (95 % interval)",
        "the scale depends strongly on single errors: it changes by -0.60 % per cm of error in the short ranges",
        "refined in 23 iterations; it changed the shape of the camera's path by 0.01 m (rms)",
        "ranges: 7 of 9 used; they differ from the map by 0.051 m (rms)",
        "map: 40 photos, 900 points, frame site",
        "",
        "trajectory  keyframes  RMSE m  after SE(3)  after Sim(3)  scale error",
        "scaled              9       -       0.0200        0.0100     +0.500 %",
        "",
        f"metric model: {Path('out/sparse_metric/0')}",
        f"all results: {Path('out/result.json')}",
    ]


def test_a_doubtful_place_always_has_its_reason() -> None:
    place = {
        "verdict": "doubtful",
        "stddev_m": [0.1, 0.1, 0.1],
        "heading_stddev_deg": 1.0,
        "worst_keyframe_stddev_m": 0.3,
    }
    doubt, wide = "anchor A2 stands elsewhere", "the map's place is known to 3 m"
    for reasons, said in (((doubt, wide), wide), ((doubt,), "for the same reasons as the scale")):
        scale = {"verdict": "doubtful", "reasons": [doubt]}
        document = result_document(scale=scale, place={**place, "reasons": list(reasons)})
        lines = ResultSummary.model_validate(document).lines(Path("out"))
        assert f"place: doubtful: {said}" in list(lines)


def test_loops_and_unnoticed_mistakes_are_told_in_sentences() -> None:
    loops = {"num_proposed": 309, "num_verified": 60, "num_closed": 15, "num_contradicted": 2, "moved_m": 0.021}
    bound = {"scale_within": 0.077, "risk": 1e-4, "limited_by": "lever arm", "unchecked": []}
    lines = list(ResultSummary.model_validate(result_document(loops=loops, reliability=bound)).lines(Path("out")))
    assert (
        "loops: the map suggests that 309 pairs of photos show the same place; 60 of them match; 15 were used to close "
        "loops, which moved the map by 0.021 m (rms); 2 contradict the measurements and were not used"
    ) in lines
    agreeing = result_document(loops={**loops, "num_closed": 0, "num_contradicted": 0})
    lines += ResultSummary.model_validate(agreeing).lines(Path("out"))
    assert any(line.endswith("60 of them match; the map agrees with these as it is") for line in lines)
    assert (
        "reliability: if one mistake was made and not noticed, the scale is off by 7.7 % at most (risk of more: "
        "0.0001); worst case: lever arm"
    ) in lines


@pytest.mark.parametrize("position_m", [(6e95, 5e95, 7e95), (1.0, -2e9, 3.0), (np.nan, 0.0, 0.0)])
def test_an_anchor_that_no_range_holds_has_no_place(position_m: tuple[float, float, float]) -> None:
    values: dict[str, Any] = {"stddev_m": 0.5, "range_bias_m": 0.0, "surveyed_position_m": None}
    entry = AnchorEntry(position_m=position_m, mirror_position_m=(1.0, 2.0, 3.0), **values)
    assert (entry.position_m, entry.mirror_position_m) == (None, (1.0, 2.0, 3.0))
    assert AnchorEntry(position_m=(5e6, 2e6, 400.0), mirror_position_m=None, **values).position_m == (5e6, 2e6, 400.0)
