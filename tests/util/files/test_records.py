"""Records: JSON by typed models, with plain values for all numbers."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from tests.outputs import names_in

from rangesfm.util.files.records import Count, Flag, Number, NumberOrNull, Record, Text, Vector, VectorOrNull


class Example(Record):
    text: Text
    flag: Flag
    count: Count
    number: Number
    unknown: NumberOrNull
    vector: Vector
    nowhere: VectorOrNull
    by_name: dict[Text, NumberOrNull]
    said: NumberOrNull = None


NOT_UTF8 = os.fsdecode(b"caf\xe9")
EXAMPLE = Example.model_validate(
    {
        "text": NOT_UTF8,
        "flag": np.bool_(True),
        "count": np.int64(3),
        "number": np.float64(0.1),
        "unknown": np.float64(np.inf),
        "vector": np.arange(3.0),
        "nowhere": np.array([0.0, np.nan, 0.0]),
        "by_name": {"über": -np.inf, NOT_UTF8: 1},
    }
)


def test_record_is_plain_json_whatever_the_numbers(tmp_path: Path) -> None:
    EXAMPLE.write(tmp_path / "example.json")
    text = (tmp_path / "example.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=pytest.fail) == {
        "text": NOT_UTF8,
        "flag": True,
        "count": 3,
        "number": 0.1,
        "unknown": None,
        "vector": [0.0, 1.0, 2.0],
        "nowhere": None,
        "by_name": {"über": None, NOT_UTF8: 1.0},
    }
    assert names_in(tmp_path) == ["example.json"]


def test_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    EXAMPLE.write(tmp_path / "example.json")
    assert Example.read(tmp_path / "example.json") == EXAMPLE
