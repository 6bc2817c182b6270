"""Reading of arguments: the parser of all commands, and option names in both spellings."""

from __future__ import annotations

import argparse
import difflib
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

from rangesfm import __version__
from rangesfm.cli.help_pages import HelpSection, Parser
from rangesfm.progress import Progress

# Modules with commands, in the order in which the help lists the commands.
_MODULES = ("begin", "stages", "batch", "results", "ranges")


@dataclass(frozen=True)
class Outcome:
    """End of a command: lines to print, and the exit status."""

    lines: Sequence[str]
    status: int = 0


Execute = Callable[[argparse.Namespace, Progress], Outcome]


class Commands(Parser):
    """Parser of the whole command line, with all commands, each described by its own module; its help lists them.

    Attributes:
        by_name: parser of each command, in the order of the help.
        listed: all commands with their lines of help, by whether the short help lists them too.
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
        self.more = ""
        version = f"rangesfm {__version__}"
        self.general.add_argument("--version", action="version", version=version, help="print the version")
        self.by_name: dict[str, Parser] = {}
        self.listed: dict[bool, list[argparse.Action]] = {True: [], False: []}
        self._subparsers_of_commands = self.add_subparsers(prog="rangesfm", metavar="COMMAND", parser_class=Parser)
        for module in _MODULES:
            getattr(import_module(f"rangesfm.cli.{module}"), f"add_{module}_commands")(self)

    def add(self, name: str, execute: Execute, help: str, *, is_common: bool = False) -> Parser:
        """Add a command and return its parser, with the options that all commands have.

        Args:
            name: of the command; it may have two words.
            execute: function that runs it. Its docstring is the description and the example in the help.
            is_common: whether most people need it; the others are in a list of their own, in the full help only.
        """
        description, _, example = inspect.cleandoc(execute.__doc__ or "").partition("\n\nexample:")
        parser: Parser = self._subparsers_of_commands.add_parser(
            name, description=description, epilog=f"example:{example}"
        )
        parser.general.add_argument("--quiet", action="store_true", help="print results and errors only")
        parser.set_defaults(execute=execute, command=name)
        self.listed[is_common].append(argparse.Action([], name, help=help))
        self.by_name[name] = parser
        return parser

    def help_sections(self, *, is_full: bool) -> list[HelpSection]:
        common: HelpSection = ("commands", self.listed[True], None)
        if not is_full:
            return [common]
        return [common, ("more commands", self.listed[False], None), ("options", self.general._group_actions, None)]


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
    args, unknown = commands.parse_known_args([two, *argv[2:]] if two in commands.by_name else list(argv))
    if not hasattr(args, "command"):
        commands.error("a command is missing, expected one of " + ", ".join(commands.by_name))
    args.typed = ["rangesfm", *argv]
    if unknown:
        parser, name = commands.by_name[args.command], unknown[0].partition("=")[0]
        if not name.startswith("-"):
            parser.error(f"unexpected argument '{unknown[0]}'")
        nearest = difflib.get_close_matches(name, parser._option_string_actions, 1)
        parser.error(f"unknown option {name}" + (f"; the nearest known one is {nearest[0]}" if nearest else ""))
    return args
