"""The type stub of the compiled part agrees with the compiled part."""

from __future__ import annotations

import pytest
from tests.solver.stub import STUB, compiled_part_stub

from rangesfm import _cpp


@pytest.mark.skipif(
    _cpp.pybind11_version in ("3.0.0", "3.0.1"),
    reason="the compiled part was built with a pybind11 that writes the types of numbers otherwise",
)
def test_the_stub_is_the_one_made_from_the_compiled_part() -> None:
    assert STUB.read_text(encoding="utf-8") == compiled_part_stub(), "python -m tests.solver.stub makes it anew"
