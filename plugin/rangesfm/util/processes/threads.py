"""Threads: their number, and independent parts of a computation in parallel."""

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

# Bounds on the number of threads that are in force in this process.
_bounds: list[int] = []

# OpenMP allows one number for each level of nested parallel loops. There are no nested ones here, so the first counts.
_NUMBER = r"\s*0*([1-9][0-9]{0,8})\s*(,.*)?"
_VARIABLE = "OMP_NUM_THREADS"


def num_threads() -> int:
    """Return the number of threads: one for each core, or fewer by ``OMP_NUM_THREADS`` or ``at_most``."""
    found = re.fullmatch(_NUMBER, os.environ.get(_VARIABLE, ""))
    asked = [] if found is None else [int(found[1])]
    return min([os.cpu_count() or 1, *asked, *_bounds])


def settle_num_threads() -> None:
    """Check ``OMP_NUM_THREADS`` before libraries read it, and limit it to the number of threads used here.

    With an invalid value libraries print warnings, and with a huge one they try to start so many threads.

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
    """Limit the number of parallel threads inside the block; a number below 1 means no limit."""
    bound = num if num > 0 else os.cpu_count() or 1
    _bounds.append(bound)
    try:
        yield
    finally:
        _bounds.remove(bound)


def with_one_blas_thread(function: Callable[_Arguments, _Done]) -> Callable[_Arguments, _Done]:
    """Decorate a function so that numpy and scipy use one BLAS thread while it runs.

    The matrices here are small. More threads make them slower, by a factor of ten on two cores, and by more beside
    other work.
    """

    @functools.wraps(function)
    def bounded(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Done:
        with _blas().limit(limits=1):
            return function(*args, **kwargs)

    return bounded


@functools.cache
def _blas() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 (SciPy has a BLAS of its own, which is found only once it is loaded)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


def side_by_side(function: Callable[[_Part], _Done], parts: Iterable[_Part]) -> list[_Done]:
    """Apply a function to each part in parallel threads, and return the results in their order.

    The results do not depend on the number of threads. It is faster for functions that compute in numpy and scipy,
    which release Python's global lock.
    """
    with ThreadPoolExecutor(num_threads()) as pool:
        return list(pool.map(function, parts))


def both(first: Callable[[], _First], second: Callable[[], _Second]) -> tuple[_First, _Second]:
    """Run two independent computations in parallel and return both results; if both fail, raise the first's error."""
    if num_threads() == 1:
        return first(), second()
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(second)
        return first(), beside.result()
