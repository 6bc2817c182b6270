"""Logs whose every value has its name beside it, as tables: JSON, ``rostopic echo``, ``anchor=A1 range=2.34``."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangesfm.files.tables import Table, read_head, read_text
from rangesfm.ranging.readers.times import CIVIL_TIME, TIME_OF_DAY

Record = dict[str, str]
_BLOCK = "\n---\n"  # ends a message of rostopic echo
_NAMED = re.compile(r"(?<![\w.:/])([A-Za-z]\w*)(?: ?= ?|: +)(\"[^\"]*\"|[^\s,;\[\]{}]+)", re.ASCII)
_KEY = re.compile(r"([A-Za-z_]\w*):(?: +(.*))?", re.ASCII)
_MIN_SHARE = 0.9


def read_records(path: Path) -> Table | None:
    """The table of a file of records, a row a range where they hold several; None if it is none.

    Cells are empty where a record does not speak of a thing at all.
    """
    head = read_head(path).lstrip()
    if head.startswith(("{", "[{")):
        numbered = list(_json_records(read_text(path)))
    elif _share_named(head) > _MIN_SHARE:
        text = read_text(path, errors="replace")
        numbered = list(_blocks(text) if _BLOCK in text else _named_records(text))
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
    """A time without a name stands before the others; a name that comes again has a number behind it."""
    for line, unit in _units(text):
        time = CIVIL_TIME.search(unit) or TIME_OF_DAY.search(unit)
        record, num = {"time": time[0]} if time else {}, Counter[str]()
        for name, value in _NAMED.findall(unit):
            num[name] += 1
            record[name if num[name] == 1 else f"{name}.{num[name]}"] = value.strip('"')
        yield line, record


def _blocks(text: str) -> Iterator[tuple[int, Record]]:
    for line, unit in _units(text):
        lines = [(len(row) - len(row.lstrip()), row.strip()) for row in unit.split("\n") if row.strip("- \t")]
        yield from ((line, record) for record in _flat(_nested(lines)))


def _nested(lines: Sequence[tuple[int, str]]) -> Any:
    """What indented lines of YAML hold, as far as messages are printed in it."""
    indent, first = lines[0] if lines else (0, "")
    is_list = first.startswith("- ") or first == "-"
    if not is_list and not _KEY.fullmatch(first):
        return _value(first)
    # The items of a list may be as far in as the key that they are of.
    starts = [k for k, (at, text) in enumerate(lines) if at == indent and (is_list or not text.startswith("-"))]
    parts = [lines[k:stop] for k, stop in zip(starts, [*starts[1:], len(lines)])]
    if is_list:
        return [_nested([(at + 2, text[2:]) for at, text in part[:1] if text[2:]] + [*part[1:]]) for part in parts]
    keys = [(_KEY.fullmatch(part[0][1]), part[1:]) for part in parts]
    return {key[1]: _value(key[2]) if key[2] else _nested(inner) for key, inner in keys if key}


def _value(text: str) -> Any:
    try:
        return json.loads(text) if text.startswith("[") else text.strip("'\"")
    except (ValueError, RecursionError):
        return text


def _json_records(text: str) -> Iterator[tuple[int, Record]]:
    decoder, at, line, counted = json.JSONDecoder(), 0, 1, 0
    while (begin := text.find("{", at)) >= 0:
        line, counted = line + text.count("\n", counted, begin), begin
        try:
            value, at = decoder.raw_decode(text, begin)
        except (ValueError, RecursionError):  # a line that was cut off, or no record
            at = begin + 1
            continue
        yield from ((line, record) for record in _flat(value))


def _flat(value: Any) -> list[Record]:
    """One record for each object in each of its lists, with the values that hold for all; or one of these alone."""
    common, each = _common_and_each(value, "")
    return [{**common, **record} for record in each] or [common]


def _common_and_each(value: Any, name: str) -> tuple[Record, list[Record]]:
    if isinstance(value, list) and value and all(isinstance(inner, (dict, list)) for inner in value):
        found = [_common_and_each(inner, name) for inner in value]
        return {}, [{**common, **record} for common, each in found for record in each or [{}]]
    if not isinstance(value, (dict, list)):
        return {name: "null" if value is None else str(value)}, []
    within = f"{name}." if name else ""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    found = [_common_and_each(item, f"{within}{key}") for key, item in inner]
    whole = {key: cell for common, _ in found for key, cell in common.items()}
    return whole, [record for _, each in found for record in each]
