"""Input that is refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rangesfm.errors import InputError


def refused(read: Callable[..., object], *given: object, **options: object) -> InputError:
    """Return the error by which a reader refuses what it is given, which is one line."""
    with pytest.raises(InputError) as caught:
        read(*given, **options)
    assert "\n" not in str(caught.value)
    return caught.value
