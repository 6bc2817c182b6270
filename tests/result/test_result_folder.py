"""The result folder: files that are never overwritten, files that go before a new result, and reading it back."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.outputs import names_in
from tests.result_document import anchor_entry, result_document

from rangesfm.errors import InputError
from rangesfm.pipeline.map_photos import refuse_to_overwrite
from rangesfm.result.result_folder import RESULT_FILES, read_result_folder
from rangesfm.result.result_tables import RESULT_TABLES, RangesAsUsed
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import survey_from_tables

PAGE = (Path(__file__).parents[2] / "examples" / "results.md").read_text(encoding="utf-8")


def files_of(folder: Path) -> set[str]:
    return set(names_in(folder))


def survey_reading(path: Path, output: Path, key: str = "report.reference", **tables: Any) -> Survey:
    table, name = key.split(".")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return survey_from_tables({table: {name: str(path)}, "output": {"path": str(output)}, **tables}, path.parent)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "ranges.csv",
            "images.csv",
            "reference.csv",
            "trajectory.tum",
            "sparse_scaled/0/a.csv",
            "sparse_metric/x.csv",
        ),
        *("sparse/0/a.csv", "photos/walk.csv", "database.db", "mapper.log", "reconstruct.json", "opf/a.csv"),
    ],
)
def test_input_is_never_overwritten(name: str, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "out", target_is_directory=True)
    for path in (tmp_path / "out" / name, tmp_path / "out" / "." / name, tmp_path / "link" / name):
        export: Any = {"export": {"formats": ["tum", "opf"]}}
        with pytest.raises(InputError, match="the results would overwrite this input") as caught:
            refuse_to_overwrite(survey_reading(path, tmp_path / "out", **export))
        assert caught.value.path == path
    refuse_to_overwrite(survey_reading(tmp_path / "beside.csv", tmp_path / "out"))


def test_a_model_that_is_read_may_stand_beside_the_results_and_not_among_them(tmp_path: Path) -> None:
    for model, output in (("0", "0"), ("out/sparse_metric/0/copy", "out"), ("out/sparse_metric", "out")):
        (tmp_path / model).mkdir(parents=True, exist_ok=True)
        survey = survey_from_tables({"images": {"model": model}, "output": {"path": output}}, tmp_path)
        with pytest.raises(InputError, match="expected another output path"):
            refuse_to_overwrite(survey)
    for images in ({"path": "photos"}, {"model": "photos/out/sparse/0"}):
        refuse_to_overwrite(survey_from_tables({"images": images, "output": {"path": "photos/out"}}, tmp_path))


def write_document(folder: Path, **changes: Any) -> Path:
    (folder / "result.json").write_text(json.dumps(result_document(**changes)))
    return folder


def test_every_file_of_a_result_stands_in_the_table_of_its_page() -> None:
    (table,) = re.findall(r"^# The result folder\n\n(.*?)\n\n", PAGE, re.DOTALL)
    documented = {name for row in table.splitlines() for name in re.findall(r"`([^`]+)`", row.split("|")[1])}
    assert set(RESULT_FILES) <= documented


def test_anchors_and_lever_arms_are_arrays(tmp_path: Path) -> None:
    anchors = {"A1": anchor_entry([1.0, 2.0, 3.0]), "A2": anchor_entry(None)}
    settings = {"tag": {"lever_arms_m": {"left": [0.5, 0.0, 0.0]}}}
    result = read_result_folder(write_document(tmp_path, anchors=anchors, settings=settings))
    assert {id_: at.tolist() for id_, at in result.anchor_positions_m.items()} == {"A1": [1.0, 2.0, 3.0]}
    assert result.lever_arms_m(["left", "other"]).tolist() == [[0.5, 0.0, 0.0], [0.0, 0.0, 0.1]]
    assert result.lever_arms_m([]).shape == (0, 3)


def test_what_a_run_did_not_leave_is_empty_or_none(tmp_path: Path) -> None:
    result = read_result_folder(write_document(tmp_path))
    assert [len(result.read(table)) for table in RESULT_TABLES] == [0] * len(RESULT_TABLES)
    assert (len(result.read_reference()), result.read_metric_model()) == (0, None)
    assert (result.timestamps_s, result.images_path) == ({}, None)


def test_times_and_ranges_are_read_as_they_stand(tmp_path: Path) -> None:
    write_document(tmp_path)
    (tmp_path / "images.csv").write_text("image_name,timestamp_s\na.jpg,1.5\nb.jpg,2.5\n")
    (tmp_path / "ranges.csv").write_text(
        f"{','.join(RangesAsUsed.columns())}\n"
        "1.7,,A1,tag,4.0,0.1,a.jpg,b.jpg,0.2,4.25,4.125,0.125,1,used\n"
        "9.9,,A1,tag,5.0,,,,,,,,,outside-path\n"
    )
    result = read_result_folder(tmp_path)
    assert result.timestamps_s == {"a.jpg": 1.5, "b.jpg": 2.5}
    ranges = result.read(RangesAsUsed)
    assert ranges.keyframe_after == ("b.jpg", "")
    assert ranges.is_used.tolist() == [True, False]
    np.testing.assert_array_equal(ranges.residuals_by_model_m["scaled"], [0.25, np.nan])
    np.testing.assert_array_equal(ranges.residuals_by_model_m["refined"], [0.125, np.nan])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r": not a result folder: it has no result.json \(expected the output_path of a run\)$"),
        ("{\n,", r"result\.json:2: not JSON"),
        ("[]", r"result\.json:1: expected a JSON object$"),
        ("{}", r"result\.json: 'scale' is missing$"),
    ],
)
def test_another_folder_is_refused(text: str | None, message: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "result.json").write_text(text)
    with pytest.raises(InputError, match=message):
        read_result_folder(tmp_path)
