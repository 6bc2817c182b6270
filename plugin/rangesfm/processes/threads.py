"""Independent parts of a computation side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Part = TypeVar("_Part")
_Done = TypeVar("_Done")
_First = TypeVar("_First")
_Second = TypeVar("_Second")


def num_threads() -> int:
    """As many as ``OMP_NUM_THREADS`` allows, or one for each core."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return max(int(asked), 1) if asked.isdigit() else os.cpu_count() or 1


def side_by_side(function: Callable[[_Part], _Done], parts: Iterable[_Part]) -> list[_Done]:
    """Of each part what the function makes of it, in their order: the same, however many threads there are.

    Worth it for numpy and scipy, which let other threads go on while they compute.
    """
    with ThreadPoolExecutor(num_threads()) as pool:
        return list(pool.map(function, parts))


def both(first: Callable[[], _First], second: Callable[[], _Second]) -> tuple[_First, _Second]:
    """What two computations give that do not need each other; where both fail, what the first raises is raised."""
    if num_threads() == 1:
        return first(), second()
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(second)
        return first(), beside.result()
