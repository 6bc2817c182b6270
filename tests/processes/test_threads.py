"""Parts side by side."""

from __future__ import annotations

import os
import threading
import time

import pytest

from rangesfm.processes.threads import both, num_threads, side_by_side


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
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    met = threading.Barrier(2, timeout=10)
    both(met.wait, met.wait)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    here = threading.get_ident()
    assert both(threading.get_ident, threading.get_ident) == (here, here)


@pytest.mark.parametrize(
    ("asked", "taken"), [("3", 3), ("0", 1), ("", None), ("4,2", None), ("many", None), (None, None)]
)
def test_so_many_threads_as_the_environment_allows(
    monkeypatch: pytest.MonkeyPatch, asked: str | None, taken: int | None
) -> None:
    if asked is None:
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert num_threads() == (taken or os.cpu_count())
