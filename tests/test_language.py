"""Class variables have a type."""

from __future__ import annotations

import re
from pathlib import Path

PACKAGE_FILES = sorted((Path(__file__).parents[1] / "plugin").rglob("*.py"))


def test_class_variables_have_a_type() -> None:
    """Pydantic refuses a plain ``ClassVar`` on Python 3.10 in a model when its module is imported."""
    texts = {path.name: path.read_text(encoding="utf-8") for path in PACKAGE_FILES}
    assert [name for name, text in texts.items() if re.search(r": ClassVar(?!\[)\b", text)] == []
