"""Arguments that say how a radio's log is read, shared by the commands that take one alone."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Parser
from rangesfm.cli.survey_flags import LOG_KEYS, add_flags, overrides_from_arguments

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.log import RangeLog


def add_log_arguments(parser: Parser) -> None:
    """The log and how it is written."""
    parser.add_argument(
        "log", nargs="+", metavar="LOG", help="the radio's log; a folder or several files: one an anchor"
    )
    add_flags(parser, *LOG_KEYS, by_own_names=True)


def notes_of_log(log: RangeLog) -> list[str]:
    """What was assumed of it, as lines for people."""
    return [f"note    {note}" for note in log.notes]


def read_log(args: argparse.Namespace, anchor_ids: Sequence[str] = ()) -> RangeLog:
    """The log that the arguments name; ``anchor_ids`` as for ``read_ranges``."""
    from rangesfm.survey import inputs
    from rangesfm.survey.settings import survey_from_tables

    options = survey_from_tables({}, Path.cwd(), overrides_from_arguments(args)).ranges
    return inputs.read_log(options.changed(path=Path(args.log[0])), anchor_ids, files=args.log)
