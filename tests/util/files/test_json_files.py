"""JSON files are read, or refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from rangesfm.errors import InputError
from rangesfm.util.files.records import read_json


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a":\n', ":2: not JSON: "),
        ("[1e999]", ": not JSON: 1e999 is too large a number"),
        ("9" * 400, f": not JSON: {'9' * 20}... is too large a number"),
        ("[" * 100_000, ": not JSON that can be read: nested too deeply"),
        ("1" * 10_000, ": not JSON: "),
        ("", ":1: not JSON: "),
    ],
)
def test_what_is_no_json_is_refused_in_one_line(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_json(path)
    assert str(caught.value).startswith(f"{path}{said}")


def test_numbers_that_json_does_not_know_are_none(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text("[NaN, -Infinity, 1]")
    assert read_json(path) == [None, None, 1]


def test_json_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text('{"ä": [1, 2.5, null]}', encoding="utf-8-sig")
    assert read_json(path) == {"ä": [1, 2.5, None]}
