"""The example programs run, and the survey files among them are valid."""

from __future__ import annotations

import io
import re
import runpy
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from PIL import Image
from tests.conftest import TAG_IN_CAM_M, TIME_OFFSET_S

from rangesfm.survey.survey_reader import parse_toml, read_survey

if TYPE_CHECKING:
    from tests.conftest import PhotoRun, WalkedSurvey

EXAMPLES = Path(__file__).parents[1] / "examples"


def run_process(name: str, *arguments: str, cwd: Path) -> str:
    """Run an example that sets its own import order, as a process of its own, and return its output."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def run_example(name: str, *arguments: str, cwd: Path) -> str:
    """Run an example in this process, which saves the imports, and return its output."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.chdir(cwd)
        patch.setattr(sys, "argv", [name, *arguments])
        with redirect_stderr(io.StringIO()) as err:
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert err.getvalue() == ""
    return out.getvalue()


def test_every_program_is_tested_here() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == {
        "compare_two_surveys.py",
        "floor_plan.py",
        "gaussian_splatting.py",
        "keys.py",
        "own_problem.py",
        "scale_existing_model.py",
    }


def test_the_reference_of_keys_is_up_to_date() -> None:
    assert run_example("keys.py", cwd=EXAMPLES) == (EXAMPLES / "keys.md").read_text(encoding="utf-8")


def test_own_problem_converges_on_a_model_that_fits_its_ranges(walked_survey: WalkedSurvey) -> None:
    printed = run_process("own_problem.py", "sparse/0", cwd=walked_survey.folder)
    assert "CONVERGENCE" in printed
    initial, final = (float(re.search(rf"{name} cost: ([\d.e+-]+)", printed)[1]) for name in ("Initial", "Final"))  # type: ignore[index]
    assert 0 < final <= initial


def test_scale_existing_model_takes_it_to_metres(walked_survey: WalkedSurvey, tmp_path: Path) -> None:
    files = ("sparse/0", "images.csv", "uwb.csv", str(tmp_path / "metric" / "0"))
    arm = map(str, TAG_IN_CAM_M)
    printed = run_process("scale_existing_model.py", *files, "--tag_in_cam", *arm, cwd=walked_survey.folder)
    offset, scale, _ = printed.splitlines()
    assert float(offset.split()[2]) == pytest.approx(TIME_OFFSET_S, abs=0.05)
    assert float(scale.split()[0]) == pytest.approx(walked_survey.site_from_sfm.scale, rel=0.02)
    images = sorted(pycolmap.Reconstruction(tmp_path / "metric" / "0").images.values(), key=lambda image: image.name)
    centers = np.array([image.projection_center() for image in images])
    length_m, true_m = (
        np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in (centers, walked_survey.centers_m)
    )
    assert length_m == pytest.approx(true_m, rel=0.02)


def test_input_for_gaussian_splatting_is_undistorted_and_metric(photo_run: PhotoRun, tmp_path: Path) -> None:
    printed = run_example("gaussian_splatting.py", str(photo_run.output_path), str(tmp_path), cwd=tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "undistorted" / "sparse" / "0")
    assert printed.startswith(f"{model.num_reg_images()} photos")
    centers = np.array([image.projection_center() for image in model.images.values()])
    refined = pycolmap.Reconstruction(photo_run.output_path / "sparse_metric" / "0")
    expected = np.array([image.projection_center() for image in refined.images.values()])
    assert np.ptp(centers, axis=0).max() == pytest.approx(np.ptp(expected, axis=0).max(), rel=0.2)


def test_floor_plan_is_drawn_with_its_extent(photo_run: PhotoRun, tmp_path: Path) -> None:
    printed = run_example("floor_plan.py", str(photo_run.output_path), "plan.png", cwd=tmp_path)
    width, depth = (float(number) for number in re.findall(r"([\d.]+) m", printed)[:2])
    assert 2 < width < 60
    assert 2 < depth < 60
    with Image.open(tmp_path / "plan.png") as plan:
        assert min(plan.size) > 500


def test_a_survey_compared_with_itself_has_not_changed(photo_run: PhotoRun, tmp_path: Path) -> None:
    folder = str(photo_run.output_path)
    printed = run_example("compare_two_surveys.py", folder, folder, "changes.ply", cwd=tmp_path)
    assert "explain: 0 (0.0 %)" in printed
    assert (tmp_path / "changes.ply").is_file()


SURVEYS = sorted(set(EXAMPLES.glob("*.toml")) - {EXAMPLES / "plan.toml"})


@pytest.mark.parametrize("path", SURVEYS, ids=lambda path: path.name)
def test_survey_file_is_one_for_a_folder_with_its_files(path: Path, tmp_path: Path) -> None:
    tables, _ = parse_toml(path)
    given = {
        f"{table}.{key}": name
        for table, keys in FILES_OF.items()
        for key in keys
        if (name := tables.get(table, {}).get(key))
    }
    for name in given.values():
        (tmp_path / name).touch()
    survey = read_survey(path, base_folder=tmp_path)
    assert survey.images.path == tmp_path / tables["images"]["path"]
    assert survey.ranges.path == tmp_path / tables["ranges"]["path"]
    assert survey.output.path == tmp_path / tables.get("output", {}).get("path", "out")


FILES_OF = {"images": ["times"], "ranges": ["path"], "anchors": ["path"], "report": ["reference"]}
