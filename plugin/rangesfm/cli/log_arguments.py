"""Arguments that say how a radio's log is read, shared by the commands that take one alone."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.survey_flags import LOG_FLAGS, add_flags, overrides_from_arguments

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.log import RangeLog


def add_log_arguments(parser: argparse.ArgumentParser) -> None:
    """The log and how it is written."""
    parser.add_argument("log", metavar="LOG", help="the radio's log")
    parser.add_argument("--format", metavar="FORMAT", help="its format (default: recognised by content)")
    add_flags(parser, LOG_FLAGS)


def read_log(args: argparse.Namespace, anchor_ids: Sequence[str] = ()) -> RangeLog:
    """The log that the arguments name; ``anchor_ids`` as for ``read_ranges``."""
    from rangesfm.survey import inputs
    from rangesfm.survey.settings import survey_from_tables

    config = survey_from_tables({}, Path.cwd(), overrides_from_arguments(args)).ranges
    return inputs.read_log(replace(config, path=Path(args.log), format=args.format), anchor_ids)
