"""Flags for the keys of a survey file. They are made from the keys, and shared by the commands that run stages."""

from __future__ import annotations

import argparse
import os
import types
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

from rangesfm.cli.help_pages import Parser
from rangesfm.errors import InputError
from rangesfm.progress import SILENT, Progress

if TYPE_CHECKING:
    from rangesfm.option_model import Key
    from rangesfm.survey.settings import Survey

MEASURED = "measured"
"""In place of the name of a table: all tables of what gives a map its metres."""
_WORDS = {"m": "METRES", "s": "SECONDS"}


def add_survey_arguments(parser: Parser, *keys: str, without: tuple[str, ...] = ()) -> None:
    """Add the argument of the survey file, and flags for its keys as ``add_flags`` does."""
    parser.add_argument(
        "survey",
        nargs="?",
        metavar="SURVEY.toml",
        help="survey file; or a folder with one, or with photos and logs as for init; flags override its keys",
    )
    parser.add_argument(
        "--base_path", metavar="FOLDER", help="folder to which paths in the file are relative (default: its own)"
    )
    add_flags(parser, *keys, without=without)


def add_restart_argument(parser: Parser) -> None:
    parser.add_argument("--restart", action="store_true", help="do all stages again, also those done by an earlier run")


def add_flags(parser: Parser, *keys: str, without: tuple[str, ...] = (), by_own_names: bool = False) -> None:
    """Add flags for keys of a survey file; ``overrides_from_arguments`` returns their values.

    Args:
        keys: dotted keys of a survey file, or names of tables for all of their keys, or ``MEASURED``; none: all keys
            there are.
        without: keys that get no flag here.
        by_own_names: whether the flags have the names of the keys, for a command that is about one table.
    """
    # Importing the keys takes longer than all else, and only the flags of the command that is run are needed.
    parser.later.append(partial(_add_flags, keys=keys, without=without, by_own_names=by_own_names))


def _add_flags(parser: Parser, *, keys: tuple[str, ...], without: tuple[str, ...], by_own_names: bool) -> None:
    from rangesfm.survey.settings import METRIC_KEYS, SURVEY_TABLES, chosen_keys

    if MEASURED in keys:
        keys = (*keys, *(dotted.partition(".")[0] for dotted in METRIC_KEYS))
    for table, model in SURVEY_TABLES.items():
        # Both keys for lever arms share one flag.
        left_out = (*without, "tag.lever_arms_m")
        if chosen := [item for item in chosen_keys(keys) if item.table == table and item.dotted not in left_out]:
            group = parser.add_argument_group(f"[{table}] in a survey file", model.__doc__)
            for item in chosen:
                _add_flag(group, item, item.name if by_own_names else item.flag)
            parser.common |= {item.dotted for item in chosen if item.is_common}


def _add_flag(group: argparse._ArgumentGroup, item: Key, flag: str) -> None:
    meaning = item.meaning.replace("%", "%%")
    if item.type is bool:
        group.add_argument(f"--{flag}", f"--no_{flag}", dest=item.dotted, action=_Switch, help=meaning)
        return
    choices = get_args(item.type) if get_origin(item.type) is Literal else None
    if choices and item.metavar:  # they are too many for the place of a value
        meaning += f". One of {', '.join(map(str, choices))}"
    is_lever_arm = item.dotted == "tag.tag_in_cam_m"
    group.add_argument(
        f"--{flag}",
        dest=item.dotted,
        action="append" if is_lever_arm else "store",
        type=_lever_arm if is_lever_arm else _converter(item.type),
        choices=choices,
        help=meaning,
        metavar=item.metavar or (None if choices else _metavar(item)),
    )


class _Switch(argparse.Action):
    """Flag without a value. It sets true, or false where it is given under its name with ``no_``."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str):
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: object, namespace: argparse.Namespace, values: object, name: str | None = None) -> None:
        setattr(namespace, self.dest, name == self.option_strings[0])


def _metavar(item: Key) -> str:
    hint = item.type
    if item.role is not None:
        return "CSV" if item.role.startswith("file") else "FOLDER"
    if get_origin(hint) is tuple:
        return "A,B,.." if get_args(hint)[-1] is Ellipsis else "X,Y,Z"
    if hint is int or int in get_args(hint):
        return "N"
    if get_origin(hint) is dict:
        return "QUANTITY=NAME,.." if get_args(hint)[1] is str else "KEY=VALUE,.."
    last = item.name.rpartition("_")[2]
    return _WORDS.get(last, last.upper())


def _converter(hint: Any) -> Callable[[str], Any]:
    """Return the function that converts the text of a flag to a value of a type. The key checks the value itself."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return partial(_choice, args)
    if origin in (Union, types.UnionType):
        words = [word for arg in args for word in get_args(arg) if isinstance(word, str)]
        return partial(_word_or_number, words) if words else int
    if origin is tuple:
        return _numbers if args[0] is float else _names
    if origin is dict:
        return _columns if args[1] is str else _options
    return str if hint is Path else hint


