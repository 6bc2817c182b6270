"""The result folder: what is never overwritten, what goes before a new result, and what is read back."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.result_document import anchor_entry, result_document

from rangesfm.errors import InputError
from rangesfm.result.folder import (
    RESULT_FILES,
    forget_result,
    read_result_folder,
    refuse_to_overwrite,
    replacing_result,
)
from rangesfm.result.tables import TABLES, RangesAsUsed
from rangesfm.survey.settings import InputPath

PAGE = (Path(__file__).parents[2] / "examples" / "results.md").read_text(encoding="utf-8")


def files_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize(
    "name", ["ranges.csv", "images.csv", "reference.csv", "trajectory.tum", "sparse_scaled/0", "sparse_metric/0"]
)
def test_input_is_never_overwritten(name: str, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "out", target_is_directory=True)
    for path in (tmp_path / "out" / name, tmp_path / "out" / "." / name, tmp_path / "link" / name):
        with pytest.raises(InputError, match="the results would overwrite this input") as caught:
            refuse_to_overwrite([InputPath("", "file", path)], tmp_path / "out")
        assert caught.value.path == path
    beside = [InputPath("", "file", tmp_path / name), InputPath("", "model", tmp_path / "out" / "sparse" / "0")]
    refuse_to_overwrite(beside, tmp_path / "out")


def test_results_do_not_stand_among_a_model_nor_a_model_among_results(tmp_path: Path) -> None:
    for model, output in (("0", "0"), ("out/sparse_metric/0/copy", "out")):
        (tmp_path / model).mkdir(parents=True, exist_ok=True)
        (tmp_path / model / "cameras.bin").touch()
        with pytest.raises(InputError, match="expected another output path"):
            refuse_to_overwrite([InputPath("", "model", tmp_path / model)], tmp_path / output)
    refuse_to_overwrite([InputPath("", "photos", tmp_path / "photos")], tmp_path / "photos" / "out")


class TestForgetting:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "sparse" / "0").mkdir(parents=True)
        for name in ("result.json", "report.html", "ranges.csv", "mine.txt"):
            (tmp_path / name).touch()
        return tmp_path

    def test_takes_away_what_was_said_of_the_model_and_nothing_else(self, folder: Path) -> None:
        forget_result(folder)
        assert files_of(folder) == {"sparse", "mine.txt"}

    def test_leaves_files_alone_that_belong_to_no_result(self, folder: Path) -> None:
        (folder / "result.json").unlink()
        forget_result(folder)
        assert files_of(folder) == {"sparse", "report.html", "ranges.csv", "mine.txt"}

    def test_goes_on_where_it_was_killed(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def die(path: Path, **_: Any) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr(Path, "unlink", die)
            with pytest.raises(KeyboardInterrupt):
                forget_result(folder)
        assert {"report.html", "ranges.csv"} < files_of(folder)
        assert "result.json" not in files_of(folder)
        forget_result(folder)
        assert files_of(folder) == {"sparse", "mine.txt"}

    def test_comes_before_a_new_result_of_which_nothing_stays_if_it_fails(self, folder: Path) -> None:
        def write_and_fail() -> None:
            with replacing_result(folder):
                assert {path.name for path in folder.glob("[!.]*")} == {"sparse", "mine.txt"}
                (folder / "ranges.csv").touch()
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_and_fail()
        assert files_of(folder) == {"sparse", "mine.txt"}

    def test_leaves_nothing_beside_a_new_result(self, folder: Path) -> None:
        with replacing_result(folder):
            (folder / "result.json").touch()
        assert files_of(folder) == {"sparse", "mine.txt", "result.json"}


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


def test_what_a_run_did_not_leave_is_none(tmp_path: Path) -> None:
    result = read_result_folder(write_document(tmp_path))
    assert [result.read(table) for table in TABLES] == [None] * len(TABLES)
    assert (result.read_reference(), result.read_metric_model()) == (None, None)
    assert (result.timestamps_s, result.images_path) == (None, None)


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
    assert ranges is not None
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
