"""A TOML file, and in which line of it a key stands."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError, OptionError, printable

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@dataclass(frozen=True)
class Source:
    """Where options come from, for messages; all are alike otherwise.

    Attributes:
        path: the file; None if there is none.
        text: its content.
        overridden: dotted keys whose values came from elsewhere.
    """

    path: Path | None = field(default=None, compare=False)
    text: str = field(default="", compare=False, repr=False)
    overridden: tuple[str, ...] = field(default=(), compare=False)

    @contextmanager
    def naming_lines(self) -> Iterator[None]:
        """Say in which line of the file an option stands that is found wrong."""
        try:
            yield
        except OptionError as error:
            key = f"{error.table}.{error.key or ''}".strip(".")
            if any(f"{key}.".startswith(f"{other}.") for other in self.overridden):
                raise InputError(str(error)) from None
            # Keys of [mapper] that are not ours are the pipeline's; an entry of a table may stand in the table's line.
            places = (key, key.replace("mapper.pipeline", "mapper"), key.rpartition(".")[0])
            lines = (self._line_of(place) for place in places)
            raise InputError(str(error), self.path, next(filter(None, lines), None)) from None

    def _line_of(self, wanted: str) -> int | None:
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


def parse_toml(path: Path) -> tuple[dict[str, Any], Source]:
    """The content of a TOML file; InputError with the line if it is none."""
    from rangesfm.files.tables import read_text

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


def parse_inline_table(text: str) -> dict[str, Any]:
    """``a = 1, b.c = "x"`` as TOML reads it; ValueError if it is no such thing."""
    table: dict[str, Any] = tomllib.loads(f"table = {{{text}}}")["table"]
    return table


def _dotted(text: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in text.split(".")).strip(".")
