"""Parts side by side."""

from __future__ import annotations

import os
import time

import pytest

from rangesfm.processes.threads import num_threads, side_by_side


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
