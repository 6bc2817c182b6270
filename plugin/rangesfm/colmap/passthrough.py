"""Transfer of survey file keys into pycolmap's option objects, each key checked."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rangesfm.colmap.glog import logging_into
from rangesfm.errors import OptionError, nearest_known, printable, shown

_EXPECTED = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    set: "a list",
    list: "a list",
}
_ACCEPTED: dict[type, tuple[type, ...]] = {float: (int, float), set: (list, tuple, set), list: (list, tuple)}


def apply_options(options: Any, values: Mapping[str, Any], table: str) -> None:
    """Set attributes of a pycolmap option object from a table of plain values.

    Args:
        options: any pycolmap ``*Options`` object; changed in place.
        values: values by COLMAP's own names. A nested object takes a table, an enumeration the name of a member.
        table: the user's name for this table, for messages (for example ``"mapper.pipeline"``).

    Raises:
        OptionError: a key is unknown (the message names the nearest known one), a value has another type, or COLMAP
            itself refuses a value (the message gives its reason).
    """
    _assign(options, values, table)
    if values and hasattr(type(options), "check"):
        _check(options, table)


def _assign(options: Any, values: Mapping[str, Any], table: str) -> None:
    known = options.todict(recursive=False)
    for key, value in values.items():
        if key not in known:
            nearest = nearest_known(key, known)
            message = f"unknown key '{printable(key)}' in [{table}]; the nearest known one is '{nearest}'"
            raise OptionError(message, table, key)
        # The type is asked, because asking a pycolmap object for an attribute that it lacks writes to COLMAP's log.
        if hasattr(type(known[key]), "todict"):
            if not isinstance(value, Mapping):
                raise _wrong_value(table, key, value, "a table")
            # Values are set on the attribute itself, because todict returned a copy.
            _assign(getattr(options, key), value, f"{table}.{key}")
        else:
            _assign_value(options, key, value, type(known[key]), table)


def _assign_value(options: Any, key: str, value: Any, kind: Any, table: str) -> None:
    """Set one attribute, with stricter types than pybind11, which accepts True for 1 and 1 for True."""
    if hasattr(kind, "__members__"):
        if not isinstance(value, str) or value not in kind.__members__:
            raise _wrong_value(table, key, value, "one of " + ", ".join(kind.__members__))
        setattr(options, key, kind.__members__[value])
        return
    kind = str if issubclass(kind, Path) else kind
    expected = _EXPECTED.get(kind, f"pycolmap.{kind.__name__}")
    if not isinstance(value, _ACCEPTED.get(kind, (kind,))) or (isinstance(value, bool) and kind is not bool):
        raise _wrong_value(table, key, value, expected)
    try:
        setattr(options, key, kind(value))
    except TypeError:  # an item of a list has another type, or a number is too large
        raise _wrong_value(table, key, value, f"{expected} that COLMAP accepts") from None


def _check(options: Any, table: str) -> None:
    """Let COLMAP check its values, and take the reason of a refusal from its log, the only place it is in."""
    with tempfile.TemporaryDirectory() as folder:
        with logging_into(Path(folder)):
            accepted = options.check()
        if not accepted:
            log = "".join(part.read_text(errors="replace") for part in Path(folder).iterdir())
            found = re.search(r"Check failed: (.*)", log)
            raise OptionError(f"[{table}] COLMAP refuses a value" + (f", expected {found[1]}" if found else ""), table)


def _wrong_value(table: str, key: str, value: Any, expected: str) -> OptionError:
    return OptionError(f"[{table}] {key} is {shown(value)}, expected {expected}", table, key)
