"""The command ``plan``, for the time before a survey."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.errors import GeometryError, InputError
from rangesfm.progress import Progress


def add_planning_commands(commands: Commands) -> None:
    plan = commands.add(
        "plan", _plan, "say before a survey how accurate it will be, and what to change", is_common=True
    )
    plan.add_argument("plan", nargs="?", metavar="PLAN.toml", help="file with anchors, path and radio")
    plan.add_argument("--from", dest="result", metavar="RESULT", help="plan another survey like this finished one")
    plan.add_argument("--output_path", metavar="FOLDER", help="write plan.json and plan.html into this folder")


def _plan(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Compute what a run of a survey would say, before any range is measured: how accurately the scale and the place
    of the map will be known, which mistakes would be found, and which change of anchors, path or radio would help
    most. If a run would refuse the scale, the exit status is 3; all is printed and written nevertheless.

    example:
      rangesfm plan plan.toml --output_path plan
      rangesfm plan --from out
    """
    if (args.plan is None) == (args.result is None):
        raise InputError("expected either the file of a plan or --from RESULT")
    from rangesfm.planning.placement import place_anchors
    from rangesfm.planning.plan_file import read_plan
    from rangesfm.planning.survey_plan import REFUSED, plan_survey
    from rangesfm.report.plan_page import write_plan
    from rangesfm.util.files.atomic import require_apart

    if args.output_path is not None:
        require_apart([Path(args.plan or args.result)], Path(args.output_path))
    if args.plan is not None:
        planned = place_anchors(read_plan(args.plan), progress)
    else:
        from rangesfm.pipeline.plan_again import plan_of_result

        planned = plan_of_result(args.result)
    plan = plan_survey(planned)
    for warning in plan.warnings:
        progress.message(warning)
    written = [] if args.output_path is None else map(str, write_plan(plan, Path(args.output_path)))
    return Outcome([*plan.lines, *written], GeometryError.exit_status if plan.verdict == REFUSED else 0)
