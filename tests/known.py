"""Unwrap optional results that a test expects to be there."""

from __future__ import annotations

from typing import TypeVar

_T = TypeVar("_T")


def known(value: _T | None) -> _T:
    """Return a value that may be None in general, but not in this test."""
    assert value is not None
    return value
