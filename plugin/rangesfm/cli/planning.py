"""The command before going out: ``plan``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.errors import InputError
from rangesfm.progress import Progress


def add_commands(commands: Commands) -> None:
    plan = commands.add("plan", _plan, "before going out: what a survey will know, and what to change")
    plan.add_argument("plan", nargs="?", metavar="PLAN.toml", help="anchors, path and radio")
    plan.add_argument("--from", dest="result", metavar="RESULT", help="the same for another survey like a finished one")
    plan.add_argument("--output_path", metavar="FOLDER", help="write plan.json and plan.html there")


def _plan(args: argparse.Namespace, progress: Progress) -> Outcome:
    """What a run of a survey would state before a range is measured: how well the scale and the place of the map
    will be known, which mistakes would be found, and which change of anchors, path or radio would gain most.

    example:
      rangesfm plan plan.toml --output_path plan
      rangesfm plan --from out
    """
    if (args.plan is None) == (args.result is None):
        raise InputError("expected either a plan's file or --from RESULT")
    from rangesfm.files.atomic import require_apart
    from rangesfm.planning.placement import place_anchors
    from rangesfm.planning.settings import read_plan
    from rangesfm.planning.survey_plan import plan_survey
    from rangesfm.report.plan_page import write_plan

    if args.output_path is not None:
        require_apart([Path(args.plan or args.result)], Path(args.output_path))
    if args.plan is not None:
        planned = place_anchors(read_plan(args.plan), progress)
    else:
        from rangesfm.workflows.plan_again import plan_of_result

        planned = plan_of_result(args.result)
    plan = plan_survey(planned)
    written = [] if args.output_path is None else map(str, write_plan(plan, Path(args.output_path)))
    return Outcome([*plan.lines, *written])
