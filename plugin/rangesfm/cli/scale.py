"""``rangesfm scale``: a model and ranges to the scale and the rescaled model."""

from __future__ import annotations

import argparse

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import (
    SCALE_KEYS,
    add_model_argument,
    add_survey_arguments,
    require_model,
    require_ranges,
    survey_from_arguments,
)
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "scale",
        execute,
        help="COLMAP model and ranges to the scale, with uncertainty and verdict",
        description="The scale of a COLMAP model (points are not needed) from ranges, and the rescaled model.",
        example="rangesfm scale --input_path sparse/0 --ranges uwb.csv --images images.csv --output_path out",
    )
    add_survey_arguments(parser, *SCALE_KEYS)
    add_model_argument(parser)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    survey = survey_from_arguments(args)
    require_model(survey)
    require_ranges(survey)
    from rangesfm.workflows.run import scale_model

    result = scale_model(survey, progress=progress)
    return Outcome(result.lines)
