"""Anchors whose ids in their file are not those in the log, where only one rule makes them the same."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Sequence

_NUMBERED = re.compile(r"(.*?)(\d+)", re.ASCII)
# What is added to the numbers of anchors to tell them from other points of a survey is a multiple of this.
_ROUND = 10


def ids_in_log(listed: Sequence[str], heard: Collection[str]) -> tuple[dict[str, str], str] | None:
    """Return the ids in the log of the listed anchors that a rule renames, and the rule in words; None without one.

    Nothing is assumed if one id is in both, or if the rule leaves out an anchor of the log.

    Args:
        listed: ids of the points in the file; some may be no anchors.
        heard: ids of the anchors in the log.
    """
    if not heard or not {*heard}.isdisjoint(listed):
        return None
    alike = defaultdict(list)
    for name in listed:
        alike[_spelt(name)].append(name)
    if {*map(_spelt, heard)} <= alike.keys() and len({*map(_spelt, heard)}) == len({*heard}):
        own = {name: alike[_spelt(name)] for name in heard}
        if all(len(names) == 1 for names in own.values()):
            return {names[0]: name for name, names in own.items()}, "the ids are spelt otherwise"
    return _by_number(listed, heard)


def _spelt(name: str) -> str:
    """Return an id without what programs write differently: capitals, 0x before a hexadecimal id, zeros in front."""
    return name.strip().casefold().removeprefix("0x").lstrip("0") or "0"


def _by_number(listed: Sequence[str], heard: Collection[str]) -> tuple[dict[str, str], str] | None:
    of_log = {name: match for name in heard if (match := _NUMBERED.fullmatch(name))}
    if len(of_log) < len({*heard}) or len({match[1] for match in of_log.values()}) > 1:
        return None
    numbers = {name: int(match[2]) for name, match in of_log.items()}
    groups: dict[str, dict[int, str]] = defaultdict(dict)
    for name in listed:
        if match := _NUMBERED.fullmatch(name):
            groups[match[1]][int(match[2])] = name
    least = min(numbers.values())
    rules = [
        (prefix, group, added)
        for prefix, group in groups.items()
        for added in (number - least for number in group)
        if added >= 0 and added % _ROUND == 0 and {number + added for number in numbers.values()} <= group.keys()
    ]
    if len(rules) != 1:
        return None
    ((prefix, group, added),) = rules
    before = next(iter(of_log.values()))[1]
    words = [f"{prefix or 'nothing'} stands for {before or 'nothing'}"] if prefix != before else []
    words += [f"{added} is added to the numbers"] if added else []
    # Points of the same numbering that the log does not hear, as anchors that hear only each other, are named alike.
    others = {name: f"{before}{number - added}" for number, name in group.items() if number >= added}
    others = {name: there for name, there in others.items() if there not in listed}
    return others | {group[number + added]: name for name, number in numbers.items()}, " and ".join(words)
