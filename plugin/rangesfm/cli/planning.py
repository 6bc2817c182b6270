"""The command before going out: ``plan``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.progress import Progress


def add_commands(commands: Commands) -> None:
    plan = commands.add("plan", _plan, "before going out: what a survey will know, and what to change")
    plan.add_argument("plan", metavar="PLAN.toml", help="anchors, path and radio")
    plan.add_argument("--output_path", metavar="FOLDER", help="write plan.json there")


def _plan(args: argparse.Namespace, progress: Progress) -> Outcome:
    """What a run of a survey would state before a range is measured: how well the scale and the place of the map
    will be known, which mistakes would be found, and which change of anchors, path or radio would gain most.

    example:
      rangesfm plan plan.toml --output_path plan
    """
    from rangesfm.planning.placement import place_anchors
    from rangesfm.planning.settings import read_plan
    from rangesfm.planning.survey_plan import plan_survey, write_plan

    plan = plan_survey(place_anchors(read_plan(args.plan), progress))
    written = [] if args.output_path is None else [str(write_plan(plan, Path(args.output_path)))]
    return Outcome([*plan.lines, *written])
