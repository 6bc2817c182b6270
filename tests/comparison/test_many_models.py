"""Models of the same photos compared with the first: a known similarity, a moved camera, and range residuals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.comparison.comparison_page import write_comparison
from rangesfm.comparison.many_models import ModelsComparison, compare_many, read_named_models
from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape_file import read_tape
from rangesfm.pipeline.ranges_for_models import ranges_of_survey
from rangesfm.pipeline.run import scale_model
from rangesfm.progress import Progress
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.reference import read_reference

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True)
TAG_IN_CAM_M = (0.03, -0.12, -0.05)


@pytest.fixture(scope="module")
def models(walked_survey: WalkedSurvey, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A model; a copy half as large, rotated and translated; and a copy with its eleventh camera moved by one unit."""
    folder = tmp_path_factory.mktemp("models")
    paths = [folder / name for name in ("first", "similar", "moved")]
    for path in paths:
        shutil.copytree(walked_survey.folder / "sparse" / "0", path)
    similar = pycolmap.Reconstruction(paths[1])
    similar.transform(pycolmap.Sim3d(0.5, pycolmap.Rotation3d(TURN.as_quat()), np.array([3.0, -2.0, 1.0])))
    similar.write(paths[1])
    moved = pycolmap.Reconstruction(paths[2])
    frame = moved.frame(sorted(moved.reg_frame_ids())[10])
    pose = frame.rig_from_world
    assert pose is not None
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.0, 1.0, 0.0]))
    moved.write(paths[2])
    return paths[0], paths[1], paths[2]


def survey_of(files: Path, others: Mapping[str, object] | None = None) -> Survey:
    """A survey of the walked survey's files, with additional keys."""
    keys = {
        "images.times": files / "images.csv",
        "ranges.path": files / "uwb.csv",
        "ranges.time_offset": 2.0,
        "anchors.path": files / "anchors.csv",
        "tag.tag_in_cam_m": TAG_IN_CAM_M,
    }
    return Survey().changed({**keys, **(others or {})})


