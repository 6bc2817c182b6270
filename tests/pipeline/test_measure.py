"""Distances between points of a result: what is measured, with which precision, and what is refused."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import ANCHORS_M, Command, WalkedSurvey
from tests.known import known

import rangesfm
from rangesfm.errors import InputError
from rangesfm.result.joint_covariance import JOINT_COVARIANCE_NAME
from rangesfm.result.result_folder import read_result_folder

FIRST, LAST = "frame_00001.jpg", "frame_00025.jpg"


@pytest.fixture(scope="module")
def walked_survey(dense_survey: WalkedSurvey) -> WalkedSurvey:
    return dense_survey


@pytest.fixture(scope="module")
def results(walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with results of the walk: refined in the site, refined in the first camera's frame, and only scaled."""
    folder = shutil.copytree(walked_survey.folder, tmp_path_factory.mktemp("measured") / "survey")
    flags = (*walked_survey.flags, "--no_report", "--output_path")
    rangesfm_command("refine", "--anchors", "anchors.csv", *flags, "site", cwd=folder)
    rangesfm_command("refine", *flags, "unknown", cwd=folder)
    rangesfm_command("scale", "--anchors", "anchors.csv", *flags, "scaled", cwd=folder)
    return folder


def test_true_distances_and_heights_are_in_their_intervals(results: Path, walked_survey: WalkedSurvey) -> None:
    names, centers_m = walked_survey.image_names, walked_survey.centers_m
    at = dict(zip(names, centers_m, strict=True)) | {name: np.array(position) for name, position in ANCHORS_M.items()}
    pairs = [(names[i], names[i + 9]) for i in range(0, 30, 6)] + [(names[3], "A1")]
    for row in rangesfm.measure(results / "site", pairs).rows:
        apart = at[row.ends[1]] - at[row.ends[0]]
        assert row.distance_m == pytest.approx(np.linalg.norm(apart), rel=0.02)
        assert known(row.height_difference_m) == pytest.approx(apart[2], abs=0.1)
        _assert_inside(row.distance_interval_m, float(np.linalg.norm(apart)))
        _assert_inside(known(row.height_interval_m), float(apart[2]))


def test_a_distance_between_anchors_that_are_given_exactly_is_exact(results: Path) -> None:
    (row,) = rangesfm.measure(results / "site", [("A1", "A2")]).rows
    length_m = float(np.linalg.norm(np.subtract(ANCHORS_M["A1"], ANCHORS_M["A2"])))
    assert (row.distance_m, *row.distance_interval_m) == pytest.approx((length_m,) * 3)


def _assert_inside(interval: tuple[float, float], truth: float) -> None:
    """Assert that a value is in an interval, stretched by a half: seven of a hundred pairs of 95 % would fail else."""
    low, high = interval
    margin = (high - low) / 4
    assert low - margin < truth < high + margin


def test_a_long_distance_is_as_certain_as_the_scale_and_a_short_one_by_its_own_photos(results: Path) -> None:
    scale = read_result_folder(results / "site").summary.scale
    relative = (known(scale.interval_95)[1] - known(scale.interval_95)[0]) / scale.value
    long, short = rangesfm.measure(results / "site", [(FIRST, LAST), (FIRST, "frame_00002.jpg")]).rows
    widths = [(row.distance_interval_m[1] - row.distance_interval_m[0]) / row.distance_m for row in (long, short)]
    assert widths[0] == pytest.approx(relative, rel=0.3)
    assert widths[1] > 1.05 * widths[0]


def test_heights_need_to_know_what_is_up(results: Path) -> None:
    found = rangesfm.measure(results / "unknown", [(FIRST, LAST)])
    assert (found.rows[0].height_difference_m, found.rows[0].height_interval_m) == (None, None)
    assert any("no height differences" in note for note in found.notes)
    assert not any("no height" in note for note in rangesfm.measure(results / "site", [(FIRST, LAST)]).notes)


