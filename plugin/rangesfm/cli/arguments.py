"""Reading of arguments: the parser of all commands, and option names in both spellings."""

from __future__ import annotations

import argparse
import difflib
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NoReturn

from rangesfm.cli.help_pages import HelpParser, HelpSection
from rangesfm.errors import InputError
from rangesfm.progress import Progress

# Modules with commands, in the order in which the help lists the commands.
_MODULES = ("begin", "stages", "batch", "planning", "results", "ranges", "doctor")


@dataclass(frozen=True)
class Outcome:
    """End of a command: lines to print, and the exit status."""

    lines: Sequence[str]
    status: int = 0


Execute = Callable[[argparse.Namespace, Progress], Outcome]


class Parser(HelpParser):
    """Parser that raises InputError where argparse would print its usage and exit.

    Attributes:
        later: functions that add arguments to this parser when it is first used. The parsers of all commands are made
            on each run, but only one is used, and some arguments are slow to make.
    """

    def __init__(self, **options: Any):
        super().__init__(**options)
        self.later: list[Callable[[Parser], object]] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        while self.later:
            self.later.pop(0)(self)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} -h)")

    def nearest_option(self, name: str) -> str | None:
        """Return the known long option that is spelt most like ``name``; None if none is similar."""
        return next(iter(difflib.get_close_matches(name, self._option_string_actions, 1)), None)


class ProgramParser(Parser):
    """Parser of the whole command line; its help lists the commands.

    Attributes:
        commands: all commands with their lines of help, by whether the short help lists them too.
    """

    def __init__(self) -> None:
        super().__init__(
            prog="rangesfm",
            usage="rangesfm COMMAND [options]",
            description="Metric COLMAP models from photos and ultra-wideband ranges.",
            epilog="example:\n  rangesfm demo\n\nmore:\n"
            "  rangesfm --help          all commands\n"
            "  rangesfm COMMAND -h      what most people need of a command\n"
            "  rangesfm COMMAND --help  everything about it; options may be spelt with _ or -",
        )
        self.more = None
        self.commands: dict[bool, list[argparse.Action]] = {True: [], False: []}
        self.general.add_argument("--version", action=_PrintVersion)

    def help_sections(self, *, is_full: bool) -> Sequence[HelpSection]:
        common = HelpSection("commands", self.commands[True])
        if not is_full:
            return [common]
        more = HelpSection("more commands", self.commands[False])
        return [common, more, HelpSection("options", self.general._group_actions)]


class Commands:
    """All commands, each described by its own module, and the parser of the whole command line.

    Attributes:
        parser: of the whole command line.
        by_name: parser of each command, in the order of the help.
    """

    def __init__(self) -> None:
        self.parser = ProgramParser()
        self._subparsers = self.parser.add_subparsers(prog="rangesfm", metavar="COMMAND", parser_class=Parser)
        self.by_name: dict[str, Parser] = {}
        for module in _MODULES:
            getattr(import_module(f"rangesfm.cli.{module}"), f"add_{module}_commands")(self)

    def add(self, name: str, execute: Execute, help: str, *, is_common: bool = False) -> Parser:
        """Add a command and return its parser, with the options that all commands have.

        Args:
            name: of the command; it may have two words.
            execute: function that runs it. Its docstring is the description and the example in the help.
            help: one line for the list of commands.
            is_common: whether most people need it; the others are in a list of their own, in the full help only.
        """
        description, _, example = inspect.cleandoc(execute.__doc__ or "").partition("\n\nexample:")
        parser: Parser = self._subparsers.add_parser(name, description=description, epilog=f"example:{example}")
        parser.general.add_argument("--quiet", action="store_true", help="print results and errors only")
        parser.set_defaults(execute=execute, command=name)
        self.parser.commands[is_common].append(argparse.Action([], name, help=help))
        self.by_name[name] = parser
        return parser


def normalize(argv: Sequence[str]) -> list[str]:
    """Return arguments with option names in snake case, and values with a minus sign joined to their option.

    ``--tag-in-cam -0.1,0,0`` becomes ``--tag_in_cam=-0.1,0,0``, because argparse would take the value for an option.
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
    """Read normalised arguments; the attribute ``typed`` has them all as one command, for advice.

    Raises:
        InputError: an unknown command or option (the text names the nearest known one), or a bad value.
        SystemExit: with the text to print, for ``-h``, ``--help`` and ``--version``.
    """
    commands = Commands()
    args: argparse.Namespace
    two = " ".join(argv[:2])  # argparse needs a command of two words as one argument
    args, unknown = commands.parser.parse_known_args([two, *argv[2:]] if two in commands.by_name else list(argv))
    if not hasattr(args, "command"):
        commands.parser.error("a command is missing, expected one of " + ", ".join(commands.by_name))
    args.typed = ["rangesfm", *argv]
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
