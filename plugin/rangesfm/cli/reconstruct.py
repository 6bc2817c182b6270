"""``rangesfm reconstruct``: photos to an unscaled model."""

from __future__ import annotations

import argparse

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import (
    add_restart_argument,
    add_survey_arguments,
    require_images,
    survey_from_arguments,
)
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "reconstruct",
        execute,
        help="photos to an unscaled COLMAP model",
        description="Photos to an unscaled COLMAP model: keyframes, features, matching, incremental mapping.",
        example="rangesfm reconstruct --images photos --image_times images.csv --output_path out",
    )
    add_survey_arguments(parser, "images", "camera", "mapper", "output")
    add_restart_argument(parser)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    survey = survey_from_arguments(args)
    require_images(survey)
    from rangesfm.workflows.run import reconstruct_survey

    return Outcome(reconstruct_survey(survey, progress=progress, restart=args.restart))
