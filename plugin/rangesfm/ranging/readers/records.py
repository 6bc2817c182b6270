"""Logs whose every value has its name beside it, as tables: JSON, ``rostopic echo``, ``anchor=A1 range=2.34``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rangesfm.files.tables import Table, read_head, read_text
from rangesfm.ranging.readers.times import CIVIL_TIME, TIME_OF_DAY

Record = dict[str, str]
_BLOCK = "\n---\n"  # ends a message of rostopic echo
_NAMED = re.compile(r"(?<![\w.:/])([A-Za-z]\w*)(?: ?= ?|: +)(\"[^\"]*\"|[^\s,;\[\]{}]+)", re.ASCII)
_MIN_SHARE = 0.9


def read_records(path: Path) -> Table | None:
    """The table of a file of records, a row a range where they hold several; None if it is none."""
    head = read_head(path).lstrip()
    if head.startswith(("{", "[{")):
        numbered = list(_json_records(read_text(path)))
    elif _share_named(head) > _MIN_SHARE:
        numbered = list(_named_records(read_text(path, errors="replace")))
    else:
        return None
    names = tuple(dict.fromkeys(name for _, record in numbered for name in record))
    cells = {name: [record.get(name, "") for _, record in numbered] for name in names}
    return Table(path, names, np.array([line for line, _ in numbered], np.int64), cells) if names else None


def _share_named(head: str) -> float:
    """Of its units, as far as they are whole, those with at least two names."""
    units = [unit for _, unit in _units(head)][:-1]
    return sum(len(_NAMED.findall(unit)) > 1 for unit in units) / len(units) if units else 0.0


def _units(text: str) -> Iterator[tuple[int, str]]:
    """The lines of a text, or its blocks, each with its first line's number."""
    line, end = 1, _BLOCK if _BLOCK in text else "\n"
    for unit in text.split(end):
        if unit.strip():
            yield line, unit
        line += unit.count("\n") + end.count("\n")


def _named_records(text: str) -> Iterator[tuple[int, Record]]:
    """A time without a name stands before the others."""
    for line, unit in _units(text):
        named = _NAMED.findall(unit)
        time = CIVIL_TIME.search(unit) or TIME_OF_DAY.search(unit)
        yield line, {**({"time": time[0]} if time else {}), **{name: value.strip('"') for name, value in named}}


def _json_records(text: str) -> Iterator[tuple[int, Record]]:
    decoder, at, line, counted = json.JSONDecoder(), 0, 1, 0
    while (begin := text.find("{", at)) >= 0:
        line, counted = line + text.count("\n", counted, begin), begin
        try:
            value, at = decoder.raw_decode(text, begin)
        except (ValueError, RecursionError):  # a line that was cut off, or no record
            at = begin + 1
            continue
        yield from ((line, record) for record in _flat(value, ""))


def _flat(value: Any, name: str) -> list[Record]:
    """One record of the values in an object; one for each object in a list, with the values around it."""
    if isinstance(value, dict):
        records: list[Record] = [{}]
        for key, inner in value.items():
            found = _flat(inner, f"{name}.{key}" if name else key)
            records = [{**one, **other} for one in records for other in found]
        return records
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [record for inner in value for record in _flat(inner, name)]
    if isinstance(value, list):
        return [{key: cell for k, inner in enumerate(value) for key, cell in _flat(inner, f"{name}.{k}")[0].items()}]
    return [{name: "" if value is None else str(value)}]
