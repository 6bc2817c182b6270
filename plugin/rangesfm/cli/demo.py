"""``rangesfm demo``: a small survey that comes with the package, and the pipeline on it."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import add_restart_argument
from rangesfm.errors import InputError
from rangesfm.progress import Progress

_DEFAULT_FOLDER = "rangesfm_demo"
_NUM_PHOTOS = range(10, 41)  # fewer do not make a map, more are not in the package


def add_commands(commands: Commands) -> None:
    parser = commands.add(
        "demo",
        execute,
        help="make a small survey and run the pipeline on it: no data needed",
        description="Make a small survey (photos that come with rangesfm, simulated UWB log, truth) and run it.",
        example="rangesfm demo my_demo",
    )
    parser.add_argument(
        "folder", nargs="?", default=_DEFAULT_FOLDER, metavar="DIR", help=f"where to (default: {_DEFAULT_FOLDER})"
    )
    parser.add_argument(
        "--num_photos", type=int, default=40, metavar="N", help="the first so many of 40 along the path (default: 40)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the radio and of the run (default: 0)")
    parser.add_argument("--num_threads", type=int, metavar="N", help="-1 for all cores")
    add_restart_argument(parser)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    if args.num_photos not in _NUM_PHOTOS:
        raise InputError(f"--num_photos is {args.num_photos}, expected {_NUM_PHOTOS[0]} to {_NUM_PHOTOS[-1]}")
    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}, expected 0 or more")
    from rangesfm.demo.survey import make_demo_survey
    from rangesfm.survey.settings import read_survey
    from rangesfm.workflows.run import run_survey

    folder = Path(args.folder)
    made = make_demo_survey(folder, num_photos=args.num_photos, seed=args.seed)
    overrides: dict[str, object] = {"output.seed": args.seed, "report.reference": folder / "reference.csv"}
    if args.num_threads is not None:
        overrides["mapper.num_threads"] = args.num_threads
    survey = read_survey(made.survey_path, overrides)
    result = run_survey(survey, progress=progress, restart=args.restart)
    return Outcome(result.lines)
