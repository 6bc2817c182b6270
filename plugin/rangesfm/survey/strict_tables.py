"""TOML read strictly: a key that nobody asks for is an error, and so is a value of the wrong type."""

from __future__ import annotations

import difflib
import math
import re
import sys
import types
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from rangesfm.errors import InputError
from rangesfm.files.tables import printable, read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Options = TypeVar("Options")
_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text", dict: "a table"}


@dataclass(frozen=True)
class Source:
    """Where tables come from, for messages.

    Attributes:
        path: the file; None if there is none.
        text: its content.
        overridden: dotted keys whose values came from elsewhere.
    """

    path: Path | None = None
    text: str = ""
    overridden: Collection[str] = frozenset()

    def error(self, message: str, table: str, key: str | None = None) -> InputError:
        """The error about ``key`` of ``table`` (or about the table), with its line in the file."""
        if key is not None and f"{table}.{key}" in self.overridden:
            return InputError(message)
        return InputError(message, self.path, self._line_of(table, key))

    def _line_of(self, table: str, key: str | None) -> int | None:
        wanted = f"{table}.{key}".strip(".") if key is not None else table
        current = ""
        for line, text in enumerate(self.text.split("\n"), 1):
            if header := re.match(r"\s*\[\[?([^\[\]]+)\]", text):
                current = _dotted(header[1])
                if current == wanted:
                    return line
            elif assignment := re.match(r"\s*([\w.\"' -]+?)\s*=", text):
                name = _dotted(f"{current}.{assignment[1]}")
                if f"{name}.".startswith(f"{wanted}."):
                    return line
        return None


@dataclass(frozen=True)
class Rule:
    """What values a key may have beyond its type."""

    expected: str
    holds: Callable[[Any], bool]


def parse_toml(path: Path) -> tuple[dict[str, Any], Source]:
    """The content of a TOML file; InputError with the line if it is none."""
    text = read_text(path)
    try:
        return tomllib.loads(text), Source(path, text)
    except RecursionError:
        raise InputError("not a TOML file (nested too deeply)", path) from None
    except ValueError as error:  # TOMLDecodeError, and numbers that Python refuses
        where = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", str(error))
        message = str(error)[: where.start()] if where else str(error)
        line = None if where is None else int(where[1] or text.rstrip().count("\n") + 1)
        raise InputError(f"not a TOML file ({printable(message)})", path, line) from None


class StrictTable:
    """One table of a file: asked for key by key, and then whether anything is left."""

    def __init__(self, values: object, name: str, source: Source, rules: Mapping[str, Rule] | None = None):
        if not isinstance(values, Mapping):
            raise source.error(f"{name} is {_shown(values)}, expected a table [{name}]", "", name)
        self._values: Mapping[str, Any] = values
        self._name = name
        self._source = source
        self._rules = rules or {}
        self._known: list[str] = []

    def value(self, key: str, hint: Any, default: Any = None) -> Any:
        """The value of ``key`` as the type ``hint``, by the rule of its name; ``default`` if it is not there."""
        self._known.append(key)
        if key not in self._values:
            return default
        given = self._values[key]
        try:
            value = _convert(given, hint)
        except _WrongTypeError as error:
            raise self.error(key, str(error)) from None
        rule = self._rules.get(key)
        if rule is not None and not rule.holds(value):
            raise self.error(key, rule.expected)
        return value

    def options(self, cls: type[Options]) -> Options:
        """A dataclass from the keys that are its fields; the others keep their defaults."""
        hints = get_type_hints(cls)
        names = [item.name for item in fields(cls)]  # type: ignore[arg-type]
        given = {name: self.value(name, hints[name]) for name in names}
        return cls(**{name: value for name, value in given.items() if name in self._values})

    def rest(self) -> dict[str, Any]:
        """What has not been asked for; it counts as asked for then."""
        rest = {key: value for key, value in self._values.items() if key not in self._known}
        self._known += rest
        return rest

    def refuse_unknown(self, *, min_likeness: float = 0.0) -> None:
        """Raise InputError for a key that was not asked for, naming the nearest that was.

        Args:
            min_likeness: from 0 to 1; a key less like any known one than this is let through.
        """
        for key in self._values:
            nearest = difflib.get_close_matches(key, self._known, 1, min_likeness)
            if nearest and key not in self._known:
                what = f"key '{printable(key)}' in [{self._name}]" if self._name else f"table [{printable(key)}]"
                message = f"unknown {what}; the nearest known one is '{nearest[0]}'"
                raise self._source.error(message, self._name, key)

    def error(self, key: str, expected: str) -> InputError:
        """The error that says what ``key`` is instead of ``expected``."""
        message = f"[{self._name}] {key} is {_shown(self._values[key])}, expected {expected}"
        return self._source.error(message, self._name, key)


class _WrongTypeError(Exception):
    """Its text is what was expected."""


def _convert(value: Any, hint: Any) -> Any:
    """``value`` as the type that the annotation of an option says."""
    if hint is Any:
        return value
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _convert(value, next(arg for arg in args if arg is not types.NoneType))
    if origin is tuple:
        return _convert_list(value, args)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise _WrongTypeError(_NAMES[dict])
        try:
            return {key: _convert(item, args[1]) for key, item in value.items()}
        except _WrongTypeError as error:
            raise _WrongTypeError(f"a table in which each value is {error}") from None
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if abs(value) <= sys.float_info.max and not math.isnan(value):
            return float(value)
        raise _WrongTypeError("a finite number")
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise _WrongTypeError(_NAMES[hint])
    return value


def _convert_list(value: Any, args: tuple[Any, ...]) -> tuple[Any, ...]:
    of_any_length = args[-1] is Ellipsis
    name = {float: "numbers", int: "whole numbers", str: "texts"}[args[0]]
    if not isinstance(value, (list, tuple)) or not (of_any_length or len(value) == len(args)):
        raise _WrongTypeError(f"a list of {name}" if of_any_length else f"a list of {len(args)} {name}")
    try:
        return tuple(_convert(item, args[0]) for item in value)
    except _WrongTypeError:
        raise _WrongTypeError(f"a list of {name}") from None


def _dotted(text: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in text.split(".")).strip(".")


def _shown(value: object) -> str:
    return printable(
        f"'{value}'" if isinstance(value, str) else "a table" if isinstance(value, Mapping) else str(value)
    )
