"""Numbers of ``result.json`` on the page: each carries its key and its full value, so that it can be checked."""

from __future__ import annotations

from typing import Any

from rangesfm.report.content import as_number
from rangesfm.report.markup import Child, element


def keyed(key: str, value: Any, text: str) -> Child:
    """``text`` as the reader sees it, marked with the key (joined by dots) and the value behind it."""
    number = as_number(value)
    return text if number is None else element("data", text, value=repr(number), data_key=key)
