"""A model and its ranges give the same files, whatever the threads, the order of the inputs, and the processor.

So do photos with ``--reproducible``. Threads and order change no byte of the models, the tables and ``result.json``
(apart from times, paths and settings). Another processor, which rounds in its own way, changes no number by more than
1e-9 of itself or of its standard deviation.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from tests.outputs import paths_below
from tests.test_kernels import NEEDED_FLAGS, why_not

from rangesfm.colmap.model_files import read_model
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

if TYPE_CHECKING:
    from tests.conftest import PhotoRun, WalkedSurvey

# A refinement of all that can be refined, with an offset to be searched for, checks, tests of mistakes and covariances.
COMMAND = (
    *("refine", "--input_path", "sparse/0", "--ranges", "uwb.csv", "--anchors", "anchors.csv"),
    *("--images", "images.csv", "--reference", "reference.csv", "--tag_in_cam", "0.03,-0.12,-0.05"),
    *("--lever_arm_stddev_m", "0.02", "--short_range_stddev_m", "0.05", "--refine_intrinsics"),
    *("--check_share", "0.1", "--formats", "tum,ply,transform", "--quiet"),
)
TABLES = ("uwb.csv", "anchors.csv", "images.csv", "reference.csv")
# What holds times, or names of folders.
TIMED = ("report.html", "mapper.log", "reconstruct.json")
LARGEST_DIFFERENCE = 1e-9


@dataclass(frozen=True)
class Left:
    """Content that a command left in its output folder."""

    folder: Path

    @property
    def result(self) -> dict[str, Any]:
        """Return the content of result.json without times, paths and settings."""
        result: dict[str, Any] = json.loads((self.folder / "result.json").read_text(encoding="utf-8"))
        for name in ("seconds", "computed", "settings", "inputs"):
            del result[name]
        del result["refine"]["seconds"]
        return result

    @property
    def contents(self) -> dict[str, bytes]:
        """Return the contents of all files, by name, without what a run says of times, paths and settings."""
        paths = {path.relative_to(self.folder).as_posix(): path for path in paths_below(self.folder) if path.is_file()}
        contents = {name: path.read_bytes() for name, path in paths.items() if name not in TIMED}
        return {**contents, "result.json": json.dumps(self.result).encode()}


def run(command: Sequence[str], folder: Path, **environment: str) -> Left:
    """Run a command in a process of its own, with other variables in its environment."""
    others = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    words = [sys.executable, "-m", "rangesfm", *command, "--output_path", "out"]
    done = subprocess.run(words, cwd=folder, env={**others, **environment}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return Left(folder / "out")


def shuffle(path: Path, rng: np.random.Generator) -> None:
    """Put the rows of a table in another order."""
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *rng.permutation(rows)]) + "\n")


@pytest.fixture(scope="module")
def alone(walked_survey: WalkedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Left:
    """The survey in one thread, as its files are."""
    folder = shutil.copytree(walked_survey.folder, tmp_path_factory.mktemp("alone") / "survey")
    return run((*COMMAND, "--num_threads", "1"), folder, OPENBLAS_NUM_THREADS="1")


def test_threads_and_the_order_of_rows_change_no_byte(alone: Left, own_survey: WalkedSurvey) -> None:
    rng, threads = np.random.default_rng(0), {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    for name in TABLES:
        shuffle(own_survey.folder / name, rng)
    assert run((*COMMAND, "--num_threads", "2"), own_survey.folder, **threads).contents == alone.contents


def test_photos_copied_in_another_order_and_another_number_of_threads_change_no_byte(
    photo_run: PhotoRun, tmp_path: Path
) -> None:
    folder = tmp_path / "yard"
    shutil.copytree(photo_run.survey.folder, folder, ignore=shutil.ignore_patterns("out", "images"))
    (folder / "images").mkdir()
    for path in sorted((photo_run.survey.folder / "images").iterdir(), reverse=True):
        shutil.copyfile(path, folder / "images" / path.name)
    shuffle(folder / "uwb.csv", np.random.default_rng(0))
    assert "--reproducible" in photo_run.flags
    flags = [*photo_run.flags, "--num_threads", "1" if os.cpu_count() != 1 else "2"]
    again, first = run(("run", *flags), folder).contents, Left(photo_run.output_path).contents
    # The database holds photos in the order in which threads were done with them.
    del again["database.db"], first["database.db"]
    assert again == first


def differences(found: Any, expected: Any, stddevs: dict[str, float], name: str = "") -> Iterator[str]:
    """Name the numbers that differ by more than a share of themselves or of their standard deviation, by key."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        more = {"size": expected["stddev"], "statistic": expected["threshold"]} if "statistic" in expected else {}
        for key, value in expected.items():
            yield from differences(found[key], value, {**stddevs, **more}, key)
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            yield from differences(one, other, stddevs, name)
    elif isinstance(expected, float):
        if not abs(found - expected) <= LARGEST_DIFFERENCE * max(abs(expected), stddevs.get(name) or 0.0):
            yield f"{name}: {expected} and {found}"
    elif found != expected:
        yield f"{name}: {expected} and {found}"


@pytest.mark.parametrize("kernel", NEEDED_FLAGS)
def test_another_processor_changes_numbers_by_less_than_a_billionth(
    kernel: str, alone: Left, own_survey: WalkedSurvey
) -> None:
    if reason := why_not(kernel):
        pytest.skip(reason)
    again, result = run((*COMMAND, "--num_threads", "1"), own_survey.folder, OPENBLAS_CORETYPE=kernel), alone.result
    of_scale, of_place_m = (
        result["scale"]["stddev_empirical"] / result["scale"]["value"],
        result["place"]["stddev_m"][0],
    )
    of_lengths = dict.fromkeys(("effect_on_place_m", "rmse_m", "rmse_se3_m", "rmse_sim3_m"), of_place_m)
    stddevs = {**of_lengths, "effect_on_scale": of_scale, "scale_error_percent": 100 * of_scale}
    assert [*differences(again.result, result, stddevs)] == []
    first, second = (
        trajectory_from_reconstruction(read_model(left.folder / "sparse_metric" / "0")) for left in (alone, again)
    )
    np.testing.assert_allclose(second.centers, first.centers, rtol=0, atol=LARGEST_DIFFERENCE)
