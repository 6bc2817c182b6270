"""Parser of a command, with two pages of help: a short one for ``-h``, and everything for ``--help``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NoReturn, TypeAlias

from rangesfm.errors import InputError

_OPTIONS = argparse.Action([], "options", metavar="[options]")  # stands for them all in the usage


# A list of arguments or commands: its title, the arguments, and a text below the title.
HelpSection: TypeAlias = tuple[str | None, Sequence[argparse.Action], str | None]


class HelpFormatter(argparse.HelpFormatter):
    """Formatter that wraps texts to the width of the terminal. Indented lines, such as commands, stay as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines: list[str] = []
        for is_prose, group in groupby(text.splitlines(), lambda line: bool(line[:1].strip())):
            block = list(group)
            lines += [super()._fill_text(" ".join(block), width, indent)] if is_prose else block
        return "\n".join(lines)


class PrintHelp(argparse.Action):
    """Flag ``-h`` or ``--help``, which ends the reading of arguments with the text to print."""

    def __init__(self, option_strings: Sequence[str], dest: str):
        super().__init__(option_strings, dest, nargs=0, help="-h: what most people need; --help: everything")

    def __call__(self, parser: object, namespace: object, values: object, name: str | None = None) -> None:
        assert isinstance(parser, Parser)
        raise SystemExit(parser.help_page(is_full=name == "--help").rstrip("\n"))


class Parser(argparse.ArgumentParser):
    """Parser that raises InputError where argparse would print its usage and exit.

    Its short page of help has the arguments that are in no group, and the common ones.

    Attributes:
        common: attributes of the parsed arguments that hold the common ones of the groups.
        general: group of the options that all commands have.
        more: last lines of the short page.
        later: functions that add arguments to this parser when it is first used. The parsers of all commands are made
            on each run, but only one is used, and some arguments are slow to make.
    """

    def __init__(self, **options: Any):
        super().__init__(formatter_class=HelpFormatter, allow_abbrev=False, add_help=False, **options)
        self.color = False  # with colours, those of Python 3.14, the text would contain control characters
        self.common: set[str] = set()
        self.more = f"everything:\n  {self.prog} --help"
        self.later: list[Callable[[Parser], object]] = []
        self.general = self.add_argument_group("general")
        self.general.add_argument("-h", "--help", action=PrintHelp)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        while self.later:
            self.later.pop(0)(self)
        return super().parse_known_args(args, namespace)

    def _print_message(self, message: str, file: object = None) -> NoReturn:
        raise SystemExit(message.rstrip("\n"))

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} -h)")

    def help_page(self, *, is_full: bool) -> str:
        """Return the text of ``--help`` (everything) or of ``-h``."""
        formatter = self.formatter_class(prog=self.prog)
        required = [action for action in self._actions if action.required or not action.option_strings]
        formatter.add_usage(self.usage, [_OPTIONS, *required], [])
        description = self.description or ""
        formatter.add_text(description if is_full else description.partition("\n\n")[0])
        for title, actions, text in self.help_sections(is_full=is_full):
            formatter.start_section(title)
            formatter.add_text(text)
            formatter.add_arguments(actions)
            formatter.end_section()
        formatter.add_text(self.epilog)
        formatter.add_text("" if is_full else self.more)
        return formatter.format_help()

    def help_sections(self, *, is_full: bool) -> list[HelpSection]:
        """Return the lists of a page: all groups, or what is common of them in two lists."""
        if is_full:
            return [(group.title, group._group_actions, group.description) for group in self._action_groups]
        ungrouped = {action for group in self._action_groups[:2] for action in group._group_actions}
        shown = [action for action in self._actions if action in ungrouped or action.dest in self.common]
        arguments, options = ([a for a in shown if bool(a.option_strings) == is_option] for is_option in (False, True))
        return [("arguments", arguments, None), ("options", options, None)]
