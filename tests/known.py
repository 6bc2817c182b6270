"""What a test knows to be there."""

from __future__ import annotations

from typing import TypeVar

_T = TypeVar("_T")


def known(value: _T | None) -> _T:
    """The value, which a result may leave open and this one must not."""
    assert value is not None
    return value