def test_a_map_that_is_only_scaled_says_that_its_intervals_are_those_of_the_scale(results: Path) -> None:
    found = rangesfm.measure(results / "scaled", [(FIRST, LAST)])
    scale = read_result_folder(results / "scaled").summary.scale
    (row,) = found.rows
    shares = np.array(row.distance_interval_m) / row.distance_m
    np.testing.assert_allclose(shares, np.array(known(scale.interval_95)) / scale.value, rtol=1e-3)
    assert row.height_interval_m is None
    assert any("from the uncertainty of the scale alone" in note for note in found.notes)


def test_a_table_of_pairs_gives_a_table_of_measurements(results: Path, rangesfm_command: Command) -> None:
    (results / "pairs.csv").write_text(f"from,to,distance_m\n{FIRST},{LAST},7\nA1,A2,\n")
    command = ("measure", "site", "--pairs", "pairs.csv", "--output_path", "measured.csv")
    printed = rangesfm_command(*command, cwd=results).stdout
    with (results / "measured.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = rangesfm.measure(results / "site", [(FIRST, LAST), ("A1", "A2")]).rows
    assert [(row["from"], row["to"]) for row in rows] == [row.ends for row in expected]
    for row, measured in zip(rows, expected, strict=True):
        assert float(row["distance_m"]) == pytest.approx(measured.distance_m, rel=1e-5)
        assert float(row["distance_low_m"]) == pytest.approx(measured.distance_interval_m[0], rel=1e-5)
        assert float(row["height_difference_high_m"]) == pytest.approx(known(measured.height_interval_m)[1], rel=1e-4)
        assert f"{measured.distance_m:.3f}" in printed


def test_all_pairs_of_the_given_points_are_measured(results: Path, rangesfm_command: Command) -> None:
    printed = rangesfm_command("measure", "site", FIRST, LAST, "A1", cwd=results).stdout.splitlines()
    assert [tuple(line.split()[:2]) for line in printed[1:4]] == [(FIRST, LAST), (FIRST, "A1"), (LAST, "A1")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["site", FIRST], "one point, frame_00001.jpg is given, expected two or more"),
        (["site"], "no point is given, expected two or more"),
        (["site", FIRST, FIRST], "frame_00001.jpg is given twice, expected different points"),
        (["site", FIRST, "frame_0002.jpg"], "'frame_0002.jpg' is not in the map, expected a photo"),
        (["site", "--pairs", "same.csv"], "same.csv:2: to is 'A1', expected another point than 'from'"),
        (["site", "--pairs", "none.csv"], "none.csv: holds no pair of points"),
        (["site", "--pairs", "same.csv", "--output_path", "same.csv"], "would overwrite this input"),
        (["nowhere", FIRST, LAST], "nowhere: not a result folder"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], message: str, results: Path, rangesfm_command: Command) -> None:
    (results / "same.csv").write_text("from,to\nA1,A1\n")
    (results / "none.csv").write_text("from,to\n")
    if "--output_path" in arguments:
        (results / "same.csv").write_text(f"from,to\n{FIRST},A1\n")
    done = rangesfm_command("measure", *arguments, cwd=results, status=2)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("damage", ["cut", "of another kind", "without an array", "not finite"])
def test_a_damaged_file_of_covariances_is_named(damage: str, results: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(results / "site", tmp_path / "site")
    path = folder / JOINT_COVARIANCE_NAME
    with np.load(path) as file:
        arrays = dict(file)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "of another kind":
        path.write_text("frame_ids\n1\n")
    else:
        if damage == "not finite":
            arrays["frame_modes"][0, 0, 0] = np.nan
        else:
            del arrays["frame_rests"]
        np.savez(path, **arrays)
    with pytest.raises(InputError, match="is damaged, expected the file as a run wrote it") as caught:
        rangesfm.measure(folder, [(FIRST, LAST)])
    assert caught.value.path == path


def test_covariances_are_read_as_they_were_written(results: Path, tmp_path: Path) -> None:
    found = read_result_folder(results / "site").read_map_errors()
    assert set(found.parts) == {"frame", "camera", "anchor"}
    assert found.parts["anchor"].ids == tuple(ANCHORS_M)
    covariance = read_result_folder(results / "site").summary.refine
    assert found.scale_stddev == pytest.approx(known(known(covariance).relative_scale_stddev))
