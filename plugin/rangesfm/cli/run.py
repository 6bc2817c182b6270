"""``rangesfm run``: the whole pipeline."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import (
    add_model_argument,
    add_restart_argument,
    add_survey_arguments,
    require_images,
    require_model,
    require_ranges,
    survey_from_arguments,
)
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from rangesfm.survey.settings import Survey
    from rangesfm.workflows.results import RunResult


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "run",
        execute,
        help="photos and ranges to a metric model: the whole pipeline",
        description="Photos and ranges to a metric model. Stages that an earlier run has done are used again.",
        example="rangesfm run survey.toml --every_nth 3 --output_path out",
    )
    add_survey_arguments(parser)
    add_model_argument(parser)
    add_restart_argument(parser)
    parser.add_argument("--live", action="store_true", help="keep live.html, a page to watch, in the output folder")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    survey = survey_from_arguments(args)
    if survey.model_path is None:
        require_images(survey)
    else:
        require_model(survey)
    require_ranges(survey)
    if not args.live:
        return Outcome(_run(survey, progress, args.restart).lines)
    from rangesfm.files.sole_writer import sole_writer
    from rangesfm.report.live import live_page

    with sole_writer(survey.output.path), live_page(progress, survey.output.path) as page:
        page.message(f"this run can be watched in {page.path}")
        result = _run(survey, page, args.restart)
        page.finish(survey.output.path / "report.html" if survey.report.enabled else None)
    return Outcome(result.lines)


def _run(survey: Survey, progress: Progress, restart: bool) -> RunResult:
    from rangesfm.workflows.run import refine_model, run_survey

    if survey.model_path is None:
        return run_survey(survey, progress=progress, restart=restart)
    return refine_model(survey, progress=progress)
