"""The type stub of the compiled part agrees with the compiled part."""

from __future__ import annotations

from tests.ceres.stub import STUB, compiled_part_stub


def test_the_stub_is_the_one_made_from_the_compiled_part() -> None:
    assert STUB.read_text(encoding="utf-8") == compiled_part_stub(), "python -m tests.ceres.stub makes it anew"
