"""``rangesfm run``: the whole pipeline."""

from __future__ import annotations

import argparse

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import (
    RANGE_FLAGS,
    RECONSTRUCTION_FLAGS,
    REFINE_FLAGS,
    add_model_argument,
    add_restart_argument,
    add_survey_arguments,
    require_images,
    require_model,
    require_ranges,
    survey_from_arguments,
)
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "run",
        execute,
        help="photos and ranges to a metric model: the whole pipeline",
        description="Photos and ranges to a metric model. Stages that an earlier run has done are used again.",
        example="rangesfm run survey.toml --every_nth 3 --output_path out",
    )
    add_survey_arguments(parser, RECONSTRUCTION_FLAGS, RANGE_FLAGS, REFINE_FLAGS)
    add_model_argument(parser)
    add_restart_argument(parser)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    survey = survey_from_arguments(args)
    if survey.model_path is None:
        require_images(survey)
    else:
        require_model(survey)
    require_ranges(survey)
    from rangesfm.pipeline import refine_model, run_survey

    if survey.model_path is None:
        result = run_survey(survey, progress=progress, restart=args.restart)
    else:
        result = refine_model(survey, progress=progress)
    return Outcome(result.summary_lines())
