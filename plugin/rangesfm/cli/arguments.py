"""How arguments are read: the parser of all commands, and names in either spelling."""

from __future__ import annotations

import argparse
import difflib
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NoReturn

from rangesfm.errors import InputError
from rangesfm.progress import Progress

# In the order of the help.
_MODULES = ("begin", "stages", "batch", "planning", "results", "ranges", "doctor")


@dataclass(frozen=True)
class Outcome:
    """What a command ends with: lines to print, and its exit status."""

    lines: Sequence[str]
    status: int = 0


Execute = Callable[[argparse.Namespace, Progress], Outcome]


class Parser(argparse.ArgumentParser):
    """Raises InputError where argparse would print its usage and exit; has some arguments only once it reads."""

    def __init__(self, **options: Any):
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **options)
        self.later: list[Callable[[Parser], None]] = []  # what adds arguments when this parser is the one that reads

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        while self.later:
            self.later.pop(0)(self)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")

    def nearest_option(self, name: str) -> str | None:
        """The known long option that is spelt most like ``name``."""
        return next(iter(difflib.get_close_matches(name, self._option_string_actions, 1)), None)


class Commands:
    """All commands, each described by the file that does it, and the parser of the whole command line.

    Attributes:
        by_name: the parser of each, in the order of the help.
    """

    def __init__(self) -> None:
        self.parser = Parser(
            prog="rangesfm",
            description="Metric COLMAP models from photos and ultra-wideband ranges.",
            epilog="example:\n  rangesfm demo\n\n"
            "rangesfm COMMAND --help explains each; options may be spelt with _ or -.",
        )
        self.parser.add_argument("--version", action=_PrintVersion)
        self._subparsers = self.parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=Parser)
        self.by_name: dict[str, Parser] = {}
        for module in _MODULES:
            import_module(f"rangesfm.cli.{module}").add_commands(self)

    def add(self, name: str, execute: Execute, help: str) -> Parser:
        """A new command, with the options that all of them have. What it does, and an example, says its docstring."""
        description, _, example = inspect.cleandoc(execute.__doc__ or "").partition("\n\nexample:")
        parser: Parser = self._subparsers.add_parser(
            name,
            help=help,
            description=description,
            epilog=f"example:{example}",
        )
        parser.add_argument("--quiet", action="store_true", help="print results and errors only")
        parser.set_defaults(execute=execute, command=name)
        self.by_name[name] = parser
        return parser


def normalize(argv: Sequence[str]) -> list[str]:
    """Option names in snake case, and values that begin with a minus sign joined to their option.

    ``--tag-in-cam -0.1,0,0`` becomes ``--tag_in_cam=-0.1,0,0``, which argparse cannot take for an option.
    """
    arguments: list[str] = []
    for position, argument in enumerate(argv):
        if argument == "--":
            return arguments + list(argv[position:])
        if argument.startswith("--"):
            name, equals, value = argument.partition("=")
            arguments.append("--" + name[2:].replace("-", "_") + equals + value)
        elif re.match(r"-\.?\d", argument) and arguments and re.fullmatch(r"--\w+", arguments[-1]):
            arguments[-1] += f"={argument}"
        else:
            arguments.append(argument)
    return arguments


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Read normalised arguments.

    Raises:
        InputError: an unknown command or option, naming the nearest known one, or a bad value.
        SystemExit: after ``--help``; for ``--version`` with what is to be printed.
    """
    commands = Commands()
    args: argparse.Namespace
    two = " ".join(argv[:2])  # a command of two words is one to argparse
    args, unknown = commands.parser.parse_known_args([two, *argv[2:]] if two in commands.by_name else list(argv))
    if not hasattr(args, "command"):
        commands.parser.error("a command is missing, expected one of " + ", ".join(commands.by_name))
    if unknown:
        commands.by_name[args.command].error(_unknown(unknown[0], commands.by_name[args.command]))
    return args


def _unknown(argument: str, parser: Parser) -> str:
    if not argument.startswith("-"):
        return f"unexpected argument '{argument}'"
    name = argument.partition("=")[0]
    nearest = parser.nearest_option(name)
    return f"unknown option {name}" + (f"; the nearest known one is {nearest}" if nearest else "")


class _PrintVersion(argparse.Action):
    def __init__(self, option_strings: Sequence[str], dest: str):
        super().__init__(option_strings, dest, nargs=0, help="print the version")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        raise SystemExit(f"rangesfm {version('rangesfm')}")
