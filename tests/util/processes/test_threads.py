"""Work in parallel threads."""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits

import rangesfm
from rangesfm.util.processes.threads import (
    num_threads,
    settle_num_threads,
    with_one_blas_thread,
)

if TYPE_CHECKING:
    from tests.conftest import Command

# Public names that only read, write, rearrange or hold something, or solve for at most four unknowns.
COMPUTES_NOTHING = {
    *("Anchor", "GeometryError", "InputError", "PlannedSurvey", "RangeLog", "RangesfmError", "ReconstructionError"),
    *("Similarity", "SolverError", "Survey", "Trajectory", "export_model", "export_result", "find_image_times"),
    *("read_anchors", "read_image_times_csv", "read_plan", "read_ranges", "read_reference", "read_survey"),
    *("reconstruct", "rescale", "select_keyframes", "tag_positions", "trajectory_from_reconstruction"),
    *("two_candidate", "write_report"),
}


@pytest.mark.parametrize(
    ("asked", "taken"),
    [("3", 3), (" 03", 3), ("4,2", 4), ("100000", 8), ("0", 8), ("-3", 8), ("", 8), ("many", 8), ("²", 8), (None, 8)],
)
def test_so_many_threads_as_the_environment_allows_and_there_are_cores(
    monkeypatch: pytest.MonkeyPatch, asked: str | None, taken: int
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    if asked is None:
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert num_threads() == taken


@pytest.mark.parametrize(("given", "left"), [("3", "3"), ("4,2", "4"), ("100000", "8"), ("", None)])
def test_libraries_find_a_number_of_threads_that_they_can_start(
    monkeypatch: pytest.MonkeyPatch, given: str, left: str | None
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    monkeypatch.setenv("OMP_NUM_THREADS", given)
    settle_num_threads()
    assert os.environ.get("OMP_NUM_THREADS") == left


@pytest.mark.parametrize("given", ["many", "-3", "0", "1.5", "²"])
def test_what_is_no_number_of_threads_is_refused(given: str, rangesfm_process: Command) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", given)
        done = rangesfm_process("scale", cwd=Path.cwd(), status=2)
    said = f"rangesfm: error: the environment's OMP_NUM_THREADS is '{given}', expected a number of threads\n"
    assert done.stderr == said


@pytest.fixture
def two_blas_threads() -> Iterator[None]:
    """Let numpy and scipy use two threads, as they do by default on two cores."""
    assert scipy.linalg.norm(np.eye(2)) > 0  # loads scipy's BLAS
    with threadpool_limits(limits=2, user_api="blas"):
        yield


def blas_threads() -> set[int]:
    """Return the numbers of threads of all BLAS libraries that can have several; OpenCV brings one that cannot."""
    return {
        library["num_threads"]
        for library in threadpool_info()
        if library["user_api"] == "blas" and library["threading_layer"] != "disabled"
    }


@pytest.mark.usefixtures("two_blas_threads")
def test_what_computes_takes_one_blas_thread_and_leaves_as_many_as_there_were() -> None:
    @with_one_blas_thread
    def compute(depth: int) -> set[int]:
        return blas_threads() | (compute(depth - 1) if depth else set())

    @with_one_blas_thread
    def fail() -> None:
        raise ZeroDivisionError

    assert blas_threads() == {2}
    assert compute(2) == {1}
    assert blas_threads() == {2}
    with pytest.raises(ZeroDivisionError):
        fail()
    assert blas_threads() == {2}


def test_every_public_function_that_computes_takes_one_blas_thread() -> None:
    bounded = {name for name in rangesfm.__all__[1:] if hasattr(getattr(rangesfm, name), "__wrapped__")}
    assert bounded == set(rangesfm.__all__[1:]) - COMPUTES_NOTHING
    assert all(inspect.getdoc(getattr(rangesfm, name)) for name in bounded)