def _choice(choices: tuple[str | int, ...], text: str) -> str | int:
    # argparse would refuse the same values, but each version of Python has its own words for that.
    for choice in choices:
        if text == str(choice):
            return choice
    raise argparse.ArgumentTypeError(f"'{text}' is not a choice, expected one of {', '.join(map(str, choices))}")


def _word_or_number(words: list[str], text: str) -> str | float:
    try:
        return text if text in words else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither {', '.join(words)} nor a number") from None


def _numbers(text: str) -> list[float]:
    try:
        return [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of numbers, expected as 1.5,-2,0") from None


def _names(text: str) -> list[str]:
    return [name for name in (part.strip() for part in text.split(",")) if name]


def position(text: str) -> list[float]:
    """Read three numbers X,Y,Z, as a type for argparse.

    Raises:
        argparse.ArgumentTypeError: the text is not three numbers.
    """
    numbers = _numbers(text)
    if len(numbers) != 3:
        raise argparse.ArgumentTypeError(f"'{text}' has {len(numbers)} numbers, expected X,Y,Z in metres")
    return numbers


def _lever_arm(text: str) -> tuple[str | None, list[float]]:
    """Read a tag's id (None without one) and its lever arm."""
    tag_id, colon, lever_arm = text.rpartition(":")
    if colon and not tag_id:
        raise argparse.ArgumentTypeError(f"'{text}' has no tag's id before the colon, expected X,Y,Z or ID:X,Y,Z")
    return tag_id or None, position(lever_arm)


def _columns(text: str) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in text.split(",")]
    if not all(quantity and name for quantity, _, name in pairs):
        raise argparse.ArgumentTypeError(f"'{text}' is not a mapping, expected as timestamp=t,anchor_id=node,range=d")
    return {quantity.strip(): name.strip() for quantity, _, name in pairs}


def _options(text: str) -> dict[str, Any]:
    from rangesfm.survey.survey_reader import parse_inline_table

    try:
        return parse_inline_table(text)
    except ValueError:
        message = f"'{text}' is not a list of options, expected as max_image_size=1200,sift.num_octaves=3"
        raise argparse.ArgumentTypeError(message) from None


def overrides_from_arguments(args: argparse.Namespace) -> dict[str, Any]:
    """Return the values of all flags that were given, by the dotted keys of a survey file.

    Raises:
        InputError: lever arms are given both with and without the id of a tag.
    """
    overrides = {key: value for key, value in vars(args).items() if "." in key and value is not None}
    lever_arms = dict(overrides.pop("tag.tag_in_cam_m", []))
    if None in lever_arms and len(lever_arms) > 1:
        raise InputError("--tag_in_cam is given with an ID and without, expected X,Y,Z once, or ID:X,Y,Z for each tag")
    if None in lever_arms:
        overrides["tag.tag_in_cam_m"] = lever_arms[None]
    elif lever_arms:
        overrides["tag.lever_arms_m"] = lever_arms
    if "images.path" in overrides and _is_table(overrides["images.path"]):
        overrides["images.times"] = overrides.pop("images.path")
    return overrides


def flags_given(args: argparse.Namespace, *keys: str) -> list[str]:
    """Return those flags of some keys that were given, with their dashes."""
    from rangesfm.survey.settings import chosen_keys

    return [f"--{item.flag}" for item in chosen_keys(keys) if getattr(args, item.dotted, None) is not None]


def survey_from_arguments(args: argparse.Namespace, progress: Progress = SILENT) -> Survey:
    """Return the survey that the arguments describe.

    It is the survey file, if there is one, with the given flags in place of its keys. For a folder without a survey
    file, it is what ``understand`` makes of the folder.

    Raises:
        InputError: the file cannot be read, or a key or a flag is wrong.
    """
    from rangesfm.survey.discovery.found_files import SURVEY_NAME
    from rangesfm.survey.survey_reader import read_survey, survey_from_tables

    overrides = overrides_from_arguments(args)
    path = None if getattr(args, "survey", None) is None else Path(args.survey)
    path = path / SURVEY_NAME if path is not None and (path / SURVEY_NAME).is_file() else path
    if path is None:
        return survey_from_tables({}, Path.cwd(), overrides)
    if path.is_dir():
        from rangesfm.survey.discovery.understood import understand
        from rangesfm.util.files.output_folder import free_output

        given = {"output.path": free_output(path.absolute()), **overrides}
        values, notes = understand([path], given, getattr(args, "typed", ()))
        for note in notes:
            progress.message(note)
        return survey_from_tables({}, Path.cwd(), values)
    return read_survey(path, overrides, args.base_path)


def _is_table(path: str) -> bool:
    from rangesfm.survey.sources.source import is_source

    return path.endswith(".csv") or (os.path.isfile(path) and not is_source(Path(path)))
