"""``rangesfm refine``: a model and ranges to the refined metric model."""

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
        "refine",
        execute,
        help="COLMAP model and ranges to a refined metric model",
        description="Scale a COLMAP model by ranges, then adjust it with the ranges in its bundle adjustment. "
        "If that breaks the map, the scaled one is the result, and the reason is said.",
        example=(
            "rangesfm refine --input_path sparse/0 --ranges uwb.csv --anchors anchors.csv \\\n"
            "    --images images.csv --tag_in_cam -0.0012,-0.09,-0.0663 --output_path out"
        ),
    )
    add_survey_arguments(parser, *SCALE_KEYS, "camera.refine_intrinsics", "refine")
    add_model_argument(parser)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    survey = survey_from_arguments(args)
    require_model(survey)
    require_ranges(survey)
    from rangesfm.workflows.run import refine_model

    result = refine_model(survey, progress=progress)
    return Outcome(result.lines)