@pytest.fixture(scope="module")
def result(walked_survey: WalkedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of the same model, scaled with its ranges."""
    files = walked_survey.folder
    output_path = tmp_path_factory.mktemp("result") / "out"
    survey = survey_of(files, {"anchors.frame": "site", "output.path": output_path, "report.enabled": False})
    survey = survey.changed({"images.model": files / "sparse" / "0"})
    scale_model(survey, progress=Progress())
    return survey.output.path


def compared(*paths: Path) -> ModelsComparison:
    return compare_many(read_named_models(paths))


def test_a_known_similarity_is_found_and_nothing_has_moved_after_it(models: tuple[Path, Path, Path]) -> None:
    _, row = compared(*models[:2]).rows
    assert row.base_from_model is not None
    assert row.base_from_model.scale == pytest.approx(2.0, rel=1e-9)
    assert row.rotation_deg == pytest.approx(np.rad2deg(TURN.magnitude()), abs=1e-6)
    assert row.moved_aligned.max() < 1e-9
    assert row.moved.min() > 0.5


def test_a_moved_camera_is_named(models: tuple[Path, Path, Path]) -> None:
    _, row = compared(models[0], models[2]).rows
    assert np.argmax(row.moved) == 10
    assert row.moved[10] == pytest.approx(1.0)
    assert np.delete(row.moved, 10).max() == 0.0
    (base, _) = compared(models[0], models[2]).rows
    assert row.reprojection_rms_px > 10 * base.reprojection_rms_px


def test_distances_are_in_each_models_own_unit(models: tuple[Path, Path, Path]) -> None:
    distances = compared(*models[:2]).distances
    assert len(distances) >= 4
    assert all(half == pytest.approx(whole / 2, rel=1e-9) for _, _, (whole, half) in distances)


def test_ranges_tell_the_metric_model_from_the_unscaled(result: Path, models: tuple[Path, Path, Path]) -> None:
    metric, unscaled, _ = compared(result, models[0], models[1]).rows
    assert metric.range_rms_m[0] < 0.1  # the radio's 0.05 m, and the interpolation between photos
    assert unscaled.range_rms_m[0] > 3 * metric.range_rms_m[0]
    assert unscaled.range_rms_m[1] == pytest.approx(metric.range_rms_m[0], rel=1e-6)


def test_a_results_row_is_the_same_whatever_it_is_compared_with(
    result: Path, walked_survey: WalkedSurvey, tmp_path: Path
) -> None:
    """Another result used other ranges, to anchors that it placed elsewhere."""
    files = walked_survey.folder
    survey = survey_of(files, {"anchors.frame": "unknown", "output.path": tmp_path / "other", "report.enabled": False})
    survey = survey.changed({"images.model": files / "sparse" / "0", "ranges.check_share": 0.3})
    scale_model(survey, progress=Progress())
    alone, _ = compared(result, files / "sparse" / "0").rows
    other, beside = compared(tmp_path / "other", result).rows
    for row, folder in ((alone, result), (beside, result), (other, tmp_path / "other")):
        said = json.loads((folder / "result.json").read_text())["ranges"]["rms_m"]
        assert row.range_rms_m[0] == pytest.approx(said, rel=1e-4)


def test_a_log_is_held_against_models_that_no_run_has_made(
    dense_survey: WalkedSurvey, models: tuple[Path, Path, Path]
) -> None:
    files = dense_survey.folder
    survey = survey_of(files)
    named = read_named_models(models)
    assert named[0].model is not None
    ranges = ranges_of_survey(survey, named[0].model, models[0])
    (first, similar, moved) = compare_many(named, ranges).rows
    rms = [row.range_rms_m for row in (first, similar, moved) if np.isfinite(row.range_rms_m[0])]
    assert len(rms) == 3
    assert rms[0][1] < 0.1  # the radio's 0.05 m, and the interpolation between photos
    assert rms[0][0] > 3 * rms[0][1]
    assert rms[1][1] == pytest.approx(rms[0][1], rel=1e-6)
    assert rms[2][1] > 1.2 * rms[0][1]  # one camera in forty is wrong


def test_a_path_without_orientations_has_no_antenna_and_so_no_range_residuals(
    result: Path, walked_survey: WalkedSurvey
) -> None:
    _, row = compared(result, walked_survey.folder / "reference.csv").rows
    assert np.isnan(row.range_rms_m).all()


def test_a_taped_distance_is_found_in_each_model_and_placed_by_the_ranges(
    result: Path, models: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    first, last = (compared(*models[:2]).rows[0].model.path.image_names[i] for i in (0, -1))
    taped = tmp_path / "taped.csv"
    taped.write_text(f"from,to,distance_m\n{first},{last},5.0\n")
    (lengths,) = compare_many(read_named_models([result, *models[:2]]), tape=read_tape(taped)).taped.values()
    measured_m, metric, whole, half, *placed_m = lengths
    assert half == pytest.approx(whole / 2)
    assert placed_m == pytest.approx((metric, metric, metric), rel=1e-6)
    assert measured_m == 5.0
    (unplaced,) = compare_many(read_named_models(models[:2]), tape=read_tape(taped)).taped.values()
    assert len(unplaced) == 3
    taped.write_text(f"from,to,distance_m\n{first},nowhere,5.0\n")
    with pytest.raises(InputError, match=r"taped.csv:2: an end is 'nowhere'.*model"):
        compare_many(read_named_models(models[:2]), tape=read_tape(taped))


def test_the_command_takes_the_log_and_the_tape(
    rangesfm_command: Command, models: tuple[Path, Path, Path], walked_survey: WalkedSurvey, tmp_path: Path
) -> None:
    files = walked_survey.folder
    names = compared(*models[:2]).rows[0].model.path.image_names
    (tmp_path / "taped.csv").write_text(f"from,to,distance_m,kind\n{names[0]},{names[9]},1.25,check\n")
    log = ("--ranges", files / "uwb.csv", "--anchors", files / "anchors.csv", "--images", files / "images.csv")
    tag = ("--tag-in-cam", ",".join(map(str, TAG_IN_CAM_M)), "--ranges_time_offset", "2")
    tape = ("--distances", "taped.csv", "--output_path", "page")
    printed = rangesfm_command("compare", *models[:2], *log, *tag, *tape, cwd=tmp_path).stdout
    rows = {line.split()[0]: line.split() for line in printed.splitlines() if line.startswith(str(models[0].parent))}
    assert all(0 < float(rows[str(path)][-1]) < 0.1 for path in models[:2])
    (taped,) = (line.split() for line in printed.splitlines() if line.startswith(f"{names[0]} to {names[9]}  1.25"))
    assert taped[-2] == taped[-1]
    assert "Taped distances" in (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--anchors", "anchors.csv"), "--anchors given without a log to use it for, expected --ranges LOG"),
        (("--markers", "marks.csv"), "expected distances beside it"),
        (("--ranges", "gone.csv"), "gone.csv"),
    ],
)
def test_flags_that_say_nothing_together_are_refused(
    rangesfm_command: Command,
    models: tuple[Path, Path, Path],
    tmp_path: Path,
    arguments: tuple[str, ...],
    said: str,
) -> None:
    for name in ("anchors.csv", "images.csv", "marks.csv"):
        (tmp_path / name).touch()
    done = rangesfm_command("compare", *models[:2], *arguments, cwd=tmp_path, status=2)
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_file_of_positions_is_a_model_too(models: tuple[Path, Path, Path], walked_survey: WalkedSurvey) -> None:
    reference = walked_survey.folder / "reference.csv"
    _, row = compared(models[0], reference).rows
    assert row.base_from_model is not None
    assert np.isnan(row.reprojection_rms_px)
    assert row.base_from_model.scale == pytest.approx(1 / walked_survey.site_from_sfm.scale, rel=1e-6)
    base, row = compared(reference, models[0]).rows
    assert row.scale_ratio == pytest.approx(1 / walked_survey.site_from_sfm.scale, rel=1e-6)
    assert base.model.frame == "site"
    assert row.model.frame is None
    with pytest.raises(InputError, match="only files of positions are given"):
        read_named_models([reference])


def test_truth_by_time_needs_no_times_of_its_own(
    rangesfm_command: Command,
    result: Path,
    models: tuple[Path, Path, Path],
    walked_survey: WalkedSurvey,
    tmp_path: Path,
) -> None:
    """The times are those of a result folder or of a table; the truth may stand anywhere."""
    files = walked_survey.folder
    time_of = dict(line.split(",") for line in (files / "images.csv").read_text().splitlines()[1:])
    rows = [line.split(",") for line in (files / "reference.csv").read_text().splitlines()]
    (tmp_path / "truth.csv").write_text(
        "timestamp_s,x_m,y_m,z_m\n" + "".join(f"{time_of[row[0]]},{','.join(row[1:4])}\n" for row in rows[1:])
    )
    scale = walked_survey.site_from_sfm.scale

    def printed(*arguments: str | Path) -> list[list[str]]:
        done = rangesfm_command("compare", *arguments, cwd=tmp_path)
        return [line.split() for line in done.stdout.splitlines()]

    by_result = printed("truth.csv", models[0], result)
    ratios = [float(row[4]) for row in by_result[1:4]]
    assert ratios == pytest.approx([1.0, 1 / scale, 1.0], rel=0.02)
    by_table = printed(models[0], "--reference", "truth.csv", "--images", files / "images.csv")
    assert by_table[-1] == [str(models[0]), "40", *3 * "-", by_table[-1][5], f"{1 / scale:.6g}"]
    assert float(by_table[-1][5]) < 0.001
    done = rangesfm_command("compare", models[0], "--reference", "truth.csv", cwd=tmp_path, status=2)
    assert "the photos have no times" in done.stderr


def test_only_models_that_are_known_to_be_metric_have_lengths_in_metres(
    rangesfm_command: Command,
    result: Path,
    models: tuple[Path, Path, Path],
    walked_survey: WalkedSurvey,
    tmp_path: Path,
) -> None:
    scaled, reference = result / "sparse_scaled" / "0", walked_survey.folder / "reference.csv"
    text = rangesfm_command("compare", result, scaled, models[1], "--reference", reference, cwd=tmp_path).stdout
    first, distances, against_truth = (block.splitlines() for block in text.split("\n\n"))
    assert [float(row.split()[4]) for row in first[1:]] == pytest.approx(
        [1.0, 1.0, 0.5 / walked_survey.site_from_sfm.scale], rel=0.01
    )
    assert [row.split()[10] == "-" for row in first[1:]] == [False, False, True]  # ranges, by the cameras as they are
    assert f"{scaled} m" in distances[0]
    assert f"{models[1]} m" not in distances[0]
    cells = {row.split()[0]: row.split()[2:] for row in against_truth[1:]}
    assert cells[str(models[1])][:2] == ["-", "-"]
    for metric in (result, scaled):
        rmse_m, aligned_by, after_se3_m = cells[str(metric)][:3]
        assert float(after_se3_m) <= float(rmse_m) < 0.5
        assert aligned_by == "nothing"


def test_models_of_other_photos_are_refused(models: tuple[Path, Path, Path], tmp_path: Path) -> None:
    other = pycolmap.Reconstruction(models[0])
    for image in other.images.values():
        image.name = f"other_{image.name}"
    (tmp_path / "other").mkdir()
    other.write(tmp_path / "other")
    with pytest.raises(InputError, match="no photo in common"):
        compared(models[0], tmp_path / "other")


def test_the_command_prints_tables_and_writes_the_page(
    rangesfm_command: Command, models: tuple[Path, Path, Path], walked_survey: WalkedSurvey, tmp_path: Path
) -> None:
    reference = walked_survey.folder / "reference.csv"
    arguments = ("compare", models[0], models[1], "--reference", reference, "--output_path", "page")
    printed = rangesfm_command(*arguments, cwd=tmp_path).stdout
    assert "photos in common" in printed
    assert "after Sim(3)" in printed
    page = (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8")
    assert "2 models of 40 photos" in page
    for row in compared(*models[:2]).rows:
        assert f"<td>{row.scale_ratio:.6g}</td>" in page


def test_the_page_has_the_table_against_the_reference_that_the_terminal_prints(
    models: tuple[Path, Path, Path], walked_survey: WalkedSurvey, tmp_path: Path
) -> None:
    reference = read_reference(walked_survey.folder / "reference.csv")
    comparison = compare_many(read_named_models(models[:2]), reference=reference)
    page = write_comparison(comparison, tmp_path).read_text(encoding="utf-8")
    assert "Each model against the reference" in page
    assert "scale / truth" in str(comparison)
    for row in comparison.truth:
        assert "".join(f"<td>{cell}</td>" for cell in row[1:]) in page
        assert row[-1] in str(comparison)


def test_one_model_alone_has_no_page(
    rangesfm_command: Command, models: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    done = rangesfm_command("compare", models[0], "--output_path", "page", cwd=tmp_path, status=2)
    assert "needs two" in done.stderr
    assert not (tmp_path / "page").exists()


def test_the_same_models_give_the_same_page(models: tuple[Path, Path, Path], tmp_path: Path) -> None:
    comparison = compared(*models)
    assert (
        write_comparison(comparison, tmp_path / "a").read_bytes()
        == write_comparison(comparison, tmp_path / "b").read_bytes()
    )
