"""Files that may be read in several ways: the error that says so, with what to type for each way."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rangesfm.errors import InputError


def columns_typed(columns: Mapping[str, str]) -> str:
    """Return the columns of quantities as one gives them to a flag."""
    return ",".join(f"{quantity}={name}" for quantity, name in columns.items())


def flags_typed(flags: Mapping[str, str]) -> list[str]:
    """Return the words that give flags their values; those without a value are left out."""
    return [word for flag, value in flags.items() if value for word in (f"--{flag}", value)]


@dataclass(frozen=True)
class Choice:
    """One way to read a file.

    Attributes:
        when: the case in which it is right, for the user; empty if the flags say it.
        flags: value of each flag that chooses it.
    """

    when: str
    flags: Mapping[str, str]

    def __str__(self) -> str:
        return f"{self.when}, add {shlex.join(flags_typed(self.flags))}"

    def typed(self, command: Sequence[str], said: Mapping[str, str]) -> str:
        """Return the command that reads the file so, where ``said`` are the flags that the user gave."""
        words = shlex.join([*command, *flags_typed({**said, **self.flags})])
        return f"{self.when}: {words}" if self.when else words


class UnclearFileError(InputError):
    """A file whose columns or units are not known for sure. The advice gives the flags for each way to read it.

    Attributes:
        what: what it lists, such as "anchors".
        about: lines that say what was found, and what is not sure.
        choices: the ways to read it.
        message: the text without the path.
    """

    def __init__(self, what: str, path: Path, about: Sequence[str], choices: Sequence[Choice], message: str = ""):
        self.what, self.about, self.choices = what, tuple(about), tuple(choices)
        self.message = message or f"a table of {what} whose columns are not known for sure"
        super().__init__(self.message, path, advice=[*self.about, *map(str, self.choices)])

    def advising(self, advice: Sequence[str]) -> InputError:
        """Return an error with the same text and other advice."""
        return InputError(self.message, self.path, advice=advice)
