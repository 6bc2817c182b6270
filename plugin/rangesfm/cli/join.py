"""``rangesfm join``: several surveys of one site to one map."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import add_flags, survey_from_arguments
from rangesfm.progress import Progress

_KEYS = (
    *("ranges.range_stddev_m", "ranges.range_bias_stddev_m", "ranges.common_bias_stddev_m", "anchors", "scale"),
    *("mapper.num_threads", "refine", "export", "report", "output"),
)
_OF_A_SURVEY = ("scale.up_in_first_camera", "scale.distances", "scale.markers")


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "join",
        execute,
        help="several surveys of one site to one metric map, through the anchors that they share",
        description=(
            "Result folders of surveys that share anchors (other days, other cameras with their own tags) to one map\n"
            "with one set of anchors; no common photo is needed. To the first one the others are joined. Anchors that\n"
            "nobody surveyed join them too, if each has three or more with the others that are not on a line."
        ),
        example="rangesfm join monday/out tuesday/out --output_path site",
    )
    parser.add_argument("results", nargs="*", metavar="RESULT", help="output folders of runs, two or more")
    add_flags(parser, *_KEYS, without=_OF_A_SURVEY)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    survey = survey_from_arguments(args)
    from rangesfm.workflows.join_surveys import join_surveys

    folders = [Path(result) for result in args.results]
    return Outcome(join_surveys(survey, folders, progress=progress).lines)
