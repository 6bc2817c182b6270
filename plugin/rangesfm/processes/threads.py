"""Independent parts of a computation side by side, and how many threads compute at all."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from rangesfm.errors import InputError, shown

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

_Part = TypeVar("_Part")
_Done = TypeVar("_Done")
_First = TypeVar("_First")
_Second = TypeVar("_Second")
_Arguments = ParamSpec("_Arguments")

# Bounds that hold in this process now.
_bounds: list[int] = []

# OpenMP takes one number for each level of parallel loops within others; there are no such loops here.
_NUMBER = r"\s*0*([1-9][0-9]{0,8})\s*(,.*)?"
_VARIABLE = "OMP_NUM_THREADS"


def num_threads() -> int:
    """One for each core, or fewer where ``OMP_NUM_THREADS`` or ``at_most`` says so."""
    found = re.fullmatch(_NUMBER, os.environ.get(_VARIABLE, ""))
    asked = [] if found is None else [int(found[1])]
    return min([os.cpu_count() or 1, *asked, *_bounds])


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


@contextmanager
def at_most(num: int) -> Iterator[None]:
    """Have no more threads side by side inside the block; less than 1 for no bound."""
    bound = num if num > 0 else os.cpu_count() or 1
    _bounds.append(bound)
    try:
        yield
    finally:
        _bounds.remove(bound)


def with_one_blas_thread(function: Callable[_Arguments, _Done]) -> Callable[_Arguments, _Done]:
    """Have numpy and scipy multiply matrices in one thread while a function computes.

    The matrices here are small: more threads make them slower, ten times so on two cores, and more beside other work.
    """

    @functools.wraps(function)
    def bounded(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Done:
        with _blas().limit(limits=1):
            return function(*args, **kwargs)

    return bounded


@functools.cache
def _blas() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 (its BLAS is another than numpy's, and is found only where it is loaded)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


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
