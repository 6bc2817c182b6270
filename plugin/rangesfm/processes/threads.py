"""Independent parts of a computation side by side."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from rangesfm.errors import InputError, shown

_Part = TypeVar("_Part")
_Done = TypeVar("_Done")
_First = TypeVar("_First")
_Second = TypeVar("_Second")


# OpenMP takes one number for each level of parallel loops within others; there are no such loops here.
_NUMBER = r"\s*0*([1-9][0-9]{0,8})\s*(,.*)?"
_VARIABLE = "OMP_NUM_THREADS"


def num_threads() -> int:
    """One for each core, or fewer where ``OMP_NUM_THREADS`` says so."""
    found = re.fullmatch(_NUMBER, os.environ.get(_VARIABLE, ""))
    num_cores = os.cpu_count() or 1
    return num_cores if found is None else min(int(found[1]), num_cores)


def settle_num_threads() -> None:
    """Check ``OMP_NUM_THREADS`` before libraries read it: they print what they do not like, or try 100000 threads.

    Raises:
        InputError: it is neither a number nor empty.
    """
    given = os.environ.get(_VARIABLE)
    if given is None:
        return
    if not given.strip():
        del os.environ[_VARIABLE]
    elif re.fullmatch(_NUMBER, given) is None:
        raise InputError(f"the environment's {_VARIABLE} is {shown(given)}, expected a number of threads")
    else:
        os.environ[_VARIABLE] = str(num_threads())


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
