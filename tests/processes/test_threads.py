"""Parts side by side."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rangesfm.processes.threads import both, num_threads, settle_num_threads, side_by_side

if TYPE_CHECKING:
    from tests.conftest import Command


@pytest.mark.parametrize("asked", ["1", "3"])
def test_what_is_made_of_parts_comes_in_their_order(monkeypatch: pytest.MonkeyPatch, asked: str) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", asked)

    def later_parts_are_done_first(part: int) -> int:
        time.sleep(0.002 * (5 - part))
        return part**2

    assert side_by_side(later_parts_are_done_first, range(5)) == [0, 1, 4, 9, 16]
    assert side_by_side(later_parts_are_done_first, []) == []


def test_an_error_in_a_part_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda part: 1 / part, [1, 0])


@pytest.mark.parametrize("asked", ["1", "2"])
def test_both_of_two_are_done_and_where_both_fail_the_first_is_heard(
    monkeypatch: pytest.MonkeyPatch, asked: str
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert both(lambda: 1, lambda: "two") == (1, "two")
    with pytest.raises(ZeroDivisionError):
        both(lambda: 1 / 0, lambda: [][1])
    with pytest.raises(IndexError):
        both(lambda: 1, lambda: [][1])


def test_two_wait_for_each_other_only_where_there_are_threads_for_both(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    met = threading.Barrier(2, timeout=10)
    both(met.wait, met.wait)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    here = threading.get_ident()
    assert both(threading.get_ident, threading.get_ident) == (here, here)


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
